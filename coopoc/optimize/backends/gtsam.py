"""gtsam: GTSAM's own Levenberg-Marquardt on its own factors, and on CustomFactors where it has none.

No step is ours: the answer is a second opinion. The error e of a GTSAM class below gives our whitened residual, or one
of the same length, as S e; S goes into its noise model and the loss into a robust one. What is not here GTSAM weighs in
another way, or does not have, and is a CustomFactor of our residual, a callback from C++ into Python, which takes some
twenty times as long: a bearing in space, and range, azimuth and inclination in the world frame with a std each. A point
is a Point2/3, a pose a Pose2/3.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Floats
from ..backend import MAX_ITERATIONS, SOLVER_STEP_TOLERANCE, Backend, SolverResult
from ..model.derivatives import linearise
from ..model.factor import Factor, Loss, unchecked
from ..model.problem import Problem
from ..model.space import Space, exp

MAX_RESTARTS = 3
"""Times that the optimiser begins where it ended, damped as at first, while it ended damped more; once if linear."""
PRECISE = 1e-15
"""Share of the cost by which a step must lower it to be followed by another; GTSAM's own 1e-5 leaves millimetres."""
POINT, POSE = False, True
Names = Mapping[tuple[bool, ...], str]
"""GTSAM's class by which of the nodes are poses."""
WEIGHT_TOLERANCE = 1e-12
"""Share by which two weights may differ and count as equal."""
ESTIMATORS = {
    "huber": "Huber",
    "cauchy": "Cauchy",
    "geman-mcclure": "GemanMcClure",
    "truncated": "TruncatedLeastSquares",
}
"""GTSAM's names of our losses; their values and weights are the same."""


def solver(
    problem: Problem, x: Floats, max_iterations: int = MAX_ITERATIONS, tolerance: float = SOLVER_STEP_TOLERANCE
) -> SolverResult:
    """Solve a problem from x (n, ambient).

    Args:
        problem: that is solved.
        x: start.
        max_iterations: of GTSAM's linear solves that lowered the cost.
        tolerance: m or rad, which GTSAM, that stops by the cost, does not know.
    """
    import gtsam

    posed, parts = which_turn(problem), forms(problem)
    graph, used, custom = graph_of(problem, parts), 0, parts.count(None)
    for _ in range(1 if problem.linear else MAX_RESTARTS):
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(max_iterations - used)
        params.setRelativeErrorTol(PRECISE)
        params.setAbsoluteErrorTol(0.0)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values(problem.space, posed, x), params)
        try:
            x = estimate(problem.space, posed, optimizer.optimize())
        except RuntimeError:  # a singular system: `solve` names the nodes that are free
            break
        used += optimizer.iterations()
        if used >= max_iterations or optimizer.lambda_() <= params.getlambdaInitial():
            break
    return SolverResult(x, used, extras={"custom_factors": custom})


class Part(NamedTuple):
    """A GTSAM class that states a factor, or those of its residuals that `root` keeps.

    Attributes:
        names: of the class, by which of the nodes are poses.
        arguments: by measurement what the class takes between keys and noise model, to be read once.
        root: (M or 1, k, k) S, square root of the information of its k errors.
    """

    names: Names
    arguments: Iterable[tuple[Any, ...]]
    root: Floats


Form = list[Part] | None
"""The parts of a factor, None if GTSAM has none with its objective."""


def forms(problem: Problem) -> list[Form]:
    """Of each factor of a problem its parts in GTSAM."""
    posed, made = which_turn(problem), list[Form]()
    for factor in problem.factors:
        kinds = {tuple([posed[i] for i in row]) for row in factor.nodes.tolist()}
        shared = factor.std is not None and len(factor.std) == 1
        parts = _parts(factor, factor.root[:1] if shared else factor.root, problem.dimension) or []
        known = all(row in part.names or row[::-1] in part.names for row in kinds for part in parts)
        joined = len(parts) > 1 and factor.loss is not None  # by no robust loss of GTSAM's
        made.append(parts if parts and known and not joined else None)
    return made


def pose_of(d: int, x: Floats) -> Any:
    """gtsam.Pose2 or Pose3 of a pose (ambient,)."""
    import gtsam

    if d == 2:
        return gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2]))
    return gtsam.Pose3(gtsam.Rot3(x[3:].reshape(3, 3)), x[:3])


def _between(name: str, d: int, z: Floats, root: Floats) -> list[Part]:
    """The part of poses (M, ambient) from one pose to another."""
    return [Part({(POSE, POSE): f"{name}Pose{d}"}, ((pose_of(d, each),) for each in z), root)]


