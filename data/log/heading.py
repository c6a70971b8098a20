"""Headings of a member of a log: as they were measured, or by its course, or by gyro, odometer and fixes."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import scipy

from coopoc.arrays import AnyArray, Floats
from coopoc.world.links import wrap

from ..assemble import SAME_INSTANT, covered

BASELINE = 10.0
"""Standard deviations of a fix, by which two must be apart to show a direction: to 0.14 rad."""
TURNS = 7.5 / BASELINE
"""Root of summed squared sines of turns above which their sense is no chance: fixes make 0.24 of it."""
GYRO_BIAS, GYRO_LASTS, GYRO_WALK = 0.02, 600.0, 0.01
"""rad/s, bias of a yaw rate, and s, for which it lasts; rad in a root of a second, by which its integral wanders."""
FADES, SEEN = 20.0, 4.0
"""s, in which fixes fade; standard deviations of a fix, by which two must be apart to show a direction as well as all
must before they count: to 0.35 rad."""

HeadingAt = Callable[[Floats], Floats]


class Signal(NamedTuple):
    """Samples of a vehicle at their own times: (M,) s, increasing, and (M, C)."""

    t: Floats
    value: Floats


def unknown(at: Floats) -> Floats:
    """(G,) headings of what has none: NaN."""
    return np.full(len(at), np.nan)


class Course(NamedTuple):
    """A heading.

    Attributes:
        at: function from times (G,) s to headings (G,) rad, NaN where unknown.
        source: what it is the course of, "" where it was measured.
        wanders: m^2/s, by which a position that is predicted with it becomes uncertain.
        unsure: rad, standard deviation of a heading that was derived.
    """

    at: HeadingAt = unknown
    source: str = ""
    wanders: float = 0.0
    unsure: float = 0.0


class Reckoning(NamedTuple):
    """Fixes, and the dead reckoning between them.

    Attributes:
        fixes: m, on two axes at least.
        speed: m/s.
        yaw_rate: rad/s.
        std: m, of a fix on an axis.
    """

    fixes: Signal
    speed: Signal
    yaw_rate: Signal
    std: float

    def ways(self) -> tuple[AnyArray, AnyArray]:
        """Places x + iy m at the fixes by dead reckoning, and by them."""
        angle = _angle(self.yaw_rate, self.speed.t)
        way = Signal(self.speed.t, self.speed.value * np.column_stack([np.cos(angle), np.sin(angle)]))
        return integral(way, self.fixes.t) @ [1, 1j], self.fixes.value[:, :2] @ [1, 1j]

    def parts(self, gap: float) -> "Iterator[Reckoning]":
        """Between gaps of the yaw rate, which nothing leads across."""
        for t in np.split(self.yaw_rate.t, np.flatnonzero(np.diff(self.yaw_rate.t) > gap + SAME_INSTANT) + 1):
            fixes, speed, rate = (
                Signal(signal.t[inside], signal.value[inside])
                for signal in (self.fixes, self.speed, self.yaw_rate)
                for inside in [(signal.t >= t[0] - 0.5 * gap) & (signal.t <= t[-1] + 0.5 * gap)]
            )
            if min(len(fixes.t), len(speed.t), len(rate.t)) > 1:
                yield Reckoning(fixes, speed, rate, self.std)

    def far_apart(self) -> Iterator[tuple[int, int, complex, complex]]:
        """Indices of fixes that are BASELINE standard deviations apart, and x + iy m by which they and dead reckoning
        moved in between."""
        (path, position), last = self.ways(), 0
        for j in range(1, len(self.fixes.t)):
            moved, driven = position[j] - position[last], path[j] - path[last]
            if min(abs(moved), abs(driven)) >= BASELINE * self.std:
                yield last, j, moved, driven
                last = j


def heading_at(heading: Signal, yaw_rate: Signal | None, gap: float) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad, NaN where unknown.

    Between measured headings h_j it is W(t) + the line through h_j - W(t_j), with the integral W of the yaw rate, which
    is zero where there is none. Without a yaw rate, gaps longer than `gap` are unknown; without a heading all is.

    >>> heading = heading_at(Signal(np.array([0.0, 1]), np.array([[3.0], [-3.1]])), None, 2.0)
    >>> heading(np.array([0.5, 9.0])).round(3).tolist()
    [3.092, nan]
    """
    if not len(heading.t):
        return unknown
    offset = np.unwrap(heading.value[:, 0] - _angle(yaw_rate, heading.t))
    sampled = heading.t if yaw_rate is None else yaw_rate.t

    def at(times: Floats) -> Floats:
        angle = wrap(np.interp(times, heading.t, offset) + _angle(yaw_rate, times))
        return np.where(covered(sampled, times, gap, gap / 2), angle, np.nan)

    return at


