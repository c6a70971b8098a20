"""Solo filter on roads: the heading's error and the odometer's scale are states, and wrong fixes count less."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, Limits, check_fields, instance
from ..errors import InputError
from ..kernels.compiling.waiting import clock
from ..kernels.dead_reckoning import SQUARE
from ..kernels.motion import MotionNoise
from ..kernels.road import SCALE, Z_VARIANCE, RoadNoise, RoadState, Z, road_motion, road_step, run_road
from ..kernels.solo import SoloMeasurements
from ..short_repr import short_repr
from ..world.fleet import Fleet
from ..world.recording import Recording, Vehicles, check_recording
from .motion_history import MotionHistory
from .noise_model import NoiseModel, constant_noise, motion_noise, resolve
from .track import Alone, Track, check_options, lost, silent_track

LIMITS: Limits = {
    "fix": (1e-6, 1e6, "> 0"),
    "motion": (1e-6, 1e6, "> 0"),
    "correlation": (0.0, 1e6, ">= 0 s"),
    "gate": (0.1, np.inf, ">= 0.1"),
    "heading": (0.0, np.pi, "in [0, pi] rad"),
    "scale": (0.0, 1.0, "in [0, 1]"),
    "lasts": (1e-3, np.inf, "> 0 s"),
    "window": (2.0, np.inf, ">= 2"),
    "least": (1e-6, 1.0, "in 1e-6..1"),
}


@dataclass(frozen=True)
class RoadErrors:
    """What a road filter assumes beyond the white noise of its noise model; the defaults are ROAD's.

    Args:
        fix: factor of the assumed standard deviation of a fix.
        motion: factor of that of the motion.
        correlation: s, for which errors of fixes last; 0 for white ones.
        gate: standard deviations per axis from which a fix counts less.
        heading: rad, standard deviation of an error of the heading that lasts.
        scale: of an error of the speed that lasts, as a share of it.
        lasts: s, correlation time of both.
        window: fixes over which their variance is raised to what innovations show.
        least: of the factor by which innovations lower the whole covariance, for errors that last show in no
            innovation; 1 where the level is known, as of simulated or calibrated errors.

    Raises:
        InputError: numbers outside these ranges.
    """

    fix: float = 2.0
    motion: float = 1.0
    correlation: float = 1.5
    gate: float = 1.4
    heading: float = 0.1
    scale: float = 0.03
    lasts: float = 300.0
    window: float = 30.0
    least: float = 0.15

    def __post_init__(self) -> None:
        check_fields(self, LIMITS)


ROAD = RoadErrors()
"""Of measurements that are not simulated, by hand: between what is learned in simulation and what the first parts of
real drives show."""
EXACT = RoadErrors(fix=1.0, motion=1.0, correlation=0.0, gate=5.0, heading=0.0, scale=0.0, window=np.inf, least=1.0)
"""Of simulated measurements whose noise is known and white: the Kalman filter, with a gate."""


@dataclass(frozen=True, eq=False)
class RoadFilter(Alone):
    r"""Kalman filter of position, heading error b and scale error s of the odometry, robust against wrong fixes.

    $$ x_t = x_{t-1} + (1 + s) R(b) \Delta t \, u_t + w, \qquad z_t = x_t + n, \qquad
       r = \max(1, d / k)^2 \, \frac{1 + \rho}{1 - \rho} \, \lambda \sigma^2, \qquad \rho = e^{-\Delta / \tau} $$

    with b and s Gauss-Markov, $d^2$ half the squared normalised innovation in the plane, k the gate and $\Delta$ the
    time since the last fix. The level $\lambda \ge 1$ follows the innovations. A fix far off moves the estimate the
    less the farther it is away, and is never shut out; heading and scale learn $k^2 / d^2$ of what it says.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel, of fixes and motion.
        errors: what it assumes beyond; None: ROAD where measurements are real, EXACT where they are simulated, with
            what the sensors of the recording state.

    References:
        Hampel et al., Robust Statistics, 1986, section 2.6 (redescending weights); docs/methods.md.

    >>> from coopoc import Fleet, Kalman, Sensors, observe
    >>> fleet = Fleet(("a",), np.arange(50) / 10, np.zeros((50, 1, 3)), np.zeros((50, 1, 3)))
    >>> seen = observe(fleet, Sensors(), runs=4)
    >>> bool(np.allclose(RoadFilter()(seen).x, Kalman(robust=False)(seen).x))
    True
    """

    noise_model: NoiseModel | str = "nominal"
    errors: RoadErrors | None = None
    name: str = "road-kalman"

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_options(self, errors=RoadErrors)

    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos, with `extras` heading_error and scale_error; InputError if one is unknown or absent."""
        began = clock()
        columns = check_recording(recording).columns(egos)
        x, cov, errors = self.filtered(recording, columns)
        names = "heading_error", "heading_error_std", "scale_error", "scale_error_std"
        extras = {name: errors[..., i] for i, name in enumerate(names)} if self.assumed(recording).heading else {}
        return silent_track(recording, columns, x, cov, began, lost(x, recording, columns), extras=extras)

    def assumed(self, recording: Recording) -> RoadErrors:
        """`errors`, or those that fit the recording."""
        if self.errors is not None:
            return self.errors
        told, usual = recording.sensors, ROAD if recording.measured else EXACT
        if told.speed_scale_std > 0:
            lasting = min(told.odometry_error_time, 1e6)
            usual = replace(usual, scale=told.speed_scale_std, heading=told.heading_bias_std, lasts=lasting)
        return usual

    def filtered(self, recording: Recording, columns: Sequence[int]) -> tuple[Floats, Floats, Floats]:
        """Position m and covariance m^2, and errors that last, as `kernels.road.run_road` writes them."""
        known, noise = self._noise(recording)
        gnss, velocity = np.ascontiguousarray(recording.gnss), np.ascontiguousarray(recording.velocity)
        shape = *gnss.shape[:2], len(columns)
        process = self.assumed(recording).motion ** 2 * known.process_variance(recording, columns)
        seen = SoloMeasurements(gnss, velocity, np.broadcast_to(process, (*shape, 3)), np.array(columns), recording.dt)
        x, cov, lasting = (np.empty((*shape, *size)) for size in ((3,), (3, 3), (4,)))
        run_road(seen, noise, x, cov, lasting)
        return x, cov, lasting

    def start(self, *, interval: float | None = None, history: float = 10.0) -> RoadStream:
        """Start the filter for one step at a time, from the first fix: `step(gnss, velocity, dt, fix_age)`.

        Args:
            interval: s, the step that the assumed process noise belongs to, as of `Kalman.start`.
            history: s, how old a delayed fix may be.

        >>> RoadFilter("identity").start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)[0].tolist()
        [1.0, 2.0, 0.0]
        """
        known, errors = constant_noise(self.noise_model), self.errors or ROAD
        return RoadStream(louder(motion_noise(known, interval), errors), road_noise(known, errors), history)

    @classmethod
    def fitted(
        cls, recording: Recording, truth: Fleet | None = None, noise_model: NoiseModel | str = "nominal"
    ) -> RoadFilter:
        """The filter with errors calibrated on a drive: by `true_cost` against a truth; without one, fixes of every
        other HELD s are kept from the filter, and the likelihood of these counts. Innovations do not show errors that
        fixes share for longer: then `fix` and `correlation` stay.

        Args:
            recording: of a drive, or of the first part of one.
            truth: of the same steps and vehicles, NaN where there is none.
            noise_model: of fixes and motion.

        Raises:
            InputError: no vehicle that drives from a fix on; a truth of other steps.
        """
        from scipy.optimize import minimize

        seen = check_recording(recording)
        if truth is not None and instance("truth", truth, Fleet).position.shape != seen.gnss.shape[1:]:
            raise InputError("truth", repr(truth), "must be on the steps of the recording", "Give read_log's.")
        parts, first = list[tuple[Recording, int, Floats]](), to_logs(ROAD)
        for column in seen.observers:
            for start, stop in seen.stretches(column, SHORTEST):
                part = seen.between(start, stop)
                target = part.gnss[:, :, column] if truth is None else truth.position[None, start:stop, column]
                if truth is None:
                    fixed = part.t[np.isfinite(part.gnss[0, :, column, 0])]
                    often = float(np.median(np.diff(fixed))) if len(fixed) > 1 else 0.0
                    held = (part.t - part.t[0]) / min(max(HELD, 3 * often), (part.t[-1] - part.t[0]) / 4) % 2 >= 1
                    target = np.where(held[:, None], target, np.nan)
                    part = replace(part, gnss=np.where(held[:, None, None], np.nan, part.gnss))
                if np.isfinite(target).any():
                    parts.append((part, column, target))
        if not parts:
            allowed = f"must hold {SHORTEST} steps of a vehicle without a break, with a target"
            raise InputError("recording", repr(seen), allowed, "Give a longer part of the drive.")

        free = [i for i in range(len(first)) if truth is not None or i not in (0, 2)]

        def at(logs: Floats) -> Floats:
            every = first.copy()
            every[free] = logs
            return every

        def cost(logs: Floats) -> float:
            made, total, steps = cls(noise_model, from_logs(at(logs), 1.0)), 0.0, 0
            for part, column, target in parts:
                x, cov, _ = made.filtered(part, [column])
                fix = 0.0 if truth is not None else made._noise(part)[1].fix[:2]
                there = int(np.isfinite(target[..., 0]).sum())
                each = true_cost(x[:, :, 0], cov[:, :, 0], target, fix, float(truth is not None))
                total, steps = total + float(each.mean()) * there, steps + there
            return total / steps + PRIOR * float(np.square(logs - first[free]).sum())

        simplex = first[free] + np.vstack([np.zeros(len(free)), 0.7 * np.eye(len(free))])
        found = minimize(cost, first[free], method="Nelder-Mead", options={"maxfev": 400, "initial_simplex": simplex})
        return cls(noise_model, from_logs(at(found.x), 1.0))

    def _noise(self, recording: Recording) -> tuple[NoiseModel, RoadNoise]:
        """Noise of the motion, and of fixes and errors."""
        known, errors = resolve(self.noise_model, recording, relative=False), self.assumed(recording)
        if known.sensors is None and self.errors is None:  # no noise is stated that a gate could measure by
            errors = replace(errors, gate=np.inf)
        return known, road_noise(known, errors)


