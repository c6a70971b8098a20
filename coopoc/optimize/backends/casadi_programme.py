"""CasADi's programme of a structure, built once, and its solvers."""

from __future__ import annotations

import shutil
import subprocess
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..symbolic import Structure, expressions

QUIET = {"print_time": False, "calc_lam_p": False, "show_eval_warnings": False, "error_on_fail": False}
IPOPT = {
    "print_level": 0, "sb": "yes", "nlp_scaling_method": "none", "bound_relax_factor": 0.0,
    "tol": 1e-12, "constr_viol_tol": 1e-9, "compl_inf_tol": 1e-18,
    "acceptable_tol": 1e-8, "acceptable_iter": 3, "acceptable_constr_viol_tol": 1e-8, "acceptable_compl_inf_tol": 1e-17,
}  # fmt: skip
"""For a cost scaled to a curvature of 1; what `tol` asks may lie below rounding, hence the acceptable level."""
FATROP = {"print_level": 0, "tolerance": 1e-12, "tol_acceptable": 1e-8, "acceptable_iter": 3}
SQP = {
    "print_header": False, "print_iteration": False, "print_status": False, "qpsol": "qrqp",
    "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False},
    "tol_pr": 1e-10, "tol_du": 1e-12,
}  # fmt: skip
COARSE = {"tol_pr": 1e-6, "tol_du": 1e-3}
"""How near the steps with J^T J come before the exact Hessian takes over."""
ENOUGH = 60
"""Of them: where residuals are large they creep."""


@dataclass(frozen=True, eq=False)
class Programme:
    """What is built once.

    Args:
        structure: of the problems that it solves. method: "fatrop", "ipopt" or "sqp".
        solvers: CasADi's nlpsol objects, each starts where the one before it ended.
    """

    structure: Structure
    method: str
    solvers: tuple[Any, ...]

    def ready(self) -> list[Solver]:
        """The solvers with memory of their own."""
        return [Solver(solver) for solver in self.solvers]


class Solver:
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
        """x and the multipliers where it ends, iterations and what it says; x is NaN where nothing could be evaluated.

        Args:
            x: start. p: parameters. sides: lower and upper of the constraints. multipliers: of them, at the start.
        """
        for name, value in (("x0", x), ("p", p), ("lbg", sides[0]), ("ubg", sides[1]), ("lam_g0", multipliers)):
            self._given[name][:] = value
        self._found["x"][:] = np.nan
        self._evaluate()
        found, stats = self._found, self._buffer.stats()
        said = stats["return_status"]
        if isinstance(said, int):  # fatrop has one number for all that is not a success
            said = "Solve_Succeeded" if stats["success"] else "Not_Solved"
        return found["x"].copy(), found["lam_g"].copy(), int(stats["iter_count"]), said


@lru_cache(maxsize=64)
def programme(structure: Structure, method: str, max_iterations: int, codegen: bool) -> Programme:
    """The programme of a structure, kept for the next problems that share it."""
    import casadi as ca

    found = expressions(structure)
    flat, scale = found.pop("flat"), ca.SX.sym("scale")
    x, p = found["x"], ca.vertcat(found["p"], scale)
    nlp = {**found, "p": p, "f": scale * found["f"]}
    if method == "ipopt":
        options = {**QUIET, "ipopt": {**IPOPT, "max_iter": max_iterations}}
        return Programme(structure, method, (_compiled("ipopt", nlp, options, codegen),))
    if method == "fatrop":
        options = {**QUIET, "structure_detection": "none", "fatrop": {**FATROP, "max_iter": max_iterations}}
        return Programme(structure, method, (_compiled("fatrop", nlp, options, codegen),))
    pulls = [ca.SX.sym("lam_f"), ca.SX.sym("lam_g", *found["g"].shape)]
    names = ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"]
    gauss = ca.Function("gauss", [x, p, *pulls], [pulls[0] * scale * flat], *names)
    coarse = {**QUIET, **SQP, **COARSE, "max_iter": min(max_iterations, ENOUGH), "hess_lag": gauss}
    fine = {**QUIET, **SQP, "max_iter": max_iterations}
    solvers = tuple(_compiled("sqpmethod", nlp, options, codegen) for options in (coarse, fine))
    return Programme(structure, method, solvers)


def _compiled(name: str, nlp: dict[str, Any], options: dict[str, Any], codegen: bool) -> Any:
    """CasADi's solver, its functions interpreted or compiled."""
    import casadi as ca

    solver = ca.nlpsol("solver", name, nlp, options)
    if not codegen:
        return solver
    code = ca.CodeGenerator("nlp")
    code.add(solver.oracle())
    for function in solver.get_function():
        code.add(solver.get_function(function))
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        code.generate(f"{folder}/")
        return ca.nlpsol("solver", name, _compile(Path(folder) / "nlp.c"), options)


def _compile(source: Path) -> str:
    """The shared library of a C file."""
    from tqdm import tqdm

    gcc = shutil.which("gcc")
    if gcc is None:
        raise InputError("codegen", True, "needs gcc on the PATH", "Install gcc, or leave codegen out: it buys little.")
    library = str(source.with_suffix(".so"))
    command = [gcc, "-O1", "-fPIC", "-shared", str(source), "-o", library, "-lm"]
    with subprocess.Popen(command) as compiler, tqdm(bar_format="gcc: {elapsed}", delay=2.0) as bar:
        while compiler.poll() is None:
            time.sleep(0.05)
            bar.update()
        if compiler.returncode:
            raise subprocess.CalledProcessError(compiler.returncode, command)
    return library
