"""Recordings whose odometry fails: as fixes correct it (`coopoc.kernels.odometry_fault`)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..kernels.odometry_fault import correct_drives, new_state
from ..world.links import stretches
from ..world.recording import Recording
from .noise_model import NoiseModel, motion_noise

NOTE = "odometry, {}:"


def when(t: Floats, marked: Bools) -> str:
    """The first three stretches of marked steps, and how many more there are.

    >>> when(np.arange(4.0), np.array([True, True, False, True]))
    '(0 to 1, 3 to 3 s)'
    """
    times = [f"{round(t[a], 3):.13g} to {round(t[b - 1], 3):.13g}" for a, b in stretches(marked)]
    return f"({', '.join(times[:3])} s{f', and {len(times) - 3} times more' * (len(times) > 3)})"


def with_odometry(
    recording: Recording, egos: Sequence[int], noise_model: NoiseModel, fix: float = 1.0
) -> tuple[Recording, NoiseModel]:
    """The recording with corrected velocities of vehicles whose odometry fails, and the noise model with the noise of
    these and a note. Both are returned unchanged where there are no `faults`.

    Args:
        recording: in the world frame.
        egos: columns that are followed; their neighbours correct what they send.
        noise_model: of the method.
        fix: factor of the standard deviation of fixes.
    """
    links = recording.links
    corrections = faults(recording, np.union1d(egos, links.neighbour[np.isin(links.observer, egos)]), noise_model, fix)
    if corrections is None:
        return recording, noise_model
    velocity, extra = recording.velocity.copy(), corrections[..., 2]
    velocity[..., :2] += corrections[..., :2]
    notes = [*noise_model.notes]
    for name, steps in zip(recording.ids, failed(corrections, recording.dt).T, strict=True):
        if steps.any():
            notes.append(f"{NOTE.format(name)} fails, or its fixes drift; they correct it {when(recording.t, steps)}")
    corrected_recording = replace(recording, velocity=velocity)
    notes.extend(note for note in recording.unlikely if note not in corrected_recording.unlikely)
    return corrected_recording, replace(noise_model, extra=extra, notes=tuple(notes))


def faults(recording: Recording, columns: Ints, noise_model: NoiseModel, fix: float = 1.0) -> Floats | None:
    """(R, T, N, 3) what corrects the odometry of some columns where fixes show that it fails: velocities east and north
    m/s, and by how much the variance of a motion is larger m^2. None where no odometry fails or no noise is stated.

    Args:
        recording: in the world frame.
        columns: of the vehicles.
        noise_model: that is assumed.
        fix: factor of the standard deviation of fixes.
    """
    sensors = noise_model.sensors
    if sensors is None or noise_model.fleet is not None:
        return None
    columns = np.setdiff1d(columns, recording.landmarks + recording.shown)
    gnss, velocity = np.ascontiguousarray(recording.gnss), np.ascontiguousarray(recording.velocity)
    fresh = new_state(motion_noise(noise_model, recording.dt))
    drives = gnss, velocity, fresh, recording.fix_scale**2 * (fix**2 * noise_model.gnss_variance), columns, recording.dt
    if not correct_drives(*drives, np.empty((0, 0, 0, 3))):
        return None
    corrections = np.zeros(velocity.shape)
    correct_drives(*drives, corrections)
    return corrections


def failed(corrections: Floats, dt: float) -> Bools:
    """(T, N) when odometry fails in any run: where a correction of `faults` is larger than its deviation, or, of a
    vehicle in a run in which none is, wherever there is one."""
    sure = np.square(dt * corrections[..., :2]).sum(-1) > corrections[..., 2]
    return np.asarray(np.where(sure.any(axis=1, keepdims=True), sure, corrections[..., 2] > 0.0).any(0))