SHORTEST, HELD = 20, 5.0
"""Steps of a stretch that calibrates, at least; s of fixes, three at least, that are kept from the filter, and then as
long given to it."""
PRIOR = 0.002
"""Weight of squared logarithms of the factors between fitted and usual numbers, beside a mean over the drive."""
LIKELIHOOD = 0.1
"""Weight of minus the log likelihood of a true position, beside the logarithm of RT-LE."""
LEAST = np.log([1e-2, 1e-2, 1e-2, 0.5, 1e-4, 1e-4, 1.0, 6.0])
MOST = np.log([1e2, 1e2, 1e3, 20.0, 1.0, 0.5, 1e5, 1e4])
"""Bounds of what is fitted."""


def to_logs(errors: RoadErrors) -> Floats:
    """(8,) logarithms of the numbers that are fitted: all but `least`."""
    return np.log(astuple(errors)[:-1])


def from_logs(logs: Floats, least: float = ROAD.least) -> RoadErrors:
    """Errors of logarithms (8,), within LEAST and MOST."""
    return replace(RoadErrors(*np.exp(np.clip(logs, LEAST, MOST)).tolist()), least=least)


def true_cost(x: Floats, cov: Floats, true: Floats, fix: Floats | float = 0.0, distance: float = 1.0) -> Floats:
    """(R,) what calibration and training reduce: logarithm of RT-LE in the plane, and LIKELIHOOD times minus the mean
    log likelihood of the true positions, as Student's t with four degrees of freedom: a lost filter costs a logarithm.

    Args:
        x: (R, T, 3) m.
        cov: (R, T, 3, 3) m^2.
        true: (R or 1, T, 3) m, NaN where unknown.
        fix: (2,) m^2, variances of fixes that stand for the truth.
        distance: weight of the first part; without it the second counts alone.
    """
    error = (x - true)[..., :2]
    there = np.isfinite(error[..., 0])
    error, count = np.where(there[..., None], error, 0.0), np.maximum(there.sum(axis=-1), 1)
    east, north = np.broadcast_to(fix, 2)
    a, b, c = cov[..., 0, 0] + east, cov[..., 1, 1] + north, cov[..., 0, 1]
    det = np.maximum(a * b - c * c, 1e-12)
    e, n = error[..., 0], error[..., 1]
    nees = (b * e * e - 2.0 * c * e * n + a * n * n) / det
    misfit = np.where(there, 0.5 * np.log(det) + 3.0 * np.log1p(nees / 4.0), 0.0).sum(axis=-1) / count
    level = 0.5 * np.log((e * e + n * n).sum(axis=-1) / count + 1e-6)
    return np.asarray(distance * level + (LIKELIHOOD if distance else 1.0) * misfit)


