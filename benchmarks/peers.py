"""Peers that are no part of the project's environment, on the same problems: pyceres and Stone Soup.

    pip install -c constraints.txt -e ".[peers]"               # leaves all that the project has pinned as it is
    OMP_NUM_THREADS=1 python benchmarks/peers.py               # a Markdown table on stdout, half a minute

The exact star of ten neighbours of backends.py. Ceres has no factor for range, azimuth and inclination in the world
frame with a std each, so its users write one in Python; the fixes are its own NormalPrior, and its Schur complement
eliminates the neighbours. Stone Soup's rows are in stone_soup.py. "x peer" is a row's time over that of the job's peer;
a row counts only if its answer is that of the reference. A line names what is not installed. What the index has as
jaxls is a language server for JAX, not the solver of that name."""

import math
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
from backends import measured as measure
from backends_star import Job, Row, as_good, ours, stars
from classical import KNOWN, NEIGHBOURS, SENSORS
from timing import report

from coopoc.optimize import Problem
from coopoc.optimize.starts.initial import initial_guess

RUNS = 40


def relative_factor(z: Any, std: Any) -> Any:
    """A cost function of the ego's and a neighbour's position, derivatives by hand."""
    import pyceres

    class RelativeMeasurement(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(3)
            self.set_parameter_block_sizes([3, 3])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            (ax, ay, az), (bx, by, bz) = parameters[0].tolist(), parameters[1].tolist()
            x, y, up = bx - ax, by - ay, bz - az
            flat2 = x * x + y * y
            flat, r2 = math.sqrt(flat2), flat2 + up * up
            r = math.sqrt(r2)
            residuals[0] = (r - z[0]) / std[0]
            residuals[1] = math.remainder(math.atan2(y, x) - z[1], math.tau) / std[1]
            residuals[2] = (math.atan2(flat, up) - z[2]) / std[2]
            if jacobians is None:
                return True
            a, b, c = 1.0 / (r * std[0]), 1.0 / (flat2 * std[1]), 1.0 / (flat * r2 * std[2])
            derivative = np.array([a * x, a * y, a * up, -b * y, b * x, 0.0, c * x * up, c * y * up, -c * flat2])
            for jacobian, sign in zip(jacobians, (-1.0, 1.0), strict=True):
                if jacobian is not None:
                    jacobian[:] = sign * derivative
            return True

    return RelativeMeasurement()


def ceres_exact(problems: list[Problem]) -> Job:
    """One Ceres problem per realisation: priors of its own, Python's cost functions, a dense Schur complement."""
    import pyceres

    spread, std = np.diag(np.square(KNOWN.gnss_std)), list(SENSORS.relative_std)
    given = [(fixes.z, edges.z.tolist()) for fixes, edges in (problem.factors for problem in problems)]
    starts = [initial_guess(problem) for problem in problems]
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.logging_type = pyceres.LoggingType.SILENT
    options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = 1e-10

    def one(fixes: Any, z: Any, start: Any) -> Any:
        model, points = pyceres.Problem(), [each.copy() for each in start]
        for point, fix in zip(points, fixes, strict=True):
            model.add_residual_block(pyceres.factors.NormalPrior(fix, spread), None, [point])
        for k in range(NEIGHBOURS):
            model.add_residual_block(relative_factor(z[k], std), None, [points[0], points[k + 1]])
        pyceres.solve(options, model, pyceres.SolverSummary())
        return points

    job = "snapshot, exact"
    return Job(
        [
            Row(job, "gauss-newton", RUNS, ours(problems, "gauss-newton")),
            Row(job, "pyceres", RUNS, lambda: np.stack([one(*of, at) for of, at in zip(given, starts, strict=True)])),
        ],
        as_good(problems),
    )


def measured() -> list[dict[str, Any]]:
    """As `backends.measured`; a line on stderr for each peer that is not installed."""
    return measure([job for peer, jobs in PEERS.items() if found(peer) for job in jobs()])


def found(peer: str) -> bool:
    """Whether it is installed."""
    if find_spec(peer) is not None:
        return True
    print(f"peers: {peer} is not installed, its rows are left out", file=sys.stderr)
    return False


def of_stone_soup() -> list[Job]:
    """Its jobs; the import needs it."""
    from stone_soup import joint_filter, snapshot

    return [snapshot(), joint_filter()]


PEERS: dict[str, Callable[[], list[Job]]] = {
    "pyceres": lambda: [ceres_exact(stars(RUNS))],
    "stonesoup": of_stone_soup,
}
"""By the package that they need."""


if __name__ == "__main__":
    print(report(measured()))