def heading_of_courses(velocity: Signal, yaw_rate: Signal | None) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad: the last course before, turned by the yaw rate since then; NaN
    before the first.

    >>> heading = heading_of_courses(Signal(np.array([1.0, 2]), np.array([[2.0, 0, 0], [0, 2, 0]])), None)
    >>> heading(np.array([0.0, 1, 1.9, 2])).round(3).tolist()
    [nan, 0.0, 0.0, 1.571]
    """
    east, north = velocity.value[:, :2].T
    offset = Signal(velocity.t, (np.arctan2(north, east) - _angle(yaw_rate, velocity.t))[:, None])
    return lambda at: wrap(held(offset, at)[:, 0] + _angle(yaw_rate, at))


def heading_of_rates(way: Reckoning, gap: float) -> Course | None:
    """`heading_of_gyro`, else `heading_of_all`, anew behind each gap of the yaw rate that is longer than `gap` s."""
    found = [(part, heading_of_gyro(part) or heading_of_all(part)) for part in way.parts(gap)]
    courses = [(part.yaw_rate.t, course) for part, course in found if course is not None]
    if not courses:
        return None

    def at(times: Floats) -> Floats:
        angle = unknown(times)
        for t, course in courses:
            here = (times >= t[0] - 0.5 * gap) & (times <= t[-1] + 0.5 * gap)
            angle[here] = course.at(times[here])
        return angle

    longest = max(courses, key=lambda each: len(each[0]))[1]
    return longest._replace(at=at)


def heading_of_gyro(way: Reckoning) -> Course | None:
    """Heading of what measures speed and yaw rate alone: a Kalman filter of the heading at the start and of the yaw
    rate's bias, NaN before the first. None if nothing moves far.

    Fixes that are BASELINE standard deviations apart measure the angle by which the way between them is turned from
    that of dead reckoning, in the middle of it; where angles scatter more than fixes explain, they weigh less.
    """
    t, state, cov, level, samples = way.fixes.t, np.zeros(2), np.zeros((2, 2)), 1.0, list[tuple[float, ...]]()
    for last, j, moved, driven in way.far_apart():
        angle, variance, since = np.angle(moved / driven), 2 * way.std**2 / abs(driven) ** 2, t[j] - t[last]
        h = np.array([1.0, -0.5 * since])
        if not samples:
            state, cov = np.array([angle, 0.0]), np.diag([variance, GYRO_BIAS**2])
        else:
            later = t[j] - samples[-1][0]
            ahead = np.array([[1.0, later], [0.0, 1.0]])
            state, cov = ahead @ state, ahead @ cov @ ahead.T
            cov += later * np.diag([GYRO_WALK**2, GYRO_BIAS**2 / GYRO_LASTS])
            gap = wrap(angle - h @ state)
            level += (max(gap**2 / (h @ cov @ h + variance), 0.5) - level) / 10
            gain = cov @ h / (h @ cov @ h + max(level, 1.0) * variance)
            state, cov = state + gain * gap, cov - np.outer(gain, cov @ h)
        samples.append((float(t[j]), *state, cov[0, 0] * (abs(driven) / since) ** 2, since, cov[0, 0]))
    if not samples:
        return None
    table = np.array(samples)

    def at(times: Floats) -> Floats:
        begun, offset, bias = held(Signal(table[:, 0], table), times).T[:3]
        return np.asarray(wrap(offset + bias * (times - begun) + _angle(way.yaw_rate, times)))

    wander, interval, variance = np.median(table[:, 3:], axis=0)
    return Course(at, "fixes", float(wander * interval), float(np.sqrt(variance + GYRO_WALK**2 * interval)))


def heading_of_all(way: Reckoning) -> Course | None:
    """As `heading_of_gyro`, of what stays near: the turn of dead reckoning onto all fixes until then, which fade in
    FADES s, by least squares; once it is as sure as by two that are SEEN standard deviations apart.

    >>> t = np.arange(0, 60, 0.5)
    >>> circle = 2.0 * np.column_stack([np.sin(0.2 * t), -np.cos(0.2 * t)])
    >>> way = Reckoning(Signal(t, circle), Signal(t, np.full((120, 1), 0.4)), Signal(t, np.full((120, 1), 0.2)), 1.0)
    >>> heading_of_gyro(way) is None, heading_of_all(way).at(np.array([50.0])).round(2)  # 10 rad
    (True, array([-2.57]))
    """
    (path, position), t, sums, samples = way.ways(), way.fixes.t, np.zeros(5, complex), list[Floats]()
    for j, (d, z) in enumerate(zip(path - path[:1], position - position[:1], strict=True)):
        sums = sums * np.exp((t[max(j - 1, 0)] - t[j]) / FADES) + [1.0, d, z, abs(d) ** 2, z * d.conjugate()]
        n, far, moved, square, product = sums
        spread = (square - abs(far) ** 2 / n).real
        turn = product - moved * far.conjugate() / n
        if abs(turn) ** 2 >= 0.75 * (SEEN * way.std) ** 2 * spread and abs(turn) > 0.5 * spread:  # fixes move, too
            samples.append(np.array([t[j], np.angle(turn), way.std**2 / spread]))
    if not samples:
        return None
    since, pace = np.array(samples), np.median(np.abs(way.speed.value))
    offset, variance = Signal(since[:, 0], since[:, 1:2]), float(np.median(since[:, 2]))
    return Course(
        lambda at: wrap(held(offset, at)[:, 0] + _angle(way.yaw_rate, at)),
        "fixes",
        variance * pace**2 * FADES,
        float(np.sqrt(variance + GYRO_WALK**2 * FADES)),
    )


def mirrored(way: Reckoning) -> bool:
    """Whether dead reckoning turns to the other side than fixes do, from one span of `far_apart` to the next."""
    spans = [(moved, driven) for _, _, moved, driven in way.far_apart()]
    if len(spans) < 3:
        return False
    a, b = (np.sin(np.angle(ends[1:] * ends[:-1].conj())) for ends in np.array(spans).T)
    return bool(a @ b < -max(0.5 * float(np.linalg.norm(a)), TURNS) * np.linalg.norm(b))


def held(signal: Signal, at: Floats) -> Floats:
    """(G, C) the last sample at or before each time (G,) s, NaN before the first.

    >>> held(Signal(np.array([0.0, 1]), np.array([[5.0], [6]])), np.array([-1.0, 0, 0.9, 1])).ravel().tolist()
    [nan, 5.0, 5.0, 6.0]
    """
    last = np.searchsorted(signal.t, at + SAME_INSTANT, side="right") - 1
    return np.where(last[:, None] >= 0, signal.value[np.maximum(last, 0)], np.nan)


def integral(signal: Signal, at: Floats) -> Floats:
    """(G, C) integral from the first sample, which holds before it, as the last one does behind it; between two at one
    time the signal leaps."""
    start = signal.t[0]
    ends = np.append(at, signal.t) - start
    t = np.concatenate([[ends.min() - 1], signal.t - start, [ends.max() + 1]])
    value = np.pad(signal.value, ((1, 1), (0, 0)), "edge")
    path = scipy.interpolate.BSpline(np.pad(t, 1, "edge"), value, 1).antiderivative()
    return np.asarray(path(at - start) - path(0.0))


def _angle(yaw_rate: Signal | None, at: Floats) -> Floats:
    """(G,) rad, integral of a yaw rate; 0 without one."""
    return np.zeros_like(at) if yaw_rate is None else integral(yaw_rate, at)[:, 0]
