"""A step of a recording in body frames as a problem in the plane: odometry, fixes, compass, ranges, bearings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from ..optimize.model.factor import Factor, of_recorded
from ..optimize.model.problem import Problem
from ..optimize.model.space import Space, pose
from ..world.frames import turned
from ..world.recording import Recording
from ..world.sensors import Sensors
from .pose_begin import body_of
from .pose_unit import LEAST_HEADING_STD, LEAST_YAW_RATE_STD

PLANE = Space(2, has_rotation=True)
NOTHING = Problem((), dimension=2)
LANDMARK_STD = 0.01
"""m, of the prior of a landmark, whose position is known."""


class Drive(NamedTuple):
    """One run of a recording and what is assumed of it.

    Attributes:
        recording: in body frames.
        run: of it.
        noise: assumed.
        begin: (N, 4) m and rad, poses at the first step, NaN where a fix and a compass take their place.
        spread: (4,) their standard deviations.
    """

    recording: Recording
    run: int
    noise: Sensors
    begin: Floats
    spread: Floats


def node(recording: Recording, column: int, step: int) -> str:
    """Name of a vehicle's pose at a step."""
    return f"{recording.ids[column]}@{step}"


def vehicles(recording: Recording, step: int) -> list[int]:
    """Columns of the vehicles that are there at a step."""
    there = np.isfinite(recording.velocity[0, step, :, 0])
    there[list(recording.landmarks)] = False
    return np.flatnonzero(there).tolist()


def pose_piece(drive: Drive, step: int, known: Mapping[str, Floats]) -> Problem:
    """Poses of all vehicles at a step, and what joins them to those of the step before and to landmarks.

    th' = th + dt w, p' = p + dt R(th + dt w / 2) u; ranges are taken to the plane, r sin(inclination). Measurements of
    another vehicle count if its message arrives at their step.

    Args:
        drive: a run.
        step: t.
        known: name -> (6,) node of each pose of the step before, and of each landmark that was measured before.

    Raises:
        InputError: a vehicle that joins with neither a pose nor fix and compass.
    """
    recording, here = drive.recording, vehicles(drive.recording, step)
    stayed = [c for c in here if step and node(recording, c, step - 1) in known]
    joined = [c for c in here if c not in stayed]
    links = _links(drive, step)
    marks = sorted({*recording.links.neighbour[links].tolist()} & {*recording.landmarks})
    names = [node(recording, c, step - 1) for c in stayed]
    before, moved = np.array([known[name] for name in names]).reshape(-1, PLANE.ambient), _odometry(drive, step, stayed)
    names += [node(recording, c, step) for c in (*stayed, *joined)] + [recording.ids[c] for c in marks]
    place = {c: len(stayed) + k for k, c in enumerate((*stayed, *joined, *marks))}
    stand = PLANE.join(recording.gnss[drive.run, 0, marks, :2])
    x0 = np.concatenate([before, _after(before, moved), pose(*_first(drive, step, joined)), stand])
    factors = [*_moves(drive, step, stayed, moved), *_own(drive, step, here, place)]
    fresh = [place[c] for c in marks if recording.ids[c] not in known]
    if fresh:
        factors.append(of_recorded("position", _column(fresh), x0[fresh, :2], np.array(LANDMARK_STD)))
    factors += _relative(drive, links, place)
    poses = tuple(range(len(stayed) + len(here)))
    return NOTHING.replace_unchecked(names=tuple(names), factors=tuple(factors), x0=x0, poses=poses)


def _column(places: Sequence[int]) -> Ints:
    return np.array(places, dtype=np.int64)[:, None]


def _links(drive: Drive, step: int) -> Ints:
    """Links of a step between vehicles that are there, and to landmarks, whose measurements arrive at once."""
    links, marks = drive.recording.links, drive.recording.landmarks
    now = np.arange(*np.searchsorted(links.step, (step, step + 1)))
    arrival, ends = drive.recording.arrival[drive.run, now], zip(links.observer[now], links.neighbour[now], strict=True)
    counts = [i not in marks and (j in marks or at == step) for (i, j), at in zip(ends, arrival, strict=True)]
    return np.asarray(now[np.array(counts, dtype=bool)])


def _odometry(drive: Drive, step: int, columns: Sequence[int]) -> Floats:
    """(M, 6) poses at a step as those of the step before see them."""
    recording, dt = drive.recording, drive.recording.dt
    rate = body_of(recording).yaw_rate[drive.run, step, columns]
    way = dt * turned(recording.velocity[drive.run, step, columns], 0.5 * dt * rate)
    return pose(way[:, :2], dt * rate)


