"""Sensors: what noise acts on the measurements, or what noise a method assumes; outliers, which are wrong by more than
noise: how often, by how much and for how long; and streams of keyed noise.
"""

import sys
import zlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.random import Generator, Philox, SeedSequence

from ..arrays import TINY, Floats, Limits, check_fields, checked, extent, instance, listed, number, seed_of
from ..errors import InputError, unknown

if TYPE_CHECKING:
    from ..kernels.motion import MotionNoise

Law = Literal["uniform", "exponential"]


@dataclass(frozen=True)
class Fault:
    r"""How often a kind of measurement is wrong, by how much, and for how long.

    Whether a sensor is at fault, and its error, are drawn anew at a step with probability $1 - e^{-dt / lasts}$ and
    stay in between. All that is wrong at one rate is wrong at a higher one, too, by the same error.

    >>> Fault(rate=0.05, size=(3.0, 20.0)).rate
    0.05
    """

    rate: float = 0.0
    """Share of the measurements, in [0, 1]."""
    size: tuple[float, float] = (0.0, 0.0)
    """(low, high) of the error: metres, of odometry a share of the speed."""
    law: Law = "uniform"
    """"uniform": between low and high. "exponential": low plus an exponential draw of mean high - low."""
    lasts: float = 0.0
    """s, time constant of the state; 0: every measurement by itself."""

    def __post_init__(self) -> None:
        lasts = (0, 1e18, ">= 0 s, 0 for every measurement by itself")
        check_fields(self, {"rate": (0, 1, "in [0, 1], 0.05 for one measurement in twenty"), "lasts": lasts})
        self.__dict__["size"] = extent("size", self.size)


@dataclass(frozen=True)
class Outliers:
    """What goes wrong beyond noise; by default nothing. Methods do not know of it.

    >>> Outliers(ranges=Fault(0.05, (3.0, 20.0))).notes
    ('5 % of the ranges 3 to 20 m too long',)
    """

    ranges: Fault = Fault(size=(3.0, 20.0))
    """Non-line-of-sight: ranges too long, the same for both vehicles of a pair."""
    angles: Fault = Fault()
    """Wrong association: azimuth and inclination are those of the vehicle nearest to the right one. The range stays:
    a radio message names its sender, a camera's or a radar's echo does not."""
    fixes: Fault = Fault(size=(10.0, 50.0), lasts=10.0)
    """Multipath: fixes displaced in a random direction. A vehicle's first fix is right."""
    outages: Fault = Fault(lasts=5.0)
    """No fix at all. A vehicle's first fix is there."""
    odometry: Fault = Fault(size=(0.2, 1.0), lasts=0.5)
    """Slip: the speed is measured too high or too low by a share of itself; wheels that lock measure none."""

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def uwb_nlos(cls) -> "Outliers":
        """Ultra-wideband ranging past obstacles: 5 % of the ranges too long by 0.3 m and more, 0.42 m on average.

        Share and sizes are those of the 233 measured ranges of libRSF's Labyrinth data set, whose stated standard
        deviation is 0.1 m (5 % are more than 0.3 m too long, by 0.42 m on average and 0.66 m at most). The law is an
        exponential (Bellusci, Janssen, Yan, Tiberius, "Modeling distance and bandwidth dependency of TOA-based UWB
        ranging error for positioning", 2008; O'Lone, Dhillon, Buehrer, arXiv 1905.00603, derive it). Combine it with
        `range_std=0.1`.
        """
        return cls(ranges=Fault(0.05, (0.3, 0.42), "exponential", 0.5))

    @classmethod
    def urban_canyon(cls) -> "Outliers":
        """Dense high buildings: 10 % of the fixes off by tens of metres, 5 % missing, for seconds.

        Reflections lengthen pseudoranges by "typically a few tens of meters" and positions are off as far (Groves,
        Adjrad, GPS Solutions 21, 2017, doi 10.1007/s10291-017-0654-1); 95 % availability is missed even in mildly
        difficult streets (Kleijer, Odijk, Verbree, "Prediction of GNSS availability and accuracy in urban
        environments", 2009). The share of wrong fixes and the durations of 10 and 5 s are choices.
        """
        return cls(fixes=Fault(0.10, (10.0, 50.0), lasts=10.0), outages=Fault(0.05, lasts=5.0))

    @classmethod
    def named(cls, text: str) -> "Outliers":
        """Of presets and kinds joined by "+", as settings of studies name them; "" is none.

        A kind has a rate and may have a duration in s: ranges=0.05, ranges=0.05:2.

        Raises:
            InputError: an unknown preset or kind, a rate outside [0, 1].

        >>> Outliers.named("urban_canyon").notes[-1]
        '5 % of the fixes missing, for 5 s'
        >>> Outliers.named("urban_canyon+ranges=0.05:2").notes[0]
        '5 % of the ranges 3 to 20 m too long, for 2 s'
        >>> Outliers.named("ranges")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        coopoc.errors.InputError: outliers = 'ranges': must be one of ... Did you mean ranges=RATE?
        """
        outliers, kinds = cls(), [field.name for field in fields(cls)]
        for part in filter(None, instance("outliers", text, str).split("+")):
            name, _, numbers = part.partition("=")
            if name in PRESETS and not numbers:
                preset = PRESETS[name]()
                outliers = replace(outliers, **{k: getattr(preset, k) for k in kinds if getattr(preset, k).rate})
            elif name in kinds and numbers:
                try:
                    changes = dict(zip(("rate", "lasts"), map(float, numbers.split(":", 1)), strict=False))
                except ValueError:
                    hint = f"{name}=0.05 makes one in twenty wrong, {name}=0.05:2 for 2 s."
                    raise InputError(name, repr(numbers), "must be RATE or RATE:SECONDS", hint) from None
                outliers = replace(outliers, **{name: replace(getattr(outliers, name), **changes)})
            else:
                raise unknown("outliers", part, [*PRESETS, *(f"{kind}=RATE" for kind in kinds)])
        return outliers

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence for each kind that acts."""
        return tuple(
            TEXTS[field.name].format(100 * fault.rate, *fault.size)
            + (", exponential" if fault.law == "exponential" else "")
            + (f", for {fault.lasts:g} s" if fault.lasts else "")
            for field in fields(self)
            if (fault := getattr(self, field.name)).rate
        )


PRESETS = {"uwb_nlos": Outliers.uwb_nlos, "urban_canyon": Outliers.urban_canyon}
TEXTS = {
    "ranges": "{:g} % of the ranges {:g} to {:g} m too long",
    "angles": "{:g} % of the angles those of another vehicle",
    "fixes": "{:g} % of the fixes {:g} to {:g} m off",
    "outages": "{:g} % of the fixes missing",
    "odometry": "{:g} % of the speeds wrong by {:g} to {:g} of themselves",
}


BiasMode = Literal["run", "sample"]
VelocityReading = Literal["axis", "speed"]
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
    velocity). "speed": ratio times the speed, on every axis."""
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
        size: Floats = abs(np.atleast_1d(checked("velocity", velocity)))
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


def stream(seed: int, sensor: str, run: int, vehicle: str, partner: str = "") -> Generator:
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
    entropy = np.array(key, np.uint32) if small else key
    return Generator(Philox(SeedSequence(entropy)))
