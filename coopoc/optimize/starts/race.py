"""Multi-start: a few steps of Levenberg-Marquardt from each start, and the lowest goes on."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy import inf, pi

from ...arrays import Floats, Ints
from ...kernels.compiling.waiting import clock
from ..algebra.sparse import Sparse, sparse
from ..assess.assess import expected
from ..descent.levenberg_marquardt import NONQUADRATIC, Arrival, arrive
from ..model.factor import reweighed
from ..model.problem import Problem, Search
from ..model.space import exp
from .graph_starts import parts
from .initial import directed, joining
from .mirrors import RANGES, RIVAL_COST, Cost, Descend, across, rewound

FIRST_STEPS = 12
"""Of each start at first; a good one has nearly arrived by then."""
LATER_STEPS, NEAR_COST = 200, 3.0
"""Steps by which those go on whose cost is within so many times the least."""
SAME_COST = 1e-3
"""Share by which costs may differ and count as the same minimum: the cheaper start then stays."""
RACE_TOLERANCE = 1e-3
"""m or rad, a step at which a start has arrived for the purpose."""
EXCESS_STDS = 5.0
"""Standard deviations above its mean, under the noise that is assumed, from which a cost is not believed."""
DRAWS, QUIET_DRAWS, AGREEING_DRAWS, DRAWN_POINTS = 90, 30, 20, 1800
"""Random starts at most, with constraints or losses, that lead to the lowest minimum and end them, and points together.
"""
SAME_MINIMUM, ROUNDED_COST = 1e-5, 1e-9
"""Share by which the costs of two random starts that led to the same minimum differ, and cost that is rounding."""
BARRIER = 0.1
"""Cost by which the way between two ends must be higher, so that they are not one flat minimum."""
ELSEWHERE = "another minimum, elsewhere, costs as much"
EASED = (30.0, 10.0, 3.0, 1.0)
"""Times as large standard deviations of ranges."""


def race(
    problem: Problem,
    starts: Mapping[str, Callable[[], Floats]],
    late: Mapping[str, Callable[[Problem], tuple[Floats, int]]],
    draws: bool,
    reached: Floats | None,
) -> Problem:
    """The problem from the start that leads lowest, its x0 where the steps from there have led, with the search.

    All starts are tried, and those whose costs are near the least go on. One start ends the race at once: its descent
    is `smooth`, its cost is within its chi-square bound, and a second start led there as smoothly, or there is nothing
    but relative poses and none is to be `rewound`. Where the cost is outside that bound, the descent was not smooth,
    and no second start led to the same end, the late starts are tried, one after the other. Where it was smooth, the
    stated noise is taken to be too small, and a note of the Solution reports it. At last random starts around the end
    are tried, what ranges alone place is mirrored, and cycles are wound the other way.

    Args:
        problem: at any start.
        starts: name -> x0 (n, ambient), cheapest first.
        late: name -> a function of the problem at the best end so far, of x0 and the iterations that it took.
        draws: whether points and bodies are started from random places, too.
        reached: (n, ambient) the end of the descent from an x0, which competes.
    """
    began, system, taken, arrived = clock(), sparse(problem), 0, True
    cost_of = system.cost
    tried = dict[str, tuple[float, Floats]]()
    straight, late = set(), dict(late)
    rough, calm, minima = list[str](), list[float](), list[float]()

    def descend(x: Floats, steps: int = 50) -> Floats:
        nonlocal taken, arrived
        end = arrive(system, x, steps, RACE_TOLERANCE)
        taken, arrived = taken + end.iterations, end.converged
        return end.x

    def attempt(name: str, x: Floats, steps: int, smooth: bool = False) -> Arrival:
        nonlocal taken
        end = arrive(system, x, steps, RACE_TOLERANCE, smooth=smooth)
        tried[name], taken = (cost_of(end.x), end.x), taken + end.iterations
        return end

    def least_of_all() -> float:
        return min(cost for cost, _ in tried.values())

    def follow(name: str, x: Floats) -> Floats:
        nonlocal taken
        y, steps = late.pop(name)(problem.starting_at(x))
        y, taken = descend(y), taken + steps
        tried[name] = cost_of(y), y
        return y

    def explained(x: Floats) -> bool:  # noise that is stated too large explains every minimum, and so none
        return arrived and abs(cost_of(x) - mean) <= usual

    def landed(x: Floats) -> Floats:
        end = descend(x, LATER_STEPS)
        return end if arrived else np.full_like(end, np.nan)  # which is no minimum

    def ended(name: str, x: Floats, sure: bool = False) -> Problem:
        ends = list[tuple[float, Floats]]()
        if draws:
            x = descend(x, LATER_STEPS)
            y, ends = drawn(scattered(problem, x), x, landed, cost_of)
            name, x = (name if y is x else "drawn"), y
        x, moves, others = across(problem, x, landed, cost_of, not starts)
        if not (taken or starts):
            return problem.replace_unchecked(search=Search(name))
        name, cost = name + ", moved" * (moves > 0), cost_of(x)
        costs = [each for each, _ in (*tried.values(), *ends[1:])] + [cost] * (moves > 0)
        ends += [*others, *((each, x) for each in minima)]
        notes = doubts(x, ends, cost_of) or (() if sure else reached_once(costs, cost))
        return problem.starting_at(x).replace_unchecked(search=Search(name, taken, clock() - began, notes))

    if reached is not None:
        if not starts:
            return ended("x0", reached)
        tried["x0"] = cost_of(reached), reached
    mean, variance = expected(problem, system.size)
    usual = EXCESS_STDS * np.sqrt(variance)
    limit = mean + usual
    relative = (
        all(f.measurement.compares_poses for f in problem.factors)
        and sum(len(f.nodes) for f in problem.factors if f.nodes.shape[1] == 1) <= 1
    )
    for name, start in starts.items():
        end, cost = attempt(name, directed(problem, start()), FIRST_STEPS, True), tried[name][0]
        if not smooth(end.record):
            rough.append(name)
        else:
            calm.append(cost)
            alike = sum(abs(cost - other) <= SAME_COST * cost for other in calm) > 1
            sure = relative and cost <= NEAR_COST * limit and next(rewound(problem, end.x, 0.0), None) is None
            if sure or (cost <= limit and alike):
                name, x = next((each, x) for each, (c, x) in tried.items() if abs(c - cost) <= SAME_COST * cost)
                return ended(name, x, True)
            if end.converged:
                straight.add(name)
    if "eased" in late and not straight and least_of_all() > NEAR_COST * limit:  # with ranges it grows first
        y = follow("incremental", np.asarray(problem.x0))
        if explained(y):
            return ended("incremental", y)
    for name in rough:
        attempt(name, tried[name][1], FIRST_STEPS)
    least = least_of_all()
    close = {name: x for name, (cost, x) in tried.items() if cost <= NEAR_COST * least}
    if max(tried[name][0] for name in close) > (1.0 + SAME_COST) * least:
        ends = [attempt(name, x, LATER_STEPS) for name, x in close.items()]
        minima = [tried[name][0] for name, end in zip(close, ends, strict=True) if end.converged]
        least = least_of_all()
    name, *others = (name for name, (cost, _) in tried.items() if cost <= (1.0 + SAME_COST) * least)
    x = tried[name][1]
    if name not in straight and not explained(x) and not others:
        x = descend(x)
        for other in [*late]:
            if explained(x):
                break
            y = follow(other, x)
            name, x = (other, y) if tried[other][0] < (1.0 - SAME_COST) * cost_of(x) else (name, x)
    return ended(name, x)


def scattered(problem: Problem, x: Floats, loose: Ints | None = None) -> Iterator[Floats]:
    """Nodes x (n, ambient) with bodies, which relative measurements hold together and no pose is measured of, moved at
    random as far as they are from one another: all (or the `loose`), one, or all across the plane or line that they are
    nearest to; at first turned alone. A point is a body, and goes anywhere among the others. Of every eight draws the
    last four take what a robust loss may part for bodies of their own."""
    from scipy.spatial.transform import Rotation

    rng, space, n = np.random.default_rng(0), problem.space, len(x)
    d, at = space.dimension, space.position(x)
    center = np.median(at, axis=0)  # what has gone far away draws nothing there
    spread = 2.0 * np.median(np.linalg.norm(at - center, axis=1)) or 1.0
    fixes = [f.z[f.informative, :d] for f in problem.factors if f.kind in ("position", "pose", "pose_chordal")]
    known = np.concatenate([*fixes, at[list(problem.fixed)]])
    if len(known) and (extent := 0.5 * np.linalg.norm(np.ptp(known, axis=0))) > 0.0:
        spread, center = np.clip(spread, extent, 4.0 * extent), np.median(known, axis=0)
    normal = np.linalg.svd(at - at.mean(0), full_matrices=False)[2][-1]
    sure = problem.replace_unchecked(factors=tuple(f for f in problem.factors if f.loss is None))
    bodies = [parts(n, *joining(each)) for each in (problem, sure)]
    poses = [f.nodes[f.informative, 0] for f in problem.factors if f.kind.startswith("pose")]
    held = np.concatenate([np.array(problem.fixed, int), *poses])
    for k in range(min(DRAWS, DRAWN_POINTS // n)):
        y, part = x.copy(), bodies[k // 4 % 2]
        free = np.setdiff1d(part if loose is None else part[loose], part[held])
        if not len(free):
            return
        for body in rng.choice(free, 1) if k % 4 == 2 else free:
            own = np.flatnonzero(part == body)
            turn = exp(rng.uniform(-pi, pi, 1)) if d == 2 else Rotation.random(random_state=rng).as_matrix()
            middle, move, alone = at[own].mean(0), spread * rng.normal(size=d), len(own) == 1
            to = (center if alone else middle) + move * (k % 4 > 0 or alone)
            to = middle + normal * (move @ normal) if k % 4 == 3 else to
            y[own] = space.join((at[own] - middle) @ turn.T + to, turn @ space.rotation(x[own]))
        yield y


def eased(problem: Problem, start: Floats) -> tuple[Floats, int]:
    """Nodes (n, ambient) and iterations from where ranges with larger standard deviations lead, and then smaller ones:
    at first odometry decides, and what ranges alone place is mirrored before they bend it."""
    x, taken = start, 0
    for times in EASED:
        factors = (reweighed(f, 1.0 / times) if f.kind in RANGES else f for f in problem.factors)
        part = problem.replace_unchecked(factors=tuple(factors))
        system = sparse(part)

        def descend(y: Floats, system: Sparse = system) -> Floats:
            nonlocal taken
            end = arrive(system, y, FIRST_STEPS, RACE_TOLERANCE)
            taken += end.iterations
            return end.x

        x = across(part, descend(x), descend, system.cost)[0]
    return x, taken


def smooth(record: Floats) -> bool:
    """Whether the gain ratio of every step of an Arrival was within 1/2 .. 3/2, without damping. An exact Hessian that
    was not positive definite does not count: J^T J goes on from there."""
    _, damping, gain = record.T
    return not damping.any() and (abs(gain[np.isfinite(gain)] - 1.0) < NONQUADRATIC).all()


def drawn(
    places: Iterable[Floats], x: Floats, descend: Descend, cost: Cost, agreeing: int = AGREEING_DRAWS
) -> tuple[Floats, list[tuple[float, Floats]]]:
    """The lowest end (n, ambient) of x and of descents from other places, until `agreeing` lead to the lowest; and all
    ends with their costs, x first."""
    best, least = x, float(np.nan_to_num(cost(x), nan=inf))
    ends = [(least, x)]
    for y in places:
        if sum(not higher(each, least) for each, _ in ends) >= agreeing:
            break
        y = descend(y)
        now = float(np.nan_to_num(cost(y), nan=inf))
        ends.append((now, y))
        best, least = (y, now) if higher(least, now) else (best, least)
    return best, ends


def doubts(x: Floats, ends: Iterable[tuple[float, Floats]], cost: Cost) -> tuple[str, ...]:
    """Notes on other ends, with their costs, than the minimum x: one elsewhere costs as much, or one little more."""
    if not (ends := [*ends]):
        return ()
    least = cost(x)
    near = [each - least for each, _ in ends if higher(each, least) and each < least + RIVAL_COST]
    notes = (f"another minimum costs {min(near):.3g} more: noise may decide between them",) if near else ()
    alike = [y for each, y in ends if not higher(each, least) and abs(y - x).max() > SAME_COST * abs(x).max()]
    return (ELSEWHERE, *notes) if any(cost(0.5 * (x + y)) > least + BARRIER for y in alike) else notes


def reached_once(costs: Sequence[float], least: float) -> tuple[str, ...]:
    """A note where one of several starts, or none, has led to the least cost.

    >>> reached_once([3.0, 2.0, 4.0], 2.0)
    ('one of 3 starts leads to this minimum: a lower one may exist',)
    """
    once = sum(not higher(each, least) for each in costs) < 2 <= len(costs)
    return (f"one of {len(costs)} starts leads to this minimum: a lower one may exist",) * once


def higher(cost: float, least: float) -> bool:
    """Whether a cost is above another by more than SAME_MINIMUM of it, and than rounding makes of exact data."""
    return cost > (1.0 + SAME_MINIMUM) * least + ROUNDED_COST
