"""Whether a cost is what the stated noise makes of the measurements: its degrees of freedom, and the tail beyond it."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats
from ..model.derivatives import linearise
from ..model.factor import Factor, unchecked
from ..model.problem import Problem

TAIL = 1e-6
"""Probability below which a cost, or one above it, is not explained by the noise that is stated."""
REJECTED = 0.5
"""Weight rho' below which a robust loss rejects a measurement."""


def judged(problem: Problem, x: Floats, cost: float) -> tuple[float, tuple[str, ...]]:
    """The expected cost at a minimum x (n, ambient) of a single problem, and what is to be said of it.

    Measurements that a robust loss rejects count neither in the cost nor in what is expected.
    """
    unknowns = len(x) * problem.space.dof if problem.movable is None else int(np.count_nonzero(problem.movable))
    robust = [factor for factor in problem.factors if factor.loss is not None]
    notes, spent, out = list[str](), 0.0, 0
    for factor in robust:
        square = squared(problem, factor, x)
        assert factor.loss is not None
        beyond = np.asarray(factor.loss.weight(square)) < REJECTED
        spent, out = spent + 0.5 * float(factor.loss.cost(square[beyond]).sum()), out + factor.size * int(beyond.sum())
        if beyond.any():
            notes.append(f"{factor.loss.name} loss rejects {beyond.sum()} of {len(square)} measurements {factor.kind}")
    mean, variance = expected(problem, unknowns + out)
    if implausible(cost - spent, mean, variance):
        notes.append(
            f"cost {cost - spent:.4g} where the stated noise explains {mean:.3g} +- {np.sqrt(variance):.2g}: a local "
            "minimum (try other x0, or certify it), outliers, or noise that is stated too small"
        )
    return mean + spent, tuple(notes)


def squared(problem: Problem, factor: Factor, x: Floats) -> Floats:
    """(M,) |W (h(x) - z)|^2 of the measurements of a factor at x (n, ambient)."""
    (residual,) = linearise(problem.space, [unchecked(factor, loss=None)], None, x[None]).residual
    return np.asarray(np.square(residual[0]).sum(axis=-1))


def implausible(cost: float, mean: float, variance: float) -> bool:
    """Whether a cost lies in the upper TAIL of 2 cost / g ~ chi-square with h degrees of freedom, g = variance / mean
    and h = 2 mean / g, which has this mean and variance (Satterthwaite); g = 1 but for angles of rotation matrices."""
    if cost <= mean + 3.0 * np.sqrt(variance) or not mean > 0:
        return False
    from scipy.special import gammaincc

    scale = variance / mean
    return bool(gammaincc(mean / scale, cost / scale) < TAIL)


def expected(problem: Problem, unknowns: int) -> tuple[float, float]:
    """Mean and variance of the cost at its minimum under the noise that it assumes.

    Each number that is measured or held by a constraint beyond the unknowns adds 1/2 to both. The entries of a rotation
    matrix count as the angles that they hold; in the plane kappa |R_j - R_i R_ij|_F^2 is twice the square of the
    angle's error over its variance, and adds 1 and 2.
    """
    d, angles = problem.dimension, problem.space.angles
    matrices = sum(len(f.nodes) for f in problem.factors if f.kind in ("pose_chordal", "relative_pose_chordal"))
    spare = (
        sum(f.size * int(np.count_nonzero(f.informative)) for f in problem.factors)
        - (d * d - angles) * matrices
        - unknowns
    )
    spare += sum(int(np.isfinite(side).sum()) for c in problem.constraints for side in (c.lower, c.upper))
    turns = matrices - len({*problem.poses} - {*problem.fixed}) if matrices and d == 2 else 0
    mean = 0.5 * (max(spare, 0) + max(turns, 0))
    return mean, mean + max(turns, 0)
