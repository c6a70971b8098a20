"""CooperativeMAP: the most probable positions of the star, by optimisation, of one step or over a sliding window."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from ..optimize.backend import require_backend
from ..optimize.batch import solve_batch
from ..optimize.model.problem import Problem
from ..optimize.robust.candidates import Candidates, mark, reweigh
from ..optimize.robust.gnc import EASY, RATE, ROUNDS, SETTLED, solve_gnc, surrogate_of
from ..optimize.solution import Status
from ..optimize.solve import solve
from ..optimize.starts.initial import converted
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .options import check_options
from .star import assumptions, measurements
from .track import Track
from .window import Positions, dead_reckoned, last_met, steps_of, vehicles_of

TOLERANCE = 1e-4
"""m, the last Gauss-Newton step of a batch, whose error is then an order smaller; other backends keep their own."""
LEAST_GROUND = 0.25
"""m, two vehicles whose centres are closer on the ground than this stand in one place."""
CONVERTED = "problems where vehicles met were solved converted"
REJECTED = "problems whose GNC weights rejected every fix were solved with all of them"
SINGULAR = "windows beyond double precision are the ego's own fix"
DAMPED = "problems that did not settle were solved one by one, damped"


@dataclass(frozen=True, eq=False)
class CooperativeMAP:
    """argmin of 1/2 sum |W (h(x) - z)|^2 over the ego and its neighbours at the last `window` steps.

    Window 1 is the snapshot maximum likelihood; a longer one adds odometry, dt u with the assumed process noise, from
    step to step: a smoother whose newest point is the estimate, without a prior from before the window. Relative
    measurements are exact factors in range and angles, or with the identity noise model unit-weight vectors; a missing
    component is no factor. Neighbours are used as far as their messages have arrived: a late one is brought forward
    with its last velocity, and a neighbour whose messages never arrive adds no information. A missing fix is no factor
    either; where a window meets a vehicle without one, its last fix counts, moved by its own odometry since. Where the
    minimum puts two vehicles in one place, which a short noisy range can do and where angles have no derivative, the
    converted (linear) problem answers instead, and the notes count it.

    Robust against neighbours that report false fixes: graduated non-convexity gives the fixes of each neighbour in the
    window one weight. The ego's own fixes, odometry and relative measurements are inliers, and so are the velocities
    that it receives.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        backend: of `coopoc.optimize.backends()`. Only gauss-newton batches over the runs; the others loop, which their
            tracks note.
        window: steps.
        robust: "truncated" or "geman-mcclure"; None for no robust loss.
        threshold: probability that the fixes of an honest neighbour in a window pass (of a robust loss).
        ego_candidates: the ego's own fixes and its odometry may be outliers, too, each as one group. Where every fix is
            rejected the window's position is unobservable: it is solved with all of them, and the notes count it.

    References:
        Yang, Antonante, Tzoumas, Carlone, Graduated non-convexity for robust spatial perception, RA-L 2020.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> CooperativeMAP()(observe(fleet, Sensors(), V2X(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    backend: str = "gauss-newton"
    window: int = 1
    robust: str | None = None
    threshold: float = 0.99
    ego_candidates: bool = False
    name: str = "cooperative-map"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        if self.window < 1:
            raise InputError("window", self.window, "must be a whole number >= 1", "Use 1 for a snapshot.")
        require_backend(self.backend)
        if self.robust is not None:
            surrogate_of(self.robust, self.threshold)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.noise_model, recording)
        positions, counts = dead_reckoned(recording, known), Counter[str]()
        variance = np.broadcast_to(positions.variance, positions.x.shape)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            windows = Windows(recording, ego, box, known, positions, self.window)
            found = windows.solve(self.gnc) if self._runs_compiled else windows.nothing()
            counts.update(windows.count(found.ended))
            for run, step, problem, vehicle in windows.problems(found.ended):
                x, cov = self._solve(problem, vehicle, counts)
                if not np.isfinite(cov).all():
                    x[0], cov = positions.x[run, step, ego], np.diag(variance[run, step, ego])
                    counts[SINGULAR] += 1
                windows.put(found, run, step, x, cov)
            yield Estimate(slice(None), found.x, found.covariance, box.link, found.neighbours)

        track = follow_egos(self, recording, egos, drive, missing=True)
        loop = known.notes if self._runs_compiled else (*known.notes, f"{self.backend} loops over the runs")
        return replace(track, notes=(*loop, *(f"{count} {note}" for note, count in counts.items() if count)))

    @property
    def _runs_compiled(self) -> bool:
        return require_backend(self.backend).capabilities.compiled

    @property
    def gnc(self) -> Any:
        """The robust loss as the kernels take it."""
        from scipy.special import gammaincinv

        from ..kernels.windows.gnc import GNC

        freedom = 3.0 * np.maximum(np.arange(self.window + 1), 1)
        bound = 2.0 * gammaincinv(0.5 * freedom, self.threshold)
        rounds = ROUNDS if self.robust else 0
        return GNC(bound, self.robust == "truncated", self.ego_candidates, RATE, EASY, SETTLED, rounds)

    def _solve(self, problem: Problem, vehicle: Ints, counts: Counter[str]) -> tuple[Floats, Floats]:
        """Newest points (n, 3) and the ego's covariance of a window, by the backend."""
        problem = self._weighted(problem, vehicle, counts)
        ego = problem.separator[-1]
        if self._runs_compiled:
            counts[DAMPED] += 1
            batch = solve_batch(problem, tolerance=TOLERANCE)
            x, cov, sound = batch.x, batch.covariance, bool(batch.converged[0])
        else:
            solution = solve(problem, self.backend, throw=False)
            x, cov, sound = solution.x[None], solution.covariance[None], solution.status is Status.SOLVED
        if not sound or _meeting(problem, x)[0]:
            linear = solve_batch(converted(problem))
            x, cov = linear.x, linear.covariance
            counts[CONVERTED] += 1
        return x[0, ego:], 0.5 * (cov[0, ego] + cov[0, ego].T)

    def _weighted(self, problem: Problem, vehicle: Ints, counts: Counter[str]) -> Problem:
        """The problem with the GNC weights of its candidates: the fixes of each vehicle, and the ego's odometry."""
        fixes = np.flatnonzero(vehicle != vehicle[0]) if not self.ego_candidates else np.arange(len(vehicle))
        candidates: Candidates = [(0, fixes.tolist())]
        groups = vehicle[fixes]
        if self.ego_candidates and len(problem.separator) > 1:
            own = np.flatnonzero(np.isin(problem.factors[1].nodes[:, 0], problem.separator))
            candidates = [*candidates, (1, own.tolist())]
            groups = np.concatenate([groups, np.full(len(own), -1)])
        if self.robust is None or not len(groups):
            return problem
        found = solve_gnc(problem, candidates, self.robust, self.threshold, groups, self.backend, throw=False)
        weights = found.extras["weights"]
        if np.isnan(found.covariance).any():
            counts[REJECTED] += 1
            weights = np.ones_like(weights)
        return reweigh(problem, mark(problem, candidates), weights, found.x)


class Windows:
    """All windows of one ego: solved by the kernels, or problem by problem.

    Args:
        length: steps of a window. The others as in `CooperativeMAP.__call__`.
    """

    def __init__(
        self, recording: Recording, ego: int, box: Inbox, known: NoiseModel, positions: Positions, length: int
    ) -> None:
        from ..kernels.windows.window import Fresh

        self.recording, self.ego, self.box, self.known, self.length = recording, ego, box, known, length
        seen = measurements(recording, ego, replace(box, fresh=box.newest >= 0), positions.x)
        self.seen = seen._replace(gnss=positions.x)
        self.assumed = assumptions(recording, known)._replace(fixes=positions.variance, broadcast=positions.variance)
        runs = np.arange(recording.runs)[:, None]
        sent = positions.new[runs, box.newest, self.seen.neighbour]
        met = last_met(self.seen.neighbour, self.seen.start)
        self.fresh = Fresh(np.ascontiguousarray(positions.new[:, :, ego]), box.fresh & sent, met)

    def solve(self, gnc: Any) -> Any:
        """By compiled Gauss-Newton, batched over the runs."""
        from ..kernels.windows.window import Settings, windows

        return windows(self.seen, self.assumed, self.fresh, Settings(self.length, TOLERANCE, LEAST_GROUND), gnc)

    def nothing(self) -> Any:
        """Every problem still to be solved."""
        from ..kernels.windows.window import LOST, Found

        shape = (self.recording.runs, len(self.recording.t))
        neighbours = np.full((shape[0], len(self.box.link), 3), np.nan)
        return Found(np.empty((*shape, 3)), np.empty((*shape, 3, 3)), neighbours, np.full(shape, LOST))

    def count(self, ended: Ints) -> dict[str, int]:
        """Of the kernels' fallbacks."""
        from ..kernels.windows.window import BLIND, MET

        return {CONVERTED: int((ended == MET).sum()), REJECTED: int((ended == BLIND).sum())}

    def problems(self, ended: Ints) -> Iterator[tuple[int, int, Problem, Ints]]:
        """Run, step, problem and the vehicle of each point, of all windows that are not solved."""
        from ..kernels.compiling.vectors import LANES
        from ..kernels.windows.window import LOST, gather_window, new_windows

        for first in range(0, len(ended), LANES):
            lost = np.argwhere(ended[first : first + LANES].T == LOST)
            if not len(lost):
                continue
            window, star = new_windows(self.seen.start, self.length)
            for t in range(int(lost[-1, 0]) + 1):
                span = (max(0, t - self.length + 1), t)
                last = min(first + LANES, len(ended)) - 1
                gather_window(window, star, self.seen, self.assumed, self.fresh, (first, last), span)
                for lane in lost[lost[:, 0] == t, 1].tolist():
                    steps = steps_of(window, self.recording, self.box, first + lane, span)
                    yield first + lane, t, Problem.from_steps(steps, self.known.sensors), vehicles_of(window, span)

    def put(self, found: Any, run: int, step: int, x: Floats, cov: Floats) -> None:
        """Fill in the solution of a problem's newest step."""
        links = slice(self.box.start[step], self.box.start[step + 1])
        found.x[run, step], found.covariance[run, step] = x[0], cov
        found.neighbours[run, links] = np.where(self.box.newest[run, links, None] >= 0, x[1:], np.nan)


def _meeting(problem: Problem, x: Floats) -> Bools:
    """(B,) True where a solution (B, n, 3) puts the ego and a vehicle that it measures in one place on the ground."""
    met = np.zeros(len(x), dtype=bool)
    for factor in problem.factors:
        if factor.kind == "spherical":
            gap = x[:, factor.nodes[:, 1], :2] - x[:, factor.nodes[:, 0], :2]
            met |= (np.linalg.norm(gap, axis=-1) < LEAST_GROUND).any(axis=1)
    return met
