"""The joint filter for receivers that err for a while: it estimates their errors along with the positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.spherical import spherical
from ..world.v2x import FIX_AND_VELOCITY, Message
from .drift_state import Drift
from .egos import Estimate, follow_egos
from .joint_filter import add_edges, exact_edges
from .knowledge import Knowledge, resolve
from .star import StarStep, star_steps
from .track import Track


@dataclass(frozen=True, eq=False)
class DriftFilter:
    """`JointFilter` with the Gauss-Markov errors of the fixes in the state: z = x + drift + common + white noise.

    At K = 0 it is the solo Kalman filter with coloured noise. A receiver's own drift is told from the others' by the
    relative measurements; an error that all share is not, and stays. Without either error it equals `JointFilter`.

    Args:
        knowledge: "nominal", or a Knowledge with `sensors` that say how the fixes err.

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.2
    (prewhitening and augmentation for autocorrelated measurement noise).
    """

    knowledge: Knowledge | str = "nominal"
    name: str = "drift"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        return follow_egos(
            self, recording, egos, lambda ego, box: self._follow(recording, ego, box, known), missing=True
        )

    def _follow(self, recording: Recording, ego: int, box: Inbox, known: Knowledge) -> Iterator[Estimate]:
        sensors = known.sensors or recording.sensors
        drift = Drift.of(sensors, recording.dt)
        white = np.square(sensors.gnss_std) - known.gnss_variance if known.sensors else np.zeros(3)
        state: Floats = np.zeros((recording.runs, 0))
        spread: Floats = np.zeros((recording.runs, 0, 0))
        for star in star_steps(recording, ego, box, known):
            n = len(star.kept)
            spread = drift.carry(spread, star.kept, np.broadcast_to(star.process, star.moved.shape))
            state = drift.moved(state, star.kept) + _positions(state, star, drift)
            state, spread = update(state, spread, star, known, drift, white)
            x = state[:, : 3 * n].reshape(-1, n, 3)
            yield Estimate(star.step, x[:, 0], spread[:, :3, :3], star.links, x[:, 1:])


def _positions(state: Floats, star: StarStep, drift: Drift) -> Floats:
    """(R, size) predicted positions, zeros behind them: members move, who joins is where the ego sees it."""
    runs, n = len(star.fix), len(star.kept)
    x, stays = np.empty((runs, n, 3)), np.flatnonzero(star.kept >= 0)
    before = state[:, : 3 * (star.kept.max(initial=-1) + 1)].reshape(runs, -1, 3)
    x[:, stays] = before[:, star.kept[stays]] + star.moved[:, stays]
    if star.kept[0] < 0:
        x[:, 0] = star.fix[:, 0]
    joins = np.flatnonzero(star.kept[1:] < 0)
    x[:, 1 + joins] = x[:, :1] + star.vector[:, joins]
    return np.pad(x.reshape(runs, 3 * n), ((0, 0), (0, drift.size(n) - 3 * n)))


def update(
    state: Floats, spread: Floats, star: StarStep, known: Knowledge, drift: Drift, white: Floats
) -> tuple[Floats, Floats]:
    """A linear update with fixes and converted vectors, then one Gauss-Newton step on the exact measurements.

    Args:
        state: (R, size). spread: (R, size, size). white: (3,) m^2 to add to the star's variance of a fix, which counts
            all of a fix's error.
    """
    runs, n = len(state), len(star.kept)
    sees, at = drift.sees(n), slice(0, 3 * n)
    weight = np.where(star.heard[..., None], 1.0 / (star.fix_variance + white), 0.0).reshape(-1, 3 * n)
    information = np.linalg.inv(spread) + np.einsum("fi,rf,fj->rij", sees, weight, sees)
    gap = star.fix.reshape(runs, 3 * n) - state @ sees.T
    pull = (weight * np.where(weight > 0, gap, 0.0)) @ sees
    if n == 1:
        cov = np.linalg.inv(information)
        return state + (cov @ pull[..., None])[..., 0], cov
    x = state[:, at].reshape(runs, n, 3)
    expected = x[:, 1:] - x[:, :1]
    edge = np.linalg.inv(known.relative_cov(np.stack(spherical(*np.moveaxis(expected, -1, 0)), axis=-1)))
    linear, push = _with_edges(information, pull, edge, (edge @ (star.vector - expected)[..., None])[..., 0], n)
    moved = np.linalg.solve(linear, push[..., None])[..., 0]
    if not known.exact_relative:
        return state + moved, np.linalg.inv(linear)
    state = state + moved
    root, residual = exact_edges(state[:, at].reshape(runs, n, 3), star, known)
    back = np.swapaxes(root, -1, -2)
    pull = pull - np.einsum("rij,rj->ri", information, moved)
    information, pull = _with_edges(information, pull, back @ root, (back @ residual)[..., 0], n)
    cov = np.linalg.inv(information)
    return state + (cov @ pull[..., None])[..., 0], cov


def _with_edges(information: Floats, pull: Floats, weight: Floats, push: Floats, n: int) -> tuple[Floats, Floats]:
    """Information and pull with what the ego measured of its neighbours."""
    block, part = np.zeros((len(pull), 3 * n, 3 * n)), np.zeros((len(pull), 3 * n))
    add_edges(block, part, weight, push)
    information, pull = information.copy(), pull.copy()
    information[:, : 3 * n, : 3 * n] += block
    pull[:, : 3 * n] += part
    return information, pull
