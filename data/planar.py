"""Robots and landmarks in a plane -> Recording in body frames, with nothing simulated: one run, no fix, no compass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coopoc.arrays import Floats
from coopoc.world.fleet import Fleet
from coopoc.world.links import Links
from coopoc.world.recording import Body, Recording
from coopoc.world.sensing import schedule
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X


def planar_recording(
    ids: Sequence[str],
    t: Floats,
    motion: tuple[Floats, Floats],
    place: Floats,
    table: Floats,
    sensors: Sensors,
    v2x: V2X,
    notes: Sequence[str],
) -> Recording:
    """The recording; landmarks stand, have their place as a fix at every step, and send nothing.

    Args:
        ids: of n robots, then of the landmarks.
        t: (T,) s.
        motion: (T, n, 2) m/s, velocity in the robots' frames, forward and left, and (T, n) rad/s, yaw rate.
        place: (m, 2) m, of the landmarks.
        table: (L, 5) step, observer, neighbour, range m, bearing rad; NaN for what was not measured.
        sensors: the noise of all this.
        v2x: which messages of robots arrive.
        notes: of the recording; that inclinations were not measured is added.
    """
    (velocity, rate), steps, n = motion, len(t), len(ids) - len(place)
    table = table[np.lexsort((table[:, 3], table[:, 1], table[:, 0]))]
    links = Links(*table[:, :3].astype(np.int64).T)
    shape = (1, steps, len(ids), 3)
    gnss, moved, turning = np.full(shape, np.nan), np.zeros(shape), np.zeros(shape[:3])
    gnss[0, :, n:] = np.column_stack([place, np.zeros(len(place))])
    moved[0, :, :n, :2], turning[0, :, :n] = velocity, rate
    still = np.zeros(shape[1:])
    broadcasts, arrival = schedule(Fleet(tuple(ids), t, still, still), links, v2x, 1, 0)
    arrival[:, links.neighbour >= n] = -1
    broadcasts[:, n:] = False
    return Recording(
        ids=tuple(ids),
        t=t,
        gnss=gnss,
        velocity=moved,
        links=links,
        relative=np.column_stack([table[:, 3:], np.full(len(table), np.pi / 2)])[None],
        broadcasts=broadcasts,
        arrival=arrival,
        sensors=sensors,
        v2x=v2x,
        observers=tuple(range(len(ids))),
        notes=(*notes, "inclination was not measured: pi/2 by the constraint z = 0"),
        body=Body(turning, np.full(turning.shape, np.nan)),
        landmarks=tuple(range(n, len(ids))),
    )
