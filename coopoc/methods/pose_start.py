"""First poses of vehicles that do not know theirs: several headings are tried, and the most likely one is kept."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints, number
from ..errors import InputError
from ..world.frames import turned
from ..world.recording import Recording, check_recording
from ..world.sensors import Sensors
from ..world.spherical import to_vector, wrap
from . import pose_unit
from .pose_begin import body_of
from .pose_filter import PoseFilter


def pose_start(
    recording: Recording,
    *,
    seconds: float = 30.0,
    headings: int = 24,
    gate: float = 5.0,
    assumed: Sensors | None = None,
) -> Floats:
    """Poses (R, N, 4) m and rad at the first step, for `PoseFilter(begin=...)`; NaN for landmarks.

    With a heading, a vehicle's first fix or first range and bearing of a landmark gives its pose there, and the
    odometry until then its pose at the first step. A solo filter starts from each of some headings around the circle;
    the one whose innovations, and bearings of other vehicles from fix to fix, have the largest likelihood over the
    first seconds is kept. A compass leaves one.

    Args:
        recording: in body frames.
        seconds: of it that are used.
        headings: that are tried.
        gate: as of the filter.
        assumed: noise, default that of the recording.

    Raises:
        InputError: a vehicle that has neither a fix nor sees a landmark in that time.

    References:
        Thrun, Burgard, Fox, Probabilistic Robotics, 2005, section 7.5 (multi-hypothesis tracking).

    >>> from coopoc import Fleet, Sensors, observe
    >>> t = np.arange(40) * 0.1
    >>> path = np.stack([20 * np.sin(0.3 * t), -20 * np.cos(0.3 * t), 0 * t], axis=1)[:, None]
    >>> fleet = Fleet(("a",), t, path, np.gradient(path, 0.1, axis=0))
    >>> exact = Sensors(gnss_std=(0.1, 0.1, 0.1), compass=False)
    >>> begin = pose_start(observe(fleet, exact, assumed=exact, frame="body"))
    >>> bool(abs(begin[0, 0, 3]) < 0.3)  # it sets out to the east
    True
    """
    check_recording(recording, body=True)
    headings = number("headings", headings, 4, 360, kind=int, allowed="4..360", hint="24 are 15 degrees apart.")
    steps = min(int(number("seconds", seconds, hint="30 is the default.") / recording.dt) + 1, len(recording.t))
    part = recording.between(0, max(steps, 2))
    angles = 2 * np.pi * np.arange(headings) / headings
    begin = np.full((recording.runs, len(recording.ids), 4), np.nan)
    spread = (*_spread(assumed or recording.sensors), np.pi / headings)
    for column in np.unique(pose_unit.fleet(part).column):
        links = part.links.of(column)
        links = links[np.isin(part.links.neighbour[links], part.landmarks)]
        for run in range(recording.runs):
            tried = begin[run].repeat(headings).reshape(-1, 4, headings).transpose(2, 0, 1).copy()
            tried[:, column] = _hypotheses(part, run, int(column), links, angles)
            filter_ = PoseFilter("solo", gate=gate, spread=spread, assumed=assumed)
            copies = part.of_runs(np.full(headings, run))
            _, _, cost = filter_.follow(copies, pose_unit.alone(copies, int(column)), links, tried)
            seen_from = _cost_of_bearings(part, run, int(column), angles, assumed or recording.sensors)
            begin[run, column] = tried[np.argmin(cost[:, 0] + seen_from), column]
    return begin


def _spread(sensors: Sensors) -> tuple[float, float, float]:
    """Of a position from one fix or one landmark, whichever is worse, m."""
    x, y, z = (max(std, sensors.range_std) for std in sensors.fix_std)
    return 2 * x, 2 * y, 2 * z


def _turns(recording: Recording, run: int, column: int) -> Floats:
    """(T,) rad that a vehicle has turned since the first step, by its yaw rates."""
    return np.append(0.0, np.cumsum(recording.dt * body_of(recording).yaw_rate[run, 1:, column]))


def _cost_of_bearings(recording: Recording, run: int, column: int, angles: Floats, noise: Sensors) -> Floats:
    """(headings,) sum of r^2 / s of bearings against the azimuths between both fixes of their step, per heading."""
    links = recording.links.of(column)
    links = links[~np.isin(recording.links.neighbour[links], recording.landmarks)]
    step, other = recording.links.step[links], recording.links.neighbour[links]
    gap = recording.gnss[run, step, other] - recording.gnss[run, step, column]
    azimuth = np.arctan2(gap[:, 1], gap[:, 0]) - _turns(recording, run, column)[step]
    residual = wrap(recording.relative[run, links, 1] + angles[:, None] - azimuth)
    fixes = 2.0 * max(noise.fix_std[:2]) ** 2 / np.maximum(np.square(gap[:, :2]).sum(axis=1), 1.0)
    found: Floats = np.nansum(residual**2 / (noise.azimuth_std**2 + fixes), axis=1)
    return found


def _hypotheses(recording: Recording, run: int, column: int, links: Ints, angles: Floats) -> Floats:
    """(headings, 4) poses at the first step that the first fix, or the first landmark seen, leaves for each heading."""
    body, relative = body_of(recording), recording.relative[run, links]
    fixes = np.flatnonzero(np.isfinite(recording.gnss[run, :, column, 0]))
    seen = np.flatnonzero(np.isfinite(relative[:, :2]).all(axis=1))
    if not len(fixes) and not len(seen):
        given = f"{recording.ids[column]} has no fix and sees no landmark in {recording.t[-1] - recording.t[0]:g} s"
        raise InputError("seconds", given, "must hold one of the two", "Take more seconds, or give its pose.")
    turns = _turns(recording, run, column)
    middle = turns - 0.5 * recording.dt * body.yaw_rate[run, :, column]
    way = recording.dt * turned(recording.velocity[run, :, column], middle)
    way[0] = 0.0
    way = np.cumsum(way, axis=0)
    if len(fixes):
        step = int(fixes[0])
        place, offset = recording.gnss[run, step, column], way[step]
    else:
        link = links[seen[0]]
        step = int(recording.links.step[link])
        flat = np.array([*relative[seen[0], :2], np.pi / 2])
        flat[2] = relative[seen[0], 2] if np.isfinite(relative[seen[0], 2]) else flat[2]
        place = recording.gnss[run, step, recording.links.neighbour[link]]
        offset = way[step] + turned(to_vector(flat), np.asarray(turns[step]))
    compass = body.heading[run, 0, column]
    angles = angles if np.isnan(compass) else np.full(len(angles), compass)
    position = place - turned(np.broadcast_to(offset, (len(angles), 3)), angles)
    return np.column_stack([position, angles])
