"""The fixed-lag smoother: the joint filter with its last steps kept open."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..optimize.backend import require_backend
from ..optimize.incremental import FixedLag
from ..optimize.model.factor import Factor
from ..optimize.model.problem import Problem
from ..plugins import unknown
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .options import check_options
from .star import FORGOTTEN, assumptions, measurements
from .track import Track
from .window import places, steps_of, vehicles_of
from .window_problem import window_problem

BACKENDS = ("gauss-newton", "gtsam")


@dataclass(frozen=True, eq=False)
class FixedLagSmoother:
    """The joint filter's star over the steps t-lag..t, given what the steps before left when they were eliminated.

    At every step one Gauss-Newton step of the window: its measurements are linearised anew at the smoothed points, the
    oldest step is eliminated into the prior of the next, D - D (J + D)^-1 D with D the information of the motion, and
    the newest point is the estimate: causal, and in a linear model the filter's own for every lag. A lag of 0 is
    JointFilter, but for measured ranges below `min_range`, whose angles are widened here (`relative_std`). Messages are
    brought forward as there; MovingHorizon puts them at their true time.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        lag: steps.
        backend: "gauss-newton", batched over the runs, or "gtsam", its incremental fixed-lag smoother, which loops over
            the runs and linearises each measurement once, when it comes.
        smoothed: answer each step when it leaves the window, `lag` steps late; the last ones at the end of the drive.
        exact: False keeps relative measurements as converted vectors.

    Raises:
        InputError: a lag < 0, another backend.
        MissingLibraryError: gtsam is not installed.

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
    backend: str = "gauss-newton"
    smoothed: bool = False
    exact: bool = True
    name: str = "fixed-lag"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        if self.lag < 0:
            raise InputError("lag", self.lag, "must be a whole number >= 0", "Use 0 for the filter.")
        if self.backend not in BACKENDS:
            raise unknown("backend", self.backend, BACKENDS, "Leave it out.")
        require_backend(self.backend)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.noise_model, recording)
        notes = (f"not causal: every estimate knows the next {self.lag} steps",) if self.smoothed else ()
        looped = (f"{self.backend} loops over the runs",) if self.backend != "gauss-newton" else ()
        follow = self._by_gtsam if looped else self._follow

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            seen, assumed = measurements(recording, ego, box), assumptions(recording, known)
            found = follow(recording, box, known, seen, assumed)
            yield Estimate(slice(None), found.x, found.covariance, box.link, found.neighbours)

        return follow_egos(self, recording, egos, drive, known.notes + notes + looped, missing=True)

    def _settings(self, known: NoiseModel, lag: int) -> Any:
        from ..kernels.windows.horizon import Settings

        return Settings(lag + 1, self.exact and known.exact_relative, 0, 0.0, -1.0, self.smoothed)

    def _follow(self, recording: Recording, box: Inbox, known: NoiseModel, seen: Any, assumed: Any) -> Any:
        from ..kernels.windows.horizon import horizons

        return horizons(seen, assumed, box.arrival, self._settings(known, self.lag))

    def _by_gtsam(self, recording: Recording, box: Inbox, known: NoiseModel, seen: Any, assumed: Any) -> Any:
        """The same steps, gathered by the kernels, in gtsam's incremental smoother."""
        from ..kernels.windows.horizon import advance, each_group, empty

        found, settings = empty(seen), self._settings(known, self.lag)._replace(smoothed=False)
        for runs, horizon in each_group(seen, settings.length):
            smoothers = [FixedLag((self.lag + 0.5) * recording.dt) for _ in range(runs[0], runs[1] + 1)]
            names: list[list[str]] = []
            for t in range(len(recording.t)):
                advance(horizon, seen, assumed, box.arrival, settings, runs, (t, t + 1), found)
                names.append([f"{m}@{t}" for m in vehicles_of(horizon.window, (t, t))])
                stamps = dict.fromkeys(names[-1], t * recording.dt)
                for run, smoother in zip(range(runs[0], runs[1] + 1), smoothers, strict=True):
                    before = names[-2] if t else []
                    piece = _piece(horizon, recording, box, known, (run, t, settings.exact), (before, names[-1]))
                    read(found, box, run, t, smoother.update(piece, stamps, names[-1]))
                    if self.smoothed and t >= self.lag:
                        read(found, box, run, t - self.lag, smoother.estimate(names[t - self.lag]))
            for t in range(max(0, len(names) - self.lag), len(names) if self.smoothed else 0):
                for run, smoother in zip(range(runs[0], runs[1] + 1), smoothers, strict=True):
                    read(found, box, run, t, smoother.estimate(names[t]))
        return found


def read(found: Any, box: Inbox, run: int, t: int, estimate: Any) -> None:
    """Put the estimates of gtsam's smoother at a step into the arrays of the kernels."""
    found.x[run, t], found.covariance[run, t] = estimate.x[0], estimate.covariance[0]
    found.neighbours[run, box.start[t] : box.start[t + 1]] = estimate.x[1:]


def _piece(
    horizon: Any, recording: Recording, box: Inbox, known: NoiseModel, which: tuple[int, int, bool], names: Any
) -> Problem:
    """Measurements of a step in a run: its members' fixes, motions from the step before, and relative measurements."""
    (run, t, exact), (before, here) = which, names
    newest = steps_of(horizon.window, recording, box, run, (t, t))[0]
    problem = window_problem(horizon, [newest], known, exact, run, (t, t))
    stays, joins = np.flatnonzero(newest.previous >= 0), np.flatnonzero(newest.previous < 0)
    top = len(stays)
    factors = [replace(factor, nodes=factor.nodes + top) for factor in problem.factors]
    if top:
        pairs = np.stack([np.arange(top), top + stays], axis=1)
        factors.append(Factor("displacement", pairs, newest.moved[stays], newest.moved_std[stays]))
    if len(joins):
        start = horizon.past.at[:, run % horizon.mask.size].reshape(-1, 3)[places(horizon.window, t)]
        factors.append(Factor("position", top + joins[:, None], start[joins], np.array(np.sqrt(FORGOTTEN))))
    return Problem((*(before[k] for k in newest.previous[stays]), *here), tuple(factors))
