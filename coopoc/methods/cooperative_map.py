"""CooperativeMAP: the most probable positions of the star, by optimisation, of one step or over a sliding window."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from ..optimize.batch import solve_batch
from ..optimize.initial import converted
from ..optimize.problem import Problem
from ..optimize.sights import Sight, chain
from ..optimize.solution import Status
from ..optimize.solve import solve, usable
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .knowledge import Knowledge, resolve
from .star import StarStep, star_steps
from .track import Track

TOLERANCE = 1e-4
"""m, the last Gauss-Newton step of a batch, whose error is then an order smaller; other backends keep their own."""
LEAST_GROUND = 0.25
"""m, two vehicles whose centres are closer on the ground than this stand in one place."""
STACKED = 64
"""Windows of one structure that are solved together, times R."""


@dataclass(frozen=True, eq=False)
class CooperativeMAP:
    """argmin of 1/2 sum |W (h(x) - z)|^2 over the ego and its neighbours at the last `window` steps (methods.md 6.0).

    Window 1 is the snapshot maximum likelihood; a longer one adds odometry, dt u with the assumed process noise, from
    step to step: a smoother whose newest point is the estimate, without a prior from before the window. Relative
    measurements are exact factors in range and angles, or with identity knowledge unit-weight vectors. Neighbours are
    used as far as their messages have arrived: a late one is brought forward with its last velocity, one never heard
    is left out. Where the minimum puts two vehicles in one place, which a short noisy range can do and where angles
    have no derivative, the converted (linear) problem answers instead, and the notes count it.

    Args:
        backend: of `coopoc.optimize.backends()`. Only gauss-newton batches over the runs; the others loop, and their
            tracks say so.
        window: steps. knowledge: "identity", "nominal" or a Knowledge.
    """

    backend: str = "gauss-newton"
    window: int = 1
    knowledge: Knowledge | str = "nominal"
    name: str = "cooperative-map"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        if self.window != int(self.window) or self.window < 1:
            raise InputError("window", self.window, "must be a whole number >= 1", "Use 1 for a snapshot.")
        usable(self.backend)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        replaced: list[int] = []

        def follow(ego: int, box: Inbox) -> Iterator[Estimate]:
            for windows in alike(_windows(recording, ego, box, known, self.window)):
                points, spread, met = self._solve(windows, known)
                replaced.append(met)
                for k, window in enumerate(windows):
                    star, held = window[-1].star, window[-1].held
                    theirs = np.where(held[:, 1:, None], points[k, :, 1:], np.nan)
                    yield Estimate(star.step, points[k, :, 0], spread[k], star.links, theirs)

        track = follow_egos(self, recording, egos, follow)
        return replace(track, notes=self._notes(sum(replaced)))

    def _solve(self, windows: Sequence[Window], known: Knowledge) -> tuple[Floats, Floats, int]:
        """Newest points (S, R, n, 3) of S windows, the ego's covariance (S, R, 3, 3), and how many were replaced."""
        problem = stack(windows, known)
        ego, last = problem.hub[-1], len(windows[0][-1].members)
        if self.backend == "gauss-newton":
            answer = solve_batch(problem, tolerance=TOLERANCE)
            x, spread, sound = answer.x, answer.covariance[:, ego], answer.converged
        else:
            each = [solve(problem.pick(b), self.backend, throw=False) for b in range(problem.batch or 1)]
            x, spread = np.stack([s.x for s in each]), np.stack([s.covariance[ego] for s in each])
            sound = np.array([s.status is Status.SOLVED for s in each])
        met = np.flatnonzero(~sound | _meeting(problem, x))
        if len(met):
            linear = solve_batch(converted(problem.pick(met)))
            x[met], spread[met] = linear.x, linear.covariance[:, ego]
        shape = (len(windows), len(x) // len(windows))
        return x[:, -last:].reshape(*shape, last, 3), spread.reshape(*shape, 3, 3), len(met)

    def _notes(self, replaced: int) -> tuple[str, ...]:
        loop = () if self.backend == "gauss-newton" else (f"{self.backend} loops over the runs",)
        return (*loop, f"{replaced} problems where vehicles met were solved converted") if replaced else loop


def _meeting(problem: Problem, x: Floats) -> Bools:
    """(B,) True where a solution (B, n, 3) puts an observer and the vehicle that it sees in one place on the ground."""
    met = np.zeros(len(x), dtype=bool)
    for factor in problem.factors:
        if factor.kind == "spherical":
            gap = x[:, factor.nodes[:, 1], :2] - x[:, factor.nodes[:, 0], :2]
            met |= (np.linalg.norm(gap, axis=-1) < LEAST_GROUND).any(axis=1)
    return met


@dataclass(frozen=True, eq=False)
class Seen:
    """One step as the window keeps it: the star, the columns of its members, and (R, n) whose messages are held."""

    star: StarStep
    members: Ints
    held: Bools


Window = tuple[Seen, ...]


def _windows(recording: Recording, ego: int, box: Inbox, known: Knowledge, length: int) -> Iterator[Window]:
    """The last `length` steps at every step, fewer at the start."""
    recent: deque[Seen] = deque(maxlen=length)
    for star in star_steps(recording, ego, box, known):
        members = np.concatenate([[ego], recording.links.neighbour[star.links]])
        span = slice(box.start[star.step], box.start[star.step + 1])
        held = np.concatenate([np.ones((recording.runs, 1), dtype=bool), box.newest[:, span] >= 0], axis=1)
        recent.append(Seen(star, members, held))
        yield tuple(recent)


def alike(windows: Iterator[Window]) -> Iterator[list[Window]]:
    """Windows of the same structure together, for one batch to solve: a drive of snapshots has K + 1 structures."""
    waiting: dict[tuple[bytes, ...], list[Window]] = defaultdict(list)
    for window in windows:
        first, *later = window
        key = (len(first.members).to_bytes(4, "little"), *(seen.star.kept.tobytes() for seen in later))
        waiting[key].append(window)
        if len(waiting[key]) == STACKED:
            yield waiting.pop(key)
    yield from waiting.values()


def stack(windows: Sequence[Window], known: Knowledge) -> Problem:
    """The problem of S windows of one structure as a batch of S R realisations."""
    columns: list[list[Sight]] = [[] for _ in windows[0]]
    for window in windows:
        met: set[int] = set()
        for sights, seen in zip(columns, window, strict=True):
            first = np.array([m not in met for m in seen.members])
            met.update(seen.members.tolist())
            sights.append(_sight(seen, first, opening=seen is window[0]))
    merged = [_merge(sights) for sights in columns]
    return chain(merged, known.sensors)


def _sight(seen: Seen, first: Bools, opening: bool) -> Sight:
    """A fix is used where its message is fresh, or held when the window meets the vehicle: never twice in a window."""
    star = seen.star
    heard = np.where(first, seen.held, star.heard)
    std = np.where(heard[..., None], np.sqrt(star.fix_variance), np.inf)
    kept = np.full_like(star.kept, -1) if opening else star.kept
    moved_std = np.broadcast_to(np.sqrt(star.process), star.moved.shape)
    return Sight(kept, star.fix, std, star.moved, moved_std, star.relative)


def _merge(sights: Sequence[Sight]) -> Sight:
    """One sight whose realisations are those of all."""
    fields = ("fix", "fix_std", "moved", "moved_std", "relative")
    return Sight(sights[0].kept, *(np.concatenate([getattr(s, f) for s in sights]) for f in fields))
