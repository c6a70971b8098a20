"""Sights: what one ego holds of its star at each step, and the snapshot or window problem that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from ..world.recording import Recording
from ..world.sensors import Sensors
from ..world.spherical import to_vector
from .factor import Factor
from .problem import Problem


class Noise(Protocol):
    """What is assumed of the noise; `coopoc.methods.Knowledge` is one."""

    @property
    def sensors(self) -> Sensors | None:
        """Relative noise in range and angles; None: unit covariance of the converted vector."""

    @property
    def gnss_variance(self) -> Floats:
        """(3,) m^2."""

    def process_variance(self, recording: Recording) -> Floats:
        """Of x_t given x_{t-1}, broadcastable to (R, T, N, 3), m^2."""


@dataclass(frozen=True, eq=False)
class Sight:
    """One step of the n members of a star, the ego first, in one (no leading axis) or B realisations.

    Args:
        kept: (n,) place of each member in the previous sight, -1 if it was not there.
        fix, fix_std: (B, n, 3) m; an infinite std where there is none.
        moved, moved_std: (B, n, 3) m since the previous step.
        relative: (B, n - 1, 3) m, rad, rad of the neighbours as the ego sees them.
    """

    kept: Ints
    fix: Floats
    fix_std: Floats
    moved: Floats
    moved_std: Floats
    relative: Floats


def chain(sights: Sequence[Sight], sensors: Sensors | None, names: Sequence[str] | None = None) -> Problem:
    """The problem of consecutive sights: a point per member and step, the ego's points being the hub.

    Args:
        sights: oldest first. sensors: relative noise of exact spherical factors; None: the converted vector has unit
            covariance, as the paper's identity baselines assume.
        names: of the points, step by step; default their numbers.
    """
    top = np.concatenate([[0], np.cumsum([len(s.kept) for s in sights])])
    fix, fix_std = _joined(sights, "fix", "fix_std")
    factors = [Factor("position", np.arange(top[-1])[:, None], fix, fix_std)]
    stays = [np.flatnonzero(s.kept >= 0) for s in sights[1:]]
    if stays:
        pairs = np.concatenate([np.stack([top[k] + s.kept[i], top[k + 1] + i], axis=1)
                                for k, (s, i) in enumerate(zip(sights[1:], stays, strict=True))])  # fmt: skip
        moved = np.concatenate([s.moved[..., i, :] for s, i in zip(sights[1:], stays, strict=True)], axis=-2)
        std = np.concatenate([s.moved_std[..., i, :] for s, i in zip(sights[1:], stays, strict=True)], axis=-2)
        factors.append(Factor("displacement", pairs, moved, std))
    edges = np.concatenate([np.stack([np.full(len(s.kept) - 1, a), a + 1 + np.arange(len(s.kept) - 1)], axis=1)
                            for s, a in zip(sights, top[:-1], strict=True)])  # fmt: skip
    if len(edges):
        relative = np.concatenate([s.relative for s in sights], axis=-2)
        factors.append(
            Factor("displacement", edges, to_vector(relative), np.ones(3)) if sensors is None
            else Factor("spherical", edges, relative, relative_std(relative, sensors))
        )  # fmt: skip
    hub = tuple(int(a) for a in top[:-1])
    return Problem(tuple(names or map(str, range(top[-1]))), tuple(factors), hub=hub)


def relative_std(relative: Floats, sensors: Sensors) -> Floats:
    """Std (3,), or (..., M, 3) if a range is below `min_range`: its angles are widened by min_range / d.

    Centres are never closer than `min_range`, so that such a range is noise, and without this the angles would place
    the neighbour to the centimetre (performance.md G1 of the design notes; `vector_cov` does the same).
    """
    wide = np.maximum(sensors.min_range / relative[..., 0], 1.0)
    if (wide == 1.0).all():
        return sensors.relative_std
    scale = np.stack([np.ones_like(wide), wide, wide], axis=-1)
    limit = np.array([np.inf, np.pi, np.pi])
    widened: Floats = np.minimum(scale * sensors.relative_std, limit)
    return widened


def _joined(sights: Sequence[Sight], *fields: str) -> list[Floats]:
    return [np.concatenate([getattr(s, field) for s in sights], axis=-2) for field in fields]


def window_problem(
    recording: Recording, step: int, ego: int | str, length: int, run: int | None, noise: Noise | None
) -> Problem:
    """Problem of the `length` steps that end at `step`, from all that was measured (see Problem.from_window)."""
    column = recording.columns([ego])[0]
    _check(recording, step, length, run)
    sights, names, before = [], [], np.empty(0, np.int64)
    for s in range(step - length + 1, step + 1):
        links = recording.links.of(column)
        links = links[recording.links.step[links] == s]
        members = np.concatenate([[column], recording.links.neighbour[links]])
        kept = np.array([int(np.flatnonzero(before == m)[0]) if m in before else -1 for m in members])
        sights.append(_sight(recording, s, members, kept, links, run, noise))
        names += [recording.ids[m] if length == 1 else f"{recording.ids[m]}@{s}" for m in members]
        before = members
    return chain(sights, recording.sensors if noise is None else noise.sensors, names)


def _sight(
    recording: Recording, step: int, members: Ints, kept: Ints, links: Ints, run: int | None, noise: Noise | None
) -> Sight:
    runs = slice(None) if run is None else run
    fix, velocity = recording.gnss[runs, step, members], recording.velocity[runs, step, members]
    if noise is None:
        fix_std = np.array(recording.sensors.gnss_std)
        moved_std = recording.dt * recording.sensors.assumed_velocity_std(velocity)
    else:
        fix_std = np.sqrt(noise.gnss_variance)
        variance = np.broadcast_to(noise.process_variance(recording), recording.velocity.shape)
        moved_std = np.sqrt(variance[runs, step, members])
    return Sight(
        kept, fix, np.broadcast_to(fix_std, fix.shape), recording.dt * velocity, moved_std,
        recording.relative[runs, links],
    )  # fmt: skip


def _check(recording: Recording, step: int, length: int, run: int | None) -> None:
    if not 0 <= step < len(recording.t):
        raise InputError("step", step, f"must be in 0..{len(recording.t) - 1}", "The drive has no other steps.")
    if not 1 <= length <= step + 1:
        raise InputError("length", length, f"must be in 1..{step + 1} at step {step}", "Start later or shorten it.")
    if run is not None and not 0 <= run < recording.runs:
        raise InputError("run", run, f"must be in 0..{recording.runs - 1}", "Or None for all at once.")
