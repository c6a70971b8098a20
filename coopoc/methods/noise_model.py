"""NoiseModel: the noise that a filter assumes. It is an axis of every study, never a hidden default."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy import inf, pi

from ..arrays import TINY, Floats, Ints, check_fields, checked, instance, number, plain, refuse, remade, texts
from ..errors import InputError, shown, suggestion
from ..kernels.motion import HELD, RECEIVED, MotionNoise, own_variances, process_variances
from ..plugins import find
from ..text import short_repr
from ..world.fleet import Fleet, same_drive
from ..world.inbox import Inbox
from ..world.links import vector_cov
from ..world.recording import Recording, check_recording
from ..world.sensors import Sensors

OFFSET_COUNT, OFFSET_PARTS, OFFSET_STDS = 100, 10, 2.5
"""Ranges of a pair, in parts of a drive, and standard deviations of the means of these that an offset has."""
OFFSETS = (
    'ranges of {} and {} contradict fixes by an offset, which only PoseFilter("fleet") (frame="body") has as a state: '
    "coopoc data check prints offset="
)
HELD_OUT = 8
"""Blocks of time on which fitted noise is tested."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Assumed process, GNSS and relative noise.

    - `identity`: unit matrices, as the paper's baselines (section IV.A of the paper).
    - `nominal`: the Sensors that a method may know, without their bias.
    - `fitted`: constants estimated on the *training* recordings only, exactly what the nets saw.
    - `oracle`: nominal with the process noise of the true velocity; a reference line, not a method.

    Args:
        name: one of the above.
        sensors: relative and velocity noise; None for identity.
        process_std: (3,) m per step, constant; None to follow the pace.
        gnss_std: (3,) m.
        fleet: whose true velocity is known, for the oracle only.
        compass: (2,) rad, noise and constant error of the heading, both of which are within the azimuth's std.
        notes: of the Track, what was changed of the recording or of the noise.
        extra: (R, T, N) m^2, increase of the variance of each motion where `methods.odometry_fault` corrects it.
    """

    name: str
    sensors: Sensors | None = None
    process_std: tuple[float, float, float] | None = None
    gnss_std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    fleet: Fleet | None = None
    compass: tuple[float, float] = (0.0, 0.0)
    notes: tuple[str, ...] = ()
    extra: Floats | None = None

    __repr__ = short_repr
    __reduce__ = remade

    def __post_init__(self) -> None:
        check_fields(self)
        self.__dict__["notes"] = texts("notes", self.notes)
        if self.process_std is None and self.sensors is None:
            hint = "Give process_std=(1.0, 1.0, 1.0), or sensors=Sensors(), whose noise follows the speed."
            raise InputError("process_std", None, "must be given where there are no sensors", hint)
        compass = checked("compass", self.compass, "(2,)", (2,))
        refuse(
            "compass",
            compass,
            ~((compass >= 0) & (compass <= pi)),
            "must be in 0..pi rad",
            "Convert degrees by np.deg2rad.",
        )
        self.__dict__["compass"] = tuple(compass.tolist())
        if self.process_std is not None:
            check_std(self, "process_std")
        check_std(self, "gnss_std")

    @classmethod
    def identity(cls) -> "NoiseModel":
        """Unit covariances: 1 m per step, 1 m GNSS, 1 m relative vector, per axis."""
        return cls("identity", process_std=(1.0, 1.0, 1.0))

    @classmethod
    def nominal(cls, sensors: Sensors) -> "NoiseModel":
        """The standard deviations of `sensors`, process noise from the measured pace; all of the error of a fix or
        an azimuth as if it were white and its own."""
        return _nominal(instance("sensors", sensors, Sensors))

    @classmethod
    def oracle(cls, sensors: Sensors, fleet: Fleet) -> "NoiseModel":
        """`nominal` with the true velocity: the bias-ignorant oracle filter that a learned gain is compared with."""
        return replace(cls.nominal(sensors), name="oracle", fleet=instance("fleet", fleet, Fleet))

    @classmethod
    def fitted(cls, recording: Recording, fleet: Fleet) -> "NoiseModel":
        """Per-axis standard deviations of a training recording against its truth.

        process: rms of x_t - x_{t-1} - dt u_t, of simulated drives at least dt times the velocity floor; GNSS: rms of
        z_t - x_t over the factor that a log states of the fix. Relative measurements keep the data sheet's figures: the
        training vehicles drive alone and cannot estimate them; so does an axis without any error, as the height of a
        drive in one plane.

        Errors of real measurements last, which white noise cannot describe. So the last third of a log is held out,
        and `nominal` is returned, unless a Kalman filter fitted to the rest is better there by the 95 % interval over
        HELD_OUT blocks of time; a note says which, and by how much.

        Args:
            recording: of the training vehicles.
            fleet: their true motion.

        Raises:
            InputError: no truth where anything was measured.
        """
        recording = instance("recording", recording, Recording)
        same_drive(instance("fleet", fleet, Fleet), recording.ids, recording.t)
        if not recording.measured:
            return cls._constant(recording, fleet)
        stated = cls.nominal(recording.sensors)
        change, by = _held_out(cls, recording, fleet)
        gain = f"fitted to a part, it changes the error on the rest by {change:.2g} +- {by:.2g} m"
        if change + by >= 0.0:
            return replace(stated, notes=(f"noise as stated: {gain}",))
        found = cls._constant(recording, fleet)
        fixes, were = (np.round(model.gnss_std, 3) for model in (found, stated))
        return replace(found, notes=(f"noise as fitted, of fixes {fixes} m, not {were} m: {gain}",))

    @classmethod
    def _constant(cls, recording: Recording, fleet: Fleet) -> "NoiseModel":
        moved = np.diff(fleet.position, axis=0) - recording.dt * recording.velocity[:, 1:]
        off = (recording.gnss - fleet.position) / recording.fix_scale
        if not (np.isfinite(moved).any() and np.isfinite(off).any()):
            actual, hint = "without truth of any fix, or of any motion", "Give the fleet whose drive was measured."
            raise InputError("fleet", actual, "must be known where it was measured", hint)
        process, gnss = (np.sqrt(np.nanmean(error**2, axis=(0, 1, 2))) for error in (moved, off))
        floor = recording.dt * recording.sensors.velocity_floor
        process = np.where((process > 0) & recording.measured, process, np.maximum(process, floor))
        gnss = np.where(gnss > 0, gnss, recording.sensors.gnss_std)
        return cls("fitted", recording.sensors, tuple(process.tolist()), tuple(gnss.tolist()))

    def process_variance(
        self,
        recording: Recording,
        columns: Sequence[int] | Ints | None = None,
        inbox: Inbox | None = None,
        first: int = 0,
    ) -> Floats:
        """Per-axis variance of x_t given x_{t-1}, m^2, broadcastable to (R, T, E, 3).

        Where it follows the velocity it is (dt max(ratio s, floor))^2, with s the pace: of past velocities
        (`kernels.motion.MotionNoise`).

        Args:
            recording: with the velocities.
            columns: (E,) of the vehicles; None for all.
            inbox: of the one vehicle. The result is then (R, T, N, 3), of all vehicles as that one knows them from the
                messages that arrive.
            first: step at which the filter begins.
        """
        velocity, links, dt = check_recording(recording).velocity, recording.links, recording.dt
        followed = slice(None) if columns is None or inbox is not None else columns
        if self.process_std is not None:
            variance = np.square(self.process_std)[None, None, None]
        elif self.fleet is not None and self.sensors is not None:
            same_drive(self.fleet, recording.ids, recording.t)
            variance = np.square(dt * self.sensors.velocity_std(self.fleet.velocity[None, :, followed], 1e-6))
        elif inbox is None:
            variance = own_variances(motion_noise(self, dt), velocity[:, :, followed], dt, first)
        else:
            use, neighbour = np.zeros(velocity.shape[:3], np.uint8), links.neighbour[inbox.link]
            use[:, links.step[inbox.link], neighbour] = RECEIVED * (inbox.arrival >= 0)
            use[np.arange(len(use))[:, None], inbox.newest, neighbour] = (
                HELD  # -1, of none: the last step is before no other
            )
            use[:, :, columns] = HELD
            velocity, longest = np.ascontiguousarray(velocity), recording.v2x.max_age
            variance = process_variances(motion_noise(self, dt), velocity, use, longest, dt)
        stated = self.process_std is None and recording.motion_variance.size > 0
        for more in (self.extra, recording.motion_extra[None, ..., 0] if stated else None):
            if more is not None:
                # of neighbours, too: what they send of fixes and velocities shows the same to who receives it
                variance = variance + more[:, :, followed, None]
        return variance

    def fix_variance(self, recording: Recording) -> Floats:
        """Per-axis variance of each fix, broadcastable to (R, T, N, 3), m^2."""
        return (self.gnss_variance * self.fix_scale(recording) ** 2)[None]

    def fix_scale(self, recording: Recording) -> Floats:
        """(T, N, 1) or 1: factors of the deviations of fixes, which the identity does not know."""
        return np.ones((1, 1, 1)) if self.sensors is None else check_recording(recording).fix_scale

    @property
    def gnss_variance(self) -> Floats:
        """(3,) m^2."""
        return np.square(self.gnss_std)

    @property
    def exact_relative(self) -> bool:
        """True if relative noise is known in range and angles, so that an exact Gauss-Newton step has a meaning."""
        return self.sensors is not None

    def relative_cov(self, relative: Floats) -> Floats:
        """Covariance (..., 3, 3) m^2 of the converted relative vectors of measurements (..., 3)."""
        relative = checked("relative", relative, "(..., 3)", (*plain(relative).shape[:-1], 3))
        if self.sensors is None:
            return np.broadcast_to(np.eye(3), (*relative.shape, 3))
        return vector_cov(relative, self.sensors.relative_std, self.sensors.min_range)


FINEST = 1e-5
"""Least std that is assumed of a relative measurement, over the largest of a fix: information of 1 / FINEST^2 = 1e10
beside 1 leaves the fixes six of double precision's sixteen digits."""
COARSE_DISTANCE = 30.0
"""m, distance that turns the noise of an angle into metres."""
SAMPLED = 2000
"""Measurements of which the median distance is taken."""
UNEVEN = 3e-7
"""Least variance that is assumed of a relative measurement, over the product of the largest std of a fix and of its own
components: information that is large in one direction and small in another loses the small one's digits, too."""


