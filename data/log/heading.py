"""Headings of a member of a log: as they were measured, or by its course, or by gyro, odometer and fixes."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy import nan, pi

from coopoc import PoseFilter, Sensors
from coopoc.arrays import Floats
from coopoc.evaluate.metrics import fix_innovations
from coopoc.world.links import wrap

from ..assemble import PLANE_STD, SAME_INSTANT, covered, planar_recording, steps_of

FILTER_STEP, FIRST_DIRECTIONS = 0.1, 4
"""s, of the steps of the pose filters that find a heading, and directions from which they do."""
PER_SAMPLE, MOST_STEPS = 20, 100_000
"""Steps for each sample of a yaw rate, and in all, beyond which they are longer."""
SURE = 0.15
"""rad, standard deviation of a heading below which it is one."""
GYRO_BIAS, GYRO_WALK, SCALE = 0.02, 0.01, 0.03
"""rad/s, bias of a yaw rate; rad in a root of a second, by which its integral wanders; share by which a speed errs."""
OTHERWISE, FITS_BETTER, MOST_SQUARE = (1.0, -1.0, pi / 180), 0.5, 25.0
"""Factors of yaw rates that may have been meant: none, clockwise, degrees; share of the squared innovations of the
first that another leaves, each over its variance, which counts as MOST_SQUARE at most."""

HeadingAt = Callable[[Floats], Floats]


class Signal(NamedTuple):
    """Samples of a vehicle at their own times: (M,) s, increasing, and (M, C)."""

    t: Floats
    value: Floats

    @property
    def size(self) -> int:
        """Of samples."""
        return len(self.t)

    @property
    def interval(self) -> float:
        """s, median time from one sample to the next, 0 where there are not two."""
        return float(np.median(np.diff(self.t))) if self.size > 1 else 0.0


def unknown(at: Floats) -> Floats:
    """(G,) headings of what has none: NaN."""
    return np.full(len(at), nan)


class Course(NamedTuple):
    """A heading.

    Attributes:
        at: function from times (G,) s to headings (G,) rad, NaN where unknown.
        source: what it is the course of, "" where it was measured.
        wanders: m^2/s, by which a position that is predicted with it becomes uncertain.
        of_pace: function from times to m^2/s at 1 m/s, the same of a direction that errs: times the speed to the 4/3.
        unsure: rad, standard deviation of a heading that was derived.
        lasts: s, for which its errors are alike.
        shown: (M,) s, when fixes have shown it, where nothing else turns it until they do again.
        bends: rad/m, root mean square of how it turns on the way.
    """

    at: HeadingAt = unknown
    source: str = ""
    wanders: float = 0.0
    of_pace: HeadingAt = np.zeros_like
    unsure: float = 0.0
    lasts: float = 0.0
    shown: Floats = np.empty(0)
    bends: float = 0.0


class Reckoning(NamedTuple):
    """Fixes, and the dead reckoning between them.

    Attributes:
        fixes: m, on two axes at least.
        speed: m/s, forward, left and up.
        yaw_rate: rad/s.
        std: m, of a fix on an axis.
        walk: rad in a root of a second, by which the integral of the yaw rate wanders.
    """

    fixes: Signal
    speed: Signal
    yaw_rate: Signal
    std: float
    walk: float = GYRO_WALK

    def parts(self, gap: float) -> "Iterator[Reckoning]":
        """Between gaps of the yaw rate, which nothing leads across."""
        gaps = np.flatnonzero(np.diff(self.yaw_rate.t) > gap + SAME_INSTANT) + 1
        for t in np.split(self.yaw_rate.t, gaps) if self.yaw_rate.size > 1 else ():
            fixes, speed, rate = (
                Signal(signal.t[inside], signal.value[inside])
                for signal in (self.fixes, self.speed, self.yaw_rate)
                for inside in [(signal.t >= t[0] - 0.5 * gap) & (signal.t <= t[-1] + 0.5 * gap)]
            )
            if min(fixes.size, speed.size, rate.size) > 1:
                yield self._replace(fixes=fixes, speed=speed, yaw_rate=rate)


def heading_at(heading: Signal, yaw_rate: Signal | None, gap: float) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad, NaN where unknown.

    Between measured headings h_j it is W(t) + the line through h_j - W(t_j), with the integral W of the yaw rate, which
    is zero where there is none. Without a yaw rate, gaps longer than `gap` are unknown; without a heading all is.

    >>> heading = heading_at(Signal(np.array([0.0, 1]), np.array([[3.0], [-3.1]])), None, 2.0)
    >>> heading(np.array([0.5, 9.0])).round(3).tolist()
    [3.092, nan]
    """
    if not heading.size:
        return unknown
    offset = np.unwrap(heading.value[:, 0] - _angle(yaw_rate, heading.t))
    sampled = heading.t if yaw_rate is None else yaw_rate.t
    return while_sampled(lambda at: wrap(np.interp(at, heading.t, offset) + _angle(yaw_rate, at)), sampled, gap)


