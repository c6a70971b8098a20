"""Calibration of a filter on a drive: what is fitted to its first two thirds must be better on the rest."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from ..arrays import Floats, instance
from ..errors import InputError
from ..world.fleet import Fleet
from ..world.recording import Recording, check_recording
from ..world.sensors import Sensors
from .track import Method

MIN_STEPS, WITHHELD_SECONDS = 20, 5.0
"""Steps of a stretch that calibrates, at least; s of fixes, three at least, that are kept from the filter, and then as
long given to it."""
FITTED, BLOCKS = 2 / 3, 8
"""Share of a drive that is fitted; blocks of time of the rest, over which errors are compared."""
PRIOR = 0.002
"""Weight of squared logarithms of the factors between fitted and usual numbers, beside a mean over the drive."""
SINGLE = frozenset(("heading", "scale"))
"""Deviations of errors of which a drive holds one draw: it can show that they are larger, not that they are smaller."""
LIKELIHOOD = 0.1
"""Weight of minus the log likelihood of a true position, beside the logarithm of RT-LE."""
M = TypeVar("M", bound=Method)


class Part(NamedTuple):
    """A stretch of a vehicle without a break.

    Attributes:
        recording: of it.
        column: of the vehicle.
        target: (R or 1, T, 3) m, its true positions or fixes that the recording does not hold; NaN for none.
        variance: (2,) m^2, of fixes that stand for the truth, or 0.
    """

    recording: Recording
    column: int
    target: Floats
    variance: Floats


def calibrated(
    make: Callable[[Mapping[str, float]], M], usual: Mapping[str, float], recording: Recording, truth: Fleet | None
) -> tuple[M, str]:
    """The method with numbers that are better than the usual ones on the last third of a drive, or with these, and a
    sentence: what has moved, and what it gained there.

    Numbers are fitted to the first two thirds, by `cost`. Only where the paired difference of the errors over BLOCKS
    blocks of the last third lies below 0 with its 95 % interval, they are fitted to all of the drive and returned.

    Args:
        make: the method by its numbers.
        usual: by name, > 0.
        recording: of a drive, or of the first part of one.
        truth: of the same vehicles and times, NaN where there is none; without one fixes of every other
            WITHHELD_SECONDS s are kept from the filter, and stand for it.

    Raises:
        InputError: no vehicle that drives from a fix on; a truth of other vehicles or times.
    """
    checked = check_recording(recording)
    if truth is not None:
        instance("truth", truth, Fleet).require(checked.ids, checked.t)
    split, default = int(FITTED * len(checked.t)), make(usual)
    first, whole = (
        parts_of(checked.between(0, stop), truth and truth.between(0, stop)) for stop in (split, len(checked.t))
    )
    rest = [part for part in whole if np.isfinite(part.target[:, part.recording.t >= checked.t[split]]).any()]
    if not first or not rest:
        allowed = f"must hold {MIN_STEPS} steps of a vehicle without a break, with a target, in all of its thirds"
        raise InputError("recording", repr(checked), allowed, "Give a longer part of the drive.")
    change, by = held_out(make(fit(make, usual, first)), default, rest, checked.t[split])
    text = f"the error on its last third by {change:.2g} +- {by:.2g} m"
    if not change + by < 0.0:
        return default, f"calibration keeps the usual numbers: fitted ones change {text}"
    fitted = fit(make, usual, whole)
    moved = ", ".join(f"{name} {usual[name]:.3g} -> {fitted[name]:.3g}" for name in usual)
    return make(fitted), f"calibrated: {moved}; this changes {text}"


def scaled(sensors: Sensors, fix: float, motion: float) -> Sensors:
    """The sensors with other deviations of fixes and of velocities, by two factors."""
    std, ratio = np.multiply(fix, sensors.gnss_std), min(motion * sensors.velocity_std_ratio, 1.0)
    floor = motion * sensors.velocity_floor
    return replace(sensors, gnss_std=tuple(std.tolist()), velocity_std_ratio=ratio, velocity_floor=floor)


def parts_of(recording: Recording, truth: Fleet | None) -> list[Part]:
    """The stretches of all vehicles that have targets."""
    parts = []
    for column in recording.observers:
        for start, stop in recording.stretches(column, MIN_STEPS):
            part, variance = recording.between(start, stop), np.zeros(2)
            if truth is None:
                target, variance = part.gnss[:, :, column], np.square(recording.sensors.gnss_std[:2])
                fixed = part.t[np.isfinite(target[0, :, 0])]
                often = float(np.median(np.diff(fixed))) if len(fixed) > 1 else 0.0
                held = (part.t - part.t[0]) / min(
                    max(WITHHELD_SECONDS, 3 * often), (part.t[-1] - part.t[0]) / 4
                ) % 2 >= 1
                target = np.where(held[:, None], target, np.nan)
                part = replace(part, gnss=np.where(held[:, None, None], np.nan, part.gnss))
            else:
                target = truth.position[None, start:stop, column]
            if np.isfinite(target).any():
                parts.append(Part(part, column, target, variance))
    return parts


def fit(
    make: Callable[[Mapping[str, float]], M], usual: Mapping[str, float], parts: Sequence[Part]
) -> dict[str, float]:
    """Numbers of least `cost` over the parts, by Nelder and Mead's search on their logarithms."""
    from scipy.optimize import minimize

    first = np.log([*usual.values()])
    least = np.where([name in SINGLE for name in usual], first, -np.inf)

    def named(logs: Floats) -> dict[str, float]:
        return dict(zip(usual, np.exp(np.maximum(logs, least)).tolist(), strict=True))

    def total(logs: Floats) -> float:
        weights, costs = list[int](), list[float]()
        for part in parts:
            try:
                track = make(named(logs))(part.recording, [part.column])
            except (ValueError, RuntimeError):  # numbers out of range
                return 1e6
            assert track.covariance is not None
            each = cost(track.x[:, :, 0], track.covariance[:, :, 0], part.target, part.variance)
            weights.append(int(np.isfinite(part.target[..., 0]).sum()))
            costs.append(float(each.mean()))
        return float(np.average(costs, weights=weights)) + PRIOR * float(np.square(logs - first).sum())

    simplex = first + np.vstack([np.zeros(len(first)), 0.7 * np.eye(len(first))])
    return named(minimize(total, first, method="Nelder-Mead", options={"maxfev": 300, "initial_simplex": simplex}).x)


