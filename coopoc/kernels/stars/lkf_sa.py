"""The Laplacian Kalman filter (LKF-SA) of an ego's star, in the blocks of the joint filter."""

from ..compiling.compile import as_written, inner, inside
from ..compiling.small import add, add_diagonal, negate, scale, store, subtract, zeros
from ..compiling.vectors import LANES, choose
from ..geometry import Numbers, metres, vector, whole
from .joint_filter import (
    Joint,
    add_fixes,
    add_relative,
    joint_within,
    move,
    predict,
    predict_state,
    rearrange,
    solve,
    write,
)
from .messages import (
    BLOCK,
    NONE,
    Assumptions,
    Estimates,
    Measurements,
    Star,
    block_at,
    clear,
    gather,
    new_estimates,
    relative_of,
    star_within,
    vector_at,
)


@as_written
def run_lkf_sa(measurements: Measurements, model: Assumptions) -> Estimates:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m."""
    runs, steps = measurements.gnss.shape[:2]
    out = new_estimates(measurements)
    most = measurements.most
    for first in range(0, runs, LANES):
        last, old = min(first + LANES, runs) - 1, NONE
        star, before, joint = star_within(most), star_within(most), joint_within(most)
        for t in range(steps):
            star, before = before, star
            n = gather(star, before, measurements, model, first, last, t, old)
            step(star, joint, model, n, old)
            write(out, joint.state, joint.scratch, first, last, t, measurements.start[t], n)
            old = n
    return out


@inner
def step(star: Star, joint: Joint, model: Assumptions, n: int, old: int) -> None:
    """Predict, add fixes and the Laplacian's measurement, and solve; the ego's covariance is then in `scratch`."""
    flat = 1.0 / model.flat
    predict_state(star, joint, n, old)
    for k in range(1, n):
        if star.previous[k] < 0:
            measured = vector(relative_of(star, k))
            store(joint.state, k, add(vector_at(joint.state, 0), measured))
    predict(joint.information, old, joint.stride, joint.process, joint.scratch)
    rearrange(star, joint, n, old, (flat, flat, flat))
    clear(joint.eta)
    add_fixes(star, joint, n)
    add_laplacian(star, joint, model, n)
    store(joint.scratch, 0, negate(solve(joint.information, joint, joint.eta, n)))
    move(joint, n)


@inner
def add_laplacian(star: Star, joint: Joint, model: Assumptions, n: int) -> None:
    """Add L W L and L W (delta - L x), L the Laplacian of the star of complete measurements: W is 1, or the edges'
    information over the degree; that of an edge is the inverse mean variance per axis of the converted vectors."""
    o, std, stride, e = 0.0 * vector_at(joint.state, 0)[0], model.relative_std, joint.stride, n - 1
    count, total, gaps = o, o, (o, o, o)
    for k in range(1, n):
        edge, gap = edge_to(star, joint, k)
        count, gaps = count + edge, add(gaps, gap)
        if len(std):
            a, b, c = metres(relative_of(star, k), std, model.min_range)
            total = total + edge * (a * a + b * b + c * c)
    outer = central = o + 1.0
    if len(std):
        outer = choose(count, 3.0 * count / max(total, o + 1e-300), outer)
        central = outer / max(count, o + 1.0)
    for k in range(1, n):
        edge, gap = edge_to(star, joint, k)
        weight = add_diagonal(zeros(o, BLOCK), (outer * edge, outer * edge, outer * edge))
        add_relative(joint.information, joint.eta, stride, k, n, weight, scale(gap, outer))
    for i in range(n):
        row = count if i == e else -edge_to(star, joint, i + 1)[0]
        store(joint.eta, i, subtract(vector_at(joint.eta, i), scale(gaps, row * central)))
        for j in range(i, n):
            other = count if j == e else -edge_to(star, joint, j + 1)[0]
            at, number = i * stride + j, central * row * other
            block = add_diagonal(block_at(joint.information, at), (number, number, number))
            store(joint.information, at, block)


@inside
def edge_to(star: Star, joint: Joint, k: int) -> tuple[float, Numbers]:
    """1 if the measurement of member k is complete, else 0; the measured vector less the predicted one m, or 0."""
    polar = relative_of(star, k)
    edge = whole(polar)
    gap = subtract(vector(polar), subtract(vector_at(joint.state, k), vector_at(joint.state, 0)))
    return edge, scale(gap, edge)