PLAIN: Mapping[str, Names] = {
    "position": {(POINT,): "PriorFactorPoint{0}", (POSE,): "PoseTranslationPrior{0}D"},
    "displacement": {(POINT, POINT): "BetweenFactorPoint{0}"},
    "range": {(POINT, POINT): "RangeFactor{0}", (POSE, POINT): "RangeFactor{0}D", (POSE, POSE): "RangeFactorPose{0}"},
}
"""GTSAM's classes of kinds whose residual is its error."""


def _parts(factor: Factor, W: Floats, d: int) -> Form:
    """The parts of a factor with W (M or 1, size, size); None of one that GTSAM weighs in another way."""
    import gtsam

    z = factor.z
    match factor.kind:
        case "position" | "displacement" | "range":
            names = {turning: name.format(d) for turning, name in PLAIN[factor.kind].items()}
            return [Part(names, zip(z[:, 0] if factor.kind == "range" else z, strict=True), W)]
        # in space it weighs a bearing by its tangent plane, not by azimuth and inclination, and has no forward axis
        case "bearing" | "body_spherical" if d == 2:
            name = "Bearing" if factor.kind == "bearing" else "BearingRange"
            names = {(POSE, POINT): f"{name}Factor2D", (POSE, POSE): f"{name}FactorPose2"}
            # its order is the other, in which a diagonal W stays one
            return [Part(names, ((gtsam.Rot2(angle), *far) for *far, angle in z), W[:, ::-1, ::-1])]
        case "relative_position":
            return _chord(W, Space(d, has_rotation=True).join(z), d)
        case "relative_pose_chordal":
            return _chord(W, z, d)
        case "relative_pose_log":  # whose errors in space are those of the rotation first
            return _between("BetweenFactor", d, z, W if d == 2 else np.roll(W, -d, axis=2))
        case "relative_pose" if not _coupled(W, d) and (chord := _chord(W[:, :d, :d], z, d)):
            size, first = (3, 2) if d == 2 else (6, 0)  # the geodesic for the rotation alone
            root = np.zeros((len(W), size, size))
            root[:, first : first + size - d, first : first + size - d] = W[:, d:, d:]
            return [*chord, *_between("BetweenFactor", d, z, root)]
        case "pose" if not _coupled(W, d):
            moved = zip(z[:, :d], strict=True), W[:, :d, :d] @ Space(d, has_rotation=True).rotation(z).mT
            turned = ((pose_of(d, each).rotation(),) for each in z), W[:, d:, d:]
            return [
                Part({(POSE,): f"PoseTranslationPrior{d}D"}, *moved),
                Part({(POSE,): f"PoseRotationPrior{d}D"}, *turned),
            ]
    return None


