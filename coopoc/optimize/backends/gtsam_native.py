"""A problem as GTSAM's graph of its own factors, its nodes as GTSAM's values, and back: a point is a Point2/3, a pose a
Pose2/3."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Any

import numpy as np

from ...arrays import Floats
from ..model.factor import Factor
from ..model.linear import linearise
from ..model.losses import Loss
from ..model.problem import Problem
from ..model.space import Space, exp
from .gtsam_forms import Form, pose_of

ESTIMATORS = {
    "huber": "Huber",
    "cauchy": "Cauchy",
    "geman-mcclure": "GemanMcClure",
    "truncated": "TruncatedLeastSquares",
}
"""GTSAM's names of our losses; their values and weights are the same."""


@dataclass(frozen=True, eq=False)
class Native:
    """A gtsam.NonlinearFactorGraph and, in its order, the factor of the problem that each part states with the noise
    models of its measurements; None: it has no information and is not in the graph."""

    graph: Any
    models: list[tuple[int, list[Any]]]

    @property
    def place(self) -> list[tuple[int, int]]:
        """Of each factor of the graph, which (factor, row) of the problem it states."""
        return [(f, k) for f, models in self.models for k, model in enumerate(models) if model is not None]


def native_graph(problem: Problem, forms_: Sequence[Form], keys: Sequence[int] | None = None) -> Native:
    """The graph of the factors that have parts.

    Args:
        forms_: of `forms`.
        keys: GTSAM's names of the nodes, default their indices.
    """
    import gtsam

    native = Native(gtsam.NonlinearFactorGraph(), [])
    add = native.graph.add
    named = np.arange(len(problem.names)) if keys is None else np.array(keys)
    posed = which_turn(problem) if problem.poses else []
    for f, (factor, parts) in enumerate(zip(problem.factors, forms_, strict=True)):
        if isinstance(parts, str):
            continue
        called = named[factor.nodes].tolist()
        turns = (
            [(False,) * len(called[0])] * len(called)
            if not posed
            else [tuple([posed[i] for i in row]) for row in factor.nodes.tolist()]
        )
        for part in parts:
            models = _models(part.root, factor)
            classes: dict[tuple[bool, ...], Any] = {at: getattr(gtsam, name) for at, name in part.names.items()}
            classes |= {at[::-1]: _swapped(made) for at, made in classes.items() if at[::-1] not in classes}
            for touched, kind, given, model in zip(called, turns, part.given(gtsam), models, strict=True):
                if model is not None:
                    add(classes[kind](*touched, *given, model))
            native.models.append((f, models))
    return native


def _swapped(made: Any) -> Any:
    """A factor of two nodes in the other order, such as a range from a point to a pose."""
    return lambda first, second, *given: made(second, first, *given)


def fix_nodes(problem: Problem, graph: Any) -> None:
    """Add to a graph GTSAM's equalities of the nodes that are fixed."""
    import gtsam

    posed = which_turn(problem)
    for i in problem.fixed:
        assert problem.x0 is not None
        name = f"NonlinearEquality{'Pose' if posed[i] else 'Point'}{problem.dimension}"
        graph.add(getattr(gtsam, name)(i, _node(gtsam, problem.dimension, problem.x0[i], posed[i])))


def values(space: Space, posed: Sequence[bool], x: Floats, keys: Iterable[int]) -> Any:
    """gtsam.Values of nodes x (n, ambient), which are points or `posed`, under their keys."""
    import gtsam

    found = gtsam.Values()
    nodes = (
        x
        if not space.has_rotation
        else (_node(gtsam, space.dimension, node, turns) for node, turns in zip(x, posed, strict=True))
    )
    for key, node in zip(keys, nodes, strict=True):
        found.insert(key, node)
    return found