def held_out(method: Method, usual: Method, parts: Sequence[Part], since: float) -> tuple[float, float]:
    """Mean difference of the errors m in the plane over blocks of time since then, the method's less the usual one's,
    and half its 95 % interval by Student's t; infinite of one block."""
    from scipy.stats import t

    errors = [list[float](), list[float]()]
    for part in parts:
        for one, block_errors in zip((method, usual), errors, strict=True):
            gap = (one(part.recording, [part.column]).x[:, :, 0] - part.target)[:, part.recording.t >= since, :2]
            blocks = np.array_split(np.linalg.norm(gap, axis=-1), max(1, BLOCKS // len(parts)), axis=1)
            block_errors += [float(np.sqrt(np.nanmean(b**2))) for b in blocks if np.isfinite(b).any()]
    change, n = np.array(errors[0]) - errors[1], len(errors[0])
    half = t.ppf(0.975, n - 1) * change.std(ddof=1) / np.sqrt(n) if n > 1 else np.inf
    return float(change.mean()), float(half)


def cost(x: Floats, cov: Floats, true: Floats, variance: Floats) -> Floats:
    """(R,) what calibration reduces: logarithm of RT-LE in the plane, and LIKELIHOOD times minus the mean log
    likelihood of the true positions, as Student's t with four degrees of freedom: a lost filter costs a logarithm.

    Args:
        x: (R, T, 3) m.
        cov: (R, T, 3, 3) m^2.
        true: (R or 1, T, 3) m, NaN where unknown.
        variance: (2,) m^2, of fixes that stand for the truth: then the likelihood alone counts; else 0.
    """
    error = (x - true)[..., :2]
    there = np.isfinite(error[..., 0])
    error, count = np.where(there[..., None], error, 0.0), np.maximum(there.sum(axis=-1), 1)
    a, b, c = cov[..., 0, 0] + variance[0], cov[..., 1, 1] + variance[1], cov[..., 0, 1]
    det = np.maximum(a * b - c * c, 1e-12)
    e, n = error[..., 0], error[..., 1]
    nees = (b * e * e - 2.0 * c * e * n + a * n * n) / det
    misfit: Floats = np.where(there, 0.5 * np.log(det) + 3.0 * np.log1p(nees / 4.0), 0.0).sum(axis=-1) / count
    if np.any(variance):
        return misfit
    level = 0.5 * np.log((e * e + n * n).sum(axis=-1) / count + 1e-6)
    return np.asarray(level + LIKELIHOOD * misfit)
