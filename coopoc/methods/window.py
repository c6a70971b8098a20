"""The window of stars: the last steps of one ego's star as a Gaussian chain, eliminated from its oldest step on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..arrays import Bools, Floats, Ints
from .knowledge import Knowledge
from .slice import Arrival, Slice, apply, entering, exactly, system
from .star import StarStep, rows


@dataclass(frozen=True, eq=False)
class Eliminated:
    """A step given the next one: d = inverse (pull + D (d_next - gap)), D the stiffness of the motion of who stays.

    Args:
        inverse: (R, 3n, 3n) m^2. pull: (R, 3n) 1/m. old, new: (3s,) rows of who stays, here and in the next step.
        stiffness: (R or 1, 3s) 1/m^2. gap: (R, 3s) m, motion that the points leave unexplained.
    """

    inverse: Floats
    pull: Floats
    old: Ints
    new: Ints
    stiffness: Floats
    gap: Floats


@dataclass(frozen=True, eq=False)
class Window:
    """Slices oldest first, the arrival cost of the first, and covariances (R, 3n, 3n) m^2: all, or the last one's."""

    arrival: Arrival
    slices: tuple[Slice, ...]
    spreads: tuple[Floats, ...]


def advance(window: Window | None, stars: Sequence[StarStep], length: int, known: Knowledge) -> Window:
    """The window with a new slice, yet to be solved; of more than `length` slices the oldest becomes arrival cost.

    Args:
        window: the solved one of the step before. stars: of its slices, as known now, and of the new step.
    """
    *old, new = stars
    slices = [replace(s, star=star) for s, star in zip(window.slices, old, strict=True)] if window else []
    slices.append(entering(slices[-1].point if slices else new.fix[:, :0], new, known))
    arrival = window.arrival if window else _nothing(slices[0].start)
    if len(slices) > length:
        arrival = eliminate(slices[0], slices[1], arrival)[1]
    return Window(arrival, tuple(slices[-length:]), ())


def sweep(window: Window, known: Knowledge, exact: bool, entered: bool = True, smooth: bool = False) -> Window:
    """One Gauss-Newton step: eliminate up to the newest slice, solve that, substitute back.

    On a chain this is a Kalman filter and a smoother's sweep back (Bell, SIAM J. Optimization 4, 1994).

    Args:
        exact: sightings in range and angles, linear around the points; False leaves them converted, as they came.
        entered: the newest slice has just come: it is solved converted, and made exact where that leads.
        smooth: covariances of all slices.
    """
    slices, newest = list(window.slices), window.slices[-1]
    if exact:
        slices = [part if entered and part is newest else exactly(part, part.point, known) for part in slices]
    stages, prior = [], window.arrival
    for here, later in pairwise(slices):
        stage, prior = eliminate(here, later, prior)
        stages.append(stage)
    move, spread = _solve(slices[-1], prior)
    if exact and entered:
        slices[-1] = exactly(newest, newest.point + move, known)
        move, spread = _solve(slices[-1], prior)
    slices[-1] = replace(slices[-1], point=slices[-1].point + move)
    ahead: Floats = (slices[-1].point - newest.point).reshape(len(move), -1)
    spreads = [spread]
    for k in range(len(stages) - 1, -1, -1):
        ahead = _back(stages[k], ahead)
        slices[k] = replace(slices[k], point=slices[k].point + ahead.reshape(slices[k].point.shape))
        if smooth:
            spreads.append(_spread_back(stages[k], spreads[-1]))
    return Window(window.arrival, tuple(slices), tuple(reversed(spreads)))


def settle(window: Window, known: Knowledge, most: int) -> tuple[Window, int]:
    """The window at its minimum, by at most `most` sweeps after the first, and in how many runs it still moves then.

    A run whose sightings are linear where it stands is left alone, so that no run depends on another.
    """
    window = sweep(window, known, exact=True)
    for _ in range(most):
        moving = _moving(window)
        if not moving.any():
            break
        window = _where(moving, sweep(window, known, exact=True, entered=False), window)
    return window, int(_moving(window).sum())


def eliminate(here: Slice, ahead: Slice, prior: Arrival) -> tuple[Eliminated, Arrival]:
    """A slice given the next one, and what it leaves as the arrival cost of that: D S^-1 J, S = J + D.

    D - D S^-1 D is the same, but a difference of near numbers where the motion is known well.
    """
    alone, pull = system(here, prior)
    total = alone.copy()
    star = ahead.star
    stays = np.flatnonzero(star.kept >= 0)
    old, new = rows(star.kept[stays]), rows(stays)
    stiffness = (1.0 / star.process[:, stays]).reshape(len(star.process), -1)
    moved = ahead.point[:, stays] - here.point[:, star.kept[stays]]
    gap = (star.moved[:, stays] - moved).reshape(len(pull), -1)
    total[:, old, old] += stiffness
    inverse = np.linalg.inv(total)
    left = stiffness[:, :, None] * (inverse[:, old] @ alone[:, :, old])
    size = ahead.point[0].size
    information, carried = np.zeros((len(pull), size, size)), np.zeros((len(pull), size))
    information[:, new[:, None], new] = left
    carried[:, new] = apply(left, gap) + stiffness * apply(inverse[:, old], pull)
    return Eliminated(inverse, pull, old, new, stiffness, gap), Arrival(ahead.point, information, carried)


def _solve(part: Slice, prior: Arrival) -> tuple[Floats, Floats]:
    """Move (R, n, 3) m and covariance (R, 3n, 3n) m^2 of the newest slice."""
    total, pull = system(part, prior)
    spread = np.linalg.inv(total)
    return apply(spread, pull).reshape(part.point.shape), spread


def _back(stage: Eliminated, ahead: Floats) -> Floats:
    pull = stage.pull.copy()
    pull[:, stage.old] += stage.stiffness * (ahead[:, stage.new] - stage.gap)
    return apply(stage.inverse, pull)


def _spread_back(stage: Eliminated, ahead: Floats) -> Floats:
    """S^-1 + S^-1 D Sigma_next D S^-1."""
    gain = stage.inverse[:, :, stage.old] * stage.stiffness[:, None]
    grown: Floats = stage.inverse + gain @ ahead[:, stage.new[:, None], stage.new] @ np.swapaxes(gain, -1, -2)
    return grown


def _nothing(at: Floats) -> Arrival:
    size = at[0].size
    return Arrival(at, np.zeros((len(at), size, size)), np.zeros((len(at), size)))


def _moving(window: Window) -> Bools:
    return np.asarray(np.any([part.strayed for part in window.slices], axis=0))


def _where(runs: Bools, new: Window, old: Window) -> Window:
    """`new` in some runs (R,) and `old` in the others."""

    def mixed(a: Floats, b: Floats) -> Floats:
        return np.where(runs.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

    slices = [
        replace(
            a, point=mixed(a.point, b.point), base=mixed(a.base, b.base), weight=mixed(a.weight, b.weight),
            seen=mixed(a.seen, b.seen),
        )
        for a, b in zip(new.slices, old.slices, strict=True)
    ]  # fmt: skip
    spreads = [mixed(a, b) for a, b in zip(new.spreads, old.spreads, strict=True)]
    return Window(new.arrival, tuple(slices), tuple(spreads))
