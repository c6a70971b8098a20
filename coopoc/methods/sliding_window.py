"""Sliding windows of the star: maximum a posteriori, fixed-lag smoother, moving horizon.

One window with settings: `CooperativeMAP` knows nothing of the time before it and may be robust, `FixedLagSmoother` and
`MovingHorizon` keep it as an arrival cost; the latter puts late messages at their true time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Bools, Floats, Ints, one_of
from ..errors import InputError
from ..optimize.backend import require_backend
from ..optimize.model.problem import Problem
from ..optimize.model.window import WindowStep
from ..optimize.robust.candidates import Candidates, mark, reweigh
from ..optimize.robust.gnc import EASY, RATE, ROUNDS, solve_gnc, surrogate_of
from ..optimize.solution import Status
from ..optimize.solve import solve, solve_batch
from ..optimize.starts.initial import converted
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, assumptions, follow_egos, measurements
from .noise_model import NoiseModel, resolve
from .star import bridged
from .track import Track, check_options

if TYPE_CHECKING:
    from ..kernels.windows.batch_window import Solutions
    from ..kernels.windows.robust import GNC
    from ..kernels.windows.window_layout import Window

TOLERANCE = 1e-4
"""m, the last Gauss-Newton step of a batch, whose error is then an order smaller; other backends keep their own."""
LEAST_GROUND = 0.25
"""m, two vehicles whose centres are closer on the ground than this stand in one place."""
STRAYED = 0.03
"""m, move of a vector v beyond which its measurement is made linear anew: off by at most 0.03^2 / 2 |v| then."""
REPEATS = 10
"""Gauss-Newton steps of a moving horizon after the first; one is common."""
CONVERTED = "problems where vehicles met were solved converted"
SINGULAR = "windows beyond double precision are the ego's own fix"
DAMPED = "problems that did not settle were solved one by one, damped"
DROPPED = "fixes came later than the horizon and were dropped"
MOVING = f"windows were still moving after {REPEATS + 1} Gauss-Newton steps"


@dataclass(frozen=True, eq=False)
class CooperativeMAP:
    r"""Most probable positions of the ego and its neighbours at the last `window` steps.

    $$ \hat x = \arg\min_x \tfrac{1}{2} \sum_k \lVert W_k (h_k(x) - z_k) \rVert^2 $$

    Window 1 is the snapshot maximum likelihood; a longer one adds odometry, dt u with the assumed process noise, from
    step to step: a smoother whose newest point is the estimate, without a prior from before the window. Relative
    measurements are exact factors in range and angles, or with the identity noise model unit-weight vectors; a missing
    component is no factor. Neighbours are used as far as their messages have arrived: a late one is brought forward
    with its last velocity, and a neighbour whose messages never arrive adds no information. A missing fix is no factor
    either; where a window meets a vehicle without one, its last fix counts, moved by its own odometry since. Where the
    minimum puts two vehicles in one place, which a short noisy range can do and where angles have no derivative, the
    converted (linear) problem answers instead, and the notes count it.

    Robust against neighbours that report false fixes: graduated non-convexity gives the fixes of each neighbour in the
    window one weight of truncated least squares. The ego's own fixes, odometry and relative measurements are inliers,
    and so are the velocities that it receives.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        backend: of `coopoc.optimize.backends()`. Only gauss-newton batches over the runs; the others loop, which their
            tracks note.
        window: steps.
        robust: "truncated"; None for no robust loss.
        threshold: probability that the fixes of an honest neighbour in a window pass (of a robust loss).

    Raises:
        InputError: a window < 1, an unknown backend or loss, a threshold outside (0, 1).

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
    name: str = "cooperative-map"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        if self.window < 1:
            raise InputError("window", self.window, "must be a whole number >= 1", "Use 1 for a snapshot.")
        require_backend(self.backend)
        if self.robust is not None:
            one_of("robust", self.robust, ("truncated",))
            surrogate_of(self.robust, self.threshold)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        noise_model, counts = resolve(self.noise_model, recording), Counter[str]()
        positions = dead_reckoned(recording, noise_model)
        variance = np.broadcast_to(positions.variance, positions.x.shape)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            windows = Windows(recording, ego, box, noise_model, positions, self.window)
            solved = windows.solve(self.gnc) if self._compiled else windows.unsolved()
            counts[CONVERTED] += windows.count_met(solved)
            for run, step, problem, vehicle in windows.problems(solved):
                x, cov = self._solve(problem, vehicle, counts)
                if not np.isfinite(cov).all():
                    x[0], cov = positions.x[run, step, ego], np.diag(variance[run, step, ego])
                    counts[SINGULAR] += 1
                windows.put(solved, run, step, x, cov)
            yield Estimate(slice(None), solved.x, solved.covariance, box.link, solved.neighbours)

        track = follow_egos(self, recording, egos, drive, missing=True)
        loop = () if self._compiled else (f"{self.backend} loops over the runs",)
        return replace(track, notes=(*noise_model.notes, *loop, *_counted(counts)))

    @property
    def _compiled(self) -> bool:
        return require_backend(self.backend).capabilities.compiled

    @property
    def gnc(self) -> GNC:
        """The robust loss as the kernels take it."""
        from scipy.special import gammaincinv

        from ..kernels.windows.robust import GNC

        freedom = 3.0 * np.maximum(np.arange(self.window + 1), 1)
        bound = 2.0 * gammaincinv(0.5 * freedom, self.threshold)
        return GNC(bound, RATE, EASY, ROUNDS if self.robust else 0)

    def _solve(self, problem: Problem, vehicle: Ints, counts: Counter[str]) -> tuple[Floats, Floats]:
        """Newest points (n, 3) and the ego's covariance of a window, by the backend."""
        problem = self._weighted(problem, vehicle)
        ego = problem.separator[-1]
        if self._compiled:
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

    def _weighted(self, problem: Problem, vehicle: Ints) -> Problem:
        """The problem with the GNC weights of the fixes of each neighbour."""
        fixes = np.flatnonzero(vehicle != vehicle[0])
        if self.robust is None or not len(fixes):
            return problem
        candidates: Candidates = [(0, fixes.tolist())]
        robust = solve_gnc(problem, candidates, self.robust, self.threshold, vehicle[fixes], self.backend, throw=False)
        return reweigh(problem, mark(problem, candidates), robust.extras["weights"], robust.x)


