"""The pose filter: extended Kalman filter of position and heading of a vehicle alone or of the whole fleet."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy import inf, nan

from ...arrays import Bools, Floats, Ints, check_fields, checked, number, refuse
from ...errors import InputError
from ...kernels.compiling.waiting import clock
from ...text import short_repr
from ...world.body_frames import between_origins
from ...world.inbox import inbox
from ...world.links import wrap
from ...world.plausible import radians
from ...world.recording import Recording, Vehicles, check_recording
from ...world.sensors import Sensors
from ...world.v2x import NO_MESSAGE, Message
from ..batch_smoother import CENTRE, centre
from ..doubts import doubts
from ..track import Track, noted
from .pose_inputs import (
    POSE,
    SPREAD,
    UPLOAD,
    body_of,
    first_poses,
    fleet_members,
    pose_measurements,
    pose_noise,
    present,
    to_landmarks,
)
from .pose_start import likely_poses
from .pose_stream import PoseStream

if TYPE_CHECKING:
    from ...kernels.poses.scalar_update import PoseNoise

PASSES = 3
"""Of the iterated filter: from one more on nothing moves by a hundredth of its standard deviation."""
START_SECONDS, START_GATE = 30.0, 5.0
"""s of a drive that show a first pose, and standard deviations of an innovation there."""
Unit = Literal["solo", "fleet"]
Fusion = Literal["joint", "naive", "intersection"]


@dataclass(frozen=True, eq=False)
class PoseFilter:
    """Extended Kalman filter of (x, y, z, heading) driven by speed and yaw rate, with fixes, compass, ranges, bearings.

    th' = th + dt w, p' = p + dt R(th + dt w / 2) u; range |p_j + R(th_j) t_j - p_i - R(th_i) t_i| between `tags` of the
    recording, bearing atan2(p_j - p_i) - th_i; a component that was not measured is no row. A landmark's position is
    known. With `exact` two more Gauss-Newton steps on the relative measurements follow, from the same prior: the
    iterated filter. There what is not linear, by second derivatives, counts as noise, so that vague positions do not
    make exact angles over-confident.

    Args:
        unit: "solo", each vehicle with its landmarks; "fleet", all vehicles.
        fusion: of a fleet. "joint": one state with all cross-covariances, at a centre, the optimum. Decentralised, each
            vehicle fuses the estimates that reach it in time: "naive" as if their errors were independent;
            "intersection" by covariance intersection.
        lasting: estimate the odometer's scale error, the yaw rate's bias and, if assumed, an offset of ranges, in a
            joint state also of each pair whose ends have fixes, and a slow error of the velocity, too
            (`Track.extras`); None where the noise has any of them, as that of a log.
        exact: False is the plain extended Kalman filter.
        robust: a component beyond its gate weighs less, far beyond it nothing, unless many are
            (`coopoc.kernels.gate`); False believes every number.
        gate: standard deviations of an innovation.
        begin: (N, 4) or (R, N, 4) m and rad, poses at the first step; None or NaN: the first fix and compass.
        spread: (4,) standard deviations of these; None: SPREAD, of a position at least that of a fix if there is one.
        assumed: noise, default that of the recording.

    References:
        Thrun, Burgard, Fox, Probabilistic Robotics, 2005, section 7.4.
        Bar-Shalom, Li, Kirubarajan, Estimation with applications to tracking and navigation, Wiley 2001, 10.3.2 (the
        second-order filter).
        Roumeliotis, Bekey, Distributed multirobot localization, IEEE TRA 18(5), 2002 (the fleet's joint state).
        Carrillo-Arce, Nerurkar, Gordillo, Roumeliotis, Decentralized multi-robot cooperative localization using
        covariance intersection, IROS 2013.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[9, 0, 0]]], np.full((2, 1, 3), [9.0, 0, 0]))
    >>> track = PoseFilter("solo")(observe(fleet, Sensors(), runs=3, frame="body"))
    >>> track.x.shape, track.heading.shape
    ((3, 2, 1, 3), (3, 2, 1))
    """

    unit: Unit = "fleet"
    fusion: Fusion = "joint"
    lasting: bool | None = None
    exact: bool = True
    robust: bool = True
    gate: float = 3.0
    begin: Floats | None = None
    spread: tuple[float, ...] | None = None
    assumed: Sensors | None = None
    name: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self)
        if self.fusion != "joint" and self.unit != "fleet":
            raise InputError("fusion", self.fusion, "is for a fleet", 'Take unit="fleet".')
        number("gate", self.gate, 1.0, inf, allowed=">= 1 standard deviation", hint="A gate of 4 rejects outliers.")
        refuse(
            "spread", self._spread, ~(self._spread > 0), "must be > 0", "Give standard deviations in m, m, m and rad."
        )
        if not self.name:
            self.__dict__["name"] = f"pose-{self.unit if self.fusion == 'joint' else self.fusion}"

    @property
    def _spread(self) -> Floats:
        return checked("spread", SPREAD if self.spread is None else self.spread, "(4,)", (4,)).copy()

    @property
    def cooperative(self) -> bool:
        """Whether other vehicles take part.

        >>> PoseFilter("solo").cooperative, PoseFilter("fleet").cooperative
        (False, True)
        """
        return self.unit != "solo"

    @property
    def message(self) -> Message:
        """What each vehicle sends."""
        if self.unit == "solo":
            return NO_MESSAGE
        return UPLOAD if self.fusion == "joint" else POSE

    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos.

        Raises:
            InputError: a recording in the world frame, an ego that is unknown or a landmark, or one whose first pose is
                not known.
        """
        began, recording = clock(), check_recording(recording, body=True)
        columns, links, notes = recording.observing(egos), recording.links, tuple[str, ...]()
        for column in columns:
            if column in recording.landmarks:
                raise InputError(
                    "egos",
                    repr(recording.ids[column]),
                    "is a landmark",
                    "Choose a vehicle: the position of a landmark is known.",
                )
        received, sent = moved = np.zeros((2, recording.runs, len(columns)))
        if self.unit == "solo":
            begin = self._begins(recording, columns)
            alone = [self._run_filter(recording, [c], to_landmarks(recording, links.of(c)), begin) for c in columns]
            x, cov = (np.concatenate(parts, 2) for parts in list(zip(*alone, strict=True))[:2])
            theirs, world = _seen(recording, columns, x, []), _in_world(recording, columns, x)
        else:
            members = fleet_members(recording)
            begin = self._begins(recording, members)
            own = np.flatnonzero(~np.isin(links.observer, recording.landmarks))
            in_time = (recording.arrival == links.step) | np.isin(links.neighbour, recording.landmarks)
            x, cov, _ = self._run_filter(recording, members, own, begin, in_time[:, own])
            theirs, world = _seen(recording, columns, x, members), _in_world(recording, members, x)
            x, cov = (values[:, :, [members.index(column) for column in columns]] for values in (x, cov))
        if self.unit == "fleet" and self.fusion == "joint":
            both, notes = centre(recording, self.message), (CENTRE,)
            moved[:] = [each[:, columns] for each in both]
        elif self.unit == "fleet":
            for k, column in enumerate(columns):
                messages = inbox(recording, column, self.message)
                received[:, k], sent[:, k] = messages.received_bytes, messages.sent_bytes
        positions = np.ascontiguousarray(x[..., :3]), np.ascontiguousarray(cov[..., :3, :3])
        notes += doubts(world, columns, *positions, neighbours=theirs)
        extras: dict[str, Floats] = {}
        lasting = "speed_scale", "yaw_rate_bias", "range_offset", *(f"{axis}_error" for axis in ("vx", "vy", "vz"))
        for k, name in enumerate(lasting[: x.shape[-1] - 4], 4):
            extras |= {name: x[..., k], f"{name}_std": np.sqrt(cov[..., k, k])}
        absent = ~present(recording)[:, columns]
        track = Track(
            recording.t,
            tuple(columns),
            *positions,
            received,
            sent,
            clock() - began,
            notes=notes,
            heading=wrap(x[..., 3]),
            heading_covariance=cov[..., 3, :4],
            extras=extras,
            ids=recording.ids,
            absent=absent if absent.any() else None,
        )
        return noted(track)

    def _begins(self, recording: Recording, members: Sequence[int]) -> Floats:
        """Poses (R, S, N, 4) at the first step, and where members begin after a gap: NaN where a fix and a compass are,
        else those of `pose_start`; in a fleet NaN where it finds none."""
        there, every = present(recording), [first_poses(recording, self.begin, members)]
        has_pose = np.isfinite(recording.gnss[..., 0] + body_of(recording).heading).min(0)
        for column in members:
            starts = 1 + np.flatnonzero(there[1:, column] & ~there[:-1, column])
            for again, start in enumerate(starts.tolist(), 1):
                if again == len(every):
                    every.append(np.full_like(every[0], nan))
                part = recording.between(start, min(start + int(START_SECONDS / recording.dt) + 2, len(there)))
                with suppress(*[InputError] * (self.unit == "fleet")):
                    if not has_pose[start, column] and len(part.t) > 1:
                        one = PoseFilter("solo", gate=START_GATE)
                        every[again][:, column] = likely_poses(part, one, [column])[:, column]
        return np.stack(every, 1)

    def start(self, dt: float, begin: Floats | None = None) -> PoseStream:
        """This filter for a vehicle alone that is fed as it drives, one `step` of dt s after the other.

        Args:
            dt: s.
            begin: (4,) m and rad, pose at the first step; None: its fix and compass.

        Raises:
            InputError: a filter of a fleet, or one without `assumed`.

        >>> from coopoc import OwnMeasurement, Sensors
        >>> stream = PoseFilter("solo", assumed=Sensors(heading_std=0.1)).start(dt=0.1)
        >>> stream.step(OwnMeasurement([9.0, 0, 0], 0.0, gnss=[1.0, 2.0, 0.0], heading=0.5)).x.round(3).tolist()
        [1.0, 2.0, 0.0, 0.5]
        """
        if self.unit == "fleet":
            raise InputError("unit", self.unit, "cannot be streamed", 'Take "solo".')
        if self.assumed is None:
            raise InputError("assumed", None, "is needed: a stream has no recording", "Give assumed=Sensors(...).")
        dt = number("dt", dt, 1e-6, 3600.0, allowed="> 0 s", hint="0.1 is 10 Hz.")
        first = np.full(4, nan) if begin is None else checked("begin", begin, "(4,)", (4,))
        radians("headings of begin", first[3:])
        return PoseStream(self._settings(self.assumed, dt), first, self._spread, dt)

    def _run_filter(
        self,
        recording: Recording,
        members: Sequence[int],
        links: Ints,
        begin: Floats,
        kept: Bools | None = None,
        landmark: Floats | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """States (R, T, n, d), covariances (R, T, n, d, d), and cost and number of rows (R, 2) of some members.

        Args:
            recording: in body frames.
            members: columns.
            links: as of `pose_measurements`, like `kept` and `landmark`.
            begin: (R, N, 4) poses at the first step, or (R, S, N, 4) at it and where a member begins anew.
            kept: which links count.
            landmark: position of what they measure.
        """
        from ...kernels.poses.ekf import run_filter
        from ...kernels.poses.odometry import new_faults
        from ...kernels.poses.scalar_update import new_poses

        sensors, spread = self.assumed or recording.sensors, self._spread
        if self.spread is None and np.isfinite(recording.gnss[:, :, members]).any():
            spread[:3] = np.maximum(spread[:3], sensors.fix_std)
        noise = self._settings(sensors, recording.dt)
        measured = pose_measurements(recording, members, links, kept, landmark)
        pairs = 1 + int(noise.longer * measured.ends[:, 2].max(initial=0))
        poses, pair = new_poses(len(members) * noise.d + pairs), new_poses(2 * noise.d + 1)
        first = np.ascontiguousarray(begin.reshape(len(begin), -1, *begin.shape[-2:])[:, :, members])
        return run_filter(measured, noise, first, spread, poses, pair, new_faults(len(members), noise, recording.dt))

    def _settings(self, sensors: Sensors, dt: float) -> "PoseNoise":
        """What it assumes, and its options, as the kernel takes them."""
        noise = pose_noise(sensors, dt, self.gate if self.robust else inf, self.lasting is not False)
        numbers = 4 + 2 * (self.lasting is True or any(noise.lasting)) + int(noise.longer)
        numbers = 10 if any(noise.lasting[3:]) else numbers
        passes, fusion = PASSES if self.exact else 1, get_args(Fusion).index(self.fusion)
        return noise._replace(d=numbers, passes=passes, fusion=fusion)


def pose_start(recording: Recording, *, seconds: float = START_SECONDS, gate: float = START_GATE) -> Floats:
    """Poses (R, N, 4) m and rad at the first step, for `PoseFilter(begin=...)`; NaN for landmarks and absent vehicles.

    A heading and the first fix, or the first range and bearing of a landmark, give a vehicle's pose there, and the
    odometry until then gives its pose at the first step; so do, by least squares, ranges to three landmarks or more.
    Headings around the circle are tried, then headings around the best: a solo filter starts from each, and the one
    with the largest likelihood of its innovations, and of bearings of other vehicles from fix to fix, is kept. Its
    estimate of least variance, moved back by odometry, gives the first pose. With a compass only its heading is tried.
    Vehicles without a fix that measure fewer than two landmarks come last: vehicles with a pose then count as
    landmarks.

    Args:
        recording: in body frames.
        seconds: of it that are used.
        gate: as of the filter.

    Raises:
        InputError: a vehicle that has no fix and sees too little of landmarks and vehicles with a pose in that time.

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
    >>> rough = Sensors(gnss_std=(0.1, 0.1, 0.1), yaw_rate_std=0.3, compass=False)
    >>> begin = pose_start(observe(fleet, rough, assumed=rough, frame="body", runs=9))
    >>> bool(np.linalg.norm(begin[:, 0, :2] - path[0, 0, :2], axis=1).max() < 0.4)  # though odometry leads astray
    True
    """
    check_recording(recording, body=True)
    steps = int(min(number("seconds", seconds, hint="30 is the default.") / recording.dt + 1.0, len(recording.t)))
    part = recording.between(0, max(steps, 2))
    return likely_poses(part, PoseFilter("solo", gate=gate), fleet_members(part))


def _seen(recording: Recording, columns: Sequence[int], x: Floats, members: Sequence[int]) -> Floats:
    """(R, L, 3) m, by link of each ego, where what it measures is: a landmark, or a member by its state x (R, T, n, d);
    NaN where nothing is known."""
    places = np.full(recording.gnss.shape, nan)
    places[:, :, list(recording.landmarks)] = recording.gnss[:, :, list(recording.landmarks)]
    places[:, :, list(members)] = x[:, :, : len(members), :3]
    links, own = recording.links, np.concatenate([recording.links.of(column) for column in columns])
    return places[:, links.step[own], links.neighbour[own]]


def _in_world(recording: Recording, members: Sequence[int], x: Floats) -> Recording:
    """A recording whose bearings are azimuths, and whose ranges are between origins, by the states x (R, T, n, d)."""
    position, turn, links = recording.gnss.copy(), np.zeros(recording.gnss.shape[:3]), recording.links
    position[:, :, list(members)], turn[:, :, list(members)] = x[..., :3], x[..., 3]
    relative = recording.relative.copy()
    relative[..., 1] = wrap(relative[..., 1] + turn[:, links.step, links.observer])
    return between_origins(replace(recording, relative=relative), position, turn)
