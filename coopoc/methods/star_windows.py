"""Star windows: the last steps of one ego's star, alike ones together, as the problems that `CooperativeMAP` solves."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..arrays import Bools, Ints
from ..optimize.problem import Problem
from ..optimize.sights import Sight, chain
from ..optimize.suspects import Suspects
from ..world.inbox import Inbox
from ..world.recording import Recording
from .knowledge import Knowledge
from .star import StarStep, star_steps

STACKED = 64
"""Windows of one structure that are solved together, times R."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One step as the window keeps it: the star, the columns of its members, and (R, n) whose messages are held."""

    star: StarStep
    members: Ints
    held: Bools


Window = tuple[Seen, ...]


def windows_of(
    recording: Recording, ego: int, box: Inbox, known: Knowledge, length: int, last: int | None = None
) -> Iterator[Window]:
    """The last `length` steps at every step, fewer at the start; of those that end in step `last`, if it is given.

    How often a message was used before a window begins is known from the steps since it may have been sent.
    """
    recent: deque[Seen] = deque(maxlen=length)
    steps = None
    if last is not None:
        before = length - 1 + min(recording.v2x.max_age / recording.dt, last)
        steps = range(max(0, last - int(np.ceil(before))), last + 1)
    for star in star_steps(recording, ego, box, known, steps):
        members = np.concatenate([[ego], recording.links.neighbour[star.links]])
        span = slice(box.start[star.step], box.start[star.step + 1])
        held = np.concatenate([np.ones((recording.runs, 1), dtype=bool), box.newest[:, span] >= 0], axis=1)
        recent.append(Seen(star, members, held))
        yield tuple(recent)


def alike(windows: Iterator[Window]) -> Iterator[list[Window]]:
    """Windows of the same structure together, for one batch to solve: a drive of snapshots has K + 1 structures."""
    waiting: dict[tuple[bytes, ...], list[Window]] = defaultdict(list)
    for window in windows:
        key = tuple(np.sort(numbers).tobytes() for numbers in vehicles(window))
        waiting[key].append(window)
        if len(waiting[key]) == STACKED:
            yield waiting.pop(key)
    yield from waiting.values()


def vehicles(window: Window) -> list[Ints]:
    """Numbers of the members at each step, in the order in which the window meets the vehicles: the ego is 0.

    A problem has its points in the order of these numbers, so that the order of the neighbours' distances, which
    changes from step to step, makes no structure of its own.
    """
    members = np.concatenate([seen.members for seen in window])
    _, first, inverse = np.unique(members, return_index=True, return_inverse=True)
    numbers = np.argsort(np.argsort(first))[inverse]
    return np.split(numbers, np.cumsum([len(seen.members) for seen in window[:-1]]))


def suspected(window: Window, ego_too: bool) -> tuple[Suspects, Ints]:
    """The suspects of a window's problem and their groups: the fixes of each neighbour; if `ego_too` those of the ego,
    and its odometry."""
    steps = vehicles(window)
    vehicle = np.concatenate([np.sort(numbers) for numbers in steps])
    rows = np.flatnonzero(vehicle + ego_too)
    if not ego_too or len(window) == 1:
        return [(0, rows.tolist())], vehicle[rows]
    stays = [len(np.intersect1d(*pair)) for pair in pairwise(steps)]
    moves = np.concatenate([[0], np.cumsum(stays[:-1])]).astype(np.int64)  # at each step the ego's is the first
    return [(0, rows.tolist()), (1, moves.tolist())], np.concatenate([vehicle[rows], np.full(len(moves), -1)])


def stack(windows: Sequence[Window], known: Knowledge) -> Problem:
    """The problem of S windows of one structure as a batch of S R realisations; points in the order of `vehicles`."""
    columns: list[list[Sight]] = [[] for _ in windows[0]]
    for window in windows:
        before, most = np.empty(0, dtype=np.int64), -1
        for sights, seen, numbers in zip(columns, window, vehicles(window), strict=True):
            sights.append(_sight(seen, numbers, before, most))
            before, most = np.sort(numbers), max(most, numbers.max())
    merged = [_merge(sights) for sights in columns]
    return chain(merged, known.sensors)


def _sight(seen: Seen, numbers: Ints, before: Ints, most: int) -> Sight:
    """The step in the order of its vehicles' numbers, those of the step before being `before` and the largest `most`.

    A fix is used where its message is fresh, or held when the window meets the vehicle: never twice in a window.
    """
    star, order = seen.star, np.argsort(numbers)
    heard = np.where(numbers > most, seen.held, star.heard)
    std = np.where(heard[..., None], np.sqrt(star.fix_variance), np.inf)
    moved_std = np.broadcast_to(np.sqrt(star.process), star.moved.shape)
    place = np.searchsorted(before, numbers[order])
    kept = np.where(np.isin(numbers[order], before), place, -1)
    return Sight(kept, star.fix[:, order], std[:, order], star.moved[:, order], moved_std[:, order],
                 star.relative[:, order[1:] - 1])  # fmt: skip


def _merge(sights: Sequence[Sight]) -> Sight:
    """One sight whose realisations are those of all."""
    fields = ("fix", "fix_std", "moved", "moved_std", "relative")
    return Sight(sights[0].kept, *(np.concatenate([getattr(s, f) for s in sights]) for f in fields))
