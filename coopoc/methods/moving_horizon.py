"""Moving-horizon estimation of the star: the last steps solved anew at every step, late messages at their true time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..optimize.backend import require_backend
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .options import check_options
from .star import assumptions, measurements
from .track import Track
from .window import points_of, steps_of
from .window_problem import Road, arrival_of, heights, limited, solution_of, violated, window_problem

STRAYED = 0.03
"""m, move of a vector v beyond which its measurement is made linear anew: off by at most 0.03^2 / 2 |v| then."""
SWEEPS = 10
"""Gauss-Newton steps of a window after the first; one is common."""
DROPPED = "fixes came later than the horizon and were dropped"
MOVING = "windows were still moving after 11 Gauss-Newton steps"


@dataclass(frozen=True, eq=False)
class MovingHorizon:
    """argmin over x_{t-N..t} of |x_{t-N} - x_a|^2_{P^-1} + sum |x_{k+1} - x_k - dt u_k|^2 + sum |h(x_k) - z_k|^2.

    x holds the ego and the neighbours of its star at each step. The arrival cost (x_a, P) is
    what the steps before the horizon leave when they are eliminated one by one, as a filter does. A message that comes
    late is put where it belongs: its fix at the step at which it was sent, its velocity in the place of the older one
    that stood in for it. A velocity that stands in n times makes the same error n times (see star_steps). A fix that is
    late by more than the horizon is dropped, and the notes count it. With linear relative measurements and no
    constraint the newest point is that of the Kalman filter.

    Constraints hold for every vehicle at every step of the horizon. They bound the answer and not the arrival cost,
    which stays that of the filter (Rao, Rawlings, Mayne, IEEE TAC 48, 2003); a window that keeps them as it is needs no
    other solution. The covariance knows of equalities only: under an exact height it is singular.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        horizon: N, steps.
        backend: "gauss-newton" solves all runs at once by block elimination, and no constraints; others of
            `coopoc.optimize.backends()` loop over the runs: osqp can hold heights, casadi all.
        road: the height m of all vehicles, (lowest, highest), or a surface z = f(x, y, m) with m a namespace that has
            sqrt, atan2 and where.
        top_speed: m/s from step to step.
        exact: False keeps relative measurements as converted vectors.

    Raises:
        InputError: a horizon < 1, a road or top speed that the backend cannot hold or no vehicle can keep.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> MovingHorizon(horizon=1)(observe(fleet, Sensors(), V2X(latency=0.1), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    horizon: int = 10
    backend: str = "gauss-newton"
    road: Road | None = None
    top_speed: float | None = None
    exact: bool = True
    name: str = "mhe"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        if self.horizon < 1:
            raise InputError("horizon", self.horizon, "must be a whole number >= 1", "Use 10 to 20 at 10 Hz.")
        require_backend(self.backend)
        self._check_constraints()

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.noise_model, recording)
        counts: Counter[str] = Counter()

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            counts[DROPPED] += self._dropped(recording, box)
            found = self._follow(recording, ego, box, known, counts)
            counts[MOVING] += int(found.moving.sum())
            yield Estimate(slice(None), found.x, found.covariance, box.link, found.neighbours)

        track = follow_egos(self, recording, egos, drive, missing=True)
        loop = () if self._runs_compiled else (f"{self.backend} loops over the runs",)
        return replace(
            track, notes=(*known.notes, *loop, *(f"{count} {what}" for what, count in counts.items() if count))
        )

    def _follow(self, recording: Recording, ego: int, box: Inbox, known: NoiseModel, counts: Counter[str]) -> Any:
        """The elimination's estimates; where the backend has to solve a window, those of the backend."""
        from ..kernels.windows.horizon import Settings, horizons

        exact = self.exact and known.exact_relative
        age = recording.v2x.max_age / recording.dt + 1e-9
        settings = Settings(self.horizon + 1, exact, SWEEPS if exact else 0, STRAYED, age, False)
        seen, assumed = measurements(recording, ego, box), assumptions(recording, known)
        seen = seen._replace(newest=seen.newest.copy(), fresh=np.zeros_like(box.fresh))
        arrival = np.ascontiguousarray(box.arrival)
        if self._runs_compiled:
            return horizons(seen, assumed, arrival, settings)
        return self._by_backend(recording, box, known, (seen, assumed, arrival, settings), counts)

    def _by_backend(self, recording: Recording, box: Inbox, known: NoiseModel, given: Any, counts: Counter[str]) -> Any:
        from ..kernels.windows.horizon import advance, each_group, empty

        seen, assumed, arrival, settings = given
        found = empty(seen)
        for runs, horizon in each_group(seen, settings.length):
            for t in range(len(recording.t)):
                advance(horizon, seen, assumed, arrival, settings, runs, (t, t + 1), found)
                span = (max(0, t - self.horizon), t)
                for run in range(runs[0], runs[1] + 1):
                    self._replace(found, horizon, recording, box, known, (run, span, settings.exact), counts)
        return found

    def _replace(
        self,
        found: Any,
        horizon: Any,
        recording: Recording,
        box: Inbox,
        known: NoiseModel,
        which: Any,
        counts: Counter[str],
    ) -> None:
        """Put the backend's newest points in the place of the elimination's, where a constraint asks for them."""
        run, span, exact = which
        problem = window_problem(horizon, steps_of(horizon.window, recording, box, run, span), known, exact, run, span)
        problem = limited(problem, recording.dt, self.road, self.top_speed)
        x, bounded = points_of(horizon.window, run, span), self.road is not None or self.top_speed is not None
        if bounded and not violated(problem, x[None])[0]:
            return
        solution = solution_of(problem, arrival_of(horizon, run, span[0]), x, self.backend)
        if solution is None:
            counts[f"windows that {self.backend} did not solve: the unconstrained answer stands"] += 1
            return
        t, ego = span[1], problem.separator[-1]
        found.x[run, t] = solution.x[ego]
        found.neighbours[run, box.start[t] : box.start[t + 1]] = solution.x[ego + 1 :]
        if bounded:
            found.covariance[run, t] = solution.covariance[ego]

    @property
    def _runs_compiled(self) -> bool:
        return require_backend(self.backend).capabilities.compiled

    def _dropped(self, recording: Recording, box: Inbox) -> int:
        return int((box.arrival - recording.links.step[box.link] > self.horizon).sum())

    def _check_constraints(self) -> None:
        if self.top_speed is not None and not self.top_speed > 0:
            raise InputError("top_speed", self.top_speed, "must be > 0 m/s", "Leave it out for none.")
        low, high = heights(self.road)
        if not low <= high:
            raise InputError("road", self.road, "must be a height or (lowest, highest) m", "Swap them.")
        able = require_backend(self.backend).capabilities.constraints
        curved = callable(self.road) or self.top_speed is not None
        if able != "all" and (curved or (able == "none" and self.road is not None)):
            given = {"road": self.road, "top_speed": self.top_speed}
            raise InputError(
                "backend", repr(self.backend), f"cannot hold {given}", 'Use backend="casadi", or "osqp" for a height.'
            )