def _held_out(make: type[NoiseModel], recording: Recording, fleet: Fleet) -> tuple[float, float]:
    """How much larger, m, a Kalman filter's error in the plane is on the last third with noise fitted to the first two
    thirds than with the stated noise: the mean over blocks of time, and half its 95 % interval; infinite where too
    little was measured."""
    from scipy.stats import t

    split, kalman = 2 * len(recording.t) // 3, find("coopoc.methods", "kalman")
    egos = [column for column in recording.observers if recording.stretches(column)]

    def errors(model: NoiseModel) -> Floats:
        gap = (kalman(model)(recording, egos).x - fleet.position[:, egos])[:, split:, :, :2]
        parts = [part for part in np.array_split(gap, HELD_OUT, axis=1) if np.isfinite(part).any()]
        return np.array([np.sqrt(np.nanmean(part**2)) for part in parts])

    fitted = make._constant(recording.between(0, split), fleet.between(0, split))
    change = errors(fitted) - errors(make.nominal(recording.sensors))
    if len(change) < 2:
        return 0.0, inf
    return float(change.mean()), float(t.ppf(0.975, len(change) - 1) * change.std(ddof=1) / np.sqrt(len(change)))


@lru_cache(maxsize=32)  # to build and to check it takes a quarter of a short drive's time
def _nominal(sensors: Sensors) -> NoiseModel:
    sensors = sensors.check_assumed().assumable()
    compass = sensors.heading_std, sensors.heading_bias_std
    sensors = replace(sensors, azimuth_std=sensors.world_azimuth_std, heading_std=0.0, heading_bias_std=0.0)
    return NoiseModel("nominal", sensors, gnss_std=sensors.fix_std, compass=compass)


