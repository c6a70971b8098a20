"""GTSAM's own optimisers on a graph of its own factors: Levenberg-Marquardt, dogleg, ISAM2, graduated non-convexity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..factor import Factor
from ..problem import Problem
from .gtsam_forms import Form, Part, pose_of
from .gtsam_native import hold, native_graph

Optimizer: TypeAlias = Callable[[Any, Any, int], tuple[Any, int]]
"""(gtsam graph, values, limit of iterations) -> values, iterations."""

STEEP = 1e12
"""Damping at which GTSAM's Levenberg-Marquardt gives up; its own 1e5 is little beside an information of 1e8."""
STILL = 1e-10
"""m or rad: ISAM2 is updated until no estimate moves by more."""
GRADUATED = {"truncated": "TLS", "geman-mcclure": "GM"}
"""GTSAM's names of the losses of graduated non-convexity."""


def levenberg_marquardt(graph: Any, at: Any, limit: int) -> tuple[Any, int]:
    """Until the cost falls no further, to the last digit."""
    import gtsam

    params = _patient(gtsam.LevenbergMarquardtParams(), limit)
    params.setlambdaUpperBound(STEEP)
    params.setUseFixedLambdaFactor(False)  # a factor of 10 to and fro finds no middle where the step overshoots
    found = gtsam.LevenbergMarquardtOptimizer(graph, at, params)
    return found.optimize(), found.iterations()


def dogleg(graph: Any, at: Any, limit: int) -> tuple[Any, int]:
    """Powell's dogleg in a trust region, until the cost falls no further."""
    import gtsam

    found = gtsam.DoglegOptimizer(graph, at, _patient(gtsam.DoglegParams(), limit))
    return found.optimize(), found.iterations()


def isam2(graph: Any, at: Any, limit: int) -> tuple[Any, int]:
    """ISAM2 with dogleg steps, all factors in the first update, everything linearised afresh in each."""
    import gtsam

    steps, params = gtsam.ISAM2DoglegParams(), gtsam.ISAM2Params()
    steps.setWildfireThreshold(0.0)
    params.setOptimizationParams(steps)
    params.setRelinearizeThreshold(0.0)
    params.relinearizeSkip = 1
    params.setFactorization("QR")
    smoother = gtsam.ISAM2(params)
    smoother.update(graph, at)
    count = 1
    while count < limit and np.abs(smoother.getDelta().vector()).max(initial=0.0) > STILL:
        smoother.update()
        count += 1
    return smoother.calculateBestEstimate(), count


OPTIMIZERS: dict[str, Optimizer] = {
    "lm": levenberg_marquardt, "dogleg": dogleg, "isam2": isam2, "gnc": levenberg_marquardt,
}  # fmt: skip
"""gnc ends with Levenberg-Marquardt from where the graduation led."""


def all_native(problem: Problem, said: Sequence[Form], optimizer: str) -> None:
    """InputError that names the factors that are not GTSAM's own."""
    lacking = [f"{factor.kind}: {form}" for factor, form in zip(problem.factors, said, strict=True)
               if isinstance(form, str)]  # fmt: skip
    if lacking:
        mend = 'Use optimizer="elimination", which takes every factor.'
        raise InputError("optimizer", repr(optimizer), f"needs GTSAM's own factors only ({'; '.join(lacking)})", mend)


def graduation(problem: Problem, said: Sequence[Form]) -> Callable[[Any, int], tuple[Any, int, list[Floats]]]:
    """gtsam.GncLMOptimizer: (values, limit) -> rough values, iterations and (M,) weights of each factor's measurements.

    GTSAM cannot copy the chord of a relative pose, as its graduation does; until it has told the outliers, the
    logarithm of the whole pose stands in for it, which has the same minimum where all residuals vanish.

    Raises:
        InputError: factors whose losses are not one of GRADUATED with one scale, or that cannot be copied.
    """
    import gtsam

    name, scale = _doubted(problem)
    parts = [copied(*pair, problem.dimension) for pair in zip(problem.factors, said, strict=True)]
    native = native_graph(problem, parts)
    believed = [k for k, (f, _) in enumerate(native.place) if problem.factors[f].loss is None]
    hold(problem, native.graph)

    def graduate(at: Any, limit: int) -> tuple[Any, int, list[Floats]]:
        used: list[int] = []
        inner = gtsam.LevenbergMarquardtParams()
        inner.setMaxIterations(limit)
        inner.setlambdaUpperBound(STEEP)
        inner.iterationHook = lambda *_: used.append(1)
        params = gtsam.GncLMParams(inner)
        params.setLossType(getattr(gtsam.GncLossType, GRADUATED[name]))
        params.setKnownInliers([*believed, *range(len(native.place), native.graph.size())])
        outer = gtsam.GncLMOptimizer(native.graph, at, params)
        outer.setInlierCostThresholds(0.5 * scale**2)
        found = outer.optimize()
        weights: list[Floats] = [np.ones(len(factor.nodes)) for factor in problem.factors]
        for (f, k), weight in zip(native.place, outer.getWeights(), strict=False):
            weights[f][k] = weight
        return found, len(used), weights

    return graduate


def _doubted(problem: Problem) -> tuple[str, float]:
    """The one loss and scale of a problem's factors."""
    losses = {(f.loss.name, f.loss.scale) for f in problem.factors if f.loss is not None}
    if len(losses) != 1 or next(iter(losses))[0] not in GRADUATED:
        mend = 'Give the factors that may be wrong loss=Loss("truncated", 3.0), and the others none.'
        given = ", ".join(sorted(f"{name} {scale}" for name, scale in losses)) or "none"
        raise InputError("losses", given, f"must be one of {sorted(GRADUATED)} with one scale for gnc", mend)
    return next(iter(losses))


def copied(factor: Factor, form: Form, d: int) -> Form:
    """Parts that GTSAM can copy."""
    assert not isinstance(form, str)
    bad = [name for part in form for name in part.names.values() if name.startswith(("FrobeniusB", "FrobeniusP"))]
    if not bad:
        return form
    if factor.kind != "relative_pose":
        mend = 'Use optimizer="lm", or coopoc.optimize.graduate.'
        raise InputError("optimizer", "'gnc'", f"cannot copy {bad[0]}, GTSAM's {factor.kind}", mend)
    root = factor.root if d == 2 else np.roll(factor.root, -d, axis=2)
    return [Part({(True, True): f"BetweenFactorPose{d}"}, lambda g: [(pose_of(g, d, z),) for z in factor.z], root)]


def _patient(params: Any, limit: int) -> Any:
    """No tolerance: GTSAM's are on the cost, which is flat to rounding 1e-8 m before the minimum."""
    params.setMaxIterations(limit)
    params.setRelativeErrorTol(0.0)
    params.setAbsoluteErrorTol(0.0)
    params.setErrorTol(0.0)
    return params
