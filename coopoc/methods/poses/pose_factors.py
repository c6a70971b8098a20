"""Factors of a step of a recording in body frames, in the plane: odometry, fixes, compass, ranges, bearings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from ...optimize.model.factor import Factor, of_checked
from ...optimize.model.inputs import check_std
from ...optimize.model.measurements import lookup
from ...optimize.model.problem import Problem
from ...optimize.model.space import Space, pose
from ...world.body_frames import turned
from ...world.recording import Recording
from ...world.sensors import Sensors
from .pose_inputs import LEAST_HEADING_STD, LEAST_YAW_RATE_STD, body_of, present

PLANE = Space(2, has_rotation=True)
NOTHING = Problem((), dimension=2)
LANDMARK_STD = 0.01
"""m, of the prior of a landmark, whose position is known."""


@dataclass(frozen=True, eq=False)
class PoseRun:
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
    def present(self) -> Bools:
        """(T, N) whether a vehicle is there."""
        return present(self.recording)

    @cached_property
    def odometry(self) -> tuple[Floats, Floats]:
        """(T, N, 6) poses of vehicles as those of the step before see them, and (T, N, 3) their std."""
        recording, there = self.recording, self.present
        dt, rate = recording.dt, body_of(recording).yaw_rate[self.run][there]
        velocity = recording.velocity[self.run][there]
        moved, std = np.zeros((*there.shape, PLANE.ambient)), np.ones((*there.shape, PLANE.dof))
        moved[there] = pose(dt * turned(velocity, 0.5 * dt * rate)[:, :2], dt * rate)
        turn = np.full((len(rate), 1), max(self.noise.yaw_rate_std, LEAST_YAW_RATE_STD))
        own = dt * np.hstack([self.noise.assumed_velocity_std(velocity)[:, :2], turn])
        std[there] = check_std(lookup("relative_pose_log"), own, own.shape)
        return moved, std

    @cached_property
    def own(self) -> list[tuple[str, Bools, Floats, Floats]]:
        """Of fixes, compasses and given poses: kind, which vehicles at which steps (T, N), z (T, N, k), (1 or N, k)
        std."""
        recording, noise, given = self.recording, self.noise, self.begin[:, [0, 1, 3]]
        fix, heading = recording.gnss[self.run, :, :, :2], body_of(recording).heading[self.run]
        angles, filled = np.nan_to_num(heading).ravel(), np.nan_to_num(given)
        compass = pose(np.zeros((len(angles), 2)), angles).reshape(*heading.shape, PLANE.ambient)
        first, start = np.zeros(heading.shape, dtype=bool), np.zeros(compass.shape)
        first[0], start[0] = np.isfinite(given).any(axis=1), pose(filled[:, :2], filled[:, 2])
        turn = max(float(np.hypot(noise.heading_std, noise.heading_bias_std)), LEAST_HEADING_STD)
        return [
            _kind("position", np.isfinite(fix.sum(axis=2)), fix, np.array(noise.fix_std[:2])),
            _kind("pose", np.isfinite(heading), compass, np.array([np.inf, np.inf, turn])),
            _kind("pose", first, start, np.where(np.isnan(given), np.inf, self.spread[[0, 1, 3]])),
        ]

    @cached_property
    def relative(self) -> list[tuple[str, Bools, Floats, Floats]]:
        """Of ranges with bearings, ranges and bearings alone: kind, which links (L,), z of all and (1, size) std."""
        distance, bearing, inclination = self.recording.relative[self.run].T
        flat = distance * np.sin(np.where(np.isnan(inclination), 0.5 * np.pi, inclination))
        far, near = np.isfinite(flat), np.isfinite(bearing)
        both = np.array([self.noise.range_std, self.noise.azimuth_std])
        return [
            _kind("body_spherical", far & near, np.column_stack([flat, bearing]), both),
            _kind("range", far & ~near, flat[:, None], both[:1]),
            _kind("bearing", near & ~far, bearing[:, None], both[1:]),
        ]

    @cached_property
    def links(self) -> list[Ints]:
        """Links of each step between vehicles that are there, and to landmarks, whose measurements arrive at once."""
        links, marks = self.recording.links, np.zeros(len(self.recording.ids), dtype=bool)
        marks[list(self.recording.landmarks)] = True
        arrived = self.recording.arrival[self.run] == links.step
        counts = np.flatnonzero(~marks[links.observer] & (marks[links.neighbour] | arrived))
        return np.split(counts, np.searchsorted(links.step[counts], np.arange(1, len(self.recording.t))))


def _kind(kind: str, where: Bools, z: Floats, std: Floats) -> tuple[str, Bools, Floats, Floats]:
    """With a std that is checked, where there is a measurement."""
    rows = std.shape[0] if std.ndim > 1 else 1
    return kind, where, z, check_std(lookup(kind), std, (rows, std.shape[-1])) if where.any() else std


def node(recording: Recording, column: int, step: int) -> str:
    """Name of a vehicle's pose at a step."""
    return f"{recording.ids[column]}@{step}"