def resolve(noise_model: NoiseModel | str, recording: Recording | None, relative: bool = True) -> NoiseModel:
    """A NoiseModel itself, or `identity` / `nominal` by name from the recording's sensors; none finer than FINEST, and
    no range finer than its direction allows (`_with_range_floor`).

    Args:
        noise_model: or its name.
        recording: that is filtered.
        relative: whether relative measurements are used; a solo filter takes the model as it is.

    >>> resolve("identity", None).gnss_std
    (1.0, 1.0, 1.0)
    """
    if isinstance(noise_model, NoiseModel):
        return _resolvable(_with_range_floor(noise_model, recording)) if relative else noise_model
    if (name := noise_model if isinstance(noise_model, str) else "") == "identity":
        return NoiseModel.identity()
    if name == "nominal":
        return resolve(NoiseModel.nominal(check_recording(recording).sensors), recording, relative)
    raise InputError(
        "noise_model",
        shown(noise_model),
        "must be 'identity', 'nominal' or a NoiseModel",
        suggestion(
            noise_model,
            ("identity", "nominal"),
            "For fitted noise pass NoiseModel.fitted(training_recording, training_fleet).",
        ),
    )


def _with_range_floor(noise_model: NoiseModel, recording: Recording | None) -> NoiseModel:
    """The model with a floor for the range's std where the direction of a range is uncertain, by medians of the whole
    drive; a note reports it.

    A direction that is off by e shortens d to d cos e along the assumed one: by d e^2 / 2, whose standard deviation is
    d std^2 / sqrt(2). Of measured angles std is theirs; where there are none, that of the line between two fixes,
    sqrt(2) std of a fix / d, and the same until the next fix: the n ranges until then may together say no more than
    one, which is sqrt(n) times the std of each. A finer range, taken for exact along a line, moves estimates by ten
    times what is claimed.

    References:
        Lerro, Bar-Shalom, IEEE Trans. AES 29(3), 1993 (converted measurements beyond d std^2 = 0.4 std of the range).
    """
    noise, links = noise_model.sensors, recording.relative.shape[1] if isinstance(recording, Recording) else 0
    if noise is None or recording is None or not links:
        return noise_model
    sample = recording.relative[0, np.linspace(0, links - 1, min(links, SAMPLED)).astype(int)]
    measured = sample[np.isfinite(sample[:, 0])]
    directed = measured[np.isfinite(measured[:, 1])]
    if not len(measured):
        return noise_model
    far = float(np.median((directed if len(directed) else measured)[:, 0]))
    notes = (*noise_model.notes, *_offsets(recording, noise))
    if noise.range_std > far / 2:
        actual = f"ranges of {far:.3g} m with a std of {noise.range_std:.3g} m"
        return replace(noise_model, notes=(*notes, f"{actual}: none is negative, so that their errors have a mean"))
    if len(directed):
        arc = far * float(np.hypot(noise.azimuth_std**2, noise.inclination_std**2)) / np.sqrt(2.0)
        why = f"angles of {max(noise.azimuth_std, noise.inclination_std):.2g} rad"
    else:
        fix = float(np.square(noise_model.gnss_std[:2]).mean())
        links, moving = recording.links, (recording.velocity[0] != 0.0).any(axis=(0, 2))
        ranges = np.unique(links.observer * len(moving) + links.neighbour, return_counts=True)[1].max()
        fixes = np.isfinite(recording.gnss[0, :, moving, 0]).sum(1).max(initial=0)
        often = max(float(ranges / (fixes or ranges)), 1.0)  # of the pair that measures most, to a fix
        arc, why = (
            np.sqrt(2.0 * often) * fix / far,
            f"fixes of {np.sqrt(fix):.2g} m, {often:.0f} ranges of a pair to a fix and no azimuth",
        )
    if arc <= noise.range_std:
        return replace(noise_model, notes=notes)
    std = float(np.hypot(arc, noise.range_std))
    text = (
        f"assumes a range std of {std:.2g} m, not {noise.range_std:.2g} m, by the whole drive (not causal): "
        f"{why} put what is {far:.3g} m away on an arc"
    )
    return replace(noise_model, sensors=replace(noise, range_std=std), notes=(*notes, text))


