"""The libraries through `coopoc.optimize` against a hand-written loop on the same library, and the plain rebuilt way.

    OMP_NUM_THREADS=1 python benchmarks/backends.py            # a Markdown table on stdout, about a minute

A star of ten neighbours, as many noise realisations as a row names. Ours is what a user writes, `solve(problem,
backend)`: start, whitening, the check of every answer and the covariances are in its time. The hand-written loops keep
what they can between two solves, get whitened arrays or starts that are prepared before their clock starts, and give x
only. Rows of a job are timed one after the other in every round; times are this thread's own, medians of rounds. "x
hand-written" is a row's time over that of the loop. A row counts only if its answer is that of gauss-newton: cost
within 1e-6 relative and positions within 1 mm.
"""

from typing import Any

import numpy as np
from backends_gtsam import gtsam_linear
from backends_programmes import casadi_exact, osqp_linear
from backends_star import Job, one_by_one, stars
from timing import report, timed

from coopoc.optimize import Factor
from coopoc.optimize.model.factor import unchecked
from coopoc.optimize.model.measurements import converted_rows

ROUNDS, RUNS = 7, 200


def as_vectors(factor: Factor) -> Factor:
    """A spherical factor as one of measured vectors, with the covariance turned by the measured angles."""
    d, rows = converted_rows([*factor.z.T], np)
    inverse = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    z, nothing = d[:, None] * inverse[:, 0], np.empty((len(factor.nodes), 0))
    root = factor.root @ inverse
    return unchecked(factor, kind="displacement", z=z, std=None, sqrt_information=root, constants=nothing, loss=None)


def jobs(runs: int = RUNS) -> list[Job]:
    """All of them; a call of each has run once."""
    exact = stars(runs)
    linear = [
        star.replace_unchecked(factors=tuple(as_vectors(f) if f.kind == "spherical" else f for f in star.factors))
        for star in exact
    ]
    return [
        gtsam_linear(linear),
        casadi_exact(exact),
        osqp_linear(linear),
        one_by_one(linear, "converted"),
        one_by_one(exact, "exact"),
    ]


def measured(found: list[Job] | None = None, rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Per row its name, microseconds per solve, the ratio to the hand-written loop and whether its answer is right."""
    out: list[dict[str, Any]] = []
    for job in jobs() if found is None else found:
        right = [job.right(row.call()) if row.judged else None for row in job.rows]
        spent = np.array([[timed(row.call) / row.solves for row in job.rows] for _ in range(rounds)])
        medians = np.median(spent, axis=0)
        for row, median, good in zip(job.rows, medians, right, strict=True):
            out.append(
                {
                    "name": f"{row.job}: {row.words}",
                    "us": 1e6 * float(median),
                    "ratio": float(median / medians[1]),
                    "right": good,
                }
            )
    return out


if __name__ == "__main__":
    print(report(measured()))
