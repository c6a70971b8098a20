"""OSQP's rows of backends.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp
from backends_star import Job, Row, as_good, ours, single
from classical import NEIGHBOURS
from scipy.sparse import csc_matrix, triu

from coopoc.optimize import Problem

SIZE = 3 * (NEIGHBOURS + 1)


def osqp_linear(problem: Problem) -> Job:
    """One workspace; P and q are ready before the clock starts. `update` writes into the P of `setup`."""
    runs = problem.batch or 1
    rows = [problem.pick(b).whiten(np.zeros((NEIGHBOURS + 1, 3))) for b in range(runs)]
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

    def workspace(b: int) -> Any:
        made = osqp.OSQP()
        made.setup(matrices[b].copy(), gradients[b], *nothing, **settings)
        return made

    persistent = workspace(0)

    def batch() -> Any:
        found = []
        for matrix, gradient in zip(matrices, gradients, strict=True):
            persistent.update(Px=matrix.data, q=gradient)
            found.append(persistent.solve(raise_error=False).x)
        return np.stack(found).reshape(runs, -1, 3)

    def bare() -> Any:
        """By the extension module that osqp's Python class calls."""
        found, core = [], persistent._solver
        for matrix, gradient in zip(matrices, gradients, strict=True):
            core.update_data_vec(gradient, None, None)
            core.update_data_mat(matrix.data, None, None, None)
            core.solve()
            found.append(core.solution.x)
        return np.stack(found).reshape(runs, -1, 3)

    def setups() -> Any:
        return np.stack([workspace(b).solve(raise_error=False).x for b in range(10)]).reshape(10, -1, 3)

    job = "osqp, snapshot, converted"
    return Job(
        [
            Row(job, "ours", runs, ours(problem, "osqp", runs)),
            Row(job, "hand-written", runs, batch),
            Row(job, "hand-written, without osqp's Python class", runs, bare),
            Row(job, "setup at each solve", 10, setups),
            Row(job, "ours, solve() one by one", 4, single(problem, "osqp", 4)),
        ],
        as_good(problem),
    )
