"""A recording as an ego has it whose neighbours send Collective Perception Messages beside their CAMs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .cam_recording import cam_received
from .cpm import from_elements, to_elements
from .data_dictionary import Origin
from .frames import turned
from .recording import Recording
from .spherical import spherical, to_vector


def cpm_received(recording: Recording, ego: int | str, origin: Origin = (50.0, 8.0, 100.0)) -> Recording:
    """`cam_received`, and what the others measured of each other as the objects of their CPMs carry it.

    A CPM holds the vector from its sender to an object, east, north and up, in cm, up to 1,310 m. In body frames the
    sender turns it by its compass, and the receiver turns it back by the orientation in the CPM, 0.1 degrees: a vehicle
    whose heading is missing sends no object. Neither is one sent without range or azimuth; an inclination may be
    missing, and then the vector is level. The observer of a link knows whom it measures.

    Args:
        recording: in any frame.
        ego: vehicle whose own measurements stay as they are.
        origin: of the local frame.

    Raises:
        InputError: an unknown ego.

    References:
        ETSI TS 103 324 V2.1.1; ETSI TS 102 894-2 V2.1.1 (data elements).

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a", "b"), [0, 1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.ones((2, 2, 3)))
    >>> seen = observe(fleet, Sensors(), runs=3)
    >>> found = cpm_received(seen, "a")
    >>> [bool((found.relative[:, k] == seen.relative[:, k]).all()) for k in (0, 1)]
    [True, False]
    """
    received = cam_received(recording, ego, origin)
    (own,) = recording.observing([ego])
    links, body = recording.links, recording.body
    sent = np.flatnonzero(~np.isin(links.observer, [own, *recording.landmarks]))
    step, observer, measured = links.step[sent], links.observer[sent], recording.relative[:, sent]
    # In the world frame vectors are as they were measured, whatever orientation a sender states.
    course = np.zeros(measured.shape[:2]) if body is None else body.heading[:, step, observer]
    level = np.isnan(measured[..., 2])
    measured[level, 2] = np.pi / 2
    vector = turned(to_vector(measured), course)
    vector[level, 2] = np.nan
    place, unstated = recording.gnss[:, step, observer], np.full(vector.shape, np.nan)
    objects = to_elements(place, course, links.neighbour[sent, None], vector[:, :, None], unstated[:, :, None], origin)
    _, orientation, found, _ = from_elements(objects, origin)
    x, y, z = np.moveaxis(turned(found[:, :, 0], -orientation), -1, 0)
    there = np.stack(spherical(x, y, np.where(level, 0.0, z)), axis=-1)
    there[level, 2] = np.nan
    relative = recording.relative.copy()
    relative[:, sent] = np.where(there[..., :1] > 0.0, there, np.nan)
    return replace(received, relative=relative)
