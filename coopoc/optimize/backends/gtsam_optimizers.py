"""GTSAM's own optimisers on a graph of its own factors: Levenberg-Marquardt, graduated non-convexity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..model.factor import Factor
from ..model.problem import Problem
from .gtsam_forms import Form, relative_log
from .gtsam_native import fix_nodes, native_graph

STEEP = 1e12
"""Damping at which GTSAM's Levenberg-Marquardt gives up; its own 1e5 is little beside an information of 1e8."""
GNC_LOSSES = {"truncated": "TLS", "geman-mcclure": "GM"}
"""GTSAM's names of the losses of graduated non-convexity."""


def levenberg_marquardt(graph: Any, at: Any, limit: int) -> tuple[Any, int]:
    """Until the cost falls no further, to the last digit."""
    import gtsam

    params = _patient(gtsam.LevenbergMarquardtParams(), limit)
    params.setlambdaUpperBound(STEEP)
    params.setUseFixedLambdaFactor(False)  # a factor of 10 to and fro finds no middle where the step overshoots
    found = gtsam.LevenbergMarquardtOptimizer(graph, at, params)
    return found.optimize(), found.iterations()


def as_it_comes(graph: Any, at: Any, limit: int) -> tuple[Any, int]:
    """GTSAM's values and iterations with its own settings: it stops where the cost falls by less than 1e-5 of it."""
    import gtsam

    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(limit)
    found = gtsam.LevenbergMarquardtOptimizer(graph, at, params)
    return found.optimize(), found.iterations()


OPTIMIZERS = ("auto", "elimination", "lm", "gnc")


def all_native(problem: Problem, forms_: Sequence[Form], optimizer: str) -> None:
    """InputError that names the factors that are not GTSAM's own."""
    lacking = [
        f"{factor.kind}: {form}" for factor, form in zip(problem.factors, forms_, strict=True) if isinstance(form, str)
    ]
    if lacking:
        hint = 'Use optimizer="elimination", which takes every factor.'
        raise InputError("optimizer", repr(optimizer), f"needs GTSAM's own factors only ({'; '.join(lacking)})", hint)


def gnc(problem: Problem, forms_: Sequence[Form]) -> Callable[[Any, int], tuple[Any, int, list[Floats]]]:
    """gtsam.GncLMOptimizer: (values, limit) -> rough values, iterations and (M,) weights of each factor's measurements.

    GTSAM's GNC copies factors and cannot copy the chord of a relative pose; until the outliers are found, the
    logarithm of the whole pose replaces it, which has the same minimum where all residuals vanish.

    Raises:
        InputError: factors whose losses are not one of GNC_LOSSES with one scale, or that cannot be copied.
    """
    import gtsam

    name, scale = _robust_loss(problem)
    parts = [copied(*pair, problem.dimension) for pair in zip(problem.factors, forms_, strict=True)]
    native = native_graph(problem, parts)
    inliers = [k for k, (f, _) in enumerate(native.place) if problem.factors[f].loss is None]
    fix_nodes(problem, native.graph)

    def solve_gnc(at: Any, limit: int) -> tuple[Any, int, list[Floats]]:
        used: list[int] = []
        inner = gtsam.LevenbergMarquardtParams()
        inner.setMaxIterations(limit)
        inner.setlambdaUpperBound(STEEP)
        inner.iterationHook = lambda *_: used.append(1)
        params = gtsam.GncLMParams(inner)
        params.setLossType(getattr(gtsam.GncLossType, GNC_LOSSES[name]))
        params.setKnownInliers([*inliers, *range(len(native.place), native.graph.size())])
        outer = gtsam.GncLMOptimizer(native.graph, at, params)
        outer.setInlierCostThresholds(0.5 * scale**2)
        found = outer.optimize()
        weights: list[Floats] = [np.ones(len(factor.nodes)) for factor in problem.factors]
        for (f, k), weight in zip(native.place, outer.getWeights(), strict=False):
            weights[f][k] = weight
        return found, len(used), weights

    return solve_gnc


def _robust_loss(problem: Problem) -> tuple[str, float]:
    """The one loss and scale of a problem's factors."""
    losses = {(f.loss.name, f.loss.scale) for f in problem.factors if f.loss is not None}
    if len(losses) != 1 or next(iter(losses))[0] not in GNC_LOSSES:
        hint = 'Give the factors that may be wrong loss=Loss("truncated", 3.0), and the others none.'
        given = ", ".join(sorted(f"{name} {scale}" for name, scale in losses)) or "none"
        raise InputError("losses", given, f"must be one of {sorted(GNC_LOSSES)} with one scale for gnc", hint)
    return next(iter(losses))


def copied(factor: Factor, form: Form, d: int) -> Form:
    """Parts that GTSAM can copy."""
    assert not isinstance(form, str)
    bad = [name for part in form for name in part.names.values() if name.startswith(("FrobeniusB", "FrobeniusP"))]
    if not bad:
        return form
    if factor.kind != "relative_pose":
        hint = 'Use optimizer="lm", or coopoc.optimize.solve_gnc.'
        raise InputError("optimizer", "'gnc'", f"cannot copy {bad[0]}, GTSAM's {factor.kind}", hint)
    return relative_log(factor, factor.root, d)


def _patient(params: Any, limit: int) -> Any:
    """No tolerance: GTSAM's are on the cost, which is flat to rounding 1e-8 m before the minimum."""
    params.setMaxIterations(limit)
    params.setRelativeErrorTol(0.0)
    params.setAbsoluteErrorTol(0.0)
    params.setErrorTol(0.0)
    return params
