"""The window as a Problem, so that any backend can solve it under constraints: a road, a top speed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from ..arrays import Bools, Floats
from ..optimize.constraint import Constraint
from ..optimize.factor import Factor
from ..optimize.measurements import measurement
from ..optimize.problem import Problem
from ..optimize.sights import Sight, chain
from ..optimize.solution import Solution, Status
from ..optimize.solve import solve
from .knowledge import Knowledge
from .slice import Arrival, Slice
from .star import FORGOTTEN, StarStep

Surface = Callable[[Any, Any, Any], Any]
"""Height m of the road, from x and y in m and a namespace with sqrt, atan2 and where: lambda x, y, m: 0.02 * x."""
Road = float | tuple[float, float] | Surface
"""The height at which vehicles are, the lowest and the highest, or a surface."""
ROUNDS = 10
"""How often a window is expanded around its solution."""
SETTLED = 1e-4
"""m, its last move."""
LEAST = 1e-3
"""1/m^2, least information of a fix of `around`; it decides how fast its iterations converge, not where to."""


def window_problem(slices: Sequence[Slice], known: Knowledge, exact: bool) -> Problem:
    """The slices in R realisations, without their arrival cost: a point per member and step, the ego's being the hub.

    Args:
        exact: sightings in range and angles; False: the vectors and weights of the slices.
    """
    problem = chain([_sight(part.star) for part in slices], known.sensors if exact else None)
    factors, tops = list(problem.factors), np.cumsum([0, *(len(part.star.kept) for part in slices)])
    if not exact and any(len(part.star.links) for part in slices):
        root = np.swapaxes(np.linalg.cholesky(np.concatenate([part.weight for part in slices], axis=1)), -1, -2)
        vector = np.concatenate([part.star.vector for part in slices], axis=1)
        factors[-1] = Factor("displacement", factors[-1].nodes, vector, sqrt_information=root)
    joins = [np.flatnonzero(part.star.kept < 0) for part in slices]
    nodes = np.concatenate([top + who for top, who in zip(tops, joins, strict=False)])
    if len(nodes):
        start = np.concatenate([part.start[:, who] for part, who in zip(slices, joins, strict=True)], axis=1)
        factors.append(Factor("position", nodes[:, None], start, np.array(np.sqrt(FORGOTTEN))))
    return replace(problem, factors=tuple(factors))


def limited(problem: Problem, dt: float, road: Road | None, top_speed: float | None) -> Problem:
    """The problem of a window with all its points on the road and all its motions within the top speed, m/s."""
    everywhere, limits = np.arange(len(problem.names))[:, None], []
    if callable(road):
        limits.append(Constraint(_above(road), everywhere, np.zeros(1), np.zeros(1)))
    elif road is not None:
        low, high = heights(road)
        limits.append(Constraint("position", everywhere, _height(low, -np.inf), _height(high, np.inf)))
    if top_speed is not None and len(problem.hub) > 1:
        motion = problem.factors[1].nodes
        most = np.array([top_speed**2])
        limits.append(Constraint(_square_of_speed(), motion, np.array([-np.inf]), most, np.array([dt])))
    return replace(problem, constraints=tuple(limits))


def heights(road: Road | None) -> tuple[float, float]:
    """The lowest and the highest height m that a road allows by itself: any, if it is a surface or there is none.

    >>> heights(2.0), heights((0.0, 3.0)), heights(None)
    ((2.0, 2.0), (0.0, 3.0), (-inf, inf))
    """
    if road is None or callable(road):
        return -np.inf, np.inf
    return road if isinstance(road, tuple) else (road, road)


def violated(problem: Problem, x: Floats, tolerance: float = 1e-6) -> Bools:
    """(R,) True where points x (R, n, 3) violate a constraint by more than the tolerance, m or m/s."""
    found = np.zeros(len(x), dtype=bool)
    for limit in problem.constraints:
        first, last = limit.nodes[:, 0], limit.nodes[:, -1]
        vector = x[:, last] - x[:, first] if limit.measurement.arity == 2 else x[:, first]
        assert limit.constants is not None
        value = limit.measurement.difference(vector, None, np.zeros(limit.lower.shape[-1]), limit.constants)
        found |= (limit.violation(value) > tolerance).any(axis=(1, 2))
    return found


def around(problem: Problem, prior: Arrival, run: int, x: Floats) -> Problem:
    """The single problem of a run with its arrival cost expanded around x (n, 3), from where it is to be solved.

    The cost couples all members of the first slice. Fixes and displacements can say that, but for the part of its
    blocks Lambda_ij which is not symmetric or not negative: at most 1.6 % of them on `town10` (K <= 6). Its gradient at
    x is exact, so that a solution that stays at x is that of the window itself; an iteration then multiplies the
    distance to it by less than 0.15.
    """
    single = replace(problem.pick(run), x0=x)
    n = prior.at.shape[1]
    informed = np.flatnonzero(prior.information[run].reshape(n, 3, 3 * n).any(axis=(1, 2)))
    if not len(informed):
        return single
    pull = prior.pull[run] - prior.information[run] @ (x[:n] - prior.at[run]).ravel()
    blocks = np.moveaxis(prior.information[run].reshape(n, 3, n, 3), 2, 1)[np.ix_(informed, informed)]
    i, j = np.triu_indices(len(informed), 1)
    tie = _root(-0.5 * (blocks[i, j] + np.swapaxes(blocks[i, j], -1, -2)), 0.0)
    own = np.einsum("iijk->ijk", blocks).copy()
    for end in (i, j):
        np.subtract.at(own, end, tie @ tie)
    fix = _root(own, LEAST)
    at = x[informed] + np.linalg.solve(fix @ fix, pull.reshape(n, 3, 1)[informed])[..., 0]
    arrival = [Factor("position", informed[:, None], at, sqrt_information=fix)]
    if len(i):
        first, second = informed[i], informed[j]
        arrival.append(Factor("displacement", np.stack([first, second], axis=1), x[second] - x[first],
                              sqrt_information=tie))  # fmt: skip
    return replace(single, factors=(*single.factors, *arrival))


def solution_of(problem: Problem, prior: Arrival, run: int, x: Floats, backend: str) -> Solution | None:
    """The window of a run solved by a backend from points x (n, 3), expanded around its solution until that stays.

    None where the backend finds none, or the solution does not stay.
    """
    for _ in range(ROUNDS):
        solution = solve(around(problem, prior, run, x), backend, throw=False)
        if solution.status is not Status.SOLVED:
            return None
        if np.abs(solution.x - x).max() <= SETTLED:
            return solution
        x = solution.x
    return None


def _sight(star: StarStep) -> Sight:
    std = np.where(star.heard[..., None], np.sqrt(star.fix_variance), np.inf)
    moved_std = np.broadcast_to(np.sqrt(star.process), star.moved.shape)
    return Sight(star.kept, star.fix, std, star.moved, moved_std, star.relative)


def _height(z: float, open_side: float) -> Floats:
    return np.array([open_side, open_side, z])


@cache
def _above(road: Surface) -> str:
    """Kind of measurement: height above the road, registered once for each surface."""
    kind = f"height above {getattr(road, '__name__', 'road')} {id(road)}"

    @measurement(kind, arity=1, components=("coordinate",))
    def height(x: Any, y: Any, z: Any, m: Any = np) -> Sequence[Any]:
        return (z - road(x, y, m),)

    return kind


@cache
def _square_of_speed() -> str:
    """Kind of measurement: unlike the speed it has a derivative where a vehicle stands."""

    @measurement("square of speed", arity=2, components=("coordinate",), constants=1)
    def square(dx: Any, dy: Any, dz: Any, dt: Any, m: Any = np) -> Sequence[Any]:
        return ((dx * dx + dy * dy + dz * dz) / (dt * dt),)

    return "square of speed"


def _root(matrix: Floats, least: float) -> Floats:
    """Symmetric square root (..., 3, 3) of the part of a symmetric matrix whose eigenvalues are at least `least`."""
    value, axes = np.linalg.eigh(matrix)
    root: Floats = (axes * np.sqrt(np.maximum(value, least))[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return root
