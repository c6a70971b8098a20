"""The filter of the whole fleet, component by component: one state of all its vehicles."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray
from ..compiling.compile import compiled, part
from ..compiling.small import from_upper, load, store, subtract
from .components import BASE, BEGIN, HOME, MEMBER, ROW, STRIDE, arrange, connect, move, padded, place
from .fleet_graph import VECTOR, Assumed, Measured, Pairs, at, pair_at_agreement
from .low_rank import Scratch, scratch, update

FORGOTTEN = 1e6
"""m^2, variance of a vehicle before its first fix."""


class State(NamedTuple):
    """The filter between two steps, twice: before and after vehicles join, leave or meet.

    Attributes:
        label: (N,) component of each vehicle, -1 where absent.
        plans: (2, 6, N+1) of the components.
        cov: (2, .) m^2, their covariances.
        now: (2,) which of the two counts, and how many components it has.
    """

    label: AnyArray
    plans: AnyArray
    cov: AnyArray
    now: AnyArray


class Step(NamedTuple):
    """What one step brings to R runs that share their covariance.

    Attributes:
        weight: (9 P) 1/m^2, information of the pairs.
        eta: (R, P, 3) 1/m.
        total: (R, N, 3) 1/m, information vectors of the vehicles.
        moved: (R, .) m.
        information: the components' matrices, lower triangles.
        near: (N, N) by members' slots, True for two that share a block.
        scratch: of the low-rank update.
    """

    weight: AnyArray
    eta: AnyArray
    total: AnyArray
    moved: AnyArray
    information: AnyArray
    near: AnyArray
    scratch: Scratch


def begin(vehicles: int, most: int, runs: int) -> tuple[State, Step]:
    """State before the first step, and memory for so many pairs a step and runs together."""
    size, wide = padded(vehicles) ** 2 + vehicles * padded(1) ** 2, padded(vehicles)
    state = State(
        np.full(vehicles, -1),
        np.zeros((2, 6, vehicles + 1), np.int64),
        np.zeros((2, size)),
        np.zeros(2, np.int64),
    )
    step = Step(
        np.zeros(9 * most),
        np.zeros((runs, most, 3)),
        np.zeros((runs, vehicles, 3)),
        np.zeros((runs, wide)),
        np.zeros(size),
        np.zeros((vehicles, vehicles), np.bool_),
        scratch(vehicles, wide),
    )
    return state, step


@compiled
def follow(
    measured: Measured,
    pairs: Pairs,
    assumed: Assumed,
    memory: tuple[State, Step],
    runs: tuple[int, int],
    span: tuple[int, int],
    found: tuple[AnyArray, AnyArray],
) -> None:
    """Filter some runs over a span of steps.

    Args:
        measured: what the fleet measured.
        pairs: those whose measurements reach the centre.
        assumed: the noise model.
        memory: as `begin` makes it.
        runs: the first and how many, which share its covariance.
        span: the first step and the one behind the last.
        found: positions (R, T, N, 3) m and covariances (R, T, N, 3, 3) m^2 to fill.
    """
    state, step = memory
    x, cov = found
    active, none_active, first = measured.active[runs[0]], np.zeros(x.shape[2], np.bool_), runs[0]
    for t in range(span[0], span[1]):
        before, now = active[t - 1] if t > 0 else none_active, slice(pairs.start[t], pairs.start[t + 1])
        if connect(before, active[t], pairs.first[now], pairs.second[now], pairs.alive[first, now], state.label):
            old, new = state.now[0], 1 - state.now[0]
            state.now[0], state.now[1] = new, arrange(state.label, state.plans[new])
            move(state.plans[old], state.plans[new], before, state.cov[old], state.cov[new], state.now[1])
        plan, covariance = state.plans[state.now[0]], state.cov[state.now[0]]
        predict(measured, assumed, runs, t, before, plan, (x, covariance))
        for run in range(first, first + runs[1]):
            for k in range(pairs.start[t], pairs.start[t + 1]):
                if pairs.alive[first, k]:
                    i, j, p = pairs.first[k], pairs.second[k], k - pairs.start[t]
                    vector = subtract(load(x[run, t, j], 0, VECTOR), load(x[run, t, i], 0, VECTOR))
                    between = difference(plan, covariance, i, j)
                    one = pair_at_agreement(vector, between, k, pairs, measured.relative[run], assumed)
                    store(step.weight, p, one[0])
                    store(step.eta[run - first, p], 0, one[1])
        gather(measured, pairs, assumed, runs, t, (before, plan, state.now[1], covariance), step)
        for run in range(first, first + runs[1]):
            sum_vectors(measured, pairs, assumed, run, first, x[run, t], t, step)
        for component in range(state.now[1]):
            update(plan, component, covariance, step.information, step.near, step.scratch, step.total, step.moved)
            for run in range(runs[1]):
                write(plan, component, covariance, step.moved[run], x[first + run, t], cov[first + run, t])


@part
def predict(
    measured: Measured, assumed: Assumed, runs: Any, t: int, before: AnyArray, plan: AnyArray, belief: Any
) -> None:
    """x += dt u and P += Q; a vehicle that joins stands at its fix, and nothing is known of it."""
    x, covariance = belief
    for c in range(x.shape[2]):
        if plan[HOME, c] >= 0:
            process, diagonal = at(assumed.process, runs[0], t, c), plan[STRIDE, plan[HOME, c]] + 1
            for a in range(3):
                for run in range(runs[0], runs[0] + runs[1]):
                    moved = x[run, t - 1, c, a] + measured.dt * measured.velocity[run, t, c, a]
                    x[run, t, c, a] = moved if before[c] else measured.gnss[run, t, c, a]
                k = place(plan, c, c) + a * diagonal
                covariance[k] = covariance[k] + process[a] if before[c] else FORGOTTEN


@part
def difference(plan: AnyArray, covariance: AnyArray, i: int, j: int) -> Any:
    """Covariance of x_j - x_i; i before j."""
    a, b, c, step = place(plan, i, i), place(plan, j, j), place(plan, i, j), plan[STRIDE, plan[HOME, i]]
    xx = covariance[a] + covariance[b] - 2.0 * covariance[c]
    xy = covariance[a + 1] + covariance[b + 1] - covariance[c + 1] - covariance[c + step]
    xz = covariance[a + 2] + covariance[b + 2] - covariance[c + 2] - covariance[c + 2 * step]
    a, b, c = a + step + 1, b + step + 1, c + step + 1
    yy = covariance[a] + covariance[b] - 2.0 * covariance[c]
    yz = covariance[a + 1] + covariance[b + 1] - covariance[c + 1] - covariance[c + step]
    a, b, c = a + step + 1, b + step + 1, c + step + 1
    return from_upper((xx, xy, xz, yy, yz, covariance[a] + covariance[b] - 2.0 * covariance[c]))


@part
def gather(measured: Measured, pairs: Pairs, assumed: Assumed, runs: Any, t: int, belief: Any, step: Step) -> None:
    """The step's information, lower triangles, and the members that share a block of it.

    A vehicle that joins begins with half of the information of its fix, and learns the other half.
    """
    before, plan, components, covariance = belief
    info, near, first = step.information, step.near, runs[0]
    last = components - 1
    info[: plan[BASE, last] + plan[STRIDE, last] ** 2 if components > 0 else 0] = 0.0
    for component in range(components):
        members = slice(plan[BEGIN, component], plan[BEGIN, component + 1])
        near[members, members] = False
    for c in range(len(before)):
        fix, noise = measured.gnss[first, t, c], at(assumed.fix, first, t, c)
        for a in range(3 if plan[HOME, c] >= 0 else 0):
            k = place(plan, c, c) + a * (plan[STRIDE, plan[HOME, c]] + 1)
            info[k] = 0.0 if math.isnan(fix[a]) else (1.0 if before[c] else 0.5) / noise[a]
            if not before[c]:
                covariance[k] = 2.0 * noise[a]
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[first, k]:
            i, j, w = pairs.first[k], pairs.second[k], 9 * (k - pairs.start[t])
            stride, begin = plan[STRIDE, plan[HOME, i]], plan[BEGIN, plan[HOME, i]]
            near[begin + plan[ROW, i], begin + plan[ROW, j]] = near[begin + plan[ROW, j], begin + plan[ROW, i]] = True
            for p, sign in ((place(plan, i, i), 1.0), (place(plan, j, j), 1.0), (place(plan, j, i), -1.0)):
                for c in range(3):
                    for d in range(3):
                        info[p + c * stride + d] += sign * step.weight[w + 3 * c + d]


@part
def sum_vectors(
    measured: Measured, pairs: Pairs, assumed: Assumed, run: int, first: int, x: AnyArray, t: int, step: Step
) -> None:
    """Information vectors of fixes and pairs at each position, 1/m."""
    total, eta = step.total[run - first], step.eta[run - first]
    for c in range(len(total)):
        fix, noise = measured.gnss[run, t, c], at(assumed.fix, run, t, c)
        for a in range(3):
            total[c, a] = 0.0 if math.isnan(fix[a]) else (fix[a] - x[c, a]) / noise[a]
    for k in range(pairs.start[t], pairs.start[t + 1]):
        if pairs.alive[first, k]:
            for a in range(3):
                total[pairs.first[k], a] -= eta[k - pairs.start[t], a]
                total[pairs.second[k], a] += eta[k - pairs.start[t], a]


@part
def write(plan: AnyArray, component: int, covariance: AnyArray, moved: AnyArray, x: AnyArray, cov: AnyArray) -> None:
    """Positions of the members of a component and their own covariances."""
    members, stride = plan[MEMBER, plan[BEGIN, component] : plan[BEGIN, component + 1]], plan[STRIDE, component]
    for i in range(len(members)):
        k = plan[BASE, component] + 3 * i * (stride + 1)
        for c in range(3):
            x[members[i], c] += moved[3 * i + c]
            for d in range(3):
                cov[members[i], c, d] = covariance[k + min(c, d) * stride + max(c, d)]
