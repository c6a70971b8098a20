"""Streaming poses: a vehicle alone or its star, fed step by step with what is measured on board and what arrives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..world.links import wrap
from . import pose_unit
from .motion_history import names_of, seconds
from .pose_measurement import BodyMeasurement, OwnMeasurement

if TYPE_CHECKING:
    from ..kernels.poses.pose_filter import PoseOptions
    from ..kernels.poses.pose_members import PoseSeen
    from ..kernels.poses.pose_motion import PoseNoise


class PoseEstimate(NamedTuple):
    """Pose of the ego.

    Attributes:
        x: (d,) position m, heading rad and, of six numbers, speed scale and yaw-rate bias rad/s.
        covariance: (d, d).
    """

    x: Floats
    covariance: Floats


class PoseStream:
    """A pose filter of one's own, step by step (`PoseFilter.start`); fed a recording it gives the numbers of its Track.

    Args:
        star: whether neighbours take part.
        noise: that is assumed.
        options: of the filter.
        begin: (4,) m and rad, pose at the first step, NaN for its fix and compass; and its standard deviations.
        dt: s of a step.
        max_age: s, older messages are not used.
    """

    def __init__(
        self,
        star: bool,
        noise: PoseNoise,
        options: PoseOptions,
        begin: tuple[Floats, Floats],
        dt: float,
        max_age: float,
    ) -> None:
        self._star, self._noise, self._options, self._dt = star, noise, options, dt
        self._oldest = int(seconds("max_age", max_age) / dt + 1e-9)
        self._first, self._spread = begin
        self._columns: dict[str, int] = {}
        self._own = np.full((1, self._oldest + 2, 1, 8), np.nan)
        self._newest, self._linked = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
        self._before = np.zeros((2, 0), dtype=np.int64)
        self._memory, self._step = pose_unit.memory(8, options.d), 0

    def step(self, own: OwnMeasurement, seen: Sequence[BodyMeasurement] = ()) -> PoseEstimate:
        """Pose of the ego now.

        Args:
            own: measurement of itself.
            seen: neighbours and landmarks, one for each, the nearest first as in a recording.

        Raises:
            InputError: a first step without fix and compass where `begin` does not give them; one seen twice;
                neighbours of a vehicle alone.
        """
        from ..kernels.poses.pose_filter import follow

        self._check(own, seen)
        self._own[:, :-1], self._own[:, -1] = self._own[:, 1:], np.nan
        self._own[0, -1, 0], self._newest[0] = own.row, self._step
        for one in seen:
            self._receive(one)
        found, members = self._seen([one for one in seen if one.relative is not None])
        begin = np.full((1, len(self._newest), 4), np.nan)
        begin[0, 0] = self._first
        options = self._options._replace(first=len(found.start) - 2)
        x, cov, _ = follow(found, self._noise, begin, self._spread, options, self._memory)
        self._before, self._step = members, self._step + 1
        state = x[0, len(found.member) - members.shape[1]]
        state[3] = wrap(state[3])
        return PoseEstimate(state, cov[0, len(found.member) - members.shape[1]])

    def _check(self, own: OwnMeasurement, seen: Sequence[BodyMeasurement]) -> None:
        names = names_of("seen", seen, BodyMeasurement)
        if not self._star and any(one.place is None for one in seen):
            raise InputError("seen", names, "must be landmarks of a vehicle alone", 'Take PoseFilter("star").')
        if self._step == 0 and np.isnan(np.where(np.isnan(self._first), own.row[:4], self._first)).any():
            raise InputError(
                "begin", None, "must give what the first fix and compass do not", "Give (x, y, z, heading)."
            )

    def _receive(self, one: BodyMeasurement) -> None:
        """Keep the newest message of a neighbour at the step at which it was sent."""
        if one.place is not None:
            return
        if one.id not in self._columns:
            self._columns[one.id] = len(self._newest)
            self._own = np.append(self._own, np.full((1, self._own.shape[1], 1, 8), np.nan), axis=2)
            self._newest, self._linked = np.append(self._newest, -1), np.append(self._linked, -1)
        column, late = self._columns[one.id], round(one.age / self._dt)
        if one.message is not None and late <= self._oldest and self._step - late > self._newest[column]:
            self._own[0, -1 - late, column], self._newest[column] = one.message.row, self._step - late

    def _seen(self, seen: Sequence[BodyMeasurement]) -> tuple[PoseSeen, Any]:
        """Arguments of the kernel for two steps, the last one and this; columns of this step's members, and what was
        newest of each."""
        from ..kernels.poses.pose_members import PoseSeen

        steps = self._own.shape[1] if self._step else 1
        now = np.array([0, *(self._columns[one.id] for one in seen if one.place is None)])
        newest = np.where(self._step - self._newest[now] > self._oldest, -1, self._newest[now])
        fresh = (self._newest[now] > self._linked[now]) & (newest >= 0)
        fresh[0], self._linked[now] = True, self._newest[now]
        members = np.stack([now, newest])
        both = np.concatenate([self._before, members], axis=1)
        local = np.where(both[1] < 0, -1, both[1] - self._step + steps - 1)
        start, first = np.zeros((2, steps + 1), dtype=np.int64)
        start[-2], start[-1], first[-1] = self._before.shape[1], both.shape[1], len(seen)
        self._memory = pose_unit.grown(self._memory, len(now), self._options.d)
        places = {column: place for place, column in enumerate(now.tolist())}
        other = [-1 if one.place is not None else places[self._columns[one.id]] for one in seen]
        ends = np.stack([np.zeros(len(seen), dtype=np.int64), np.array(other, dtype=np.int64)], axis=1)
        place = np.array([one.place if one.place is not None else np.zeros(3) for one in seen]).reshape(-1, 3)
        relative = np.array([one.relative for one in seen], dtype=float).reshape(1, -1, 3)
        shown = np.concatenate([np.zeros(self._before.shape[1], dtype=bool), fresh])
        own = np.ascontiguousarray(self._own[:, -steps:])
        return PoseSeen(own, both[0], start, local[None], shown[None], ends, first, place, relative, self._dt), members
