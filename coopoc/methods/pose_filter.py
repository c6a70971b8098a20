"""The pose filter: position and heading of a vehicle, its star or the whole fleet, from what is measured on board."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from ..arrays import Bools, Floats, Ints, checked, number
from ..errors import InputError
from ..plugins import one_of
from ..short_repr import short_repr
from ..world.recording import Recording, check_recording
from ..world.sensors import Sensors
from ..world.spherical import wrap
from ..world.v2x import NO_MESSAGE, Message
from . import pose_unit
from .options import check_options
from .pose_begin import first_poses, pose_egos
from .pose_estimates import each, whole
from .pose_stream import PoseStream
from .pose_unit import Members
from .track import Track
from .whole_fleet import CENTRE

if TYPE_CHECKING:
    from ..kernels.poses.pose_filter import PoseOptions

Unit = Literal["solo", "star", "fleet"]
Fusion = Literal["joint", "naive", "intersection"]
SPREAD = (1.0, 1.0, 1.0, 0.2)
"""m and rad, standard deviations of poses at the first step that are given."""


@dataclass(frozen=True, eq=False)
class PoseFilter:
    """Extended Kalman filter of (x, y, z, heading) driven by speed and yaw rate, with fixes, compass, ranges, bearings.

    th' = th + dt w, p' = p + dt R(th + dt w / 2) u; range |p_j - p_i|, bearing atan2(p_j - p_i) - th_i; a component
    that was not measured is no row. A landmark's position is known. With `exact` one more Gauss-Newton step on the
    relative measurements follows, from the same prior.

    Args:
        unit: "solo", a vehicle and its landmarks; "star", an ego and its neighbours in one state, by what they
            broadcast; "fleet", all vehicles.
        fusion: of a fleet. "joint": one state with all cross-covariances, at a centre, the optimum. Decentralised, each
            vehicle fuses the estimates that reach it in time: "naive" as if their errors were independent;
            "intersection" by covariance intersection.
        lasting: estimate the odometer's scale error and the yaw rate's bias, too (`Track.extras`).
        exact: False is the plain extended Kalman filter.
        invariant: the right-invariant filter of SE(2), of a solo vehicle: errors are those of the group.
        gate: standard deviations of an innovation beyond which a component is left out; infinity keeps all.
        begin: (N, 4) or (R, N, 4) m and rad, poses at the first step; None or NaN: the first fix and compass.
        spread: (4,) standard deviations of these.
        assumed: noise, default that of the recording.

    References:
        Thrun, Burgard, Fox, Probabilistic Robotics, 2005, section 7.4.
        Roumeliotis, Bekey, Distributed multirobot localization, IEEE TRA 18(5), 2002 (the fleet's joint state).
        Barrau, Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE TAC 62(4), 2017.
        Carrillo-Arce, Nerurkar, Gordillo, Roumeliotis, Decentralized multi-robot cooperative localization using
        covariance intersection, IROS 2013.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[9, 0, 0]]], np.full((2, 1, 3), [9.0, 0, 0]))
    >>> track = PoseFilter("solo")(observe(fleet, Sensors(), runs=3, frame="body"))
    >>> track.x.shape, track.heading.shape
    ((3, 2, 1, 3), (3, 2, 1))
    """

    unit: Unit = "star"
    fusion: Fusion = "joint"
    lasting: bool = False
    exact: bool = True
    invariant: bool = False
    gate: float = np.inf
    begin: Floats | None = None
    spread: tuple[float, ...] = SPREAD
    assumed: Sensors | None = None
    name: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_options(self)
        for field, words in (("unit", get_args(Unit)), ("fusion", get_args(Fusion))):
            one_of(field, getattr(self, field), words)
        if self.fusion != "joint" and self.unit != "fleet":
            raise InputError("fusion", self.fusion, "is for a fleet", 'Take unit="fleet".')
        if self.invariant and (self.unit != "solo" or self.exact):
            hint = 'Take PoseFilter("solo", exact=False, invariant=True).'
            raise InputError("invariant", True, "is for a solo vehicle and one linearisation", hint)
        number("gate", self.gate, 1.0, np.inf, allowed=">= 1 standard deviation", hint="4 leaves outliers out.")
        if not (checked("spread", self.spread, "(4,)", (4,)) > 0).all():
            raise InputError("spread", self.spread, "must be > 0", "Give m, m, m and rad.")
        if not self.name:
            word = self.unit if self.fusion == "joint" else self.fusion
            object.__setattr__(self, "name", f"pose-{'invariant' if self.invariant else word}")

    @property
    def cooperative(self) -> bool:
        """Whether other vehicles take part."""
        return self.unit != "solo"

    @property
    def message(self) -> Message:
        """What each vehicle sends."""
        if self.unit == "fleet":
            return pose_unit.UPLOAD if self.fusion == "joint" else pose_unit.POSE
        return pose_unit.ODOMETRY if self.cooperative else NO_MESSAGE

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos.

        Raises:
            InputError: a recording in the world frame, an ego that is unknown, absent at times or a landmark, one whose
                first pose is not known, or a star whose neighbours send no compass.
        """
        began, recording = time.perf_counter(), check_recording(recording, body=True)
        columns = pose_egos(recording, egos)
        begin = first_poses(recording, self.begin, None if self.unit == "fleet" else columns)
        if self.unit == "fleet":
            units = whole(self.follow, self.message, self.fusion == "joint", recording, columns, begin)
        else:
            units = each(self.follow, self.message, self.unit == "star", recording, columns, begin)
        found = {one.ego: one for one in units}
        mine = [found[ego] for ego in columns]
        x = np.stack([one.x[:, one.place] for one in mine], axis=2)
        cov = np.stack([one.covariance[:, one.place] for one in mine], axis=2)
        extras: dict[str, Floats] = {}
        for k, name in enumerate(("speed_scale", "yaw_rate_bias") if self.lasting else (), 4):
            extras |= {name: x[..., k], f"{name}_std": np.sqrt(cov[..., k, k])}
        notes = (CENTRE,) if self.unit == "fleet" and self.fusion == "joint" else ()
        return Track(
            recording.t,
            tuple(columns),
            x[..., :3],
            cov[..., :3, :3],
            np.stack([one.received for one in mine], axis=1),
            np.stack([one.sent for one in mine], axis=1),
            time.perf_counter() - began,
            np.concatenate([one.neighbours for one in mine], axis=1),
            notes,
            wrap(x[..., 3]),
            cov[..., 3, :4],
            extras,
        )

    def start(self, dt: float, begin: Floats | None = None, *, max_age: float = 1.0) -> PoseStream:
        """This filter for a vehicle alone or a star that is fed as it drives, one `step` of dt s after the other.

        Args:
            dt: s.
            begin: (4,) m and rad, pose at the first step; None: its fix and compass.
            max_age: s, older messages are not used.

        Raises:
            InputError: a filter of a fleet, or one without `assumed`.

        >>> from coopoc import OwnMeasurement, Sensors
        >>> stream = PoseFilter("solo", assumed=Sensors(heading_std=0.1)).start(dt=0.1)
        >>> stream.step(OwnMeasurement([9.0, 0, 0], 0.0, gnss=[1.0, 2.0, 0.0], heading=0.5)).x.round(3).tolist()
        [1.0, 2.0, 0.0, 0.5]
        """
        if self.unit == "fleet":
            raise InputError("unit", self.unit, "has no stream", 'Take "solo" or "star".')
        if self.assumed is None:
            raise InputError("assumed", None, "is needed: a stream has no recording", "Give assumed=Sensors(...).")
        dt = number("dt", dt, 1e-6, 3600.0, allowed="> 0 s", hint="0.1 is 10 Hz.")
        noise = pose_unit.pose_noise(self.assumed.check_assumed(), dt, self.gate)
        given = np.full(4, np.nan) if begin is None else np.asarray(begin, dtype=float)
        if given.shape != (4,):
            raise InputError("begin", begin, "must be (x, y, z, heading)", "Give NaN for what is not known.")
        first = given, np.array(self.spread, dtype=float)
        return PoseStream(self.unit == "star", noise, self.options(), first, dt, max_age)

    def follow(
        self,
        recording: Recording,
        members: Members,
        links: Ints,
        begin: Floats,
        kept: Bools | None = None,
        place: Floats | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """States, covariances, and cost and number of measurements of a unit; `kept` and `place` as of `seen`."""
        from ..kernels.poses.pose_filter import follow, follow_apart

        noise = pose_unit.pose_noise(self.assumed or recording.sensors, recording.dt, self.gate)
        measured, options = pose_unit.seen(recording, members, links, kept, place), self.options()
        memory = pose_unit.memory(int(np.diff(members.start).max()), options.d)
        run = follow if self.fusion == "joint" else follow_apart
        return run(measured, noise, begin, np.array(self.spread, dtype=float), options, memory)

    def options(self) -> PoseOptions:
        """As the kernel takes them."""
        from ..kernels.poses.pose_filter import PoseOptions

        fusion = get_args(Fusion).index(self.fusion)
        return PoseOptions(6 if self.lasting else 4, 1 + self.exact, self.invariant, fusion, 0)
