"""The joint cooperative filter: ego and neighbours in one state, with one exact Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..kernels.compile import use_kernels
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.spherical import spherical
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .knowledge import Knowledge, resolve
from .network import whitened
from .star import FORGOTTEN, StarStep, assumed_arrays, measured_arrays, rows, star_steps
from .star_stream import Advance, StarStream
from .stream import alone
from .track import Track


@dataclass(frozen=True, eq=False)
class JointFilter:
    """Kalman filter of the star {ego} + neighbours in information form; axes couple through the relative covariances.

    Lambda = P^-1 + blkdiag(GNSS^-1) + B blkdiag(C_e^-1) B^T with C_e the rotated covariance of the converted vector
    (methods.md section 3.5) at the predicted geometry: at the measured one the weight would depend on the noise. Then,
    if `exact`, one Gauss-Newton step on (range, azimuth, inclination) themselves, which is within 3e-5 of the
    maximum-likelihood cost (performance.md section 1.1). Who joins or leaves resets nobody else.

    Args:
        knowledge: "identity", "nominal" or a Knowledge. exact: False stops at the linear update (LKF-SA's edge form).
    """

    knowledge: Knowledge | str = "nominal"
    exact: bool = True
    name: str = "joint"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        if use_kernels() and recording.complete:
            return follow_egos(self, recording, egos, self._compiled(recording, known))
        return follow_egos(
            self, recording, egos, lambda ego, box: self._follow(recording, ego, box, known), missing=True
        )

    def _compiled(self, recording: Recording, known: Knowledge) -> Callable[[int, Inbox], Iterator[Estimate]]:
        """What `_follow` yields, as one estimate of all steps from compiled code."""
        from ..kernels.star_filter import follow

        assumed, exact = assumed_arrays(recording, known), self.exact and known.exact_relative

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            x, cov, neighbours = follow(measured_arrays(recording, ego, box), assumed, exact)
            yield Estimate(slice(None), x, cov, box.link, neighbours)

        return drive

    def _follow(self, recording: Recording, ego: int, box: Inbox, known: Knowledge) -> Iterator[Estimate]:
        state: Floats = np.empty((recording.runs, 0, 3))
        spread: Floats = np.empty((recording.runs, 0, 0))
        advance = self._advance(known)
        for star in star_steps(recording, ego, box, known):
            state, spread = advance(state, spread, star)
            yield Estimate(star.step, state[:, 0], spread[:, :3, :3], star.links, state[:, 1:])

    def start(
        self, x0: npt.ArrayLike | None = None, *, interval: float = 0.1, history: float = 10.0, max_age: float = 1.0
    ) -> StarStream:
        """The filter that is fed step by step: `step(gnss, velocity, dt, fix_age, neighbours=[Sighting(...)])`.

        Args:
            x0, interval, history: as in `Kalman.start`. max_age: s, older messages of neighbours are forgotten.

        >>> from coopoc.methods.star_stream import Sighting
        >>> ego = JointFilter("identity").start()
        >>> seen = Sighting("b", [9.0, 0.0, np.pi / 2], gnss=[10.0, 0.0, 0.0], velocity=[9.0, 0.0, 0.0])
        >>> x, _ = ego.step([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, neighbours=[seen])
        >>> float(x[0].round(3)), float(ego.neighbours["b"][0].round(3))  # the fixes say 10 m, the sighting 9 m
        (0.333, 9.667)
        """
        known = alone(self.knowledge)
        return StarStream(self._advance(known), known, x0, interval, history, max_age)

    def _advance(self, known: Knowledge) -> Advance:
        def advance(state: Floats, spread: Floats, star: StarStep) -> tuple[Floats, Floats]:
            state, spread = predict(state, spread, star)
            return update(state, spread, star, known, self.exact and known.exact_relative)

        return advance


def predict(state: Floats, spread: Floats, star: StarStep) -> tuple[Floats, Floats]:
    """Members that stay move with their velocity; who has left is marginalised, who joins starts at the ego's sighting.

    Args:
        state: (R, m, 3) m. spread: (R, 3m, 3m) m^2 of the previous star.

    Returns:
        (R, n, 3), (R, 3n, 3n) of this star.
    """
    runs, n = len(star.fix), len(star.kept)
    stays = np.flatnonzero(star.kept >= 0)
    old = star.kept[stays]
    new_state = np.empty((runs, n, 3))
    new_state[:, stays] = state[:, old] + star.moved[:, stays]
    variance = np.full((runs, n, 3), FORGOTTEN)
    variance[:, stays] = star.process[:, stays]
    new_spread = variance.reshape(runs, 3 * n)[:, :, None] * np.eye(3 * n)
    here, there = rows(stays), rows(old)
    new_spread[:, here[:, None], here] += spread[:, there[:, None], there]
    if star.kept[0] < 0:
        new_state[:, 0] = star.fix[:, 0]
    joins = np.flatnonzero(star.kept[1:] < 0)
    new_state[:, 1 + joins] = new_state[:, :1] + star.vector[:, joins]
    return new_state, new_spread


def update(state: Floats, spread: Floats, star: StarStep, known: Knowledge, exact: bool) -> tuple[Floats, Floats]:
    """A linear update with fixes and converted vectors, then, if `exact`, one Gauss-Newton step."""
    n = state.shape[1]
    prior = np.linalg.inv(spread)
    information, pull = prior.copy(), np.zeros((len(state), 3 * n))
    weight = np.where(star.heard[..., None], 1.0 / star.fix_variance, 0.0)
    diagonal = np.arange(3 * n)
    information[:, diagonal, diagonal] += weight.reshape(-1, 3 * n)
    pull += (weight * (star.fix - state)).reshape(-1, 3 * n)
    if n == 1:
        cov = np.linalg.inv(information)
        return state + (cov @ pull[..., None])[..., 0].reshape(state.shape), cov
    expected = state[:, 1:] - state[:, :1]
    edge = np.linalg.inv(known.relative_cov(np.stack(spherical(*np.moveaxis(expected, -1, 0)), axis=-1)))
    linear, linear_pull = information.copy(), pull.copy()
    gap = star.vector - expected
    add_edges(linear, linear_pull, edge, (edge @ gap[..., None])[..., 0])
    if not exact:
        cov = np.linalg.inv(linear)
        return state + (cov @ linear_pull[..., None])[..., 0].reshape(state.shape), cov
    moved = np.linalg.solve(linear, linear_pull[..., None])[..., 0]
    point = state + moved.reshape(state.shape)
    root, residual = exact_edges(point, star, known)
    pull = pull - np.einsum("rij,rj->ri", information, moved)
    add_edges(information, pull, np.swapaxes(root, -1, -2) @ root, (np.swapaxes(root, -1, -2) @ residual)[..., 0])
    cov = np.linalg.inv(information)
    return point + (cov @ pull[..., None])[..., 0].reshape(state.shape), cov


def add_edges(information: Floats, pull: Floats, weight: Floats, push: Floats) -> None:
    """Add in place the information (R, k, 3, 3) and the pull (R, k, 3) of measured x_j - x_ego for k neighbours."""
    runs, k = push.shape[:2]
    blocks = information.reshape(runs, k + 1, 3, k + 1, 3)
    j = np.arange(1, k + 1)
    blocks[:, 0, :, 0] += weight.sum(axis=1)
    per_edge = np.moveaxis(weight, 1, 0)
    blocks[:, j, :, j] += per_edge
    blocks[:, 0, :, j] -= per_edge
    blocks[:, j, :, 0] -= per_edge
    pull[:, :3] -= push.sum(axis=1)
    pull[:, 3:] += push.reshape(runs, 3 * k)


def exact_edges(point: Floats, star: StarStep, known: Knowledge) -> tuple[Floats, Floats]:
    """Whitened Jacobian (R, k, 3, 3) by x_j - x_ego and residual (R, k, 3, 1) of range, azimuth and inclination."""
    root, residual = whitened(point[:, 1:] - point[:, :1], star.relative, known)
    return root, residual[..., None]
