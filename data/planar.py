"""Measurements at their own times on steps, and robots and landmarks in a plane -> Recording in body frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.world.fleet import Fleet
from coopoc.world.links import Links
from coopoc.world.recording import Body, Recording
from coopoc.world.sensing import schedule
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

PLANE_STD = 0.01
"""m and rad: how well z = 0, and with it an inclination of pi/2, is known where heights were not measured."""


def nearest(late: Floats, step: Ints, observer: Ints, neighbour: Ints) -> Ints:
    """Indices of one measurement per step, observer and neighbour, the nearest in time, sorted by these.

    Args:
        late: (M,) s between a measurement and its step.
        step: (M,); negative ones are left out.
        observer: (M,) columns; negative ones are left out.
        neighbour: (M,) as `observer`.

    >>> nearest(np.array([0.04, 0.01, 0.02]), np.array([3, 3, -1]), np.zeros(3, int), np.ones(3, int))
    array([1])
    """
    order = np.lexsort((late, neighbour, observer, step))
    order = order[((step >= 0) & (observer >= 0) & (neighbour >= 0))[order]]
    return order[_changes(step[order], observer[order], neighbour[order])]


def steps_of(t: Floats, dt: float, steps: int) -> tuple[Ints, Floats]:
    """Step of each time (M,) s after the first step, -1 outside the drive, and how far off it is in s.

    >>> steps_of(np.array([0.21, 9.0]), 0.1, 5)[0]
    array([ 2, -1])
    """
    step = np.rint(t / dt)
    return np.where((step >= 0) & (step < steps), step, -1).astype(np.int64), np.abs(t - dt * step)


def first_of_each(most: int, *keys: Ints | Floats) -> Bools:
    """True for the first `most` of each run of rows with equal keys.

    >>> first_of_each(1, np.array([0, 0, 1])).tolist()
    [True, False, True]
    """
    every = np.arange(len(keys[0]))
    return np.asarray(every - np.maximum.accumulate(np.where(_changes(*keys), every, 0)) < most)


def _changes(*keys: Ints | Floats) -> Bools:
    """True at the first of each run of equal rows."""
    rows = np.column_stack(keys)
    first: Bools = np.append(True, (np.diff(rows, axis=0) != 0).any(axis=1))[: len(rows)]
    return first


def planar_recording(
    ids: Sequence[str],
    t: Floats,
    velocity: Floats,
    yaw_rate: Floats,
    place: Floats,
    table: Floats,
    sensors: Sensors,
    v2x: V2X,
    note: str,
) -> Recording:
    """One run, nothing simulated; landmarks stand, have their place as a fix at every step, and send nothing.

    Args:
        ids: of n robots, then of the landmarks.
        t: (T,) s.
        velocity: (T, n, 2) m/s in the robots' frames, forward and left.
        yaw_rate: (T, n) rad/s.
        place: (m, 2) m, of the landmarks.
        table: (L, 5) step, observer, neighbour, range m, bearing rad; NaN for what was not measured.
        sensors: the noise of all this.
        v2x: which messages of robots arrive.
        note: of the recording; that inclinations were not measured is added.
    """
    n = len(ids) - len(place)
    table = table[np.lexsort((table[:, 3], table[:, 1], table[:, 0]))]
    links = Links(*table[:, :3].astype(np.int64).T)
    shape = (1, len(t), len(ids), 3)
    gnss, moved, turning = np.full(shape, np.nan), np.zeros(shape), np.zeros(shape[:3])
    gnss[0, :, n:] = np.column_stack([place, np.zeros(len(place))])
    moved[0, :, :n, :2], turning[0, :, :n] = velocity, yaw_rate
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
        notes=(note, "inclination was not measured: pi/2 by the constraint z = 0"),
        body=Body(turning, np.full(turning.shape, np.nan)),
        landmarks=tuple(range(n, len(ids))),
    )