@dataclass(frozen=True, eq=False)
class FixedLagSmoother:
    """The joint filter's star over the steps t-lag..t, given what the steps before left when they were eliminated.

    At every step one Gauss-Newton step of the window: its measurements are linearised anew at the smoothed points, the
    oldest step is eliminated into the prior of the next, and the newest point is the estimate: causal, and in a linear
    model the filter's own for every lag. A lag of 0 is JointFilter, but for measured ranges below `min_range`, whose
    angles are widened here (`relative_std`). Messages are brought forward as there; MovingHorizon puts them at their
    true time.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        lag: steps.
        exact: False keeps relative measurements as converted vectors.

    Raises:
        InputError: a lag < 0.

    References:
        Sibley, Matthies, Sukhatme, Sliding window filter with application to planetary landing, Journal of Field
        Robotics 27(5), 2010.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> FixedLagSmoother(lag=1)(observe(fleet, Sensors(), V2X(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    lag: int = 5
    exact: bool = True
    name: str = "fixed-lag"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        if self.lag < 0:
            raise InputError("lag", self.lag, "must be a whole number >= 0", "Use 0 for the filter.")

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        return _behind_arrival_cost(self, recording, egos, self.lag + 1, late=False)


@dataclass(frozen=True, eq=False)
class MovingHorizon:
    r"""Most probable positions of the star over the last N steps, behind an arrival cost.

    $$
    \min_{x_{t-N..t}} \lVert x_{t-N} - x_a \rVert^2_{P^{-1}} + \sum_k \lVert x_{k+1} - x_k - \Delta t \, u_k
    \rVert^2_{Q^{-1}} + \sum_k \lVert h(x_k) - z_k \rVert^2_{R^{-1}}
    $$

    x holds the ego and the neighbours of its star at each step. The arrival cost (x_a, P) is
    what the steps before the horizon leave when they are eliminated one by one, as a filter does. A message that comes
    late is put where it belongs: its fix at the step at which it was sent, its velocity in the place of the older one
    that stood in for it. A velocity that stands in n times makes the same error n times (see star_steps). A fix that is
    late by more than the horizon is dropped, and the notes count it. With linear relative measurements the newest point
    is that of the Kalman filter.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        horizon: N, steps.
        exact: False keeps relative measurements as converted vectors.

    Raises:
        InputError: a horizon < 1.

    References:
        Rao, Rawlings, Mayne, Constrained state estimation for nonlinear discrete-time systems, IEEE TAC 48(2), 2003.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> MovingHorizon(horizon=1)(observe(fleet, Sensors(), V2X(latency=0.1), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    horizon: int = 10
    exact: bool = True
    name: str = "mhe"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        if self.horizon < 1:
            raise InputError("horizon", self.horizon, "must be a whole number >= 1", "Use 10 to 20 at 10 Hz.")

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        return _behind_arrival_cost(self, recording, egos, self.horizon + 1, late=True)


def _behind_arrival_cost(
    method: FixedLagSmoother | MovingHorizon,
    recording: Recording,
    egos: Sequence[int | str],
    length: int,
    late: bool,
) -> Track:
    """Track of windows of `length` steps; `late` puts messages at the step at which they were sent."""
    from ..kernels.windows.horizon import Settings, horizons

    noise_model, counts = resolve(method.noise_model, recording), Counter[str]()
    exact = method.exact and noise_model.exact_relative
    age = recording.v2x.max_age / recording.dt + 1e-9 if late else -1.0
    settings = Settings(length, exact, REPEATS if exact and late else 0, STRAYED, age)

    def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
        seen, assumed = measurements(recording, ego, box), assumptions(recording, noise_model)
        if late:
            seen = seen._replace(newest=seen.newest.copy(), fresh=np.zeros_like(box.fresh))
            counts[DROPPED] += int((box.arrival - recording.links.step[box.link] >= length).sum())
        solved = horizons(seen, assumed, np.ascontiguousarray(box.arrival), settings)
        counts[MOVING] += int(solved.moving.sum())
        yield Estimate(slice(None), solved.x, solved.covariance, box.link, solved.neighbours)

    track = follow_egos(method, recording, egos, drive, missing=True)
    return replace(track, notes=(*noise_model.notes, *_counted(counts)))


def _counted(counts: Counter[str]) -> tuple[str, ...]:
    """Notes of what was counted."""
    return tuple(f"{count} {note}" for note, count in counts.items() if count)


@dataclass(frozen=True, eq=False)
class Positions:
    """The positions that vehicles may use and send (R, T, N, 3) m, their variance m^2, and (R, T, N) where one is new.

    A fix that is missing is replaced by the last one, moved by the vehicle's own odometry since.
    """

    x: Floats
    variance: Floats
    new: Bools


def dead_reckoned(recording: Recording, noise_model: NoiseModel) -> Positions:
    """All fixes, and where one is missing the last one moved by odometry, its variance grown by the process noise."""
    new: Bools = np.asarray(np.isfinite(recording.gnss).all(axis=-1))
    return Positions(*bridged(recording, noise_model), new)


class Windows:
    """All windows of one ego without an arrival cost: solved by the kernels, or problem by problem.

    Args:
        recording: the measurements.
        ego: column.
        box: its messages.
        noise_model: what is assumed.
        positions: of all vehicles.
        length: steps of a window.
    """

    def __init__(
        self, recording: Recording, ego: int, box: Inbox, noise_model: NoiseModel, positions: Positions, length: int
    ) -> None:
        from ..kernels.windows.batch_window import Fresh

        self.recording, self.box, self.noise_model, self.length = recording, box, noise_model, length
        seen = measurements(recording, ego, replace(box, fresh=box.newest >= 0), positions.x)
        self.seen = seen._replace(gnss=positions.x)
        variance = positions.variance
        self.assumed = assumptions(recording, noise_model)._replace(fixes=variance, broadcast=variance)
        sent = positions.new[np.arange(recording.runs)[:, None], box.newest, self.seen.neighbour]
        met = last_met(self.seen.neighbour, self.seen.start)
        self.fresh = Fresh(np.ascontiguousarray(positions.new[:, :, ego]), box.fresh & sent, met)

    def solve(self, gnc: GNC) -> Solutions:
        """By compiled Gauss-Newton, batched over the runs."""
        from ..kernels.windows.batch_window import BatchSettings, windows

        return windows(self.seen, self.assumed, self.fresh, BatchSettings(self.length, TOLERANCE, LEAST_GROUND), gnc)

    def unsolved(self) -> Solutions:
        """Every problem still to be solved."""
        from ..kernels.windows.batch_window import LOST, Solutions

        shape = (self.recording.runs, len(self.recording.t))
        neighbours = np.full((shape[0], len(self.box.link), 3), np.nan)
        return Solutions(np.empty((*shape, 3)), np.empty((*shape, 3, 3)), neighbours, np.full(shape, LOST))

    def count_met(self, solved: Solutions) -> int:
        """Windows in which vehicles met."""
        from ..kernels.windows.batch_window import MET

        return int((solved.ended == MET).sum())

    def problems(self, solved: Solutions) -> Iterator[tuple[int, int, Problem, Ints]]:
        """Run, step, problem and the vehicle of each point, of all windows that are not solved."""
        from ..kernels.compiling.vectors import LANES
        from ..kernels.windows.batch_window import LOST, gather_window, new_windows

        for first in range(0, len(solved.ended), LANES):
            lost = np.argwhere(solved.ended[first : first + LANES].T == LOST)
            if not len(lost):
                continue
            window, star = new_windows(self.seen.start, self.length)
            for t in range(int(lost[-1, 0]) + 1):
                span = (max(0, t - self.length + 1), t)
                last = min(first + LANES, len(solved.ended)) - 1
                gather_window(window, star, self.seen, self.assumed, self.fresh, (first, last), span)
                for lane in lost[lost[:, 0] == t, 1].tolist():
                    steps, vehicle = self._steps(window, first + lane, span)
                    yield first + lane, t, Problem.from_steps(steps, self.noise_model.sensors), vehicle

    def _steps(self, window: Window, run: int, span: tuple[int, int]) -> tuple[list[WindowStep], Ints]:
        """The steps of a compiled window in one run, oldest first, and the vehicle of each of their points."""
        lane, most, box = run % window.motion.shape[1], window.layout[1], self.box
        motion, used = window.motion[:, lane].reshape(-1, 4, 3), window.used[:, lane].reshape(-1, 3)
        steps, vehicles = [], []
        for step in range(span[0], span[1] + 1):
            slot = step % len(window.sizes)
            here = slice(slot * most, slot * most + int(window.sizes[slot]))
            moved, process, fix, _ = np.moveaxis(motion[here], 1, 0)
            with np.errstate(divide="ignore"):
                std = 1.0 / np.sqrt(used[here])
            relative = self.recording.relative[run, box.link[box.start[step] : box.start[step + 1]]]
            steps.append(WindowStep(window.previous[here].copy(), fix, std, moved, np.sqrt(process), relative))
            vehicles.append(window.member[here])
        return steps, np.concatenate(vehicles)

    def put(self, solved: Solutions, run: int, step: int, x: Floats, cov: Floats) -> None:
        """Fill in the solution of a problem's newest step."""
        links = slice(self.box.start[step], self.box.start[step + 1])
        solved.x[run, step], solved.covariance[run, step] = x[0], cov
        solved.neighbours[run, links] = np.where(self.box.newest[run, links, None] >= 0, x[1:], np.nan)


def last_met(neighbour: Ints, start: Ints) -> Ints:
    """(M,) step at which the neighbour of each link was linked before, -1 for never."""
    step = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((step, neighbour))
    met = np.full(len(neighbour), -1, np.int64)
    again = np.flatnonzero(np.diff(neighbour[order]) == 0)
    met[order[again + 1]] = step[order[again]]
    return met


def _meeting(problem: Problem, x: Floats) -> Bools:
    """(B,) True where a solution (B, n, 3) puts the ego and a vehicle that it measures in one place on the ground."""
    met = np.zeros(len(x), dtype=bool)
    for factor in problem.factors:
        if factor.kind == "spherical":
            gap = x[:, factor.nodes[:, 1], :2] - x[:, factor.nodes[:, 0], :2]
            met |= (np.linalg.norm(gap, axis=-1) < LEAST_GROUND).any(axis=1)
    return met
