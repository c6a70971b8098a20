"""The fixed-lag smoother: the joint filter with its last steps kept open."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Ints
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..optimize.factor import Factor
from ..optimize.incremental import FixedLag
from ..optimize.problem import Problem
from ..optimize.sights import relative_std
from ..optimize.solve import usable
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .knowledge import Knowledge, resolve
from .slice import Slice, entering, estimate
from .star import FORGOTTEN, assumed_arrays, measured_arrays, star_steps
from .track import Track
from .window import Window, advance, sweep

BACKENDS = ("gauss-newton", "gtsam")


@dataclass(frozen=True, eq=False)
class FixedLagSmoother:
    """The joint filter's star over the steps t-lag..t, given what the steps before left when they were eliminated.

    At every step one Gauss-Newton step of the window: sightings are made linear anew at the smoothed points, the oldest
    step is eliminated into the prior of the next, D - D (J + D)^-1 D with D the stiffness of the motion, and the newest
    point is the estimate: causal, and in a linear model the filter's own for every lag (performance.md section 1.2). A
    lag of 0 is JointFilter, but for measured ranges below `min_range`, whose angles are widened here (`relative_std`).
    Messages are brought forward as there; MovingHorizon puts them at their true time.

    Args:
        lag: steps. backend: "gauss-newton", batched over the runs, or "gtsam", its incremental fixed-lag smoother,
            which loops over the runs and makes each sighting linear once, when it comes.
        smoothed: answer each step when it leaves the window, `lag` steps late; the last ones at the end of the drive.
        knowledge: "identity", "nominal" or a Knowledge. exact: False keeps sightings as converted vectors.

    Raises:
        InputError: a lag < 0, another backend. MissingLibraryError: no gtsam.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> FixedLagSmoother(lag=1)(observe(fleet, Sensors(), V2X(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    lag: int = 5
    backend: str = "gauss-newton"
    smoothed: bool = False
    knowledge: Knowledge | str = "nominal"
    exact: bool = True
    name: str = "fixed-lag"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        if self.lag != int(self.lag) or self.lag < 0:
            raise InputError("lag", self.lag, "must be a whole number >= 0", "Use 0 for the filter.")
        if self.backend not in BACKENDS:
            raise InputError("backend", repr(self.backend), f"must be one of {BACKENDS}", "Leave it out.")
        usable(self.backend)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.knowledge, recording)
        notes = (f"not causal: every estimate knows the next {self.lag} steps",) if self.smoothed else ()
        looped = (f"{self.backend} loops over the runs",) if self.backend != "gauss-newton" else ()
        plain = self._follow if self.smoothed or not use_kernels() else self._compiled
        follow = self._by_gtsam if looped else plain
        return follow_egos(self, recording, egos, lambda ego, box: follow(recording, ego, box, known), notes + looped)

    def _compiled(self, recording: Recording, ego: int, box: Inbox, known: Knowledge) -> Iterator[Estimate]:
        """What `_follow` yields, as one estimate of all steps from compiled code."""
        from ..kernels.horizon import horizons

        measured, assumed = measured_arrays(recording, ego, box), assumed_arrays(recording, known)
        exact = self.exact and known.exact_relative
        x, cov, neighbours, _ = horizons(measured, assumed, None, self.lag + 1, exact, 0, 0.0, 0.0)
        yield Estimate(slice(None), x, cov, box.link, neighbours)

    def _follow(self, recording: Recording, ego: int, box: Inbox, known: Knowledge) -> Iterator[Estimate]:
        window: Window | None = None
        exact, length = self.exact and known.exact_relative, self.lag + 1
        for star in star_steps(recording, ego, box, known):
            stars = [*(part.star for part in window.slices), star] if window else [star]
            window = sweep(advance(window, stars, length, known), known, exact, smooth=self.smoothed)
            if not self.smoothed:
                yield estimate(window.slices[-1], window.spreads[-1])
            elif len(window.slices) == length:
                yield estimate(window.slices[0], window.spreads[0])
        if self.smoothed and window:
            full = len(window.slices) == length
            for part, spread in zip(window.slices[full:], window.spreads[full:], strict=True):
                yield estimate(part, spread)

    def _by_gtsam(self, recording: Recording, ego: int, box: Inbox, known: Knowledge) -> Iterator[Estimate]:
        smoothers = [FixedLag((self.lag + 0.5) * recording.dt) for _ in range(recording.runs)]
        exact, length = self.exact and known.exact_relative, self.lag + 1
        point, names = np.empty((recording.runs, 0, 3)), [""]
        window: deque[tuple[Slice, list[str]]] = deque(maxlen=length)
        for star in star_steps(recording, ego, box, known):
            part, before = entering(point, star, known), names
            names = [f"{m}@{star.step}" for m in (ego, *recording.links.neighbour[star.links])]
            piece = _piece(part, before, names, known, exact)
            stamps = dict.fromkeys(names, star.step * recording.dt)
            found = [smoother.update(piece.pick(run), stamps, names) for run, smoother in enumerate(smoothers)]
            point = np.stack([each.x for each in found])
            window.append((part, names))
            if not self.smoothed:
                yield estimate(replace(part, point=point), np.stack([each.covariance[0] for each in found]))
            elif len(window) == length:
                yield _read(*window[0], smoothers)
        for part, late in list(window)[len(window) == length :] if self.smoothed else ():
            yield _read(part, late, smoothers)


def _read(part: Slice, names: list[str], smoothers: Sequence[FixedLag]) -> Estimate:
    """What gtsam's smoothers now say of an older step."""
    found = [smoother.estimate(names) for smoother in smoothers]
    return estimate(replace(part, point=np.stack([f.x for f in found])), np.stack([f.covariance[0] for f in found]))


def _piece(part: Slice, before: list[str], names: list[str], known: Knowledge, exact: bool) -> Problem:
    """What a step adds in R realisations: its members' fixes, motions from the step before, and sightings."""
    star, top = part.star, int((part.star.kept >= 0).sum())
    stays, joins, here = np.flatnonzero(star.kept >= 0), np.flatnonzero(star.kept < 0), top + np.arange(len(names))
    std = np.where(star.heard[..., None], np.sqrt(star.fix_variance), np.inf)
    factors = [Factor("position", here[:, None], star.fix, std)]
    if len(stays):
        pairs = np.stack([np.arange(top), here[stays]], axis=1)
        factors.append(Factor("displacement", pairs, star.moved[:, stays], np.sqrt(star.process[:, stays])))
    if len(joins):
        factors.append(Factor("position", here[joins, None], part.start[:, joins], np.array(np.sqrt(FORGOTTEN))))
    if len(star.links):
        factors.append(_sightings(part, here, known, exact))
    return Problem((*(before[k] for k in star.kept[stays]), *names), tuple(factors))


def _sightings(part: Slice, here: Ints, known: Knowledge, exact: bool) -> Factor:
    pairs = np.stack([np.full(len(here) - 1, here[0]), here[1:]], axis=1)
    if exact:
        assert known.sensors is not None
        return Factor("spherical", pairs, part.star.relative, relative_std(part.star.relative, known.sensors))
    root = np.swapaxes(np.linalg.cholesky(part.weight), -1, -2)
    return Factor("displacement", pairs, part.star.vector, sqrt_information=root)