def _offsets(recording: Recording, noise: Sensors) -> Iterator[str]:
    """A note on each pair of a log whose ranges are off by fixes of both at one step, by more than these scatter:
    methods of positions have no state for that."""
    links, ranges = recording.links, recording.relative[0, :, 0]
    ends = np.sort([links.observer, links.neighbour], 0)
    one, other = recording.gnss[0][links.step, ends]
    off = ranges - np.linalg.norm(other - one, axis=1)
    for pair in np.unique(ends, axis=1).T if recording.measured else ():
        here = (pair == ends.T).all(1) & np.isfinite(off)
        if here.sum() > OFFSET_COUNT:
            parts = [part.mean() for part in np.array_split(off[here], OFFSET_PARTS)]
            least = 2.0 * noise.range_std + off[here].var() / ranges[here].mean()
            if abs(np.mean(parts)) > OFFSET_STDS * np.std(parts) + least:
                yield OFFSETS.format(*(recording.ids[end] for end in pair))


def _resolvable(noise_model: NoiseModel) -> NoiseModel:
    """The model with relative noise of at least FINEST and UNEVEN, angles at a distance of 1 m; a note names the
    floor."""
    if (noise := noise_model.sensors) is None:
        return noise_model
    fix, coarse = (
        max(noise_model.gnss_std),
        max(noise.relative_std * np.array([1.0, COARSE_DISTANCE, COARSE_DISTANCE])),
    )
    least = max(FINEST * fix, float(np.sqrt(UNEVEN * fix * min(fix, coarse))))
    if min(noise.relative_std) >= least:
        return noise_model
    names = ("range_std", "azimuth_std", "inclination_std")
    raised = {name: max(getattr(noise, name), min(least, pi)) for name in names}
    beside = f"finer ones beside a fix of {max(noise_model.gnss_std):g} m exceed double precision"
    note = f"assumes relative std of at least {least:.2g} m and rad: {beside}"
    return replace(noise_model, sensors=replace(noise, **raised), notes=(*noise_model.notes, note))


