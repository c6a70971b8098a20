"""Streaming poses: a vehicle alone, fed step by step with what is measured on board."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy import inf, nan
from numpy.typing import ArrayLike

from ...arrays import Floats, instance, number
from ...errors import InputError
from ...world.links import wrap
from ...world.plausible import MAX_SPEED, MAX_YAW_RATE, UNWRAPPED, radians
from ..motion_history import fix_or_none, relative_vector, three

if TYPE_CHECKING:
    from ...kernels.poses.scalar_update import PoseNoise


@dataclass(frozen=True, eq=False)
class OwnMeasurement:
    """What a vehicle measures of itself in a step.

    Args:
        velocity: (3,) m/s, forward, left and up, the mean over the step.
        yaw_rate: rad/s, the mean over the step.
        gnss: (3,) m; None or NaN for no fix.
        heading: rad, of a compass; None or NaN for none.

    >>> OwnMeasurement([9.0, 0.0, 0.0], 0.1).row.shape
    (8,)
    """

    velocity: ArrayLike
    yaw_rate: float
    gnss: ArrayLike | None = None
    heading: float | None = None
    row: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        heading = nan
        if self.heading is not None and not (isinstance(self.heading, float) and np.isnan(self.heading)):
            heading = number("heading", self.heading, -inf, allowed="finite rad, or None", hint="None: no compass.")
        rate = number("yaw_rate", self.yaw_rate, -inf, allowed="finite rad/s", hint="Give 0 for a vehicle that stands.")
        radians("heading", np.array(heading), UNWRAPPED)
        radians("yaw_rate", np.array(rate), MAX_YAW_RATE)
        moving = three("velocity", self.velocity, MAX_SPEED)
        self.__dict__["row"] = np.concatenate([fix_or_none(self.gnss, "gnss"), [heading], moving, [rate]])


@dataclass(frozen=True, eq=False)
class LandmarkMeasurement:
    """A landmark as the ego measures it now.

    Args:
        relative: (3,) range m, bearing from the heading rad, inclination rad, NaN for a component that is missing.
        position: (3,) m, its own.

    >>> LandmarkMeasurement([9.0, 0.1, 1.57], position=[5.0, 5.0, 3.0]).relative.tolist()
    [9.0, 0.1, 1.57]
    """

    relative: ArrayLike
    position: ArrayLike

    def __post_init__(self) -> None:
        self.__dict__["relative"] = relative_vector(self.relative)
        self.__dict__["position"] = three("position", self.position)


class PoseEstimate(NamedTuple):
    """Pose of the ego.

    Attributes:
        x: (d,) position m, heading rad and, of six numbers, speed scale and yaw-rate bias rad/s.
        covariance: (d, d).
    """

    x: Floats
    covariance: Floats


class PoseStream:
    """A pose filter of one's own, step by step (`PoseFilter.start`), with ranges from its position: fed a recording
    without tags it gives the numbers of its Track.

    Args:
        noise: that is assumed.
        begin: (4,) m and rad, pose at the first step, NaN for its fix and compass.
        spread: (4,) standard deviations of it.
        dt: s of a step.
    """

    def __init__(self, noise: "PoseNoise", begin: Floats, spread: Floats, dt: float) -> None:
        from ...kernels.poses.odometry import new_faults
        from ...kernels.poses.scalar_update import new_poses

        self._noise, self._spread, self._dt = noise, spread, dt
        self._begin, self._later, self._heading = begin[None, None, None], False, nan
        self._poses, self._pair = (new_poses(count * noise.d + 1) for count in (1, 2))
        self._faults = new_faults(1, noise, dt)

    def step(self, own: OwnMeasurement, landmarks: Sequence[LandmarkMeasurement] = ()) -> PoseEstimate:
        """Pose of the ego now.

        Args:
            own: measurement of itself.
            landmarks: that it measures, the nearest first as in a recording.

        Raises:
            InputError: a first step without fix and compass where `begin` does not give them; a heading beyond two
                turns that does not follow the one before.
        """
        from ...kernels.poses.ekf import PoseMeasurements, step

        heading = instance("own", own, OwnMeasurement).row[3]
        if not abs(heading - self._heading) < np.pi:
            radians("heading", heading)
        given = landmarks if isinstance(landmarks, Sequence) else [landmarks]
        marks = [instance("landmarks", mark, LandmarkMeasurement) for mark in given]
        if not self._later and np.isnan(np.where(np.isnan(self._begin), own.row[:4], self._begin)).any():
            what = "must give what the first fix and compass do not"
            raise InputError("begin", None, what, "Give (x, y, z, heading).")
        t, count = int(self._later), len(marks)
        positions = np.array([mark.position for mark in marks], float).reshape(-1, 3)
        relative = np.array([mark.relative for mark in marks], float).reshape(1, -1, 3)
        both, ends = np.tile(own.row, (1, 2, 1, 1)), np.tile([0, -1, 0], (count, 1))
        first = np.array([0, 0, count] if t else [0, count, count])
        active = np.ones((2, 1), bool)
        measured = PoseMeasurements(both, active, ends, first, positions, relative, self._dt, np.zeros((2, 3)))
        memory = self._poses, self._pair, self._faults
        step(measured, self._noise, self._begin, self._spread, *memory, 0, t)
        self._heading = self._heading if np.isnan(heading) else heading
        self._later, d = True, self._noise.d
        x = self._poses.x[:d].copy()
        x[3] = wrap(x[3])
        return PoseEstimate(x, self._poses.cov[:d, :d].copy())
