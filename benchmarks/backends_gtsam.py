"""GTSAM's rows of backends.py."""

from typing import Any

import gtsam
import numpy as np
from backends_star import Job, Row, as_good, ours
from classical import KNOWN, NEIGHBOURS

from coopoc.optimize import Problem


def gtsam_linear(problems: list[Problem]) -> Job:
    """Prior and Between factors of the converted problem."""
    given = [(fixes.z, edges.z, edges.root) for fixes, edges in (problem.factors for problem in problems)]
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))
    zero, keys = gtsam.Values(), range(NEIGHBOURS + 1)
    for k in keys:
        zero.insert(k, np.zeros(3))

    def one(fix: Any, vector: Any, root: Any) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        for k in keys:
            graph.add(gtsam.PriorFactorPoint3(k, fix[k], model))
        for k in range(NEIGHBOURS):
            edge = gtsam.noiseModel.Gaussian.SqrtInformation(root[k], False)
            graph.add(gtsam.BetweenFactorPoint3(0, k + 1, vector[k], edge))
        return graph.linearize(zero).optimize().vector().reshape(-1, 3)

    def each() -> Any:
        return np.stack([one(*numbers) for numbers in given])

    job = "gtsam, snapshot, converted"
    return Job(
        [
            Row(job, "ours, solve() one by one", 4, ours(problems[:4], "gtsam")),
            Row(job, "hand-written", len(given), each),
        ],
        as_good(problems),
    )
