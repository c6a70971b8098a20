"""Bytes on air of encoded CAMs and CPMs with what stands around them, and the channels of these sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import number
from . import cam, cpm
from .v2x import FIX_AND_VELOCITY, V2X

HEADERS, DIGEST, CERTIFICATE = 44, 96, 220
"""Bytes around a message: BTP-B and GeoNetworking single hop (EN 302 636), security (TS 103 097) with a digest of the
sender's certificate or, once a second, with the certificate."""
VELOCITY = 12
"""Bytes of a velocity in FIX_AND_VELOCITY: a CPM holds none of its sender."""
ORIGIN, STD = (47.0, 8.0, 400.0), (1.5, 1.5, 1.5)
"""Of the message that is measured; its size depends on neither."""


def share(due: float, rate: float) -> float:
    """Share of the messages at a rate, Hz, that carry what is due so many times a second."""
    return min(1.0, due / rate)


def on_air(message: float, rate: float) -> float:
    """Mean bytes on air of messages of a mean size, bytes, at a rate, Hz.

    >>> on_air(41, 10.0)
    193.4
    """
    return HEADERS + message + DIGEST + share(1.0, rate) * (CERTIFICATE - DIGEST)


def cam_size(rate: float, path: int = 10) -> float:
    """Mean bytes on air of a car's CAMs at a rate, in Hz, with low-frequency containers and certificates when due."""
    state = cam.to_elements(np.zeros(3), np.array(0.0), np.array(10.0), np.array(0.0), ORIGIN)
    short, long = (len(cam.encode(state, STD, path=points)) for points in (0, path))
    return on_air(short + share(2.0, rate) * (long - short), rate)


def cam_encoded(max_neighbours: int = 6) -> V2X:
    """`V2X.cam` with the size of an encoded CAM, which holds a fix and a velocity; what a method adds comes on top.

    >>> cam_encoded(6).overhead
    285
    """
    plain = V2X.cam(max_neighbours)
    assert plain.rate is not None
    return replace(plain, overhead=round(cam_size(plain.rate)) - FIX_AND_VELOCITY.payload)


def cpm_size(rate: float, objects: int, described: bool = False) -> float:
    """Mean bytes on air of a car's CPMs at a rate, in Hz, with sensors and certificates when due.

    Args:
        rate: Hz.
        objects: perceived.
        described: as in `cpm.encode`.
    """
    several = np.arange(objects)
    vectors, std = np.ones((objects, 3)), np.full((objects, 3), 0.5)
    elements = cpm.to_elements(np.zeros(3), np.array(0.0), several, vectors, std, ORIGIN)
    short, long = (len(cpm.encode(elements, STD, 0.0, described, sensors)) for sensors in (False, True))
    return on_air(short + share(1.0, rate) * (long - short), rate)


def cpm_encoded(max_neighbours: int = 6, objects: int | None = None) -> V2X:
    """`V2X.cpm` with the size of an encoded CPM, which holds a fix; what a method adds, a velocity first, is on top.

    Args:
        max_neighbours: K.
        objects: perceived, up to 255, with position and confidence; None for K. A method that sends its relative
            measurements counts them itself: give 0.

    Raises:
        InputError: another number of objects.
        MissingLibraryError: asn1tools is not installed.

    >>> cpm_encoded(6).overhead
    284
    """
    plain = V2X.cpm(max_neighbours)
    assert plain.rate is not None
    given = min(plain.max_neighbours, 255) if objects is None else objects
    several = number("objects", given, 0, 255, kind=int, allowed="in 0..255", hint="A CPM holds at most 255.")
    return replace(plain, overhead=round(cpm_size(plain.rate, several)) - (FIX_AND_VELOCITY.payload - VELOCITY))
