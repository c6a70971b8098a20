"""MR.CLAM -> Recording in body frames, with nothing simulated: odometry, and robots and landmarks that are seen."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.body import Body
from coopoc.world.fleet import Fleet
from coopoc.world.links import Links
from coopoc.world.recording import Recording
from coopoc.world.sensing import schedule
from coopoc.world.v2x import V2X

from .mrclam import MrclamLog
from .mrclam_calibration import Calibration, delayed
from .mrclam_recording import kept
from .nearest import nearest, steps_of


def pose_recording(log: MrclamLog, v2x: V2X, known: Calibration) -> Recording:
    """Recording of the robots' own measurements, one run: odometry, range and bearing of robots and landmarks.

    There are no fixes and no compass. Inclinations are pi/2: the robots drive on one floor. Of several measurements of
    a subject in a step the one nearest to the step's instant is kept; at most K robots, nearest first by measured
    range, and all landmarks.

    Args:
        log: of read_mrclam.
        v2x: K, radius and channel.
        known: of its sensors: odometry is scaled and delayed by it, since it is a record of commands.

    Raises:
        InputError: a folder without positions of landmarks.
    """
    robots, marks = log.fleet.ids, surveyed(log)
    ids = (*robots, *(f"landmark{int(subject)}" for subject in marks[:, 0]))
    steps, n = len(log.fleet.t), len(robots)
    place = np.column_stack([marks[:, 1:], np.zeros(len(marks))])
    gnss = np.full((1, steps, len(ids), 3), np.nan)
    gnss[:, :, n:] = place
    velocity, rate = np.zeros(gnss.shape), np.zeros(gnss.shape[:3])
    velocity[0, :, :n, 0] = known.speed * delayed(log, log.speed, known.lag)
    rate[0, :, :n] = known.turn * delayed(log, log.turn_rate, known.lag)
    table = np.vstack([_robots(log, v2x), _landmarks(log, n)])
    table = table[np.lexsort((table[:, 3], table[:, 1], table[:, 0]))]
    links = Links(*table[:, :3].astype(np.int64).T)
    relative = np.column_stack([table[:, 3:], np.full(len(table), np.pi / 2)])[None]
    still = np.zeros((steps, len(ids), 3))
    broadcasts, arrival = schedule(Fleet(ids, log.fleet.t, still, still), links, v2x, 1, 0)
    arrival[:, links.neighbour >= n] = -1
    broadcasts[:, n:] = False
    return Recording(
        ids=ids,
        t=log.fleet.t,
        gnss=gnss,
        velocity=velocity,
        links=links,
        relative=relative,
        broadcasts=broadcasts,
        arrival=arrival,
        sensors=known.sensors,
        v2x=v2x,
        observers=tuple(range(len(ids))),
        notes=(
            "odometry, ranges and bearings are real; no fix, no compass, nothing simulated",
            "inclination was not measured: pi/2 by the constraint z = 0",
        ),
        body=Body(rate, np.full(rate.shape, np.nan)),
        landmarks=tuple(range(n, len(ids))),
    )


def surveyed(log: MrclamLog) -> Floats:
    """(M, 3) subject, x m, y m of the landmarks; InputError if there is none."""
    if not len(log.landmarks):
        raise InputError("folder", log.fleet.name, "has no Landmark_Groundtruth.dat", "Unpack the set again.")
    return log.landmarks


def _robots(log: MrclamLog, v2x: V2X) -> Floats:
    """(L, 5) step, observer, robot, range m, bearing rad."""
    index, _, _ = kept(log, v2x, gaps=True)
    columns = (log.step[index], log.observer[index], log.subject[index], log.range[index], log.bearing[index])
    return np.column_stack(columns)


def _landmarks(log: MrclamLog, first: int) -> Floats:
    """(L, 5) step, observer, column of the landmark, range m, bearing rad."""
    t, observer, mark, reach, bearing = log.sightings.T
    step, late = steps_of(t, log.fleet.dt, len(log.fleet.t))
    order = nearest(late, step, observer, mark)
    return np.asarray(np.column_stack([step, observer, first + mark, reach, bearing])[order])