def estimate(space: Space, posed: Sequence[bool], found: Any, keys: Sequence[int]) -> Floats:
    """x (n, ambient) of the nodes in gtsam.Values, which holds no others."""
    from gtsam import utilities

    d, x, rank = space.dimension, np.empty((len(posed), space.ambient)), np.argsort(keys)
    turns = np.array(posed, dtype=bool)[rank]
    points, poses = rank[~turns], rank[turns]
    if len(points):
        x[points] = space.join(getattr(utilities, f"extractPoint{d}")(found))
    if len(poses) and d == 2:
        rows = utilities.extractPose2(found)
        x[poses] = space.join(rows[:, :2], exp(rows[:, 2:]))
    elif len(poses):
        rows = utilities.extractPose3(found)
        x[poses] = space.join(rows[:, 9:], rows[:, :9].reshape(-1, 3, 3))
    return x


def which_turn(problem: Problem) -> list[bool]:
    """Of each node whether it is a pose."""
    if not problem.poses:
        return [False] * len(problem.names)
    poses = set(problem.poses)
    return [i in poses for i in range(len(problem.names))]


def tangent(space: Space, posed: Sequence[bool], x: Floats) -> Sequence[Floats]:
    """Of each node of x (n, ambient) the (dof, own) matrix T with our step = T GTSAM's, which has `own` numbers.

    GTSAM moves a pose in its body's directions, in space with the rotation first; we move its position in the world's.
    A covariance of GTSAM's becomes T C T^T, a derivative by our step times T is one by GTSAM's.

    >>> from coopoc.optimize import pose
    >>> tangent(Space(2, has_rotation=True), [True], pose([[5.0, 1.0]], np.pi / 2))[0].round(3) + 0.0
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    d, still, found = space.dimension, np.eye(space.dof, space.dimension), []
    if not space.has_rotation:
        return [still] * len(posed)
    rotation = space.rotation(x)
    for i, turns in enumerate(posed):
        if not turns:
            found.append(still)
            continue
        matrix = np.eye(space.dof)
        matrix[:d, :d] = rotation[i]
        found.append(matrix if d == 2 else np.roll(matrix, space.angles, axis=1))
    return found


def linearised(problem: Problem, which: Sequence[int], x: Floats, keys: Sequence[int]) -> list[Any]:
    """The factors `which` as gtsam.LinearContainerFactors, linear around x (n, ambient) for good."""
    import gtsam

    jacobian: Any = gtsam.JacobianFactor
    factors, posed = [problem.factors[f] for f in which], which_turn(problem)
    linear, found = linearise(problem.space, factors, None, x[None]), []
    turn, at = tangent(problem.space, posed, x), values(problem.space, posed, x, keys)
    for factor, residual, jacobians in zip(factors, linear.residual, linear.by_node(factors), strict=True):
        unit = gtsam.noiseModel.Unit.Create(factor.size)
        wide = [np.broadcast_to(jacobian[0], (len(factor.nodes), *jacobian.shape[2:])) for jacobian in jacobians]
        for k in np.flatnonzero(factor.informative).tolist():
            blocks = [(keys[i], jacobian[k] @ turn[i]) for i, jacobian in zip(factor.nodes[k], wide, strict=True)]
            found.append(gtsam.LinearContainerFactor(jacobian(*chain(*blocks), -residual[0, k], unit), at))
    return found


def _node(gtsam: Any, d: int, x: Floats, posed: bool) -> Any:
    return pose_of(gtsam, d, x) if posed else x[:d]


def _models(root: Floats, factor: Factor) -> list[Any]:
    """A noise model per measurement of roots (M or 1, k, k), one object for equal ones; None: it has no information."""
    size, loss = root.shape[-1], factor.loss
    return [_model(row.tobytes(), size, loss) for row in root] * (len(factor.nodes) if len(root) == 1 else 1)


@lru_cache(maxsize=1024)
def _model(raw: bytes, size: int, loss: Loss | None) -> Any:
    """Of one measurement, kept for the next equal ones; what GTSAM itself takes for diagonal may have entries below."""
    import gtsam

    noise, root = gtsam.noiseModel, np.frombuffer(raw).reshape(size, size)
    if not root.any():
        return None
    diagonal = not any(entry for i, row in enumerate(root.tolist()) for entry in row[:i])
    model: Any = noise.Gaussian.SqrtInformation(root, diagonal)
    if loss is None:
        return model
    shape = getattr(noise.mEstimator, ESTIMATORS[loss.name]).Create(loss.scale)
    return noise.Robust.Create(shape, model)
