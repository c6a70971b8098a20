"""Range-only cooperative localization as a QCQP: how good is the local solution? A lower bound tells.

One ego and its neighbours have GNSS fixes and the ranges between them, no angles. The cost

    1/2 sum_i |x_i - z_i|^2 / sigma_g^2 + 1/2 sum_j (|x_j - x_0| - r_j)^2 / sigma_r^2

is not convex. With a unit vector s_j per range, (|v| - r)^2 = min over |s| = 1 of |v - r s|^2, so that it is a
quadratic programme with quadratic equalities; the positions are eliminated, and replacing [1, s][1, s]^T by a positive
semidefinite matrix Y with unit blocks gives Shor's relaxation, a semidefinite programme whose value no position can
beat (CORA, arXiv 2302.11614). Where Y has rank one the bound is attained: the rounded point is a global optimum.

Run:  python examples/range_only.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np

from coopoc.arrays import Floats
from coopoc.optimize import Problem, solve

GNSS_STD, RANGE_STD = 3.5, 1.0


@dataclass(frozen=True)
class Row:
    """One snapshot: neighbours, lower bound, cost of the rounded and refined point, second over first eigenvalue of Y,
    cost that Gauss-Newton reaches from the fixes alone."""

    neighbours: int
    bound: float
    cost: float
    rank_ratio: float
    from_fixes: float


def snapshot(neighbours: int, seed: int, spread: float = 20.0) -> Problem:
    """A range-only star with the noise of the paper's second scenario, started from its fixes."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.zeros((1, 3)), rng.uniform(-spread, spread, (neighbours, 3)) * [1, 1, 0.1]])
    fixes = truth + GNSS_STD * rng.standard_normal(truth.shape)
    ranges = np.linalg.norm(truth[1:] - truth[0], axis=1) + RANGE_STD * rng.standard_normal(neighbours)
    names = ("ego", *(f"v{j}" for j in range(1, neighbours + 1)))
    pairs = [("ego", name) for name in names[1:]]
    problem = Problem(names, hub=(0,)).add("position", names, fixes, std=GNSS_STD)
    return problem.add("range", pairs, np.abs(ranges)[:, None], std=RANGE_STD)


def shor(neighbours: int) -> Callable[[Floats], tuple[float, Floats]]:
    """Solver of min <C, Y> over Y >= 0 with Y_00 = 1 and unit blocks, built once: C is a parameter (DPP)."""
    size = 3 * neighbours + 1
    objective = cp.Parameter((size, size), symmetric=True)
    gram = cp.Variable((size, size), PSD=True)
    diagonal = cp.diag(gram)
    units = [cp.sum(diagonal[1 + 3 * j : 4 + 3 * j]) == 1 for j in range(neighbours)]
    programme = cp.Problem(cp.Minimize(cp.sum(cp.multiply(objective, gram))), [gram[0, 0] == 1, *units])

    def relax(cost: Floats) -> tuple[float, Floats]:
        objective.value = cost
        programme.solve(solver=cp.CLARABEL)
        return float(programme.value), np.asarray(gram.value)

    return relax


def eliminate_positions(problem: Problem) -> tuple[Floats, Callable[[Floats], Floats]]:
    """C with cost = y^T C y at y = [1, s], and the positions (n, 3) that belong to unit vectors s (m, 3).

    The residual A x - (b + G s) is projected on what x cannot reach: C = 1/2 [b G]^T (I - A A^+) [b G].
    """
    fixes, ranges = problem.factors
    n, m = len(fixes.z), len(ranges.z)
    centre = fixes.z.mean(axis=0)
    incidence = np.zeros((m, n))
    incidence[np.arange(m), ranges.nodes[:, 0]], incidence[np.arange(m), ranges.nodes[:, 1]] = -1.0, 1.0
    A = np.kron(np.concatenate([np.eye(n) / GNSS_STD, incidence / RANGE_STD]), np.eye(3))
    b = np.concatenate([(fixes.z - centre).ravel() / GNSS_STD, np.zeros(3 * m)])
    G = np.kron(np.concatenate([np.zeros((n, m)), np.diag(ranges.z[:, 0]) / RANGE_STD]), np.eye(3))
    inverse = np.linalg.pinv(A)
    seen = np.column_stack([b, G])
    rest = seen - A @ (inverse @ seen)

    def positions(s: Floats) -> Floats:
        at: Floats = (inverse @ (b + G @ s.ravel())).reshape(n, 3) + centre
        return at

    return 0.5 * rest.T @ rest, positions


def bound_and_refine(problem: Problem, relax: Callable[[Floats], tuple[float, Floats]]) -> Row:
    """Lower bound, rounding by the top eigenvector, refinement by Gauss-Newton."""
    cost, positions = eliminate_positions(problem)
    bound, gram = relax(cost)
    values, vectors = np.linalg.eigh(gram)
    top = vectors[1:, -1] * np.sign(vectors[0, -1])
    units = top.reshape(-1, 3)
    units = units / np.linalg.norm(units, axis=1, keepdims=True)
    refined = solve(replace(problem, x0=positions(units)))
    return Row(len(units), bound, refined.cost, float(values[-2] / values[-1]), solve(problem).cost)


def main(seeds: int = 3) -> list[Row]:
    """Print and return the rows of a few snapshots with 3, 6 and 10 neighbours."""
    rows = []
    print(f"{'K':>3} {'lower bound':>12} {'cost':>12} {'gap':>9} {'rank ratio':>11} {'from fixes':>12}")
    for neighbours in (3, 6, 10):
        relax = shor(neighbours)
        for seed in range(seeds):
            row = bound_and_refine(snapshot(neighbours, seed), relax)
            gap = (row.cost - row.bound) / row.cost
            print(
                f"{row.neighbours:3d} {row.bound:12.6f} {row.cost:12.6f} {gap:9.1e} {row.rank_ratio:11.1e} "
                f"{row.from_fixes:12.6f}"
            )
            rows.append(row)
    tight = sum(row.rank_ratio < 1e-5 for row in rows)
    print(f"{tight} of {len(rows)} relaxations are tight: their refined point is a global optimum.")
    return rows


if __name__ == "__main__":
    main()