def _chord(W: Floats, z: Floats, d: int) -> Form:
    """GTSAM's T_j - T_i Z is R_i times our residual, column by column: each must have one std and no correlation.

    Args:
        W: of the translation, or of it and the rotation.
        z: (M, ambient) poses.
    """
    information = W.mT @ W
    weight = np.zeros((len(W), (d + 1) ** 2))
    expected = np.zeros_like(information)
    rotation = [d + k + d * np.arange(d) for k in range(W.shape[-1] // d - 1)]  # our residuals of each column
    for column, rows in enumerate([np.arange(d), *rotation], -1):
        own = information[:, rows[0], rows[0]]
        weight[:, (d + 1) * (column % (d + 1)) + np.arange(d)] = own[:, None]
        expected[:, rows, rows] = own[:, None]
    scale = np.sqrt(np.einsum("mii->mi", information))
    if (abs(information - expected) > WEIGHT_TOLERANCE * scale[:, :, None] * scale[:, None, :]).any():
        return None
    return _between("FrobeniusBetweenFactor", d, z, np.sqrt(weight)[:, :, None] * np.eye(weight.shape[1]))


def _coupled(W: Floats, d: int) -> bool:
    """Whether position and rotation are correlated."""
    return bool(max(abs(W[:, :d, d:]).max(), abs(W[:, d:, :d]).max()) > WEIGHT_TOLERANCE * abs(W).max())


def callbacks(problem: Problem, factors: Sequence[Factor]) -> Callable[[int, int, Sequence[int]], Any]:
    """Residuals and derivatives of factors that GTSAM lacks, for its CustomFactors, all at once at each new point: a
    function of a factor's number, a row and its nodes, which gives the error function of a measurement."""
    import gtsam

    space, posed, bare = problem.space, which_turn(problem), [unchecked(factor, loss=None) for factor in factors]
    at: Any = None
    linear: Any = None
    turned: Sequence[Floats] = ()

    def of(k: int, row: int, nodes: Sequence[int]) -> Callable[[Any, Any, Any], Any]:
        def error(_: Any, estimates: Any, jacobians: Any) -> Any:
            nonlocal at, linear, turned
            if at is None or not estimates.equals(at, 0.0):
                at, x = gtsam.Values(estimates), estimate(space, posed, estimates)
                linear, turned = linearise(space, bare, x), tangent(space, posed, x)
            if jacobians is not None:
                own = linear.jacobian[k][row].reshape(-1, len(nodes), space.dof)
                for slot, i in enumerate(nodes):
                    jacobians[slot] = own[:, slot] @ turned[i]
            return linear.residual[k][row]

        return error

    return of


def graph_of(problem: Problem, parts: Sequence[Form], keys: Sequence[int] | None = None) -> Any:
    """The gtsam.NonlinearFactorGraph of the factors, of which those without parts (see `forms`) are CustomFactors, and
    of the nodes that are fixed, with these keys, or their indices."""
    import gtsam

    keys = range(len(problem.names)) if keys is None else keys

    graph, posed = gtsam.NonlinearFactorGraph(), which_turn(problem)
    lacking = [factor for factor, form in zip(problem.factors, parts, strict=True) if form is None]
    error = callbacks(problem, lacking)
    for k, factor in enumerate(lacking):
        model = _robust(gtsam.noiseModel.Unit.Create(factor.size), factor.loss)
        for row in np.flatnonzero(factor.informative).tolist():
            nodes = factor.nodes[row].tolist()
            graph.add(gtsam.CustomFactor(model, nodes, error(k, row, nodes)))
    for factor, form in zip(problem.factors, parts, strict=True):
        for part in form or ():
            for nodes, arguments, root in zip(factor.nodes.tolist(), part.arguments, cycle(part.root), strict=False):
                model = _model(root.tobytes(), len(root), factor.loss)
                if (turning := tuple([posed[i] for i in nodes])) not in part.names:
                    nodes, turning = nodes[::-1], turning[::-1]  # such as a range from a point to a pose
                if model is not None:
                    graph.add(getattr(gtsam, part.names[turning])(*[keys[i] for i in nodes], *arguments, model))
    for i in problem.fixed:
        name = f"NonlinearEquality{'Pose' if posed[i] else 'Point'}{problem.dimension}"
        graph.add(getattr(gtsam, name)(keys[i], _node(problem.dimension, np.asarray(problem.x0)[i], posed[i])))
    return graph


def values(space: Space, posed: Sequence[bool], x: Floats, first: int = 0) -> Any:
    """gtsam.Values of nodes x (n, ambient), which are points or `posed`, under their indices from `first` on."""
    import gtsam

    result = gtsam.Values()
    for key, (node, turns) in enumerate(zip(x, posed, strict=True), first):
        result.insert(key, _node(space.dimension, node, turns))
    return result


def estimate(space: Space, posed: Sequence[bool], values: Any) -> Floats:
    """x (n, ambient) of the nodes in gtsam.Values, which holds no others."""
    from gtsam import utilities

    d, x = space.dimension, np.empty((len(posed), space.ambient))
    points, poses = np.flatnonzero(~np.array(posed)), np.flatnonzero(posed)
    if len(points):
        x[points] = space.join(getattr(utilities, f"extractPoint{d}")(values))
    if len(poses) and d == 2:
        rows = utilities.extractPose2(values)
        x[poses] = space.join(rows[:, :2], exp(rows[:, 2:]))
    elif len(poses):
        rows = utilities.extractPose3(values)
        x[poses] = space.join(rows[:, 9:], rows[:, :9].reshape(-1, 3, 3))
    return x


def which_turn(problem: Problem) -> list[bool]:
    """Of each node whether it is a pose."""
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
    d, still, blocks = space.dimension, np.eye(space.dof, space.dimension), []
    for turns, rotation in zip(posed, space.rotation(x), strict=True):
        matrix = np.eye(space.dof)
        matrix[:d, :d] = rotation
        blocks.append(still if not turns else matrix if d == 2 else np.roll(matrix, space.angles, axis=1))
    return blocks


def _node(d: int, x: Floats, turns: bool) -> Any:
    return pose_of(d, x) if turns else x[:d]


@lru_cache(maxsize=1024)
def _model(raw: bytes, size: int, loss: Loss | None) -> Any:
    """The noise model of one measurement by its root (size, size), kept for the next equal ones; None: it has no
    information. What GTSAM itself takes for diagonal may have entries below."""
    import gtsam

    noise, root = gtsam.noiseModel, np.frombuffer(raw).reshape(size, size)
    if not root.any():
        return None
    return _robust(noise.Gaussian.SqrtInformation(root, not np.tril(root, -1).any()), loss)


def _robust(model: Any, loss: Loss | None) -> Any:
    """A noise model under a loss."""
    from gtsam import noiseModel as noise

    if loss is None:
        return model
    return noise.Robust.Create(getattr(noise.mEstimator, ESTIMATORS[loss.name]).Create(loss.scale), model)


BACKEND = Backend("gtsam", solver, "gtsam")
