"""CasADi's programme of a structure, built once, and its solver."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats
from ..model.symbolic import Structure, expressions

QUIET = {"print_time": False, "calc_lam_p": False, "show_eval_warnings": False, "error_on_fail": False}
IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "nlp_scaling_method": "none",
    "bound_relax_factor": 0.0,
    "tol": 1e-12,
    "constr_viol_tol": 1e-9,
    "compl_inf_tol": 1e-18,
    "acceptable_tol": 1e-8,
    "acceptable_iter": 3,
    "acceptable_constr_viol_tol": 1e-8,
    "acceptable_compl_inf_tol": 1e-17,
}
"""For a cost scaled to a curvature of 1; what `tol` asks may lie below rounding, hence the acceptable level."""
FATROP = {"print_level": 0, "tolerance": 1e-12, "tol_acceptable": 1e-8, "acceptable_iter": 3}


@dataclass(frozen=True, eq=False)
class Programme:
    """A programme, built once.

    Args:
        structure: of the problems that it solves.
        method: "fatrop" or "ipopt".
        solver: CasADi's nlpsol.
    """

    structure: Structure
    method: str
    solver: Any


class NlpSolver:
    """CasADi's nlpsol, whose numbers go in and out by memory that is shared with it.

    Its call makes a matrix of every number and output: of 770 us for a star of ten, 100. Each has a memory of its own.

    Args:
        solver: the nlpsol.
    """

    def __init__(self, solver: Any) -> None:
        self._buffer, self._evaluate = solver.buffer()
        self._given: dict[str, Any] = {name: np.zeros(solver.nnz_in(i)) for i, name in enumerate(solver.name_in())}
        self._found: dict[str, Any] = {name: np.zeros(solver.nnz_out(i)) for i, name in enumerate(solver.name_out())}
        for i, array in enumerate(self._given.values()):
            self._buffer.set_arg(i, memoryview(array))
        for i, array in enumerate(self._found.values()):
            self._buffer.set_res(i, memoryview(array))
        self._given["lbx"][:], self._given["ubx"][:] = -np.inf, np.inf

    def __call__(self, x: Floats, p: Floats, sides: tuple[Floats, Floats], multipliers: Floats) -> tuple[Any, ...]:
        """x and the multipliers where it ends, iterations and status; x is NaN where nothing could be evaluated.

        Args:
            x: start.
            p: parameters.
            sides: lower and upper of the constraints.
            multipliers: of them, at the start.
        """
        for name, value in (("x0", x), ("p", p), ("lbg", sides[0]), ("ubg", sides[1]), ("lam_g0", multipliers)):
            self._given[name][:] = value
        self._found["x"][:] = np.nan
        self._evaluate()
        found, stats = self._found, self._buffer.stats()
        status = stats["return_status"]
        if isinstance(status, int):  # fatrop has one number for all that is not a success
            status = "Solve_Succeeded" if stats["success"] else "Not_Solved"
        return found["x"].copy(), found["lam_g"].copy(), int(stats["iter_count"]), status


@lru_cache(maxsize=64)
def programme(structure: Structure, method: str, max_iterations: int) -> Programme:
    """The programme of a structure, kept for the next problems that share it."""
    import casadi as ca

    found, scale = expressions(structure), ca.SX.sym("scale")
    nlp = {**found, "p": ca.vertcat(found["p"], scale), "f": scale * found["f"]}
    own: dict[str, dict[str, Any]] = {
        "ipopt": {"ipopt": {**IPOPT, "max_iter": max_iterations}},
        "fatrop": {"structure_detection": "none", "fatrop": {**FATROP, "max_iter": max_iterations}},
    }
    return Programme(structure, method, ca.nlpsol("solver", method, nlp, {**QUIET, **own[method]}))
