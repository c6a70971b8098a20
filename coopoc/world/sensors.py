"""Sensors: what noise acts on the measurements, or what noise a method assumes; and streams of keyed noise."""

import sys
import zlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..arrays import TINY, Floats, Limits, check_fields, checked, extent, listed, number, seed_of
from ..errors import InputError
from .outliers import Outliers

if TYPE_CHECKING:
    from ..kernels.motion import MotionNoise

BiasMode = Literal["run", "sample"]
VelocityReading = Literal["axis", "speed", "fixes"]
ANGULAR = "azimuth_std", "inclination_std", "heading_std", "heading_bias_std", "yaw_rate_std", "yaw_rate_bias_std"


@dataclass(frozen=True)
class Sensors:
    """Standard deviations of GNSS, velocity and relative measurements.

    The same class holds the noise that *acts* (zero is allowed) and that a method *assumes* (zero is an error: a
    singular covariance). Where the paper leaves a choice open, the field gives the default and the reason.
    """

    gnss_std: tuple[float, float, float] = (1.5, 1.5, 1.5)
    """m, per axis."""
    gnss_bias: tuple[float, float] = (0.0, 0.0)
    """m, (low, high) of a uniform draw, positive on every axis as the paper's U[0.5, 1] reads."""
    gnss_bias_mode: BiasMode = "run"
    """"run": one draw per run, vehicle and axis (a bias is constant; default). "sample": a new draw at every step."""
    gnss_drift_std: float = 0.0
    """m, per axis, of an error of each receiver that stays for a while (multipath): Gauss-Markov, added to the white
    one of `gnss_std`."""
    gnss_common_std: float = 0.0
    """m, per axis, of the same kind of error that all vehicles share (ionosphere, orbits)."""
    gnss_drift_time: float = 60.0
    """s, correlation time of both: e(t) and e(t + s) have correlation exp(-s / gnss_drift_time)."""
    velocity_std_ratio: float = 0.10
    """Velocity noise over true velocity: the paper's 10 % (training) and 15 % (test)."""
    velocity_reading: VelocityReading = "axis"
    """"axis": ratio times each component (default, as in the authors' public code: no noise on an axis with zero
    velocity). "speed": ratio times the speed, on every axis. "fixes": as "axis", of velocities that fixes have shown,
    since a log holds no odometry: there is none that could slip or be turned."""
    velocity_floor: float = 0.05
    """m/s, the least velocity std that a method assumes; it never acts. Without it "axis" is singular."""
    climb_std: float = 0.0
    """m/s, what a method assumes of a vertical velocity that is not measured, new at every step; it never acts."""
    range_std: float = 1.0
    """m."""
    azimuth_std: float = float(np.deg2rad(4.0))
    """rad, of the bearing as the sensor sees it. The paper implies that the heading, which makes it a world azimuth, is
    known."""
    inclination_std: float = float(np.deg2rad(4.0))
    """rad."""
    range_offset_std: float = 0.0
    """m, of what all ranges of an observer are too long by for a whole run (delays of radios). The cooperative filter
    has it as a state; other methods take ranges as calibrated, and a bound knows it."""
    heading_std: float = 0.0
    """rad, noise of the observer's heading, new at every step: it turns all that is seen at the step alike."""
    heading_bias_std: float = 0.0
    """rad, of an error of the heading that each vehicle has for a whole run (mounting, magnetic declination)."""
    compass: bool = True
    """Whether a recording in body frames holds headings, with the two errors above."""
    yaw_rate_std: float = 0.01
    """rad/s, noise of a measured yaw rate, new at every step."""
    yaw_rate_bias_std: float = 0.0
    """rad/s, of an error of the yaw rate that lasts."""
    speed_scale_std: float = 0.0
    """Of an error that lasts and is a share of the speed (tyre radius)."""
    velocity_bias_std: float = 0.0
    """m/s, of an error on each axis of a body velocity that lasts."""
    odometry_error_time: float = 1e6
    """s, correlation time of these three (Gauss-Markov); the default is one draw for a whole run."""
    min_range: float = 2.0
    """m, centres closer than a vehicle is wide are not measured (a range near zero makes angles seem exact)."""
    outliers: Outliers | None = None
    """What goes wrong beyond noise. It acts; what methods assume has none unless you say so."""

    def __post_init__(self) -> None:
        most = sys.float_info.max
        limits: Limits = {
            **{field.name: (0.0, most, "finite and >= 0, in SI units") for field in fields(self)},
            **dict.fromkeys(("gnss_drift_time", "odometry_error_time"), (TINY, most, "finite and > 0 s")),
            **dict.fromkeys(ANGULAR, (0.0, np.pi, "in 0..pi rad or rad/s, by np.deg2rad")),
            **dict.fromkeys(("velocity_std_ratio", "speed_scale_std"), (0.0, 1.0, "in [0, 1], 0.15 for 15 %")),
        }
        check_fields(self, limits)
        hint = "Give metres in a tuple."
        stds = listed("gnss_std", self.gnss_std, hint, "must be 3 numbers")
        if len(stds) != 3:
            raise InputError("gnss_std", self.gnss_std, "must be 3 numbers", hint)
        self.__dict__["gnss_std"] = tuple(number("gnss_std", std, hint=hint) for std in stds)
        self.__dict__["gnss_bias"] = extent("gnss_bias", self.gnss_bias, hint)

    @property
    def relative_std(self) -> Floats:
        """(3,) m, rad, rad."""
        return np.array([self.range_std, self.azimuth_std, self.inclination_std])

    @property
    def world_azimuth_std(self) -> float:
        """rad, of all that is wrong with an azimuth in the world frame: bearing and heading."""
        more = self.heading_std**2 + self.heading_bias_std**2
        return float(np.sqrt(self.azimuth_std**2 + more)) if more else self.azimuth_std

    @property
    def fix_std(self) -> tuple[float, float, float]:
        """(3,) m per axis of all that is wrong with a fix but the bias: white noise, drift and the common error."""
        more = self.gnss_drift_std**2 + self.gnss_common_std**2
        x, y, z = (float(np.sqrt(white**2 + more)) if more else white for white in self.gnss_std)
        return x, y, z

    def velocity_std(self, velocity: Floats, floor: float = 0.0) -> Floats:
        """Noise std (..., 3) m/s at a velocity (..., 3) m/s, at least `floor` (default 0: what acts)."""
        size: Floats = np.abs(np.atleast_1d(checked("velocity", velocity)))
        if self.velocity_reading == "speed":
            size = np.broadcast_to(np.linalg.norm(size, axis=-1, keepdims=True), size.shape)
        std: Floats = np.maximum(self.velocity_std_ratio * size, number("floor", floor))
        return std

    def motion_noise(self, interval: float = 0.0) -> "MotionNoise":
        """Noise of a motion that a method assumes, never below `velocity_floor`; `interval` s as of MotionNoise."""
        from ..kernels.motion import MotionNoise

        interval = number("interval", interval)
        ratio, of_speed = np.full(3, self.velocity_std_ratio), self.velocity_reading == "speed"
        base = np.array([0.0, 0.0, self.climb_std * interval])
        return MotionNoise(base, ratio, self.velocity_floor, float(of_speed), interval)

    def motion_std(self, velocity: Floats, interval: float) -> Floats:
        """Noise std (R, T, N, 3) m that a method assumes of motions of `interval` s with *measured* velocities
        (R, T, N, 3) m/s, by the pace before each."""
        from ..kernels.motion import own_variances

        velocity = checked("velocity", velocity, "(R, T, N, 3)", (-1, -1, -1, 3))
        noise = self.motion_noise(interval)
        return np.sqrt(own_variances(noise, velocity, noise.interval))

    def assumable(self) -> "Sensors":
        """The same sensors as a method may know them: it knows neither the bias nor the outliers."""
        return replace(self, gnss_bias=(0.0, 0.0), outliers=None)

    def check_assumed(self) -> "Sensors":
        """Itself, if a method may assume it; InputError where an assumed std is zero."""
        for name in ("gnss_std", "range_std", "azimuth_std", "inclination_std", "velocity_floor"):
            if np.min(value := getattr(self, name)) <= 0:
                allowed = "is zero: noise may act with zero std but not be assumed with it"
                hint = "Pass observe(..., assumed=Sensors(...)) with positive standard deviations."
                raise InputError(name, value, allowed, hint)
        return self

    @classmethod
    def paper_training(cls, velocity_reading: VelocityReading = "axis") -> "Sensors":
        """Noise of the paper's training set: 1.5 m per axis, 10 % of the velocity (section IV.A)."""
        return cls(velocity_reading=velocity_reading)

    @classmethod
    def paper_scenario1(cls) -> "Sensors":
        """Learned methods among themselves: 1.8 m plus a bias U[0.5, 1] m, 15 % of the velocity (section IV.B.1)."""
        return cls(gnss_std=(1.8, 1.8, 1.8), gnss_bias=(0.5, 1.0), velocity_std_ratio=0.15)

    @classmethod
    def paper_scenario2(cls, velocity_std_ratio: float = 0.15) -> "Sensors":
        """Training against decision: 3.5 m, 1 m, 4 deg, 4 deg (section IV.B.2); the velocity noise is not stated there,
        15 % (the paper's test setting) is the default and 10 % (its training setting) the other reading."""
        return cls(gnss_std=(3.5, 3.5, 3.5), velocity_std_ratio=velocity_std_ratio)


def stream(seed: int, sensor: str, run: int, vehicle: str, partner: str = "") -> np.random.Generator:
    """Random stream of one sensor of one vehicle in one run; step t takes the t-th draw.

    30 runs are a prefix of 100, and adding a vehicle, a neighbour or a method changes no other draws, because the key
    names everything that the draw belongs to (ids, not columns). Philox is counter-based: streams do not overlap.

    Args:
        seed: the study's seed.
        run: 0..R-1.
        sensor: names.
        vehicle: names.
        partner: names.

    >>> bool(stream(0, "gnss", 3, "a").normal() == stream(0, "gnss", 3, "a").normal())
    True
    """
    if type(seed) is not int or seed < 0:
        seed = seed_of(seed)
    key = (seed, run, *(zlib.crc32(word.encode()) for word in (sensor, vehicle, partner)))
    small = max(seed, run) < 2**32  # then NumPy makes the same words of the key, three times as slowly
    entropy = np.array(key, dtype=np.uint32) if small else key
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))
