"""Heading and velocity of one vehicle from what its log holds of them, at any time and on the steps of a Recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from coopoc.arrays import Bools, Floats

from .rows import SAME
from .smooth import smooth

MOVING = 1.0
"""m/s, least speed at which a course is a heading."""
COURSE_RATE = 0.25
"""Half-power frequency, in fixes, of the smoother that makes velocities of fixes."""


class Signal(NamedTuple):
    """Samples of a vehicle at their own times: (M,) s, increasing, and (M, C)."""

    t: Floats
    value: Floats

    @property
    def interval(self) -> float:
        """Median interval, s; 0 for a single sample."""
        return float(np.median(np.diff(self.t))) if len(self.t) > 1 else 0.0


def bridged(signal: Signal, dt: float, max_gap: float | None) -> float:
    """s, the longest gap between samples that is bridged: max_gap, or what `assemble` takes.

    >>> bridged(Signal(np.arange(4.0), np.zeros((4, 1))), 0.1, None)
    1.5
    """
    return max_gap or max(5 * dt, 0.5, 1.5 * signal.interval)


def covered(signal: Signal, at: Floats, gap: float, edge: float) -> Bools:
    """True between samples at most `gap` apart, and up to `edge` beyond a sample.

    >>> covered(Signal(np.array([0.0, 1, 5]), np.zeros((3, 1))), np.array([0.5, 2, 4.8]), 2.0, 0.3).tolist()
    [True, False, True]
    """
    t = signal.t
    right = np.clip(np.searchsorted(t, at), 1, max(len(t) - 1, 1)) if len(t) > 1 else np.zeros(len(at), dtype=np.int64)
    left = np.maximum(right - 1, 0)
    between = (at >= t[left] - SAME) & (at <= t[right] + SAME) & (t[right] - t[left] <= gap + SAME)
    near = np.minimum(np.abs(at - t[left]), np.abs(at - t[right])) <= edge + SAME
    return np.asarray(between | near)


def step_means(signal: Signal, grid: Floats) -> Floats:
    """(T, C) mean over the step that ends at each instant, of the samples joined by straight lines.

    >>> step_means(Signal(np.array([0.0, 1]), np.array([[0.0], [2]])), np.array([0.0, 0.5, 1])).ravel().tolist()
    [0.0, 0.5, 1.5]
    """
    dt = grid[1] - grid[0]
    edges = np.append(grid[0] - dt, grid)
    means: Floats = np.diff(_integral(signal, edges), axis=0) / dt
    return means


def _integral(signal: Signal, at: Floats) -> Floats:
    """(G, C) integral from the first sample, which holds before it, as the last one does behind it."""
    t, v = signal
    if len(t) == 1:
        constant: Floats = (at - t[0])[:, None] * v
        return constant
    whole = np.vstack([0 * v[:1], np.cumsum(np.diff(t)[:, None] * (v[1:] + v[:-1]) / 2, axis=0)])
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    inside = np.clip(at, t[0], t[-1])
    s = (inside - t[k])[:, None]
    bend = (v[k + 1] - v[k]) / (t[k + 1] - t[k])[:, None]
    out: Floats = (
        whole[k] + s * v[k] + 0.5 * s**2 * bend + (at - inside)[:, None] * np.where((at < t[0])[:, None], v[0], v[-1])
    )
    return out


def heading_at(heading: Signal, yaw_rate: Signal | None, gap: float) -> Callable[[Floats], Floats]:
    """Function from times (G,) s to headings (G,) rad, NaN where unknown.

    Between measured headings h_j it is W(t) + the line through h_j - W(t_j), with the integral W of the yaw rate, which
    is zero where there is none. Without a yaw rate, gaps longer than `gap` are unknown.

    >>> at = heading_at(Signal(np.array([0.0, 1]), np.array([[3.0], [-3.0]])), None, 2.0)
    >>> at(np.array([0.5, 9.0])).round(3).tolist()
    [3.142, nan]
    """
    turned = (lambda at: _integral(yaw_rate, at)[:, 0]) if yaw_rate is not None else np.zeros_like
    offset = np.unwrap(heading.value[:, 0] - turned(heading.t))

    def at(times: Floats) -> Floats:
        found = np.interp(times, heading.t, offset) + turned(times)
        known = covered(heading, times, gap, gap / 2) if yaw_rate is None else covered(yaw_rate, times, gap, gap / 2)
        wrapped = np.arctan2(np.sin(found), np.cos(found))
        return np.where(known, wrapped, np.nan)

    return at


def course(velocity: Signal) -> Signal:
    """Direction (M, 1) rad of the samples (M, 2 or 3) m/s that move."""
    moving = np.hypot(velocity.value[:, 0], velocity.value[:, 1]) > MOVING
    v = velocity.value[moving]
    return Signal(velocity.t[moving], np.arctan2(v[:, 1:2], v[:, :1]))


def velocity_of_fixes(fixes: Signal, gap: float) -> Signal:
    """Velocity (M, 3) m/s at the times of the fixes, from a smooth curve through each stretch without a gap.

    Its errors are those of the fixes: a filter that takes both for independent believes too much.
    """
    t, x = fixes
    step = max(fixes.interval, SAME)
    out = np.zeros_like(x)
    for part in np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > gap + SAME) + 1):
        if len(part) < 2:
            continue
        grid = np.arange(t[part[0]], t[part[-1]] + step / 2, step)
        even = np.column_stack([np.interp(grid, t[part], column) for column in x[part].T])
        speed = np.gradient(smooth(even, step, COURSE_RATE / step), step, axis=0) if len(grid) > 1 else 0 * even
        out[part] = np.column_stack([np.interp(t[part], grid, column) for column in speed.T])
    return Signal(t, out)
