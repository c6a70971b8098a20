"""Moving-horizon estimation of the star: the last steps solved anew at every step, late messages at their true time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Ints
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..optimize.solve import backends, usable
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .knowledge import Knowledge, resolve
from .slice import STRAYED, estimate
from .star import assumed_arrays, measured_arrays
from .track import Track
from .true_time import Seen, known_by, seen_steps
from .window import Window, advance, settle, sweep
from .window_problem import Road, heights, limited, solution_of, violated, window_problem

SWEEPS = 10
"""Gauss-Newton steps of a window after the first; one is common."""
DROPPED = "fixes came later than the horizon and were dropped"
MOVING = "windows were still moving after 11 Gauss-Newton steps"


@dataclass(frozen=True, eq=False)
class MovingHorizon:
    """argmin over x_{t-N..t} of |x_{t-N} - x_a|^2_{P^-1} + sum |x_{k+1} - x_k - dt u_k|^2 + sum |h(x_k) - z_k|^2.

    x holds the ego and the neighbours of its star at each step (methods.md section 6.9). The arrival cost (x_a, P) is
    what the steps before the horizon leave when they are eliminated one by one, as a filter does. A message that comes
    late is put where it belongs: its fix at the step at which it was sent, its velocity in the place of the older one
    that stood in for it. A velocity that stands in n times makes the same error n times (see star_steps). A fix that is
    late by more than the horizon is dropped, and the notes count it. With linear sightings and no constraint the newest
    point is that of the Kalman filter.

    Constraints hold for every vehicle at every step of the horizon. They bound the answer and not the arrival cost,
    which stays that of the filter (Rao, Rawlings, Mayne, IEEE TAC 48, 2003); a window that keeps them as it is needs no
    other solution. The covariance knows of equalities only: under an exact height it is singular.

    Args:
        horizon: N, steps. backend: "gauss-newton" solves all runs at once by block elimination, and no constraints;
            others of `coopoc.optimize.backends()` loop over the runs: osqp can hold heights, casadi all.
        road: the height m of all vehicles, (lowest, highest), or a surface z = f(x, y, m) with m a namespace that has
            sqrt, atan2 and where. top_speed: m/s from step to step.
        knowledge: "identity", "nominal" or a Knowledge. exact: False keeps sightings as converted vectors.

    Raises:
        InputError: a horizon < 1, a road or top speed that the backend cannot hold or no vehicle can keep.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> MovingHorizon(horizon=1)(observe(fleet, Sensors(), V2X(latency=0.1), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    horizon: int = 10
    backend: str = "gauss-newton"
    road: Road | None = None
    top_speed: float | None = None
    knowledge: Knowledge | str = "nominal"
    exact: bool = True
    name: str = "mhe"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        if self.horizon != int(self.horizon) or self.horizon < 1:
            raise InputError("horizon", self.horizon, "must be a whole number >= 1", "Use 10 to 20 at 10 Hz.")
        usable(self.backend)
        self._check_constraints()

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        counts: Counter[str] = Counter()
        follow = self._compiled if self.backend == "gauss-newton" and use_kernels() else self._follow
        track = follow_egos(self, recording, egos, lambda ego, box: follow(recording, ego, box, known, counts))
        loop = () if self.backend == "gauss-newton" else (f"{self.backend} loops over the runs",)
        return replace(track, notes=(*loop, *(f"{count} {what}" for what, count in counts.items() if count)))

    def _compiled(
        self, recording: Recording, ego: int, box: Inbox, known: Knowledge, counts: Counter[str]
    ) -> Iterator[Estimate]:
        """What `_follow` yields, as one estimate of all steps from compiled code."""
        from ..kernels.horizon import horizons

        counts[DROPPED] += self._dropped(recording, box, box.arrival)
        exact, limits = self.exact and known.exact_relative, recording.v2x.max_age / recording.dt + 1e-9
        variance, _, *others = assumed_arrays(recording, known)
        assumed = (variance, known.gnss_variance[None, None, None], *others)
        x, cov, neighbours, moving = horizons(
            measured_arrays(recording, ego, box), assumed, np.ascontiguousarray(box.arrival), self.horizon + 1, exact,
            SWEEPS if exact else 0, limits, STRAYED,
        )  # fmt: skip
        counts[MOVING] += int(moving.sum())
        yield Estimate(slice(None), x, cov, box.link, neighbours)

    def _follow(
        self, recording: Recording, ego: int, box: Inbox, known: Knowledge, counts: Counter[str]
    ) -> Iterator[Estimate]:
        exact, length = self.exact and known.exact_relative, self.horizon + 1
        arrival, variance = box.arrival, known.process_variance(recording)
        counts[DROPPED] += self._dropped(recording, box, arrival)
        recent: list[Seen] = []
        window: Window | None = None
        for new in seen_steps(recording, ego, box, arrival, known):
            recent.append(new)
            for k in range(len(recent) > length, len(recent)):
                before = recent[k - 1] if k else None
                recent[k] = known_by(new.star.step, recent[k], before, recording, known, variance)
            window = advance(window, [part.star for part in recent], length, known)
            recent = recent[-length:]
            window, moving = settle(window, known, SWEEPS) if exact else (sweep(window, known, exact), 0)
            counts[MOVING] += moving
            yield self._answer(window, known, exact, recording.dt, counts)

    def _answer(self, window: Window, known: Knowledge, exact: bool, dt: float, counts: Counter[str]) -> Estimate:
        """The newest slice as the elimination has it, or where the backend has to solve the window, as that does."""
        newest, spread = window.slices[-1], window.spreads[-1]
        if self.backend == "gauss-newton":
            return estimate(newest, spread)
        problem = limited(window_problem(window.slices, known, exact), dt, self.road, self.top_speed)
        x = np.concatenate([part.point for part in window.slices], axis=1)
        point, cov, n = newest.point.copy(), spread[:, :3, :3].copy(), newest.point.shape[1]
        bounded = self.road is not None or self.top_speed is not None
        for run in np.flatnonzero(violated(problem, x)).tolist() if bounded else range(len(x)):
            solution = solution_of(problem, window.arrival, run, x[run], self.backend)
            if solution is None:
                counts[f"windows that {self.backend} did not solve: the unconstrained answer stands"] += 1
                continue
            point[run] = solution.x[-n:]
            if bounded:
                cov[run] = solution.covariance[problem.hub[-1]]
        return estimate(replace(newest, point=point), cov)

    def _dropped(self, recording: Recording, box: Inbox, arrival: Ints) -> int:
        return int((arrival - recording.links.step[box.link] > self.horizon).sum())

    def _check_constraints(self) -> None:
        if self.top_speed is not None and not self.top_speed > 0:
            raise InputError("top_speed", self.top_speed, "must be > 0 m/s", "Leave it out for none.")
        low, high = heights(self.road)
        if not low <= high:
            raise InputError("road", self.road, "must be a height or (lowest, highest) m", "Swap them.")
        able = backends()[self.backend].constraints
        curved = callable(self.road) or self.top_speed is not None
        if able != "all" and (curved or (able == "none" and self.road is not None)):
            given = {"road": self.road, "top_speed": self.top_speed}
            raise InputError("backend", repr(self.backend), f"cannot hold {given}",
                             'Use backend="casadi", or "osqp" for a height.')  # fmt: skip