def while_sampled(heading: HeadingAt, t: Floats, gap: float) -> HeadingAt:
    """The same heading, NaN in gaps of the samples at t (M,) s that are longer than `gap` s."""
    return lambda at: np.where(covered(t, at, gap, gap / 2), heading(at), nan)


def heading_until(heading: Signal, yaw_rate: Signal | None) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad: the last one before, turned by the yaw rate since then; NaN
    before the first.

    >>> heading = heading_until(Signal(np.array([1.0, 2]), np.array([[0.0], [1.5]])), None)
    >>> heading(np.array([0.0, 1, 1.9, 2])).tolist()
    [nan, 0.0, 0.0, 1.5]
    """
    offset = Signal(heading.t, heading.value - _angle(yaw_rate, heading.t)[:, None])
    return lambda at: wrap(held(offset, at)[:, 0] + _angle(yaw_rate, at))


def heading_of_rates(way: Reckoning, gap: float) -> tuple[Course | None, float]:
    """Heading of what measures speed and yaw rate alone, by `poses_of`, anew behind each gap of the yaw rate that is
    longer than `gap` s; None if none is found. And which factor of yaw rates fits fixes best by far.

    A heading that errs by s rad at a speed of v m/s makes the position wander, between fixes of r m that are T s apart,
    by q m^2/s = (2 s^2 v^2)^(2/3) (r^2 T)^(1/3).

    >>> t = np.arange(0, 60, 0.5)
    >>> circle = 2.0 * np.column_stack([np.sin(0.2 * t), -np.cos(0.2 * t)])
    >>> speed, rate = np.tile([0.4, 0, 0], (120, 1)), np.full((120, 1), 0.2)
    >>> way = Reckoning(Signal(t, circle), Signal(t, speed), Signal(t, rate), 1.0)
    >>> course, factor = heading_of_rates(way, 1.0)
    >>> course.at(np.array([50.0])).round(1), factor  # 10 rad
    (array([-2.6]), 1.0)
    >>> begins_elsewhere = 20 * circle + np.outer(t < 10, [1000, 0])
    >>> heading_of_rates(way._replace(fixes=Signal(t, begins_elsewhere), speed=Signal(t, 20 * speed)), 1.0)[1]
    1.0
    """
    per_part = [*map(poses_of, way.parts(gap))]
    if not per_part:
        return None, 1.0
    t, heading, variance, squares = (np.concatenate(each) for each in zip(*per_part, strict=True))
    squares = squares.reshape(-1, len(OTHERWISE)).sum(0)
    factor = OTHERWISE[squares.argmin() * int(squares.min() < FITS_BETTER * squares[0])]
    known, rate = np.isfinite(heading), way.yaw_rate
    if not known.any():
        return None, factor
    at = while_sampled(heading_until(Signal(t, heading[:, None]), rate), rate.t, gap)
    noise, square = way.std**2 * way.fixes.interval, Signal(t, variance)
    usual = float(np.median(variance[known]))  # of a steady filter, whose error has this time constant
    return Course(
        at,
        "fixes",
        of_pace=lambda times: np.nan_to_num(4.0 * noise * held(square, times) ** 2) ** (1 / 3),
        unsure=usual**0.5,
        lasts=usual / way.walk**2,
    ), factor


def poses_of(way: Reckoning) -> tuple[Floats, Floats, Floats, Floats]:
    """Times (M,) s and headings (M,) rad, NaN until one is SURE, of the pose filter whose innovations are the least
    until then, of those that begin in FIRST_DIRECTIONS directions; their variances (M,) rad^2; and the least sums of
    squared innovations over their variances, with the yaw rates by each factor of OTHERWISE."""
    fixes, speed, rate, std, walk = way
    span = max(float(rate.t[-1] - fixes.t[0]), FILTER_STEP)
    dt = max(FILTER_STEP, span / min(PER_SAMPLE * rate.size, MOST_STEPS))
    t = np.arange(fixes.t[0], fixes.t[0] + span + dt, dt)
    sensors = Sensors(
        gnss_std=(std, std, PLANE_STD),
        yaw_rate_std=walk / dt**0.5,
        compass=False,
        speed_scale_std=SCALE,
        yaw_rate_bias_std=GYRO_BIAS,
    )
    moves, turn = step_means(speed, t)[:, None, :2], step_means(rate, t)
    rec = planar_recording(("vehicle",), t, moves, turn, np.empty((0, 2)), np.empty((0, 5)), sensors, "")
    step = steps_of(fixes.t - t[0], dt, len(t))
    gnss = np.full_like(rec.gnss, nan)
    gnss[0, step[step >= 0], 0] = fixes.value[step >= 0, :2] @ np.eye(2, 3)
    runs = np.arange(len(OTHERWISE) * FIRST_DIRECTIONS)
    rec = replace(rec, gnss=gnss).of_runs(0 * runs)
    meant = np.repeat(OTHERWISE, FIRST_DIRECTIONS)[:, None, None]
    rec = replace(rec, body=replace(rec.body, yaw_rate=meant * rec.body.yaw_rate))  # type: ignore[type-var, union-attr]
    begin = np.pad(gnss[0, 0, 0], (0, 1)) + np.outer(runs % FIRST_DIRECTIONS, [0, 0, 0, 2 * pi / FIRST_DIRECTIONS])
    spread = std, std, PLANE_STD, pi / FIRST_DIRECTIONS
    track: Any = PoseFilter("solo", begin=begin[:, None], spread=spread)(rec, [0])
    known = 2.0 * std**2 + np.trace(track.covariance[:, :, 0, :2, :2], axis1=2, axis2=3)
    squares = np.square(fix_innovations(track, rec)[:, :, 0]).sum(-1) / known
    sums = np.nancumsum(squares / (1.0 + squares / MOST_SQUARE), axis=1)  # a receiver may begin km away
    best = sums[:FIRST_DIRECTIONS].argmin(0), np.arange(len(t))
    heading, variance = track.heading[..., 0][best], track.heading_covariance[..., 0, 3][best]
    known = np.maximum.accumulate(variance < SURE**2)
    return t, np.where(known, heading, nan), variance, sums[:, -1].reshape(len(OTHERWISE), -1).min(1)


def held(signal: Signal, at: Floats, otherwise: float = nan) -> Floats:
    """(G, ...) the last sample at or before each time (G,) s, NaN, or what else is given, before the first.

    >>> held(Signal(np.array([0.0, 1]), np.array([[5.0], [6]])), np.array([-1.0, 0, 0.9, 1])).ravel().tolist()
    [nan, 5.0, 5.0, 6.0]
    """
    last = np.searchsorted(signal.t, at + SAME_INSTANT, side="right") - 1
    return np.where(last >= 0, signal.value.T[..., last], otherwise).T


def between(signal: Signal, at: Floats) -> Floats:
    """(G, C) on the straight lines between samples, beyond them the first or last."""
    return np.column_stack([np.interp(at, signal.t, column) for column in signal.value.T])


def integral(signal: Signal, at: Floats) -> Floats:
    """(G, C) integral from the first sample, which holds before it, as the last one does behind it; between two at one
    time the signal leaps."""
    start = signal.t[0]
    ends = np.append(at, signal.t) - start
    t = np.r_[ends.min() - 1, signal.t - start, ends.max() + 1]
    path = scipy.interpolate.BSpline(
        np.pad(t, 1, "edge"), np.pad(signal.value, ((1, 1), (0, 0)), "edge"), 1
    ).antiderivative()
    return np.asarray(path(at - start) - path(0.0))


def step_means(signal: Signal, grid: Floats) -> Floats:
    """(T, C) mean over the step that ends at each instant, of the samples joined by straight lines.

    >>> speed = Signal(np.array([0.0, 1]), np.array([[0.0], [2]]))
    >>> step_means(speed, np.array([0.0, 0.5, 1])).ravel().tolist()
    [0.0, 0.5, 1.5]
    """
    dt = grid[1] - grid[0]
    means: Floats = np.diff(integral(signal, np.append(grid[0] - dt, grid)), axis=0) / dt
    return means


def _angle(yaw_rate: Signal | None, at: Floats) -> Floats:
    """(G,) rad, integral of a yaw rate; 0 without one."""
    return np.zeros_like(at) if yaw_rate is None else integral(yaw_rate, at)[:, 0]
