"""Innovations: how well a method predicts the next fix, which needs no truth."""

from __future__ import annotations

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..methods.track import Track
from ..world.body_frames import turned
from ..world.recording import Recording


def fix_innovations(track: Track, recording: Recording) -> Floats:
    """Fix less prediction, z_t - (x_{t-1} + dt u_t), (R, T, E, 3) m; NaN without a fix, and at the first step.

    In body frames u_t is turned by the heading in the middle of the step, h_{t-1} + dt w_t / 2.

    Args:
        track: of the recording.
        recording: whose fixes and velocities were used.

    >>> from coopoc import GNSS, Fleet, Sensors, observe
    >>> seen = observe(Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3))), Sensors(), runs=5)
    >>> fix_innovations(GNSS()(seen), seen).shape
    (5, 2, 1, 3)
    """
    egos = list(track.egos)
    found = np.full(track.x.shape, np.nan)
    moved = recording.dt * turned(recording.velocity[:, 1:, egos], _halfway(track, recording))
    found[:, 1:] = recording.gnss[:, 1:, egos] - (track.x[:, :-1] + moved)
    return found


def normalised_innovations(track: Track, recording: Recording) -> Floats | None:
    """d^T S^-1 d / n of the innovations d, (R, T, E): 1 on average if the assumed noise is right and white.

    S = P_{t-1} + dt^2 diag(sigma_u^2) + diag(sigma_fix^2), with the standard deviations that the recording states and
    its `dimensions` n. In body frames sigma_u is turned as u is, and the heading of the track adds its part of S.

    Returns:
        None for a method without a covariance.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
    """
    if track.covariance is None:
        return None
    egos, noise = list(track.egos), recording.sensors
    innovation = fix_innovations(track, recording)
    u, angle = recording.velocity[:, 1:, egos], _halfway(track, recording)
    axes = turned(np.eye(3), angle[..., None])  # rows: the axes of sigma_u
    moving = recording.dt * np.nan_to_num(noise.assumed_velocity_std(u))[..., None] * axes
    covariance = track.covariance[:, :-1] + np.einsum("...ki,...kj->...ij", moving, moving)
    covariance[..., range(3), range(3)] += np.square(noise.fix_std)
    if track.heading_covariance is not None:
        shared, variance = track.heading_covariance[:, :-1, :, :3], track.heading_covariance[:, :-1, :, 3, None, None]
        aside = recording.dt * np.nan_to_num(turned(u, angle + np.pi / 2) * [1.0, 1.0, 0.0])
        cross = shared[..., :, None] * aside[..., None, :]
        covariance += cross + np.swapaxes(cross, -1, -2) + variance * aside[..., :, None] * aside[..., None, :]
    there: Bools = np.asarray(np.isfinite(innovation[:, 1:]).all(axis=-1))
    found = np.full(innovation.shape[:3], np.nan)
    d = np.where(there[..., None], innovation[:, 1:], 0.0)
    square = np.einsum("...i,...i->...", d, np.linalg.solve(covariance, d[..., None])[..., 0])
    found[:, 1:] = np.where(there, square / dimensions(recording), np.nan)
    return found


def _halfway(track: Track, recording: Recording) -> Floats:
    """(R, T-1, E) rad from the frame of odometry to the world in the middle of each step; 0 in the world frame."""
    if recording.body is None or track.heading is None:
        return np.zeros(track.x[:, 1:, :, 0].shape)
    return track.heading[:, :-1] + 0.5 * recording.dt * recording.body.yaw_rate[:, 1:, list(track.egos)]


def dimensions(recording: Recording) -> int:
    """Degrees of freedom of a fix: 3, or 2 where every fix has the same height, which was not measured then.

    >>> from coopoc import Fleet, Sensors, observe
    >>> dimensions(observe(Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3))), Sensors()))
    3
    """
    height = recording.gnss[..., 2]
    return 3 if np.nanmax(height) > np.nanmin(height) else 2


def innovation_columns(track: Track, recording: Recording) -> dict[str, Floats]:
    """Columns (R, E): `innovation_m`, the root mean square of the fixes' innovations, m; `fixes`, their number; `nis`,
    the mean of the normalised ones, 1 if consistent, of a method with a covariance. NaN where there is no second fix.
    """
    innovation = fix_innovations(track, recording)
    there = np.isfinite(innovation[..., 0])
    count = there.sum(axis=1)
    level = np.where(there, (np.nan_to_num(innovation) ** 2).sum(axis=-1), 0.0).sum(axis=1)
    found = {"innovation_m": np.sqrt(_mean(level, count)), "fixes": count.astype(float)}
    each = normalised_innovations(track, recording)
    if each is not None:
        found["nis"] = _mean(np.nan_to_num(each).sum(axis=1), count)
    return found


def _mean(total: Floats, count: Ints) -> Floats:
    return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))
