"""The window as a Problem, so that any backend can solve it under constraints: a road, a top speed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from ..arrays import Bools, Floats, number
from ..optimize.model.constraint import Constraint
from ..optimize.model.factor import Factor
from ..optimize.model.measurements import measurement
from ..optimize.model.problem import Problem
from ..optimize.model.window import WindowStep
from ..optimize.solution import Solution, Status
from ..optimize.solve import solve
from .noise_model import NoiseModel
from .star import FORGOTTEN
from .window import Span, places

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


@dataclass(frozen=True, eq=False)
class Arrival:
    """The cost 1/2 d^T information d - eta^T d of the past, d = x - at.

    Args:
        at: (n, 3) m.
        information: (3n, 3n) 1/m^2.
        eta: (3n,) 1/m.
    """

    at: Floats
    information: Floats
    eta: Floats


def arrival_of(horizon: Any, run: int, step: int) -> Arrival:
    """Information of the past about the first step of a compiled horizon, in one run."""
    window, past = horizon.window, horizon.past
    lane, here = run % window.motion.shape[1], places(window, step)
    n = here.stop - here.start
    order = np.append(n - 1, np.arange(n - 1))  # the ego's block is the last
    blocks = past.information[:, lane].reshape(-1, 3, 3)[: window.layout[1] ** 2]
    blocks = blocks.reshape(window.layout[1], window.layout[1], 3, 3)[:n, :n]
    upper = np.triu(np.moveaxis(blocks, 2, 1).reshape(3 * n, 3 * n))
    full = (upper + np.triu(upper, 1).T).reshape(n, 3, n, 3)[order][:, :, order].reshape(3 * n, 3 * n)
    eta = past.eta[:, lane].reshape(-1, 3)[:n][order]
    return Arrival(past.at[:, lane].reshape(-1, 3)[here].copy(), full, eta.ravel())


def window_problem(
    horizon: Any, steps: Sequence[WindowStep], known: NoiseModel, exact: bool, run: int, span: Span
) -> Problem:
    """The steps of a compiled horizon in one run, without their arrival cost: a point per member and step.

    Args:
        exact: measurements in range and angles; False: the vectors and weights of the kernels.
    """
    window, past = horizon.window, horizon.past
    lane, problem = run % window.motion.shape[1], Problem.from_steps(steps, known.sensors)
    factors, here = list(problem.factors), [places(window, step) for step in range(span[0], span[1] + 1)]
    if not exact and any(len(s.relative) for s in steps):
        factors[-1] = _vectors(window, lane, here, factors[-1])
    start = past.at[:, lane].reshape(-1, 3)
    tops = np.cumsum([0, *(part.stop - part.start for part in here)])
    joins = [np.flatnonzero((window.previous[part] < 0) & (k > 0)) for k, part in enumerate(here)]
    nodes = np.concatenate([top + joining for top, joining in zip(tops, joins, strict=False)])
    if len(nodes):
        at = np.concatenate([start[part][joining] for part, joining in zip(here, joins, strict=True)])
        factors.append(Factor("position", nodes[:, None], at, np.array(np.sqrt(FORGOTTEN))))
    return replace(problem, factors=tuple(factors))


def _vectors(window: Any, lane: int, here: Sequence[slice], edges: Factor) -> Factor:
    """The edges of a compiled window as measured vectors."""
    weight = np.concatenate([window.edge[:, lane].reshape(-1, 3, 3)[part][1:] for part in here])
    eta = np.concatenate([window.eta[:, lane].reshape(-1, 3)[part][1:] for part in here])
    root = np.swapaxes(np.linalg.cholesky(weight), -1, -2)
    return Factor("displacement", edges.nodes, np.linalg.solve(weight, eta[..., None])[..., 0], sqrt_information=root)


def limited(problem: Problem, dt: float, road: Road | None, top_speed: float | None) -> Problem:
    """The problem of a window with all its points on the road and all its motions within the top speed, m/s."""
    everywhere, limits = np.arange(len(problem.names))[:, None], []
    if callable(road):
        limits.append(Constraint(_above(road), everywhere, np.zeros(1), np.zeros(1)))
    elif road is not None:
        low, high = heights(road)
        limits.append(Constraint("position", everywhere, _height(low, -np.inf), _height(high, np.inf)))
    if top_speed is not None and len(problem.separator) > 1:
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
    low, high = road if isinstance(road, tuple | list) and len(road) == 2 else (road, road)
    hint = "Give a height m, (lowest, highest), or a surface z = f(x, y, m)."
    least, most = (number("road", z, -np.inf, np.inf, allowed="in m", hint=hint) for z in (low, high))
    return least, most


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


def around(problem: Problem, prior: Arrival, x: Floats) -> Problem:
    """The problem with its arrival cost expanded around x (n, 3), from where it is to be solved.

    The cost couples all members of the first step. Fixes and displacements can express that, but for the part of its
    blocks Lambda_ij which is not symmetric or not negative: at most 1.6 % of them on `town10` (K <= 6). Its gradient at
    x is exact, so that a solution that stays at x is that of the window itself; an iteration then multiplies the
    distance to it by less than 0.15.
    """
    n = len(prior.at)
    eta = prior.eta - prior.information @ (x[:n] - prior.at).ravel()
    blocks = np.moveaxis(prior.information.reshape(n, 3, n, 3), 2, 1)
    i, j = np.triu_indices(n, 1)
    tie = _root(-0.5 * (blocks[i, j] + np.swapaxes(blocks[i, j], -1, -2)), 0.0)
    own = np.einsum("iijk->ijk", blocks).copy()
    for end in (i, j):
        np.subtract.at(own, end, tie @ tie)
    fix = _root(own, LEAST)
    at = x[:n] + np.linalg.solve(fix @ fix, eta.reshape(n, 3, 1))[..., 0]
    arrival = [Factor("position", np.arange(n)[:, None], at, sqrt_information=fix)]
    if len(i):
        pairs = np.stack([i, j], axis=1)
        arrival.append(Factor("displacement", pairs, x[j] - x[i], sqrt_information=tie))
    return replace(problem, x0=x, factors=(*problem.factors, *arrival))


def solution_of(problem: Problem, prior: Arrival, x: Floats, backend: str) -> Solution | None:
    """The window solved by a backend from points x (n, 3), expanded around its solution until that stays.

    None where the backend finds none, or the solution does not stay.
    """
    for _ in range(ROUNDS):
        solution = solve(around(problem, prior, x), backend, throw=False)
        if solution.status is not Status.SOLVED:
            return None
        if np.abs(solution.x - x).max() <= SETTLED:
            return solution
        x = solution.x
    return None


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
