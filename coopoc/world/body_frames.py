"""Body frames: headings, motion, yaw rate, compass and bearings in a vehicle's own frame, and back to the world."""

from dataclasses import replace

import numpy as np
from numpy import nan, pi

from ..arrays import TINY, Floats
from ..errors import InputError
from .fleet import Fleet
from .links import Links, wrap
from .recording import Body, Recording, check_recording
from .sensors import Sensors, stream

STANDING_SPEED_M_S = 0.1
"""m/s, below which a vehicle keeps its heading: the course of one that stands is noise."""


def true_heading(fleet: Fleet) -> Floats:
    """(T, N) rad, unwrapped: the fleet's own, else the course, halfway between those of the steps before and after.

    A vehicle that stands keeps the course it came with; before it first moves it has the one it leaves with.

    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[0, 2, 0]]], [[[0, 2, 0]], [[0, 2, 0]]])
    >>> true_heading(fleet).round(3).ravel().tolist()
    [1.571, 1.571]
    """
    if fleet.heading is not None:
        return fleet.heading
    x, y = fleet.velocity[..., 0], fleet.velocity[..., 1]
    course = np.where(np.hypot(x, y) >= STANDING_SPEED_M_S, np.arctan2(y, x), nan)
    for column in course.T:
        finite = np.flatnonzero(np.isfinite(column))
        held = np.searchsorted(finite, np.arange(len(column)), side="right") - 1
        column[:] = np.unwrap(column[finite])[np.maximum(held, 0)] if len(finite) else 0.0
    course[1:-1] = (course[1:-1] + course[2:]) / 2
    return np.where(fleet.present, course, nan)


def turned(vector: Floats, angle: Floats) -> Floats:
    """Vectors (..., 3) turned by angles (...) rad about z.

    >>> turned(np.array([1.0, 0, 2]), np.array(np.pi / 2)).round(3).tolist()
    [0.0, 1.0, 2.0]
    """
    (x, y, z), cos, sin = np.moveaxis(vector, -1, 0), np.cos(angle), np.sin(angle)
    return np.stack(np.broadcast_arrays(cos * x - sin * y, sin * x + cos * y, z), -1)


def midway(heading: Floats) -> Floats:
    """(..., T, N) rad, the heading in the middle of the step that ends at t; that of the first step at its end.

    A step after a missing heading takes the one at its end.

    >>> midway(np.array([[0.0], [1.0], [np.nan]])).ravel().tolist()
    [0.0, 0.5, nan]
    """
    before = np.concatenate([heading[..., :1, :], heading[..., :-1, :]], -2)
    return np.asarray(heading - wrap(heading - np.where(np.isnan(before), heading, before)) / 2)


def body_motion(fleet: Fleet) -> tuple[Floats, Floats]:
    """True velocity (T, N, 3) m/s, forward, left and up, and yaw rate (T, N) rad/s over the step that ends at t."""
    heading = true_heading(fleet)
    change = np.nan_to_num(np.diff(heading, axis=0, prepend=heading[:1]))
    turns = np.round(change / (2 * pi))  # between headings that are wrapped
    rate = np.where(fleet.present, (change - 2 * pi * turns) / fleet.dt, nan)
    return turned(fleet.velocity, -midway(heading)), rate


def in_world(recording: Recording) -> Recording:
    """The recording turned into the world frame by the compass of each vehicle, as position methods take it.

    Raises:
        InputError: a recording in the world frame, or a vehicle that drives or observes without a compass.

    >>> from coopoc import Sensors, observe
    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[0, 2, 0]]], [[[0, 2, 0]], [[0, 2, 0]]])
    >>> exact = Sensors(velocity_std_ratio=0.0)
    >>> in_world(observe(fleet, exact, frame="body")).velocity.round(3)[0, 1].tolist()
    [[0.0, 2.0, 0.0]]
    """
    body = check_recording(recording, body=True).body
    assert body is not None
    needed = abs(recording.velocity).sum(axis=-1) > 0
    needed[:, recording.links.step, recording.links.observer] = True
    if np.isnan(body.heading[needed]).any():
        _, step, column = np.argwhere(needed & np.isnan(body.heading))[0]
        actual = f"none of {recording.ids[column]} at step {step}"
        raise InputError("heading", actual, "must be there to turn a recording", "Take a pose filter.")
    relative, links = recording.relative.copy(), recording.links
    relative[..., 1] = wrap(relative[..., 1] + body.heading[:, links.step, links.observer])
    velocity = turned(recording.velocity, np.nan_to_num(midway(body.heading)))
    return replace(recording, body=None, velocity=velocity, relative=relative)


