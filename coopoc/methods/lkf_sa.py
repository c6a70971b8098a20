"""LKF-SA: the Laplacian Kalman filter over the star, in the identity form that the paper compares with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .knowledge import Knowledge, resolve
from .star import FORGOTTEN, StarStep, assumed_arrays, measured_arrays, star_steps
from .track import Track


@dataclass(frozen=True, eq=False)
class LaplacianKalman:
    """Per axis: z = [delta; gnss], H = [L; I], L the star's graph Laplacian, delta_i = -sum_j (x_j - x_i) as measured.

    With identity knowledge this is LKF-SA as the paper compares with it. Cov(delta) is sigma^2 L and not the diagonal
    used here, so no weighting of this form is right (methods.md section 3.5): `JointFilter(exact=False)` is. With other
    knowledge delta_i has variance deg_i times the mean per-axis variance of the converted vectors.

    Args:
        knowledge: "identity" (the paper), "nominal" or a Knowledge.
        transition: "identity"; "ones" propagates the covariance with blocks of ones as the authors' public code does.
        membership: "keep" the states of who stays; "reset" all at every change, as the public code does.
    """

    knowledge: Knowledge | str = "identity"
    transition: Literal["identity", "ones"] = "identity"
    membership: Literal["keep", "reset"] = "keep"
    name: str = "lkf-sa"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        for field, allowed in (("transition", ("identity", "ones")), ("membership", ("keep", "reset"))):
            if getattr(self, field) not in allowed:
                raise InputError(field, repr(getattr(self, field)), f"must be one of {allowed}", "Pick one.")

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        plain = self.transition == "identity" and self.membership == "keep"
        if plain and use_kernels() and recording.complete:
            return follow_egos(self, recording, egos, self._compiled(recording, known))
        return follow_egos(
            self, recording, egos, lambda ego, box: self._follow(recording, ego, box, known), missing=True
        )

    def _compiled(self, recording: Recording, known: Knowledge) -> Callable[[int, Inbox], Iterator[Estimate]]:
        """What `_follow` yields, as one estimate of all steps from compiled code."""
        from ..kernels.laplacian import follow

        assumed = assumed_arrays(recording, known)
        same = known.sensors is None and len(assumed[0]) == len(assumed[1]) == 1
        shared = same and not recording.v2x.loss  # a lone run that loses messages must not know that it is alone

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            alike = shared and bool((box.newest == box.newest[:1]).all() and (box.fresh == box.fresh[:1]).all())
            x, variance, neighbours = follow(measured_arrays(recording, ego, box), assumed, alike)
            yield Estimate(slice(None), x, variance[..., None] * np.eye(3), box.link, neighbours)

        return drive

    def _follow(self, recording: Recording, ego: int, box: Inbox, known: Knowledge) -> Iterator[Estimate]:
        state: Floats = np.empty((recording.runs, 0, 3))
        spread: Floats = np.empty((1, 3, 0, 0))
        for star in star_steps(recording, ego, box, known):
            state, spread = self._step(state, spread, star, edge_variance(star, known))
            own = spread[:, :, 0, 0, None] * np.eye(3)
            yield Estimate(star.step, state[:, 0], own, star.links, state[:, 1:])

    def _step(self, state: Floats, spread: Floats, star: StarStep, variance: Floats | None) -> tuple[Floats, Floats]:
        changed = len(star.kept) != state.shape[1] or bool((star.kept != np.arange(len(star.kept))).any())
        if self.membership == "reset" and changed:
            return self._restart(star)
        state, spread = self._predict(state, spread, star)
        return laplacian_update(state, spread, star, variance)

    def _predict(self, state: Floats, spread: Floats, star: StarStep) -> tuple[Floats, Floats]:
        """Per-axis prediction; spread is (R or 1, 3, n, n), shared by the runs while it does not depend on them."""
        n = len(star.kept)
        stays = np.flatnonzero(star.kept >= 0)
        old = star.kept[stays]
        variance = np.full((len(star.process), 3, n), FORGOTTEN)
        variance[:, :, stays] = np.swapaxes(star.process[:, stays], 1, 2)
        new_spread = np.repeat((variance[..., None] * np.eye(n)), max(1, len(spread) // len(variance)), axis=0)
        kept = spread[:, :, old[:, None], old]
        if self.transition == "ones":
            kept = np.broadcast_to(kept.sum(axis=(-2, -1), keepdims=True), kept.shape)
        new_spread[:, :, stays[:, None], stays] += kept
        new_state = np.empty((len(state), n, 3))
        new_state[:, stays] = state[:, old] + star.moved[:, stays]
        if star.kept[0] < 0:
            new_state[:, 0] = star.fix[:, 0]
        joins = np.flatnonzero(star.kept[1:] < 0)
        new_state[:, 1 + joins] = new_state[:, :1] + star.vector[:, joins]
        return new_state, new_spread

    def _restart(self, star: StarStep) -> tuple[Floats, Floats]:
        """argmin ||[L; I] x - z||^2 per axis and unit covariance, as the public code restarts."""
        n = len(star.kept)
        start = np.concatenate([star.fix[:, :1], star.fix[:, :1] + star.vector], axis=1)
        blank = np.broadcast_to(FORGOTTEN * np.eye(n), (1, 3, n, n))
        state, _ = laplacian_update(start, blank, star, None)
        return state, np.broadcast_to(np.eye(n), (1, 3, n, n))


def edge_variance(star: StarStep, known: Knowledge) -> Floats | None:
    """Mean per-axis variance (R,) m^2 of the star's converted vectors; None for unit variance of delta itself."""
    if known.sensors is None or len(star.links) == 0:
        return None
    return np.asarray(np.trace(known.relative_cov(star.relative), axis1=-2, axis2=-1).mean(axis=1) / 3)


def laplacian_update(state: Floats, spread: Floats, star: StarStep, variance: Floats | None) -> tuple[Floats, Floats]:
    """Update with delta and GNSS: Lambda = P^-1 + L W L + diag(1/r), W = 1 or 1/(deg variance).

    Args:
        state: (R, n, 3) m. spread: (R or 1, 3, n, n) m^2 per axis. variance: (R,) m^2 of an edge, or None for W = I.

    Returns:
        the same two after the update.
    """
    n = state.shape[1]
    degree = np.full(n, 1.0)
    degree[0] = n - 1.0
    laplacian = np.diag(degree if n > 1 else np.zeros(1))
    laplacian[0, 1:] = laplacian[1:, 0] = -1.0
    weight = np.ones((1, n)) if variance is None else 1.0 / (degree * variance[:, None])
    weighted = laplacian * weight[:, None]
    delta = np.concatenate([-star.vector.sum(axis=1, keepdims=True), star.vector], axis=1)
    fixes = np.where(star.heard[..., None], 1.0 / star.fix_variance, 0.0)
    fixes = fixes[:1] if star.heard.all() and len(star.fix_variance) == 1 else fixes
    information = np.linalg.inv(spread) + (weighted @ laplacian)[:, None]
    information = information + np.swapaxes(fixes, 1, 2)[..., None] * np.eye(n)
    cov = np.linalg.inv(information)
    pull = weighted @ (delta - laplacian @ state) + fixes * (star.fix - state)
    moved = (cov @ np.swapaxes(pull, 1, 2)[..., None])[..., 0]
    return state + np.swapaxes(moved, 1, 2), cov