def pose_subgraph(run: PoseRun, step: int, known: Mapping[str, Floats]) -> Problem:
    """Poses of all vehicles at a step, and what joins them to those of the step before and to landmarks.

    th' = th + dt w, p' = p + dt R(th + dt w / 2) u; ranges are taken to the plane, r sin(inclination). Measurements of
    another vehicle count if its message arrives at their step.

    Args:
        run: of a recording.
        step: t.
        known: name -> (6,) node of each pose of the step before, and of each landmark that was measured before.

    Raises:
        InputError: a vehicle that joins with neither a pose nor fix and compass.
    """
    recording, here = run.recording, np.flatnonzero(run.present[step]).tolist()
    stayed = [c for c in here if step and node(recording, c, step - 1) in known]
    joined, links = [c for c in here if c not in stayed], run.links[step]
    marks = sorted({*recording.links.neighbour[links].tolist()} & {*recording.landmarks})
    names = [node(recording, c, step - 1) for c in stayed]
    before = np.array([known[name] for name in names]).reshape(-1, PLANE.ambient)
    moved, std = (values[step, stayed] for values in run.odometry)
    names += [node(recording, c, step) for c in (*stayed, *joined)] + [recording.ids[c] for c in marks]
    index = np.full(len(recording.ids), -1)
    index[[*stayed, *joined, *marks]] = len(stayed) + np.arange(len(here) + len(marks))
    stand = PLANE.join(recording.gnss[run.run, 0, marks, :2])
    x0 = np.concatenate([before, _after(before, moved), _first(run, step, joined), stand])
    factors: list[Factor] = []
    if stayed:
        pairs = np.arange(2 * len(stayed)).reshape(2, -1).T
        factors.append(of_checked("relative_pose_log", pairs, moved, std))
    for kind, where, z, own_std in run.own:
        on = [c for c in here if where[step, c]]
        if on:
            factors.append(of_checked(kind, index[on, None], z[step, on], own_std[on] if len(own_std) > 1 else own_std))
    fresh = index[[c for c in marks if recording.ids[c] not in known]]
    if len(fresh):
        factors.append(of_checked("position", fresh[:, None], x0[fresh, :2], np.full((1, 2), LANDMARK_STD)))
    ends = np.stack([index[recording.links.observer], index[recording.links.neighbour]], axis=1)
    for kind, where, z, relative_std in run.relative:
        rows = links[where[links]]
        if len(rows):
            factors.append(of_checked(kind, ends[rows], z[rows], relative_std))
    poses = tuple(range(len(stayed) + len(here)))
    return NOTHING.replace_unchecked(names=tuple(names), factors=tuple(factors), x0=x0, poses=poses)


def _after(x: Floats, moved: Floats) -> Floats:
    """Poses (M, 6) after relative poses (M, 6)."""
    rotation = PLANE.rotation(x)
    position = x[:, :2] + (rotation @ moved[:, :2, None])[..., 0]
    return PLANE.join(position, rotation @ PLANE.rotation(moved))


def _first(run: PoseRun, step: int, columns: Sequence[int]) -> Floats:
    """(M, 6) of what is given of first poses, else fixes and compasses."""
    recording = run.recording
    heading = body_of(recording).heading[run.run, step, columns]
    measured = np.column_stack([recording.gnss[run.run, step, columns, :2], heading])
    given = run.begin[columns][:, [0, 1, 3]] if step == 0 else np.full_like(measured, np.nan)
    first = np.where(np.isnan(given), measured, given)
    for column, row in zip(columns, first, strict=True):
        if np.isnan(row).any():
            what = f"{recording.ids[column]} joins at step {step} without fix and compass"
            raise InputError("begin", what, "must be known where it joins", "Cut it with recording.between(...).")
    return pose(first[:, :2], first[:, 2]) if len(first) else np.empty((0, PLANE.ambient))
