"""The steps of a window as one ego has them, and the factors of what was measured in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ...arrays import Floats, Ints, number
from ...errors import InputError, shown
from ...world.links import to_vector
from ...world.recording import Recording, check_recording
from ...world.sensors import Sensors
from .factor import Factor


@runtime_checkable
class Noise(Protocol):
    """Protocol of a noise model; `coopoc.methods.noise_model.NoiseModel` is one."""

    @property
    def sensors(self) -> Sensors | None:
        """Relative noise in range and angles; None: unit covariance of the converted vector."""

    @property
    def gnss_variance(self) -> Floats:
        """(3,) m^2."""

    def process_variance(self, recording: Recording) -> Floats:
        """Of x_t given x_{t-1}, broadcastable to (R, T, N, 3), m^2."""


@dataclass(frozen=True, eq=False)
class WindowStep:
    """One step of the n members of a star, the ego first.

    NaN is what was not measured.

    Args:
        previous: (n,) index of each member in the previous step, -1 if it was not there.
        fix: (n, 3) m, GNSS.
        fix_std: (n, 3) m; infinite where the fix is not to be used.
        moved: (n, 3) m since the previous step.
        moved_std: (n, 3) m.
        relative: (n - 1, 3) m, rad, rad of the neighbours as the ego measures them.
    """

    previous: Ints
    fix: Floats
    fix_std: Floats
    moved: Floats
    moved_std: Floats
    relative: Floats


def window_factors(
    steps: Sequence[WindowStep], sensors: Sensors | None
) -> tuple[int, tuple[Factor, ...], tuple[int, ...]]:
    """Number of points, factors and separator of consecutive steps: a point per member and step.

    Args:
        steps: oldest first.
        sensors: relative noise of exact spherical factors; None: the converted vector has unit covariance, as the
            paper's identity baselines assume.
    """
    tops = np.concatenate([[0], np.cumsum([len(s.previous) for s in steps])])
    factors = _measured("position", np.arange(tops[-1])[:, None], *_joined([(s.fix, s.fix_std) for s in steps]))
    pairs, motions = [np.empty((0, 2), np.int64)], []
    for s, before, top in zip(steps[1:], tops, tops[1:], strict=False):
        stays = np.flatnonzero(s.previous >= 0)
        pairs.append(np.stack([before + s.previous[stays], top + stays], axis=1))
        motions.append((s.moved[stays], s.moved_std[stays]))
    if motions:
        factors += _measured("displacement", np.concatenate(pairs), *_joined(motions))
    counts = [len(s.previous) - 1 for s in steps]
    edges = np.stack([np.repeat(tops[:-1], counts), np.delete(np.arange(tops[-1]), tops[:-1])], axis=1)
    relative = np.concatenate([s.relative for s in steps])
    return int(tops[-1]), (*factors, *_relative(edges, relative, sensors)), tuple(tops[:-1].tolist())


def _relative(edges: Ints, relative: Floats, sensors: Sensors | None) -> list[Factor]:
    """Factors of range, azimuth and inclination (M, 3): of the three where all are there, else of what is."""
    whole = np.isfinite(relative).all(axis=1, keepdims=True)
    std = np.ones(3) if sensors is None else relative_std(relative, sensors)
    complete = np.where(whole, relative, np.nan)
    if sensors is None:
        factors = _measured("displacement", edges, to_vector(complete), std)
    else:
        factors = _measured("spherical", edges, complete, std)
    for k, kind in enumerate(() if whole.all() else ("range", "azimuth", "inclination")):
        factors += _measured(kind, edges, np.where(whole, np.nan, relative)[:, k, None], std[..., k, None])
    return factors


def _measured(kind: str, nodes: Ints, z: Floats, std: Floats) -> list[Factor]:
    """The factor of the rows that were measured."""
    rows = np.isfinite(z).all(axis=1)
    return [Factor(kind, nodes[rows], z[rows], std if std.ndim == 1 else std[rows])] if rows.any() else []


def relative_std(relative: Floats, sensors: Sensors) -> Floats:
    """Std (3,), or (M, 3) if a range is below `min_range`: that of its angles is inflated by min_range / range.

    Centres are never closer than `min_range`, so such a range is noise, and without this the angles would place the
    neighbour to the centimetre (`vector_cov` does the same).
    """
    ratio = np.fmax(sensors.min_range / relative[:, 0], 1.0)
    if (ratio == 1.0).all():
        return sensors.relative_std
    scale = np.stack([np.ones_like(ratio), ratio, ratio], axis=1)
    return np.minimum(scale * sensors.relative_std, [np.inf, np.pi, np.pi])


def _joined(parts: Sequence[tuple[Floats, Floats]]) -> Iterator[npt.NDArray[np.float64]]:
    return (np.concatenate(column) for column in zip(*parts, strict=True))


def recorded_steps(
    recording: Recording, step: int, ego: int | str, length: int, run: int, noise: Noise | None
) -> tuple[list[WindowStep], list[str]]:
    """The `length` steps that end at `step` with all that was measured, and the names of their points.

    Arguments and errors as `Problem.from_window`.
    """
    check_recording(recording)
    (column,) = recording.observing([ego])
    if noise is not None and not isinstance(noise, Noise):
        raise InputError("noise", shown(noise), "must be a noise model", "Give NoiseModel.nominal(sensors).")
    _check(recording, step, length, run)
    steps, names, before = [], [], np.empty(0, np.int64)
    if noise is None:
        gnss_std = np.array(recording.sensors.gnss_std)
        motion_std = recording.sensors.motion_std(recording.velocity[[run]], recording.dt)[0]
    else:
        gnss_std = np.sqrt(noise.gnss_variance)
        variance = np.broadcast_to(noise.process_variance(recording), recording.velocity.shape)
        motion_std = np.sqrt(variance[run])
    for s in range(step - length + 1, step + 1):
        links = recording.links.of(column)
        links = links[recording.links.step[links] == s]
        members = np.concatenate([[column], recording.links.neighbour[links]])
        previous = np.array([int(np.flatnonzero(before == m)[0]) if m in before else -1 for m in members])
        fix, velocity = recording.gnss[run, s, members], recording.velocity[run, s, members]
        moved_std = motion_std[s, members]
        fix_std, moved = np.broadcast_to(gnss_std, fix.shape), recording.dt * velocity
        steps.append(WindowStep(previous, fix, fix_std, moved, moved_std, recording.relative[run, links]))
        names += [recording.ids[m] if length == 1 else f"{recording.ids[m]}@{s}" for m in members]
        before = members
    return steps, names


def _check(recording: Recording, step: int, length: int, run: int) -> None:
    for name, value in (("step", step), ("length", length), ("run", run)):
        number(name, value, -(2**62), 2**62, kind=int, allowed="counted from 0", hint="Give a whole number.")
    if not 0 <= step < len(recording.t):
        raise InputError("step", step, f"must be in 0..{len(recording.t) - 1}", "The drive has no other steps.")
    if not 1 <= length <= step + 1:
        raise InputError("length", length, f"must be in 1..{step + 1} at step {step}", "Start later or shorten it.")
    if not 0 <= run < recording.runs:
        raise InputError("run", run, f"must be in 0..{recording.runs - 1}", "Or None for all at once.")