def _after(x: Floats, moved: Floats) -> Floats:
    """Poses (M, 6) after relative poses (M, 6)."""
    rotation = PLANE.rotation(x)
    position = x[:, :2] + (rotation @ moved[:, :2, None])[..., 0]
    return PLANE.join(position, rotation @ PLANE.rotation(moved))


def _first(drive: Drive, step: int, columns: Sequence[int]) -> tuple[Floats, Floats]:
    """(M, 2) m and (M,) rad: what is given of first poses, else fixes and compasses."""
    recording, run = drive.recording, drive.run
    compass = body_of(recording).heading[run, step, columns]
    seen = np.column_stack([recording.gnss[run, step, columns, :2], compass])
    given = drive.begin[columns][:, [0, 1, 3]] if step == 0 else np.full_like(seen, np.nan)
    found = np.where(np.isnan(given), seen, given)
    for column, row in zip(columns, found, strict=True):
        if np.isnan(row).any():
            what = f"{recording.ids[column]} joins at step {step} without fix and compass"
            raise InputError("begin", what, "must be known where it joins", "Cut it with recording.between(...).")
    return found[:, :2], found[:, 2]


def _moves(drive: Drive, step: int, columns: Sequence[int], moved: Floats) -> list[Factor]:
    """Odometry of the M vehicles that stayed: nodes 0..M-1 are their former poses, the next M those of the step."""
    if not columns:
        return []
    dt, noise, count = drive.recording.dt, drive.noise, len(columns)
    speed = noise.assumed_velocity_std(drive.recording.velocity[drive.run, step, columns])[:, :2]
    turn = np.full((count, 1), max(noise.yaw_rate_std, LEAST_YAW_RATE_STD))
    pairs = np.arange(2 * count).reshape(2, count).T
    return [of_recorded("relative_pose_log", pairs, moved, dt * np.hstack([speed, turn]))]


def _own(drive: Drive, step: int, columns: Sequence[int], place: Mapping[int, int]) -> list[Factor]:
    """Fixes, compasses and, at the first step, the poses that are given."""
    recording, noise, found = drive.recording, drive.noise, []
    fix, compass = recording.gnss[drive.run, step], body_of(recording).heading[drive.run, step]
    fixed = [c for c in columns if np.isfinite(fix[c, :2]).all()]
    if fixed:
        found.append(
            of_recorded("position", _column([place[c] for c in fixed]), fix[fixed, :2], np.array(noise.fix_std[:2]))
        )
    headed = [c for c in columns if np.isfinite(compass[c])]
    if headed:
        turn = max(float(np.hypot(noise.heading_std, noise.heading_bias_std)), LEAST_HEADING_STD)
        z = pose(np.zeros((len(headed), 2)), compass[headed])
        found.append(of_recorded("pose", _column([place[c] for c in headed]), z, np.array([np.inf, np.inf, turn])))
    given = drive.begin[:, [0, 1, 3]]
    begun = [c for c in columns if step == 0 and np.isfinite(given[c]).any()]
    if begun:
        std = np.where(np.isnan(given[begun]), np.inf, drive.spread[[0, 1, 3]])
        z = pose(np.nan_to_num(given[begun, :2]), np.nan_to_num(given[begun, 2]))
        found.append(of_recorded("pose", _column([place[c] for c in begun]), z, std))
    return found


def _relative(drive: Drive, links: Ints, place: Mapping[int, int]) -> list[Factor]:
    """Ranges and bearings: both as one measurement where both are there."""
    table, noise = drive.recording.links, drive.noise
    distance, bearing, inclination = drive.recording.relative[drive.run, links].T
    flat = distance * np.sin(np.where(np.isnan(inclination), 0.5 * np.pi, inclination))
    ends = np.column_stack([table.observer[links], table.neighbour[links]]).tolist()
    pairs = np.array([[place[a], place[b]] for a, b in ends], dtype=np.int64).reshape(-1, 2)
    far, seen = np.isfinite(flat), np.isfinite(bearing)
    both = np.array([noise.range_std, noise.azimuth_std])
    kinds = (
        ("body_spherical", far & seen, np.column_stack([flat, bearing]), both),
        ("range", far & ~seen, flat[:, None], both[:1]),
        ("bearing", seen & ~far, bearing[:, None], both[1:]),
    )
    return [of_recorded(kind, pairs[rows], z[rows], std) for kind, rows, z, std in kinds if rows.any()]