def louder(motion: MotionNoise, errors: RoadErrors) -> MotionNoise:
    """The noise of the motion times its factor."""
    by = errors.motion
    return motion._replace(base=by * motion.base, ratio=by * motion.ratio, floor=by * motion.floor)


def road_noise(known: NoiseModel, errors: RoadErrors) -> RoadNoise:
    """Both as the kernel takes them."""
    fix = np.square(errors.fix * np.array(known.gnss_std))
    e = errors
    return RoadNoise(fix, e.correlation, e.gate, e.heading, e.scale, e.lasts, e.window, e.least)


class RoadStream:
    """A road filter, step by step.

    Args:
        motion: noise of the motion.
        noise: what is assumed beside it.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, motion: MotionNoise, noise: RoadNoise, history: float) -> None:
        self.history, self._motion, self._noise = MotionHistory(history), motion, noise
        self.state = RoadState(np.full(4, np.nan), np.zeros((4, 4)), np.empty((4, 2)), np.zeros(6))

    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 now, as `FilterStream.step`; NaN and None before the first fix."""
        self.history.check(gnss, velocity, dt, fix_age)
        speed = np.array(velocity, dtype=float)
        moved, q = np.empty(3), np.empty(3)
        road_motion(self._motion, self.history.rows[0, SQUARE], speed, float(dt), moved, q)
        self.history.push(dt, moved, q)
        fix, late = self.history.forward(gnss, fix_age)
        state = self.state
        road_step(state, self._noise, moved, q, float(dt), fix, late)
        if np.isnan(state.x[0]):
            return np.full(3, np.nan), None
        cov = np.zeros((3, 3))
        cov[:2, :2], cov[2, 2] = state.p[:2, :2], state.more[Z_VARIANCE]
        return np.append(state.x[:2], state.more[Z]), state.more[SCALE] * cov
