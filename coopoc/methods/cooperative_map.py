"""CooperativeMAP: the most probable positions of the star, by optimisation, of one step or over a sliding window."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Bools, Floats
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..optimize.batch import solve_batch
from ..optimize.gnc import EASY, RATE, ROUNDS, SETTLED, graduate, graduate_batch, surrogate_of
from ..optimize.initial import converted
from ..optimize.problem import Problem
from ..optimize.solution import Status
from ..optimize.solve import solve, usable
from ..optimize.suspects import mark, reweigh
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .knowledge import Knowledge, resolve
from .star import assumed_arrays, measured_arrays
from .star_windows import Window, alike, stack, suspected, vehicles, windows_of
from .track import Track

TOLERANCE = 1e-4
"""m, the last Gauss-Newton step of a batch, whose error is then an order smaller; other backends keep their own."""
LEAST_GROUND = 0.25
"""m, two vehicles whose centres are closer on the ground than this stand in one place."""


@dataclass(frozen=True, eq=False)
class CooperativeMAP:
    """argmin of 1/2 sum |W (h(x) - z)|^2 over the ego and its neighbours at the last `window` steps (methods.md 6.0).

    Window 1 is the snapshot maximum likelihood; a longer one adds odometry, dt u with the assumed process noise, from
    step to step: a smoother whose newest point is the estimate, without a prior from before the window. Relative
    measurements are exact factors in range and angles, or with identity knowledge unit-weight vectors. Neighbours are
    used as far as their messages have arrived: a late one is brought forward with its last velocity, one never heard
    is left out. Where the minimum puts two vehicles in one place, which a short noisy range can do and where angles
    have no derivative, the converted (linear) problem answers instead, and the notes count it.

    Robust against neighbours that report false fixes: graduated non-convexity (`coopoc.optimize.graduate`) gives the
    fixes of each neighbour in the window one weight. What the ego measures itself, its own fixes, its odometry and its
    relative measurements, is believed, and so are the velocities it is sent.

    Args:
        backend: of `coopoc.optimize.backends()`. Only gauss-newton batches over the runs; the others loop, and their
            tracks say so.
        window: steps. knowledge: "identity", "nominal" or a Knowledge.
        robust: "truncated" or "geman-mcclure"; None believes everyone.
        threshold: probability that the fixes of an honest neighbour in a window pass (of a robust loss).
        suspect_ego: doubt the ego's own fixes and its odometry, too, each as one group. Where all fixes are doubted
            nothing says where the window is: it is then solved as if all were honest, and the notes count it. There
            is no compiled kernel for these doubts.
    """

    backend: str = "gauss-newton"
    window: int = 1
    knowledge: Knowledge | str = "nominal"
    robust: str | None = None
    threshold: float = 0.99
    suspect_ego: bool = False
    name: str = "cooperative-map"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        if self.window != int(self.window) or self.window < 1:
            raise InputError("window", self.window, "must be a whole number >= 1", "Use 1 for a snapshot.")
        usable(self.backend)
        if self.robust is not None:
            surrogate_of(self.robust, self.threshold)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        replaced: list[tuple[int, int]] = []

        def follow(ego: int, box: Inbox) -> Iterator[Estimate]:
            for windows in alike(windows_of(recording, ego, box, known, self.window)):
                points, spread, counts = self._solve(windows, known)
                replaced.append(counts)
                for k, window in enumerate(windows):
                    star, held = window[-1].star, window[-1].held
                    rank = np.argsort(np.argsort(vehicles(window)[-1]))
                    theirs = np.where(held[:, 1:, None], points[k][:, rank[1:]], np.nan)
                    yield Estimate(star.step, points[k, :, 0], spread[k], star.links, theirs)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            whole, lost, met = self._compiled(recording, ego, box, assumed)
            replaced.append((met, 0))
            if lost.any():
                replaced.extend(self._mend(recording, ego, box, known, lost, whole))
            yield whole

        able = self.robust is None or not self.suspect_ego
        kernels = able and self.backend == "gauss-newton" and use_kernels()
        assumed = assumed_arrays(recording, known) if kernels else ()
        track = follow_egos(self, recording, egos, drive if kernels else follow)
        return replace(track, notes=self._notes(*np.sum(replaced, axis=0)))

    def _compiled(
        self, recording: Recording, ego: int, box: Inbox, assumed: tuple[Any, ...]
    ) -> tuple[Estimate, Bools, int]:
        """All windows of a drive by compiled code, (R, T) True where one did not settle, and how many of the others
        were solved converted."""
        from ..kernels.snapshot import LOST, MET, snapshots
        from ..kernels.window import windows

        measured, fresh = measured_arrays(recording, ego, replace(box, fresh=box.newest >= 0)), box.fresh
        if self.window == 1 and self.robust is None:
            x, cov, neighbours, ended = snapshots(measured, assumed, TOLERANCE, LEAST_GROUND)
        else:
            doubt = self.robust and doubt_of(self.robust, self.threshold, self.window)
            x, cov, neighbours, ended = windows(measured, assumed, np.ascontiguousarray(fresh), self.window, TOLERANCE,
                                                LEAST_GROUND, doubt)  # fmt: skip
        return Estimate(slice(None), x, cov, box.link, neighbours), ended == LOST, int((ended == MET).sum())

    def _mend(
        self, recording: Recording, ego: int, box: Inbox, known: Knowledge, lost: Bools, whole: Estimate
    ) -> Iterator[tuple[int, int]]:
        """Put the answers of `_solve` where runs and steps (R, T) were lost, and count as that does."""
        for step in np.flatnonzero(lost.any(axis=0)):
            runs = np.flatnonzero(lost[:, step])
            mine = replace(box, newest=box.newest[runs], fresh=box.fresh[runs])
            few = recording.of_runs(runs)
            window = deque(windows_of(few, ego, mine, known, self.window, int(step)), maxlen=1).pop()
            points, spread, counts = self._solve([window], known)
            rank = np.argsort(np.argsort(vehicles(window)[-1]))
            whole.x[runs, step], whole.covariance[runs, step] = points[0, :, 0], spread[0]
            theirs = np.where(window[-1].held[:, 1:, None], points[0][:, rank[1:]], np.nan)
            whole.neighbours[runs, box.start[step] : box.start[step + 1]] = theirs
            yield counts

    def _solve(self, windows: Sequence[Window], known: Knowledge) -> tuple[Floats, Floats, tuple[int, int]]:
        """Newest points (S, R, n, 3) of S windows, the ego's covariance (S, R, 3, 3), and how many were solved
        converted and how many in spite of doubts."""
        problem, blind = self._doubted(stack(windows, known), windows[0])
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
        return x[:, -last:].reshape(*shape, last, 3), spread.reshape(*shape, 3, 3), (len(met), blind)

    def _doubted(self, problem: Problem, window: Window) -> tuple[Problem, int]:
        """The problem with the weights of `robust`, and in how many realisations all fixes were doubted."""
        suspects, groups = suspected(window, self.suspect_ego)
        if self.robust is None or not len(groups):
            return problem, 0
        if self.backend == "gauss-newton":
            batch = graduate_batch(problem, suspects, self.robust, self.threshold, groups, tolerance=TOLERANCE)
            x, weights, spread = batch.x, batch.weights, batch.covariance
        else:
            each = [graduate(problem.pick(b), suspects, self.robust, self.threshold, groups, self.backend, throw=False)
                    for b in range(problem.batch or 1)]  # fmt: skip
            x, spread = np.stack([s.x for s in each]), np.stack([s.covariance for s in each])
            weights = np.stack([s.extras["weights"] for s in each])
        blind = np.isnan(spread).any(axis=(1, 2, 3))
        weights[blind] = 1.0
        return reweigh(problem, mark(problem, suspects), weights, x), int(blind.sum())

    def _notes(self, replaced: int, blind: int) -> tuple[str, ...]:
        loop = () if self.backend == "gauss-newton" else (f"{self.backend} loops over the runs",)
        counted = {f"{replaced} problems where vehicles met were solved converted": replaced,
                   f"{blind} problems where all fixes were doubted were solved as if honest": blind}  # fmt: skip
        return (*loop, *(note for note, count in counted.items() if count))


def _meeting(problem: Problem, x: Floats) -> Bools:
    """(B,) True where a solution (B, n, 3) puts an observer and the vehicle that it sees in one place on the ground."""
    met = np.zeros(len(x), dtype=bool)
    for factor in problem.factors:
        if factor.kind == "spherical":
            gap = x[:, factor.nodes[:, 1], :2] - x[:, factor.nodes[:, 0], :2]
            met |= (np.linalg.norm(gap, axis=-1) < LEAST_GROUND).any(axis=1)
    return met


def doubt_of(loss: str, threshold: float, length: int) -> tuple[Any, ...]:
    """A robust loss as `coopoc.kernels.doubts` takes it, about fixes of at most `length` steps."""
    from scipy.special import gammaincinv

    freedom = 3.0 * np.maximum(np.arange(length + 1), 1)
    return 2.0 * gammaincinv(0.5 * freedom, threshold), loss == "truncated", RATE, EASY, SETTLED, ROUNDS
