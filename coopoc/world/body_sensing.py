"""What vehicles measure in their own frames: speed, yaw rate, compass, bearings from the heading."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats
from .body import Body
from .fleet import Fleet
from .frames import body_motion, true_heading
from .links import Links
from .noise import stream
from .sensors import Sensors
from .spherical import wrap


def body_measurements(fleet: Fleet, sensors: Sensors, runs: int, seed: int) -> tuple[Floats, Body]:
    """Velocity (R, T, N, 3) m/s forward, left and up, yaw rate and compass heading in R runs.

    u = (1 + s) u_true + n, w = w_true + b + n, with s and b Gauss-Markov of `odometry_error_time`; the noise of u takes
    the draws of a velocity in the world. Each error has a stream of its own: adding one changes no other draws.

    Args:
        fleet: the truth.
        sensors: the noise that acts.
        runs: R.
        seed: of all draws.
    """
    motion, rate = body_motion(fleet)
    heading, noise = true_heading(fleet), sensors.velocity_std(motion)
    velocity, yaw = np.empty((runs, *motion.shape)), np.empty((runs, *rate.shape))
    compass = np.full(yaw.shape, np.nan)
    for r in range(runs):
        scale = _lasting(fleet, "speed_scale", sensors.speed_scale_std, sensors, (seed, r))
        bias = _lasting(fleet, "yaw_rate_bias", sensors.yaw_rate_bias_std, sensors, (seed, r))
        velocity[r] = motion * (1.0 + scale[..., None]) + noise * _normals(fleet, "velocity", (seed, r), 3)
        yaw[r] = rate + bias + sensors.yaw_rate_std * _normals(fleet, "yaw_rate", (seed, r))
        if sensors.compass:
            compass[r] = heading + sensors.heading_std * _normals(fleet, "heading", (seed, r))
            compass[r] += sensors.heading_bias_std * _normals(fleet, "heading_bias", (seed, r))[:1]
    return velocity, Body(yaw, wrap(compass))


def in_body(relative: Floats, fleet: Fleet, links: Links, turned: Floats) -> Floats:
    """Measurements (R, L, 3) m, rad, rad with azimuths in the world, as seen from the observers' headings.

    Args:
        relative: with the observers' compass errors in them.
        fleet: the truth.
        links: L of them.
        turned: (R, L) rad, these errors, which a bearing does not have.
    """
    found = relative.copy()
    found[..., 1] = wrap(found[..., 1] - turned - true_heading(fleet)[links.step, links.observer])
    return found


def _normals(fleet: Fleet, sensor: str, at: tuple[int, int], *size: int) -> Floats:
    """(T, N, ...) standard normals, a stream per vehicle."""
    draws = [stream(at[0], sensor, at[1], name).standard_normal((len(fleet.t), *size)) for name in fleet.ids]
    return np.stack(draws, axis=1)


def _lasting(fleet: Fleet, sensor: str, std: float, sensors: Sensors, at: tuple[int, int]) -> Floats:
    """(T, N) of an error that lasts."""
    if not std:
        return np.zeros((len(fleet.t), len(fleet.ids)))
    return std * gauss_markov(_normals(fleet, sensor, at), fleet.dt / sensors.odometry_error_time)


def gauss_markov(normals: Floats, steps: float) -> Floats:
    """Stationary e_t = a e_{t-1} + sqrt(1 - a^2) w_t of unit variance from normals w (T, ...), a = exp(-steps).

    Args:
        steps: time between samples over the correlation time.

    >>> gauss_markov(np.ones((3, 1)), 0.0).ravel()
    array([1., 1., 1.])
    """
    keep = np.exp(-steps)
    fresh = np.sqrt(-np.expm1(-2.0 * steps))
    error = normals.copy()
    for t in range(1, len(error)):
        error[t] = keep * error[t - 1] + fresh * normals[t]
    return np.asarray(error)
