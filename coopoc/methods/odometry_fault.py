"""Recordings whose odometry fails: as fixes correct it (`coopoc.kernels.odometry_fault`)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..kernels.odometry_fault import correct_drives, new_state
from ..world.recording import Recording
from .doubts import when
from .noise_model import NoiseModel, motion_noise


def with_odometry(
    recording: Recording, egos: Sequence[int], noise_model: NoiseModel, fix: float = 1.0
) -> tuple[Recording, NoiseModel]:
    """The recording with corrected velocities of vehicles whose odometry fails, and the noise model with the noise of
    these and a note. Both are returned unchanged where no odometry fails, no noise is stated, or velocities were
    derived from fixes.

    Args:
        recording: in the world frame.
        egos: columns that are followed; their neighbours correct what they send.
        noise_model: of the method.
        fix: factor of the standard deviation of fixes.
    """
    sensors, links = noise_model.sensors, recording.links
    if sensors is None or noise_model.fleet is not None or sensors.velocity_reading == "fixes":
        return recording, noise_model
    columns = np.union1d(egos, links.neighbour[np.isin(links.observer, egos)])
    more = recording.motion_extra[:, columns, 0]  # as uncertain at every step: fixes alone show the velocity
    columns = columns[~np.isin(columns, recording.landmarks) & ~((more[0] > 0.0) & (np.ptp(more, axis=0) == 0.0))]
    gnss, velocity = np.ascontiguousarray(recording.gnss), np.ascontiguousarray(recording.velocity)
    fresh = new_state(motion_noise(noise_model, recording.dt))
    variance = recording.fix_scale**2 * (fix**2 * noise_model.gnss_variance)
    drives = gnss, velocity, fresh, variance, columns, recording.dt
    if not correct_drives(*drives, np.empty((0, 0, 0, 3))):
        return recording, noise_model
    corrections = np.zeros(velocity.shape)
    correct_drives(*drives, corrections)
    velocity, extra = velocity.copy(), corrections[..., 2]
    velocity[..., :2] += corrections[..., :2]
    notes = [*noise_model.notes]
    for n in columns.tolist():
        if (failed := np.asarray((extra[:, :, n] > 0).any(axis=0))).any():
            text = f"odometry, {recording.ids[n]}: fails, or its fixes drift; they correct it"
            notes.append(f"{text} {when(recording.t, failed)}")
    corrected_recording = replace(recording, velocity=velocity)
    notes.extend(note for note in recording.unlikely if note not in corrected_recording.unlikely)
    return corrected_recording, replace(noise_model, extra=extra, notes=tuple(notes))
