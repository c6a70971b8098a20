"""MR.CLAM -> Recording in body frames, with nothing simulated: odometry, and robots and landmarks that are seen."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.recording import Recording
from coopoc.world.v2x import V2X

from .mrclam import MrclamLog
from .mrclam_calibration import Calibration, delayed
from .mrclam_recording import kept
from .nearest import nearest, steps_of
from .planar import planar_recording


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
    turn, forward = (
        known.turn * delayed(log, log.turn_rate, known.lag),
        known.speed * delayed(log, log.speed, known.lag),
    )
    return planar_recording(
        ids,
        log.fleet.t,
        (np.stack([forward, np.zeros_like(forward)], axis=-1), turn),
        marks[:, 1:],
        np.vstack([_robots(log, v2x), _landmarks(log, len(robots))]),
        known.sensors,
        v2x,
        ("odometry, ranges and bearings are real; no fix, no compass, nothing simulated",),
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
