"""A recording as an ego has it whose neighbours send Cooperative Awareness Messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Floats, checked, instance
from .body import Body
from .cam import from_elements, to_elements
from .data_dictionary import Origin, received_std
from .recording import Recording


def cam_received(recording: Recording, ego: int | str, origin: Origin = (50.0, 8.0, 100.0)) -> Recording:
    """The recording with the others' fixes and motion as CAMs carry them, and with the standard deviations they state.

    A CAM holds a place to 1e-7 degrees and 1 cm, a heading to 0.1 degrees, a speed to 1 cm/s, a yaw rate to 0.01
    degrees/s, and no vertical velocity. In the world frame the heading is the course of the measured velocity; in body
    frames it is the compass's, and the speed is the forward one.

    Args:
        recording: in any frame.
        ego: vehicle whose own measurements stay as they are.
        origin: of the local frame.

    Raises:
        InputError: an unknown ego.

    References:
        ETSI EN 302 637-2 V1.4.1; ETSI TS 102 894-2 V1.3.1 (data elements).

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a", "b"), [0, 1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.ones((2, 2, 3)))
    >>> seen = observe(fleet, Sensors(), runs=3)
    >>> found = cam_received(seen, "a")
    >>> bool(np.abs(found.gnss - seen.gnss).max() < 0.01), found.velocity[0, 0, 1, 2]
    (True, np.float64(0.0))
    """
    instance("recording", recording, Recording)
    latitude, longitude, height = checked("origin", origin, "(3,)", (3,)).tolist()
    origin = (latitude, longitude, height)
    (own,) = recording.observing([ego])
    kept = [own, *recording.landmarks]
    forward, body = recording.velocity, recording.body
    if body is None:
        course, speed = np.arctan2(forward[..., 1], forward[..., 0]), np.hypot(forward[..., 0], forward[..., 1])
        rate: Floats = np.full(speed.shape, np.nan)
    else:
        course, speed, rate = body.heading, forward[..., 0], body.yaw_rate
    place, course, speed, rate = from_elements(to_elements(recording.gnss, course, speed, rate, origin), origin)
    along = (np.cos(course), np.sin(course)) if body is None else (np.ones(speed.shape), np.zeros(speed.shape))
    velocity = np.stack([speed * along[0], speed * along[1], 0.0 * speed], axis=-1)
    place[:, :, kept], velocity[:, :, kept] = recording.gnss[:, :, kept], recording.velocity[:, :, kept]
    if body is not None:
        rate[:, :, kept], course[:, :, kept] = body.yaw_rate[:, :, kept], body.heading[:, :, kept]
        body = Body(rate, course)
    stated = received_std(recording.sensors.gnss_std)
    sensors = replace(recording.sensors, gnss_std=stated)
    return replace(recording, gnss=place, velocity=velocity, body=body, sensors=sensors)
