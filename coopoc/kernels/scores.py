"""Errors and NEES of a track in one pass."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats
from .compiling.compile import compiled, part


@part
def less(a: AnyArray, b: AnyArray) -> Any:
    """a - b, three numbers."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def distances(x: AnyArray, truth: AnyArray) -> Floats:
    """(R, T, E) m between x (R, T, E, 3) and truth (T, E, 3)."""
    found = np.empty(x.shape[:3])
    for run in range(len(x)):
        for t in range(x.shape[1]):
            for e in range(x.shape[2]):
                a, b, c = less(x[run, t, e], truth[t, e])
                found[run, t, e] = math.sqrt(a * a + b * b + c * c)
    return found


@compiled
def normalised(x: AnyArray, truth: AnyArray, cov: AnyArray) -> tuple[Floats, bool]:
    """e^T P^-1 e (R, T, E) by P = L D L^T, NaN where P is zero, and whether every other P could be inverted."""
    found, sound = np.empty(x.shape[:3]), True
    for run in range(len(x)):
        for t in range(x.shape[1]):
            for e in range(x.shape[2]):
                p = cov[run, t, e]
                a, b, c = less(x[run, t, e], truth[t, e])
                first, second = p[0, 1] / p[0, 0], p[0, 2] / p[0, 0]
                yy, yz, zz = p[1, 1] - first * p[0, 1], p[1, 2] - first * p[0, 2], p[2, 2] - second * p[0, 2]
                third, b = yz / yy, b - first * a
                zz, c = zz - third * yz, c - second * a - third * b
                value = a * a / p[0, 0] + b * b / yy + c * c / zz
                if not math.isfinite(value):
                    sound &= not p.any()
                    value = np.nan
                found[run, t, e] = value
    return found, sound


@compiled
def root_mean_squares(theirs: AnyArray, truth: AnyArray, ends: AnyArray) -> Floats:
    """(R, E) m: root mean square over the links ends[e]:ends[e + 1] of what is known in (R, L, 3); NaN for nothing."""
    found = np.empty((len(theirs), len(ends) - 1))
    for run in range(len(theirs)):
        for e in range(len(ends) - 1):
            total, count = 0.0, 0
            for link in range(ends[e], ends[e + 1]):
                a, b, c = less(theirs[run, link], truth[link])
                square = a * a + b * b + c * c
                if math.isfinite(square):
                    total, count = total + square, count + 1
            found[run, e] = math.sqrt(total / count) if count else np.nan
    return found