def check_std(made: Any, field: str, least: float = TINY) -> None:
    """A tuple of three standard deviations in a field of a dataclass; InputError unless they are finite and at least
    that."""
    value = checked(field, getattr(made, field), "(3,)", (3,))
    wrong, allowed = ~((value >= least) & (value < inf)), f"must be {'positive' if least else '>= 0'} and finite"
    refuse(field, value, wrong, allowed, "Give standard deviations of three axes.")
    made.__dict__[field] = tuple(value.tolist())


def constant_noise(noise_model: NoiseModel | str) -> NoiseModel:
    """The noise model of a filter without a recording: "identity" or a NoiseModel of constant noise, which needs
    none."""
    model = noise_model if isinstance(noise_model, NoiseModel) else None
    if noise_model == "nominal" or (model and model.fleet is not None):
        raise InputError(
            "noise_model",
            repr(model.name if model else noise_model),
            "needs a recording, and a stream has none",
            "Pass NoiseModel.nominal(Sensors(...)), a fitted NoiseModel or 'identity'.",
        )
    return resolve(noise_model, None)


def motion_noise(noise_model: NoiseModel, interval: float | None) -> MotionNoise:
    """White motion noise that is assumed of a recording with dt = `interval` s; None for the dt of each step."""
    interval = 0.0 if interval is None else check_interval(interval)
    if noise_model.process_std is not None:
        return MotionNoise(np.array(noise_model.process_std, float), np.zeros(3), 0.0, 0.0, interval)
    return noise_model.sensors.motion_noise(interval)  # type: ignore[union-attr]


def check_interval(interval: float) -> float:
    """The interval, s; InputError unless it is finite and > 0."""
    hint = "The dt that the noise belongs to."
    checked: float = number("interval", interval, sys.float_info.min, allowed="finite and > 0", hint=hint)
    return checked
