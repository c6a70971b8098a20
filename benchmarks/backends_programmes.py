"""CasADi's and OSQP's rows of backends.py."""

from typing import Any

import casadi
import numpy as np
import osqp
from backends_star import Job, Row, as_good, ours
from classical import KNOWN, NEIGHBOURS, SENSORS
from scipy.sparse import csc_matrix, triu

from coopoc.optimize import Problem
from coopoc.optimize.starts.initial import initial_guess

PLAIN = {"print_time": False}, {"print_level": 0}
"""Options of CasADi's plugin, and of IPOPT behind it."""


def casadi_exact(problems: list[Problem]) -> Job:
    """One programme whose measurements are parameters, by the same solver."""
    given = [(*(factor.z for factor in problem.factors), initial_guess(problem)) for problem in problems]
    std, fix_std = np.array(SENSORS.relative_std), np.array(KNOWN.gnss_std)
    quiet, inner = PLAIN

    def cost(x: Any, fix: Any, seen: Any) -> Any:
        """Of x and fix (3, n) and seen (3, K)."""
        gap = x[:, 1:] - casadi.repmat(x[:, 0], 1, NEIGHBOURS)
        flat = casadi.sqrt(gap[0, :] ** 2 + gap[1, :] ** 2)
        across = gap[1, :] * casadi.cos(seen[1, :]) - gap[0, :] * casadi.sin(seen[1, :])
        along = gap[0, :] * casadi.cos(seen[1, :]) + gap[1, :] * casadi.sin(seen[1, :])
        rest = casadi.vertcat(
            (casadi.sqrt(flat**2 + gap[2, :] ** 2) - seen[0, :]) / std[0],
            casadi.atan2(across, along) / std[1],
            (casadi.atan2(flat, gap[2, :]) - seen[2, :]) / std[2],
        )
        return 0.5 * (casadi.sumsqr((x - fix) / casadi.repmat(fix_std, 1, NEIGHBOURS + 1)) + casadi.sumsqr(rest))

    x, fix, relative = (
        casadi.SX.sym(name, 3, n) for name, n in (("x", NEIGHBOURS + 1), ("fix", NEIGHBOURS + 1), ("seen", NEIGHBOURS))
    )
    nlp = {"x": casadi.vec(x), "p": casadi.veccat(fix, relative), "f": cost(x, fix, relative)}
    solver = casadi.nlpsol("solver", "ipopt", nlp, {**quiet, "ipopt": inner})

    numbers = [(np.concatenate([fix.ravel(), seen.ravel()]), start.ravel()) for fix, seen, start in given]

    def each() -> Any:
        return np.stack([np.asarray(solver(x0=start, p=p)["x"]).reshape(-1, 3) for p, start in numbers])

    def opti() -> Any:
        found = []
        for fixes, edges, start in given[:2]:
            model = casadi.Opti()
            nodes = [model.variable(3) for _ in range(NEIGHBOURS + 1)]
            total = sum(casadi.sumsqr((node - fix) / fix_std) for node, fix in zip(nodes, fixes, strict=True))
            for node, (r, azimuth, inclination) in zip(nodes[1:], edges, strict=True):
                gap = node - nodes[0]
                flat = casadi.sqrt(gap[0] ** 2 + gap[1] ** 2)
                turn = casadi.atan2(gap[1], gap[0]) - azimuth
                turn = casadi.atan2(casadi.sin(turn), casadi.cos(turn))
                total += ((casadi.norm_2(gap) - r) / std[0]) ** 2 + (turn / std[1]) ** 2
                total += ((casadi.atan2(flat, gap[2]) - inclination) / std[2]) ** 2
            model.minimize(0.5 * total)
            for node, at in zip(nodes, start, strict=True):
                model.set_initial(node, at)
            model.solver("ipopt", quiet, inner)
            answer = model.solve()
            found.append([answer.value(node) for node in nodes])
        return np.stack(found)

    job = "casadi ipopt, snapshot, exact"
    return Job(
        [
            Row(job, "ours, solve() one by one", 20, ours(problems[:20], "casadi")),
            Row(job, "hand-written", len(given), each),
            Row(job, "Opti, rebuilt", 2, opti),
        ],
        as_good(problems),
    )


SIZE = 3 * (NEIGHBOURS + 1)


def osqp_linear(problems: list[Problem]) -> Job:
    """One workspace; P and q are ready before the clock starts. `update` writes into the P of `setup`."""
    runs = len(problems)
    rows = [problem.whiten(np.zeros((NEIGHBOURS + 1, 3))) for problem in problems]
    matrices = [csc_matrix(triu(J.T @ J, format="csc")) for _, J in rows]
    gradients = [np.asarray(J.T @ r) for r, J in rows]
    settings = {
        "scaling": 0,
        "rho": 1e-4,
        "alpha": 1.0,
        "eps_abs": 1e-9,
        "eps_rel": 1e-9,
        "max_iter": 200,
        "check_termination": 1,
        "adaptive_rho": 0,
        "verbose": False,
    }
    nothing = csc_matrix((0, SIZE)), np.empty(0), np.empty(0)

    persistent = osqp.OSQP()
    persistent.setup(matrices[0].copy(), gradients[0], *nothing, **settings)

    def batch() -> Any:
        found = []
        for matrix, gradient in zip(matrices, gradients, strict=True):
            persistent.update(Px=matrix.data, q=gradient)
            found.append(persistent.solve(raise_error=False).x)
        return np.stack(found).reshape(runs, -1, 3)

    job = "osqp, snapshot, converted"
    return Job(
        [
            Row(job, "ours, solve() one by one", 4, ours(problems[:4], "osqp")),
            Row(job, "hand-written", runs, batch),
        ],
        as_good(problems),
    )
