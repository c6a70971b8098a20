"""MR.CLAM -> Recording: real odometry, range and bearing; simulated GNSS. Every label stands in Recording.notes."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.world.links import Links
from coopoc.world.recording import Recording
from coopoc.world.sensing import observe, schedule
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from .mrclam import MrclamLog, innovations
from .nearest import changes, nearest

HEIGHT_STD = 0.01
"""m, how well z = 0 is known: the robots drive on one floor."""
PLANE_STD = 0.01
"""rad, assumed for the inclination, which is pi/2 by the same constraint."""
ODOMETRY_STD = 0.015
"""m/s per axis, of the odometry velocity against Vicon: 0.014-0.018 over the five robots of set 6."""

STATED_STD, LEAST_STD = (0.095, 0.007), 1e-4
"""m, rad, of a folder without measurements between robots; and the least that is believed."""


def recording(
    log: MrclamLog, v2x: V2X, *, runs: int = 1, seed: int = 0, gnss_std: float = 0.3, assumed: Sensors | None = None
) -> Recording:
    """Recording of the real drive: runs differ only in the simulated GNSS, everything else was measured.

    velocity = v (cos th, sin th, 0) with wheel speed v and Vicon's heading th in the middle of the step (after a gap of
    Vicon: at its end); relative = (measured range, measured bearing + Vicon's heading, pi/2). Of several measurements
    of one robot in a step the one nearest to the step's instant is kept; at most K <= 4 neighbours, nearest first by
    measured range.

    Args:
        log: of read_mrclam.
        v2x: K, radius and channel.
        runs: R.
        seed: of GNSS and channel.
        gnss_std: m, simulated on x and y.
        assumed: what methods may know; default: gnss_std, and the noise measured against Vicon (a calibration).
    """
    acting = Sensors(gnss_std=(gnss_std, gnss_std, 0.0), velocity_std_ratio=0.0)
    known = assumed or _calibrated(log, gnss_std)
    fixes = observe(log.fleet, acting, V2X(max_neighbours=0), runs=runs, seed=seed, assumed=known).gnss
    index, lost_in_gaps, repeated = kept(log, v2x)
    links = Links(log.step[index], log.observer[index], log.subject[index])
    azimuth = log.bearing[index] + log.observer_heading[index]
    azimuth = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    relative = np.column_stack([log.range[index], azimuth, np.full(len(index), np.pi / 2)])
    broadcasts, arrival = schedule(log.fleet, links, v2x, runs, seed)
    return Recording(
        ids=log.fleet.ids,
        t=log.fleet.t,
        gnss=fixes,
        velocity=np.broadcast_to(_velocity(log), fixes.shape),
        links=links,
        relative=np.broadcast_to(relative, (runs, *relative.shape)),
        broadcasts=broadcasts,
        arrival=arrival,
        sensors=known,
        v2x=v2x,
        observers=tuple(range(len(log.fleet.ids))),
        notes=(
            f"GNSS is simulated, {gnss_std:g} m on x and y: there is none indoors; z = 0 is taken as known",
            "range, bearing and wheel odometry are real",
            "world azimuth and direction of travel use Vicon's heading, which is truth",
            "inclination was not measured: pi/2 by the constraint z = 0",
            *(() if assumed else ("assumed standard deviations were measured against Vicon",)),
            f"{repeated} repeated measurements within a step and {lost_in_gaps} in gaps of Vicon are left out",
        ),
    )


def _calibrated(log: MrclamLog, gnss_std: float) -> Sensors:
    residuals = innovations(log)
    return Sensors(
        gnss_std=(gnss_std, gnss_std, HEIGHT_STD),
        velocity_std_ratio=0.0,
        velocity_floor=ODOMETRY_STD,
        range_std=max(residuals.range_std, LEAST_STD) if len(residuals.range) else STATED_STD[0],
        azimuth_std=max(residuals.bearing_std, LEAST_STD) if len(residuals.range) else STATED_STD[1],
        inclination_std=PLANE_STD,
        min_range=0.0,
    )


def _velocity(log: MrclamLog) -> Floats:
    before = np.where(np.isfinite(log.heading[:-1]), log.heading[:-1], log.heading[1:])
    middle = np.vstack([log.heading[:1], (log.heading[1:] + before) / 2])
    velocity = log.speed[..., None] * np.stack([np.cos(middle), np.sin(middle), 0 * middle], axis=-1)
    return np.where(log.fleet.present[..., None], velocity, np.nan)


def kept(log: MrclamLog, v2x: V2X, gaps: bool = False) -> tuple[Ints, int, int]:
    """Measurements that become links, by step, observer and range; numbers left out in gaps and as repetitions.

    Args:
        log: of read_mrclam.
        v2x: K and radius.
        gaps: whether those in gaps of Vicon stay.
    """
    known = np.flatnonzero(log.step >= 0)
    present = log.fleet.present
    visible = present[log.step, log.observer] & present[log.step, log.subject] & np.isfinite(log.observer_heading)
    index = known[visible[known] | gaps]
    late = np.abs(log.time - log.fleet.t[log.step])[index]
    unique = index[nearest(late, log.step[index], log.observer[index], log.subject[index])]
    near = unique[log.range[unique] <= v2x.radius]
    near = near[np.lexsort((log.range[near], log.observer[near], log.step[near]))]
    groups = changes(log.step[near], log.observer[near])
    rank = np.arange(len(near)) - np.maximum.accumulate(np.where(groups, np.arange(len(near)), 0))
    return near[rank < v2x.max_neighbours], int((~visible[known]).sum()), len(index) - len(unique)
