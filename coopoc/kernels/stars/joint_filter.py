"""The joint filter of a star: predict in information form, add fixes, then relative measurements by Gauss-Newton.

No matrix is ever inverted as a whole.
"""

from __future__ import annotations

from ..compiling.compile import as_written, inner
from ..compiling.small import add, add_diagonal, load, negate, store, subtract, times
from ..compiling.vectors import LANES
from .gated import Gates, carry, gate_star, gates_within, set_ego
from .joint import (
    Joint,
    add_relative,
    block_of,
    copy,
    exact_information,
    joint_within,
    move,
    place_on_broadcast,
    placed,
    predict,
    predict_state,
    rearrange,
    relative_information,
    solve,
)
from .messages import (
    NONE,
    RELATIVE,
    Assumptions,
    Estimates,
    Measurements,
    Star,
    block_at,
    clear,
    fix_information,
    gather,
    largest,
    new_estimates,
    position_of,
    star_within,
    vector_at,
)


@as_written
def run_filter(measurements: Measurements, model: Assumptions, refine: bool, robust: bool) -> Estimates:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m.

    Args:
        measurements: measurements and messages of the ego.
        model: noise model.
        refine: one Gauss-Newton step on range and angles.
        robust: gate innovations.
    """
    runs, steps = measurements.gnss.shape[:2]
    out = new_estimates(measurements)
    most = largest(measurements.start)
    for first in range(0, runs, LANES):
        last, old = min(first + LANES, runs) - 1, NONE
        star, before, joint, gates = star_within(most), star_within(most), joint_within(most), gates_within(most)
        for t in range(steps):
            star, before = before, star
            n = gather(star, before, measurements, model, first, last, t, old)
            step(star, joint, gates, model, refine, robust, n, old)
            write(out, joint, first, last, t, measurements.start[t], n)
            old = n
    return out


@inner
def write(out: Estimates, joint: Joint, first: int, last: int, t: int, link: int, n: int) -> None:
    """Copy the estimates of a step in runs first to last; `link` is its first link."""
    x, cov, neighbours = out
    for lane in range(last - first + 1):
        for i in range(3):
            x[first + lane, t, i] = joint.state[i, lane]
            for j in range(3):
                cov[first + lane, t, i, j] = joint.scratch[3 * min(i, j) + max(i, j), lane]
            for k in range(1, n):
                neighbours[first + lane, link + k - 1, i] = joint.state[3 * k + i, lane]


@inner
def step(
    star: Star, joint: Joint, gates: Gates, model: Assumptions, refine: bool, robust: bool, n: int, old: int
) -> None:
    """Predict and update the state of n members, `old` of them before; the ego's covariance is then in `scratch`."""
    flat = 1.0 / model.flat
    predict_state(star, joint, n, old)
    predict(joint.information, old, joint.stride, joint.process, joint.scratch)
    rearrange(star, joint, n, old, (flat, flat, flat))
    place_on_broadcast(star, joint, n)
    if robust:
        carry(star, gates, model.flat, n, old)
        for k in range(1, n):
            store(joint.move, k, (placed(joint, k, load(star.relative, k, RELATIVE)),))
        gate_star(star, gates, joint.state, joint.move, model.min_range, n)
    clear(joint.eta)
    add_fixes(star, joint, n)
    update(star, joint, model, refine, n)
    set_ego(gates, block_at(joint.scratch, 0))


@inner
def add_fixes(star: Star, joint: Joint, n: int) -> None:
    """Add every member's position as broadcast."""
    for k in range(n):
        weight, i = fix_information(star, k), block_of(k, n)
        gap, at = subtract(position_of(star, k), vector_at(joint.state, k)), i * joint.stride + i
        store(joint.information, at, add_diagonal(block_at(joint.information, at), weight))
        store(joint.eta, i, add(vector_at(joint.eta, i), times(weight, gap)))


@inner
def update(star: Star, joint: Joint, model: Assumptions, refine: bool, n: int) -> None:
    """Add the relative measurements, converted at the predicted geometry, and solve; to refine, solve a copy and add
    them once more, exact, linear at that solution."""
    last = 1 if refine and n > 1 else 0
    clear(joint.move)
    for stage in range(last + 1):
        a, eta = joint.information, joint.eta
        if stage < last:
            a, eta = joint.factor, joint.move
            copy(joint.information, a, n, joint.stride)
            for i in range(n):
                store(eta, i, vector_at(joint.eta, i))
        for k in range(1, n):
            if stage == 1:
                weight, vector = exact_information(star, joint, k, n, model.min_range)
            else:
                weight, vector = relative_information(star, joint, k, model.relative_std, model.min_range)
            add_relative(a, eta, joint.stride, k, n, weight, vector)
        store(joint.scratch, 0, negate(solve(a, joint, eta, n)))
    move(joint, n)
