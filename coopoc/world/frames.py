"""Body frames and the world: true headings, motion in a vehicle's own frame, and recordings turned by their compass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from .fleet import Fleet
from .recording import Recording, check_recording
from .spherical import wrap

SLOWEST = 0.1
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
    course = np.where(np.hypot(x, y) >= SLOWEST, np.arctan2(y, x), np.nan)
    for column in course.T:
        known = np.flatnonzero(np.isfinite(column))
        held = np.searchsorted(known, np.arange(len(column)), side="right") - 1
        column[:] = np.unwrap(column[known])[np.maximum(held, 0)] if len(known) else 0.0
    course[1:-1] = (course[1:-1] + course[2:]) / 2
    return np.where(fleet.present, course, np.nan)


def turned(vector: Floats, angle: Floats) -> Floats:
    """Vectors (..., 3) turned by angles (...) rad about z.

    >>> turned(np.array([1.0, 0, 2]), np.array(np.pi / 2)).round(3).tolist()
    [0.0, 1.0, 2.0]
    """
    (x, y, z), cos, sin = np.moveaxis(vector, -1, 0), np.cos(angle), np.sin(angle)
    return np.stack(np.broadcast_arrays(cos * x - sin * y, sin * x + cos * y, z), axis=-1)


def midway(heading: Floats) -> Floats:
    """(..., T, N) rad, the heading in the middle of the step that ends at t; that of the first step at its end.

    A step after a missing heading takes the one at its end.

    >>> midway(np.array([[0.0], [1.0], [np.nan]])).ravel().tolist()
    [0.0, 0.5, nan]
    """
    before = np.concatenate([heading[..., :1, :], heading[..., :-1, :]], axis=-2)
    return np.asarray(heading - wrap(heading - np.where(np.isnan(before), heading, before)) / 2)


def body_motion(fleet: Fleet) -> tuple[Floats, Floats]:
    """True velocity (T, N, 3) m/s, forward, left and up, and yaw rate (T, N) rad/s over the step that ends at t."""
    heading = true_heading(fleet)
    change = np.diff(heading, axis=0, prepend=heading[:1])
    rate = np.where(fleet.present, np.nan_to_num(change) / fleet.dt, np.nan)
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
    needed = np.abs(recording.velocity).sum(axis=-1) > 0
    needed[:, recording.links.step, recording.links.observer] = True
    if np.isnan(body.heading[needed]).any():
        _, step, column = np.argwhere(needed & np.isnan(body.heading))[0]
        given = f"none of {recording.ids[column]} at step {step}"
        raise InputError("heading", given, "must be there to turn a recording", "Take a pose filter.")
    relative, links = recording.relative.copy(), recording.links
    relative[..., 1] = wrap(relative[..., 1] + body.heading[:, links.step, links.observer])
    velocity = turned(recording.velocity, np.nan_to_num(midway(body.heading)))
    return replace(recording, body=None, velocity=velocity, relative=relative)
