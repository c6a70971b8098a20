"""The factors of what was measured in a drive: of the star of an ego over a window of steps, or of a whole fleet."""

from typing import Protocol, runtime_checkable

import numpy as np

from ...arrays import Floats, Ints, whole
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

    def fix_variance(self, recording: Recording) -> Floats:
        """Of fixes, broadcastable to (R, T, N, 3), m^2."""

    def process_variance(self, recording: Recording) -> Floats:
        """Of x_t given x_{t-1}, broadcastable to (R, T, N, 3), m^2."""


def drive_factors(
    recording: Recording,
    run: int,
    points: tuple[Ints, Ints],
    link: Ints,
    relative: Floats,
    stds: tuple[Floats, Floats],
    sensors: Sensors | None,
) -> tuple[Factor, ...]:
    """Factors of fixes, of motions from step to step, and of relative measurements between points of a drive.

    Args:
        recording: of the measurements; NaN is what was not measured.
        run: noise realisation.
        points: step and column of each point.
        link: (M,) links both of whose ends are points.
        relative: (M, 3) m, rad, rad of them.
        stds: m, broadcastable to (T, N, 3), of fixes, infinite where one is not to be used, and of motions.
        sensors: relative noise of exact spherical factors; None: the converted vector has unit covariance, as the
            paper's identity baselines assume.
    """
    (step, member), links = points, recording.links
    number = np.full((len(recording.t), len(recording.ids)), -1)
    number[step, member] = here = np.arange(len(step))
    fix_std, motion_std = (np.broadcast_to(each, (*number.shape, 3))[step, member] for each in stds)
    before = np.where(step > 0, number[step - 1, member], -1)
    stays = before >= 0
    moved = recording.dt * recording.velocity[run, step, member]
    ends = np.column_stack([number[links.step[link], end[link]] for end in (links.observer, links.neighbour)])
    return (
        *_measured("position", here[:, None], recording.gnss[run, step, member], fix_std),
        *_measured("displacement", np.column_stack([before, here])[stays], moved[stays], motion_std[stays]),
        *_relative(ends, relative, sensors),
    )


def _relative(edges: Ints, relative: Floats, sensors: Sensors | None) -> list[Factor]:
    """Factors of range, azimuth and inclination (M, 3): of the three where all are there, else of what is."""
    std = np.ones(3) if sensors is None else relative_std(relative, sensors)
    kind, z = ("displacement", to_vector(relative)) if sensors is None else ("spherical", relative)
    factors = _measured(kind, edges, z, std)
    partial = np.where(np.isfinite(relative).all(axis=1, keepdims=True), np.nan, relative)
    for k, kind in enumerate(("range", "azimuth", "inclination")):
        factors += _measured(kind, edges, partial[:, k, None], std[..., k, None])
    return factors


def _measured(kind: str, nodes: Ints, z: Floats, std: Floats) -> list[Factor]:
    """The factor of the rows that were measured, if any were."""
    rows = np.isfinite(z).all(1)
    return [Factor(kind, nodes[rows], z[rows], std if std.ndim == 1 else std[rows])] if rows.any() else []


def relative_std(relative: Floats, sensors: Sensors) -> Floats:
    """Std (3,), or (M, 3) if a range is below `min_range`: that of its angles is inflated by min_range / range.

    Centres are never closer than `min_range`, so such a range is noise, and without this the angles would place the
    neighbour to the centimetre (`vector_cov` does the same).
    """
    ratio = np.fmax(sensors.min_range / relative[:, 0], 1.0)
    if (ratio == 1.0).all():
        return sensors.relative_std
    scale = np.column_stack([np.ones_like(ratio), ratio, ratio])
    return np.minimum(scale * sensors.relative_std, [np.inf, np.pi, np.pi])


def window(
    recording: Recording, step: int, ego: int | str, length: int, run: int, noise: Noise | None
) -> tuple[tuple[str, ...], tuple[Factor, ...], int]:
    """Names of the points of the `length` steps that end at `step`, the ego's first at each, their factors, and which
    is the ego's newest.

    Arguments and errors as `Problem.from_window`.
    """
    check_recording(recording)
    (column,) = recording.observing([ego])
    if noise is not None and not isinstance(noise, Noise):
        raise InputError("noise", shown(noise), "must be a noise model", "Give NoiseModel.nominal(sensors).")
    last, runs = len(recording.t) - 1, recording.runs
    whole("step", step, 0, last, "The drive has no other steps.")
    whole("length", length, 1, step + 1, "Take a later step or shorten it.")
    whole("run", run, 0, runs - 1, "A problem is one of the runs.")
    sensors: Sensors | None = recording.sensors
    if noise is None:
        fix_std = np.array(recording.sensors.gnss_std) * recording.fix_scale
        motion_std = recording.sensors.motion_std(recording.velocity[[run]], recording.dt)[0]
        motion_std = np.sqrt(motion_std**2 + recording.motion_extra)
    else:
        sensors, fix_std = noise.sensors, np.sqrt(noise.fix_variance(recording)[0])
        motion_std = np.sqrt(np.broadcast_to(noise.process_variance(recording), recording.velocity.shape)[run])
    first, links = step - length + 1, recording.links
    link = links.of(column)
    link = link[(links.step[link] >= first) & (links.step[link] <= step)]
    steps = np.concatenate([np.arange(first, step + 1), links.step[link]])
    order = np.argsort(steps, kind="stable")
    member = np.concatenate([np.full(length, column), links.neighbour[link]])[order]
    stds, relative = (fix_std, motion_std), recording.relative[run, link]
    factors = drive_factors(recording, run, (steps[order], member), link, relative, stds, sensors)
    ids = [recording.ids[m] for m in member]
    names = ids if length == 1 else [f"{name}@{s}" for name, s in zip(ids, steps[order], strict=True)]
    return tuple(names), factors, int(np.flatnonzero(member == column)[-1])
