"""Windows of a star as problems, one run each: for backends that solve them in place of the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..optimize.model.window import WindowStep
from ..world.inbox import Inbox
from ..world.recording import Recording
from . import star
from .noise_model import NoiseModel

Span = tuple[int, int]
"""First and last step of a window."""


@dataclass(frozen=True, eq=False)
class Positions:
    """The positions that vehicles may use and send (R, T, N, 3) m, their variance m^2, and (R, T, N) where one is new.

    A fix that is missing is replaced by the last one, moved by the vehicle's own odometry since.
    """

    x: Floats
    variance: Floats
    new: Bools


def dead_reckoned(recording: Recording, known: NoiseModel) -> Positions:
    """All fixes, and where one is missing the last one moved by odometry, its variance grown by the process noise."""
    new: Bools = np.asarray(np.isfinite(recording.gnss).all(axis=-1))
    variance = np.ascontiguousarray(known.fix_variance(recording))
    if recording.complete:
        return Positions(recording.gnss, variance, new)
    x, variance = star.dead_reckoned(recording, known)
    x.flags.writeable = False  # as the fixes are, for the same compiled code
    return Positions(x, variance, new)


def last_met(neighbour: Ints, start: Ints) -> Ints:
    """(M,) step at which the neighbour of each link was linked before, -1 for never."""
    step = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((step, neighbour))
    met = np.full(len(neighbour), -1, np.int64)
    again = np.flatnonzero(np.diff(neighbour[order]) == 0)
    met[order[again + 1]] = step[order[again]]
    return met


def steps_of(window: Any, recording: Recording, box: Inbox, run: int, span: Span) -> list[WindowStep]:
    """The steps of a compiled window in one run, oldest first."""
    lane, steps = run % window.motion.shape[1], []
    motion, used = window.motion[:, lane].reshape(-1, 4, 3), window.used[:, lane].reshape(-1, 3)
    for step in range(span[0], span[1] + 1):
        here = places(window, step)
        moved, process, fix, _ = np.moveaxis(motion[here], 1, 0)
        with np.errstate(divide="ignore"):
            std = 1.0 / np.sqrt(used[here])
        relative = recording.relative[run, box.link[box.start[step] : box.start[step + 1]]]
        steps.append(WindowStep(window.previous[here].copy(), fix, std, moved, np.sqrt(process), relative))
    return steps


def places(window: Any, step: int) -> slice:
    """Of the members of a step in the arrays of a compiled window."""
    slot = step % len(window.sizes)
    return slice(slot * window.layout[1], slot * window.layout[1] + int(window.sizes[slot]))


def vehicles_of(window: Any, span: Span) -> Ints:
    """(n,) column of the vehicle of each point of a compiled window."""
    return np.concatenate([window.member[places(window, step)] for step in range(span[0], span[1] + 1)])


def points_of(window: Any, run: int, span: Span) -> Floats:
    """(n, 3) m, the estimate at all steps of a window."""
    point = window.point[:, run % window.point.shape[1]].reshape(-1, 3)
    return np.concatenate([point[places(window, step)] for step in range(span[0], span[1] + 1)])