def between_origins(recording: Recording, position: Floats, heading: Floats) -> Recording:
    """The recording with ranges between vehicles: |p_j - p_i| - |p_j + R(h_j) t_j - p_i - R(h_i) t_i| is added.

    Args:
        recording: with tags t.
        position: p, (R, T, N, 3) m.
        heading: h, (R, T, N) rad.

    >>> from coopoc import Sensors, observe
    >>> fleet = Fleet(("a", "b"), [0, 1], np.full((2, 2, 3), [[0.0] * 3, [9, 0, 0]]), np.zeros((2, 2, 3)))
    >>> seen = replace(observe(fleet, Sensors()), tags=[[0, -1.0, 0], [0, 2, 0]])
    >>> moved = between_origins(seen, fleet.position[None], np.full((1, 2, 2), np.pi / 2))
    >>> (moved.relative - seen.relative)[0, 0].round(9).tolist()
    [3.0, 0.0, 0.0]
    """
    links, relative = recording.links, recording.relative.copy()
    tips = position + turned(recording.tags, heading)
    far, longer = (
        np.linalg.norm(ends[:, links.step, links.neighbour] - ends[:, links.step, links.observer], axis=-1)
        for ends in (position, tips)
    )
    relative[..., 0] = np.maximum(relative[..., 0] + far - longer, TINY)
    return replace(recording, relative=relative, tags=0.0 * recording.tags)


def body_measurements(fleet: Fleet, sensors: Sensors, runs: int, seed: int) -> tuple[Floats, Body]:
    """Velocity (R, T, N, 3) m/s forward, left and up, yaw rate and compass heading in R runs.

    u = (1 + s) u_true + e + n, w = w_true + b + n, with s, e and b Gauss-Markov of `odometry_error_time`; the noise of
    u takes the draws of a velocity in the world. Each error has a stream of its own: adding one changes no other draws.

    Args:
        fleet: the truth.
        sensors: the noise that acts.
        runs: R.
        seed: of all draws.
    """
    motion, rate = body_motion(fleet)
    heading, noise = true_heading(fleet), sensors.velocity_std(motion)
    velocity, yaw = np.empty((runs, *motion.shape)), np.empty((runs, *rate.shape))
    compass = np.full(yaw.shape, nan)
    for r in range(runs):
        scale = _lasting(fleet, "speed_scale", sensors.speed_scale_std, sensors, (seed, r))
        bias = _lasting(fleet, "yaw_rate_bias", sensors.yaw_rate_bias_std, sensors, (seed, r))
        error = _lasting(fleet, "velocity_bias", sensors.velocity_bias_std, sensors, (seed, r), 3)
        velocity[r] = motion * (1.0 + scale[..., None]) + error + noise * _normals(fleet, "velocity", (seed, r), 3)
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
    turned_back = relative.copy()
    turned_back[..., 1] = wrap(turned_back[..., 1] - turned - true_heading(fleet)[links.step, links.observer])
    return turned_back


def _normals(fleet: Fleet, sensor: str, at: tuple[int, int], *size: int) -> Floats:
    """(T, N, ...) standard normals, a stream per vehicle."""
    draws = [stream(at[0], sensor, at[1], name).standard_normal((len(fleet.t), *size)) for name in fleet.ids]
    return np.stack(draws, 1)


def _lasting(fleet: Fleet, sensor: str, std: float, sensors: Sensors, at: tuple[int, int], *size: int) -> Floats:
    """(T, N, ...) of an error that lasts."""
    if not std:
        return np.zeros((len(fleet.t), len(fleet.ids), *size))
    return std * gauss_markov(_normals(fleet, sensor, at, *size), fleet.dt / sensors.odometry_error_time)


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
    return error
