"""Headings of a member of a log: as they were measured, or by its course, or by gyro, odometer and fixes."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import scipy

from coopoc.arrays import AnyArray, Bools, Floats
from coopoc.world.links import wrap

from ..assemble import SAME

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


def heading_at(heading: Signal, yaw_rate: Signal | None, gap: float) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad, NaN where unknown.

    Between measured headings h_j it is W(t) + the line through h_j - W(t_j), with the integral W of the yaw rate, which
    is zero where there is none. Without a yaw rate, gaps longer than `gap` are unknown.

    >>> heading = heading_at(Signal(np.array([0.0, 1]), np.array([[3.0], [-3.1]])), None, 2.0)
    >>> heading(np.array([0.5, 9.0])).round(3).tolist()
    [3.092, nan]
    """
    turned = (lambda at: integral(yaw_rate, at)[:, 0]) if yaw_rate is not None else np.zeros_like
    offset = np.unwrap(heading.value[:, 0] - turned(heading.t))
    sampled = heading.t if yaw_rate is None else yaw_rate.t

    def at(times: Floats) -> Floats:
        angle = wrap(np.interp(times, heading.t, offset) + turned(times))
        return np.where(covered(sampled, times, gap, gap / 2), angle, np.nan)

    return at


def heading_of_courses(velocity: Signal, yaw_rate: Signal | None) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad: the last course before, turned by the yaw rate since then; NaN
    before the first.

    >>> heading = heading_of_courses(Signal(np.array([1.0, 2]), np.array([[2.0, 0, 0], [0, 2, 0]])), None)
    >>> heading(np.array([0.0, 1, 1.9, 2])).round(3).tolist()
    [nan, 0.0, 0.0, 1.571]
    """
    turned = (lambda at: integral(yaw_rate, at)[:, 0]) if yaw_rate is not None else np.zeros_like
    east, north = velocity.value[:, :2].T
    offset = Signal(velocity.t, (np.arctan2(north, east) - turned(velocity.t))[:, None])
    return lambda at: wrap(held(offset, at)[:, 0] + turned(at))


def heading_of_gyro(
    fixes: Signal, speed: Signal, yaw_rate: Signal, std: float
) -> tuple[HeadingAt, float, float] | None:
    """Function from times (G,) s to headings (G,) rad of what measures speed and yaw rate alone: a Kalman filter of the
    heading at the start and of the yaw rate's bias, NaN before the first; m^2/s, by which a position that is
    predicted with it becomes uncertain; and rad, its own standard deviation. None if nothing moves far.

    Fixes that are BASELINE standard deviations apart measure the angle by which the way between them is turned from
    that of dead reckoning, in the middle of it; where angles scatter more than fixes explain, they weigh less.

    Args:
        fixes: m, on two axes at least.
        speed: m/s.
        yaw_rate: rad/s.
        std: m, of a fix on an axis.
    """
    t, state, cov, level, samples = fixes.t, np.zeros(2), np.zeros((2, 2)), 1.0, list[tuple[float, ...]]()
    for last, j, moved, driven in far_apart(fixes, speed, yaw_rate, std):
        angle, variance = float(np.angle(moved / driven)), 2 * std**2 / abs(driven) ** 2
        h = np.array([1.0, 0.5 * (t[last] - t[j])])
        if not samples:
            state, cov = np.array([angle, 0.0]), np.diag([variance, GYRO_BIAS**2])
        else:
            ahead = np.array([[1.0, t[j] - samples[-1][0]], [0.0, 1.0]])
            state, cov = ahead @ state, ahead @ cov @ ahead.T
            cov += (t[j] - samples[-1][0]) * np.diag([GYRO_WALK**2, GYRO_BIAS**2 / GYRO_LASTS])
            gap = float(wrap(np.array(angle - h @ state)))
            level += (max(gap**2 / (h @ cov @ h + variance), 0.5) - level) / 10
            gain = cov @ h / (h @ cov @ h + max(level, 1.0) * variance)
            state, cov = state + gain * gap, cov - np.outer(gain, cov @ h)
        pace = abs(driven) / (t[j] - t[last])
        samples.append((float(t[j]), *state, cov[0, 0] * pace**2, t[j] - t[last], cov[0, 0]))
    if not samples:
        return None
    since = Signal(np.array([k[0] for k in samples]), np.array(samples))

    def at(times: Floats) -> Floats:
        begun, offset, bias = held(since, times).T[:3]
        heading: Floats = wrap(offset + bias * (times - begun) + integral(yaw_rate, times)[:, 0])
        return heading

    wander, interval, variance = np.median(since.value[:, 3:], axis=0)
    return at, float(wander * interval), float(np.sqrt(variance + GYRO_WALK**2 * interval))


def far_apart(
    fixes: Signal, speed: Signal, yaw_rate: Signal, std: float
) -> Iterator[tuple[int, int, complex, complex]]:
    """Indices of fixes that are BASELINE standard deviations apart, and x + iy m by which they and dead reckoning moved
    in between."""
    (path, position), last = _ways(fixes, speed, yaw_rate), 0
    for j in range(1, len(fixes.t)):
        moved, driven = position[j] - position[last], path[j] - path[last]
        if min(abs(moved), abs(driven)) >= BASELINE * std:
            yield last, j, moved, driven
            last = j


def _ways(fixes: Signal, speed: Signal, yaw_rate: Signal) -> tuple[AnyArray, AnyArray]:
    """Places x + iy m at the fixes by dead reckoning, and by them."""
    turned = integral(yaw_rate, speed.t)
    way = speed.value * np.column_stack([np.cos(turned), np.sin(turned)])
    return integral(Signal(speed.t, way), fixes.t) @ [1, 1j], fixes.value[:, :2] @ [1, 1j]


def heading_of_all(fixes: Signal, speed: Signal, yaw_rate: Signal, std: float) -> tuple[HeadingAt, float, float] | None:
    """As `heading_of_gyro`, of what stays near: the turn of dead reckoning onto all fixes until then, which fade in
    FADES s, by least squares; once it is as sure as by two that are SEEN standard deviations apart.

    >>> t = np.arange(0, 60, 0.5)
    >>> circle = 2.0 * np.column_stack([np.sin(0.2 * t), -np.cos(0.2 * t)])
    >>> signals = Signal(t, circle), Signal(t, np.full((120, 1), 0.4)), Signal(t, np.full((120, 1), 0.2))
    >>> heading_of_gyro(*signals, 1.0) is None, heading_of_all(*signals, 1.0)[0](np.array([50.0])).round(2)  # 10 rad
    (True, array([-2.57]))
    """
    (path, position), t, sums, samples = _ways(fixes, speed, yaw_rate), fixes.t, np.zeros(5, complex), list[Floats]()
    for j, (d, z) in enumerate(zip(path - path[:1], position - position[:1], strict=True)):
        sums = sums * np.exp((t[max(j - 1, 0)] - t[j]) / FADES) + [1.0, d, z, abs(d) ** 2, z * d.conjugate()]
        n, far, moved, square, product = sums
        spread = (square - abs(far) ** 2 / n).real
        turn = product - moved * far.conjugate() / n
        if abs(turn) ** 2 >= 0.75 * (SEEN * std) ** 2 * spread and abs(turn) > 0.5 * spread:  # fixes move, too
            samples.append(np.array([t[j], np.angle(turn), std**2 / spread]))
    if not samples:
        return None
    since, pace = np.array(samples), float(np.median(np.abs(speed.value)))
    offset = Signal(since[:, 0], since[:, 1:2])
    at = lambda times: wrap(held(offset, times)[:, 0] + integral(yaw_rate, times)[:, 0])  # noqa: E731
    variance = float(np.median(since[:, 2]))
    return at, variance * pace**2 * FADES, float(np.sqrt(variance + GYRO_WALK**2 * FADES))


def mirrored(fixes: Signal, speed: Signal, yaw_rate: Signal, std: float) -> bool:
    """Whether dead reckoning turns to the other side than fixes do, from one span of `far_apart` to the next."""
    spans = [(moved, driven) for _, _, moved, driven in far_apart(fixes, speed, yaw_rate, std)]
    if len(spans) < 3:
        return False
    a, b = (np.sin(np.angle(way[1:] * way[:-1].conj())) for way in np.array(spans).T)
    return bool(a @ b < -max(0.5 * float(np.linalg.norm(a)), TURNS) * float(np.linalg.norm(b)))


def held(signal: Signal, at: Floats) -> Floats:
    """(G, C) the last sample at or before each time (G,) s, NaN before the first.

    >>> held(Signal(np.array([0.0, 1]), np.array([[5.0], [6]])), np.array([-1.0, 0, 0.9, 1])).ravel().tolist()
    [nan, 5.0, 5.0, 6.0]
    """
    last = np.searchsorted(signal.t, at + SAME, side="right") - 1
    return np.where(last[:, None] >= 0, signal.value[np.maximum(last, 0)], np.nan)


def covered(t: Floats, at: Floats, gap: float, edge: float) -> Bools:
    """True between samples at most `gap` apart, and up to `edge` beyond a sample.

    >>> covered(np.array([0.0, 1, 5]), np.array([0.5, 2, 4.8]), 2.0, 0.3).tolist()
    [True, False, True]
    """
    right = np.clip(np.searchsorted(t, at), min(1, len(t) - 1), len(t) - 1)
    left = np.maximum(right - 1, 0)
    between = (at >= t[left] - SAME) & (at <= t[right] + SAME) & (t[right] - t[left] <= gap + SAME)
    near = np.minimum(np.abs(at - t[left]), np.abs(at - t[right])) <= edge + SAME
    return between | near


def integral(signal: Signal, at: Floats) -> Floats:
    """(G, C) integral from the first sample, which holds before it, as the last one does behind it."""
    start = signal.t[0]
    ends = np.append(at, signal.t) - start
    t = np.concatenate([[ends.min() - 1], signal.t - start, [ends.max() + 1]])
    path = scipy.interpolate.make_interp_spline(t, np.pad(signal.value, ((1, 1), (0, 0)), "edge"), k=1).antiderivative()
    return np.asarray(path(at - start) - path(0.0))
