"""A step of a recording in body frames as a problem in the plane: odometry, fixes, compass, ranges, bearings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from ..optimize.model.factor import Factor, of_checked, of_recorded
from ..optimize.model.inputs import check_std
from ..optimize.model.measurements import lookup
from ..optimize.model.problem import Problem
from ..optimize.model.space import Space, pose
from ..world.body_frames import turned
from ..world.recording import Recording
from ..world.sensors import Sensors
from .pose_begin import body_of
from .pose_unit import LEAST_HEADING_STD, LEAST_YAW_RATE_STD

PLANE = Space(2, has_rotation=True)
NOTHING = Problem((), dimension=2)
LANDMARK_STD = 0.01
"""m, of the prior of a landmark, whose position is known."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One run of a recording and what is assumed of it; what all its steps share is found once.

    Args:
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

    @cached_property
    def there(self) -> Bools:
        """(T, N) whether a vehicle is there."""
        there: Bools = np.isfinite(self.recording.velocity[0, :, :, 0])
        there[:, list(self.recording.landmarks)] = False
        return there

    @cached_property
    def odometry(self) -> tuple[Floats, Floats]:
        """(T, N, 6) poses of vehicles as those of the step before see them, and (T, N, 3) their std."""
        recording, noise, there = self.recording, self.noise, self.there
        dt, rate = recording.dt, body_of(recording).yaw_rate[self.run][there]
        velocity = recording.velocity[self.run][there]
        way = dt * turned(velocity, 0.5 * dt * rate)
        turn = np.full((len(rate), 1), max(noise.yaw_rate_std, LEAST_YAW_RATE_STD))
        own = dt * np.hstack([noise.assumed_velocity_std(velocity)[:, :2], turn])
        moved, std = np.zeros((*there.shape, PLANE.ambient)), np.ones((*there.shape, PLANE.dof))
        moved[there], std[there] = pose(way[:, :2], dt * rate), check_std(lookup("relative_pose_log"), own, own.shape)
        return moved, std

    @cached_property
    def fix_std(self) -> Floats:
        """(1, 2) m."""
        return check_std(lookup("position"), np.array(self.noise.fix_std[:2]), (1, 2))

    @cached_property
    def compass(self) -> tuple[Floats, Floats]:
        """(T, N, 6) poses that have the headings of the compasses, NaN where there is none, and (1, 3) their std."""
        noise, seen = self.noise, body_of(self.recording).heading[self.run]
        turn = max(float(np.hypot(noise.heading_std, noise.heading_bias_std)), LEAST_HEADING_STD)
        z, there = np.full((*seen.shape, PLANE.ambient), np.nan), np.isfinite(seen)
        z[there] = pose(np.zeros((int(there.sum()), 2)), seen[there])
        return z, check_std(lookup("pose"), np.array([np.inf, np.inf, turn]), (1, 3))

    @cached_property
    def relative(self) -> list[tuple[str, Bools, Floats, Floats]]:
        """Of ranges with bearings, ranges and bearings alone: kind, which links (L,), z of all and (1, size) std."""
        noise = self.noise
        distance, bearing, inclination = self.recording.relative[self.run].T
        flat = distance * np.sin(np.where(np.isnan(inclination), 0.5 * np.pi, inclination))
        far, seen, both = np.isfinite(flat), np.isfinite(bearing), np.array([noise.range_std, noise.azimuth_std])
        kinds = (
            ("body_spherical", far & seen, np.column_stack([flat, bearing]), both),
            ("range", far & ~seen, flat[:, None], both[:1]),
            ("bearing", seen & ~far, bearing[:, None], both[1:]),
        )
        return [
            (kind, rows, z, check_std(lookup(kind), std, (1, len(std)))) for kind, rows, z, std in kinds if rows.any()
        ]

    @cached_property
    def links(self) -> list[Ints]:
        """Links of each step between vehicles that are there, and to landmarks, whose measurements arrive at once."""
        links, marks = self.recording.links, np.zeros(len(self.recording.ids), dtype=bool)
        marks[list(self.recording.landmarks)] = True
        arrived = self.recording.arrival[self.run] == links.step
        counts = np.flatnonzero(~marks[links.observer] & (marks[links.neighbour] | arrived))
        steps = np.arange(len(self.recording.t) + 1)
        ends = np.searchsorted(links.step[counts], steps).tolist()
        return [counts[first:last] for first, last in pairwise(ends)]


