"""Faults: draws of outliers. Each is added to a clean draw of the same seed: recordings with and without are pairs."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Bools, Floats, Ints, last_true
from .fleet import Fleet
from .links import Links, spherical, wrap
from .sensors import Fault, Outliers, stream

Pairs = Sequence[tuple[str, str, Ints, Ints]]
"""Observer id, neighbour id, indices of its links, and their steps."""
PAIRS_AT_ONCE = 2_000_000
"""Pairs of vehicles that are looked at in one go, at most: it bounds the memory."""


class Episodes(NamedTuple):
    """A fault of one sensor at every step.

    Attributes:
        wrong: (T,) whether it acts.
        size: (T,) of its error, in the unit of `Fault.size`.
        turn: (T, 2) uniform draws in [0, 1) for its direction.
    """

    wrong: Bools
    size: Floats
    turn: Floats


def episodes(fault: Fault, key: tuple[int, str, int, str, str], steps: int, dt: float) -> Episodes:
    """Draws of a fault; fewer steps are a prefix.

    Args:
        fault: its law.
        key: seed, kind, run, vehicle and partner.
        steps: T.
        dt: s.

    >>> float(episodes(Fault(0.25), (0, "outages", 0, "a", ""), 10_000, 0.1).wrong.mean().round(2))
    0.25
    """
    draws = stream(*key).random((steps, 5))
    fresh = draws[:, 0] >= (np.exp(-dt / fault.lasts) if fault.lasts else 0.0)
    fresh[:1] = True
    held = draws[last_true(fresh)]
    low, high = fault.size
    share = -np.log1p(-held[:, 2]) if fault.law == "exponential" else held[:, 2]
    return Episodes(held[:, 1] < fault.rate, low + (high - low) * share, held[:, 3:])


def wrong_fixes(gnss: Floats, fleet: Fleet, outliers: Outliers, seed: int, remove_outliers: bool) -> None:
    """Displace and remove fixes (R, T, N, 3) in place; `remove_outliers` removes the displaced ones, too."""
    for r, column, jump in _of_vehicles("fixes", outliers.fixes, fleet, len(gnss), seed):
        up, around = 2.0 * jump.turn[:, 0] - 1.0, 2.0 * np.pi * jump.turn[:, 1]
        flat = np.sqrt(1.0 - up**2)
        error = jump.size[:, None] * np.stack([flat * np.cos(around), flat * np.sin(around), up], axis=-1)
        gnss[r, jump.wrong, column] += np.nan if remove_outliers else error[jump.wrong]
    for r, column, gap in _of_vehicles("outages", outliers.outages, fleet, len(gnss), seed):
        gnss[r, gap.wrong, column] = np.nan


def wrong_odometry(
    velocity: Floats, motion: Floats, fleet: Fleet, outliers: Outliers, seed: int, remove_outliers: bool
) -> None:
    """Add slip to velocities (R, T, N, 3) in place, a share of the true motion (T, N, 3), unless `remove_outliers`."""
    for r, column, slip in _of_vehicles("odometry", outliers.odometry, fleet, len(velocity), seed):
        if not remove_outliers:
            share = np.where(slip.turn[:, 0] < 0.5, slip.size, -np.minimum(slip.size, 1.0))
            velocity[r, :, column] += np.where(slip.wrong, share, 0.0)[:, None] * motion[:, column]


def _of_vehicles(kind: str, fault: Fault, fleet: Fleet, runs: int, seed: int) -> Iterator[tuple[int, int, Episodes]]:
    """Run, column and episodes of each vehicle, which never begin before its second step."""
    for r in range(runs if fault.rate else 0):
        for column, name in enumerate(fleet.ids):
            faulty = episodes(fault, (seed, f"outlier {kind}", r, name, ""), len(fleet.t), fleet.dt)
            faulty.wrong[: int(np.argmax(fleet.present[:, column])) + 1] = False
            yield r, column, faulty


def wrong_relative(
    relative: Floats,
    pairs: Pairs,
    fleet: Fleet,
    links: Links,
    outliers: Outliers,
    reach: tuple[float, float],
    seed: int,
    remove_outliers: bool,
) -> None:
    """Lengthen ranges and mistake angles of measurements (R, L, 3) in place; `remove_outliers` removes these
    components.

    Args:
        relative: m, rad, rad.
        pairs: that measure one another.
        fleet: the truth.
        links: L of them.
        outliers: what goes wrong.
        reach: (min_range, radius) m, within which a vehicle may be mistaken for another.
        seed: of all draws.
        remove_outliers: whether NaN takes the place of what is wrong.
    """
    steps, dt = len(fleet.t), fleet.dt
    for r in range(len(relative) if outliers.ranges.rate else 0):
        for observer, neighbour, index, step in pairs:
            one, other = sorted((observer, neighbour))
            late = episodes(outliers.ranges, (seed, "outlier ranges", r, one, other), steps, dt)
            hit = late.wrong[step]
            relative[r, index[hit], 0] += np.nan if remove_outliers else late.size[step[hit]]
    if not outliers.angles.rate:
        return
    mistaken = np.zeros(relative.shape[:2], dtype=bool)
    for r in range(len(relative)):
        for observer, neighbour, index, step in pairs:
            faulty = episodes(outliers.angles, (seed, "outlier angles", r, observer, neighbour), steps, dt)
            mistaken[r, index] = faulty.wrong[step]
    (at,) = np.nonzero(mistaken.any(axis=0))
    error, mistakable = mistaken_angles(fleet, links, at, reach)
    run, row = np.nonzero(mistaken[:, at] & mistakable)
    wrong = run, at[row]
    relative[(*wrong, 1)] = wrap(relative[(*wrong, 1)] + (np.nan if remove_outliers else error[row, 0]))
    relative[(*wrong, 2)] += np.nan if remove_outliers else error[row, 1]


def mistaken_angles(fleet: Fleet, links: Links, at: Ints, reach: tuple[float, float]) -> tuple[Floats, Bools]:
    """Error (M, 2) rad of azimuth and inclination if the vehicle nearest to the neighbour is taken for it, and whether
    (M,) the observer sees another at all.

    Args:
        fleet: the truth.
        links: L of them.
        at: M indices of links.
        reach: (min_range, radius) m.
    """
    error, done = np.zeros((len(at), 2)), np.zeros(len(at), dtype=bool)
    at_once = max(1, PAIRS_AT_ONCE // len(fleet.ids))
    for first in range(0, len(at), at_once):
        part = slice(first, first + at_once)
        step, observer, neighbour = (side[at[part]] for side in (links.step, links.observer, links.neighbour))
        everyone, rows = fleet.position[step], np.arange(len(step))
        own, right = everyone[rows, observer], everyone[rows, neighbour]
        away = np.linalg.norm(everyone - own[:, None], axis=-1)
        gap = np.linalg.norm(everyone - right[:, None], axis=-1)
        gap[~((away >= reach[0]) & (away <= reach[1]))] = np.inf  # of absent vehicles, too
        gap[rows, neighbour] = gap[rows, observer] = np.inf
        other = np.argmin(gap, axis=1)
        done[part] = np.isfinite(gap[rows, other])
        angles = (np.stack(spherical(*(to - own).T)[1:], axis=-1) for to in (everyone[rows, other], right))
        error[part] = np.where(done[part, None], next(angles) - next(angles), 0.0)
    return error, done