def node(recording: Recording, column: int, step: int) -> str:
    """Name of a vehicle's pose at a step."""
    return f"{recording.ids[column]}@{step}"


def vehicles(drive: Drive, step: int) -> list[int]:
    """Columns of the vehicles that are there at a step."""
    return np.flatnonzero(drive.there[step]).tolist()


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
    recording, here = drive.recording, vehicles(drive, step)
    stayed = [c for c in here if step and node(recording, c, step - 1) in known]
    joined = [c for c in here if c not in stayed]
    links = drive.links[step]
    marks = sorted({*recording.links.neighbour[links].tolist()} & {*recording.landmarks})
    names = [node(recording, c, step - 1) for c in stayed]
    before = np.array([known[name] for name in names]).reshape(-1, PLANE.ambient)
    moved = drive.odometry[0][step, stayed]
    names += [node(recording, c, step) for c in (*stayed, *joined)] + [recording.ids[c] for c in marks]
    place = {c: len(stayed) + k for k, c in enumerate((*stayed, *joined, *marks))}
    stand = PLANE.join(recording.gnss[drive.run, 0, marks, :2])
    joining = pose(*_first(drive, step, joined)) if joined else np.empty((0, PLANE.ambient))
    x0 = np.concatenate([before, _after(before, moved), joining, stand])
    factors = [*_moves(drive, step, stayed), *_own(drive, step, here, place)]
    fresh = [place[c] for c in marks if recording.ids[c] not in known]
    if fresh:
        factors.append(of_recorded("position", _column(fresh), x0[fresh, :2], np.array(LANDMARK_STD)))
    factors += _relative(drive, links, place)
    poses = tuple(range(len(stayed) + len(here)))
    return NOTHING.replace_unchecked(names=tuple(names), factors=tuple(factors), x0=x0, poses=poses)


def _column(places: Sequence[int]) -> Ints:
    return np.array(places, dtype=np.int64)[:, None]


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


def _moves(drive: Drive, step: int, columns: Sequence[int]) -> list[Factor]:
    """Odometry of the M vehicles that stayed: nodes 0..M-1 are their former poses, the next M those of the step."""
    if not columns:
        return []
    moved, std = drive.odometry
    pairs = np.arange(2 * len(columns)).reshape(2, -1).T
    return [of_checked("relative_pose_log", pairs, moved[step, columns], std[step, columns])]


def _own(drive: Drive, step: int, columns: Sequence[int], place: Mapping[int, int]) -> list[Factor]:
    """Fixes, compasses and, at the first step, the poses that are given."""
    found, fix, (compass, turn) = [], drive.recording.gnss[drive.run, step, :, :2], drive.compass
    fixed = np.isfinite(fix[:, 0] + fix[:, 1])
    on = [c for c in columns if fixed[c]]
    if on:
        found.append(of_checked("position", _column([place[c] for c in on]), fix[on], drive.fix_std))
    headed = np.isfinite(compass[step, :, 0])
    on = [c for c in columns if headed[c]]
    if on:
        found.append(of_checked("pose", _column([place[c] for c in on]), compass[step, on], turn))
    given = drive.begin[:, [0, 1, 3]]
    on = [c for c in columns if step == 0 and np.isfinite(given[c]).any()]
    if on:
        std = np.where(np.isnan(given[on]), np.inf, drive.spread[[0, 1, 3]])
        z = pose(np.nan_to_num(given[on, :2]), np.nan_to_num(given[on, 2]))
        found.append(of_recorded("pose", _column([place[c] for c in on]), z, std))
    return found


def _relative(drive: Drive, links: Ints, place: Mapping[int, int]) -> list[Factor]:
    """Ranges and bearings: both as one measurement where both are there."""
    table = drive.recording.links
    first, second = ([place[c] for c in ends[links].tolist()] for ends in (table.observer, table.neighbour))
    pairs, found = np.array([first, second], dtype=np.int64).T, []
    for kind, rows, z, std in drive.relative:
        on = rows[links]
        if on.any():
            found.append(of_checked(kind, pairs[on], z[links[on]], std))
    return found
