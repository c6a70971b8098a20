"""Measurements: one formula for NumPy, torch and CasADi; our derivative against CasADi's own differentiation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from coopoc import InputError
from coopoc.optimize import MEASUREMENTS, Problem, backends, measurement, solve
from coopoc.optimize.model import dual as dual_numbers
from coopoc.optimize.model.dual import seeds
from coopoc.optimize.model.space import Space, exp

VECTORS = np.random.default_rng(0).normal(size=(50, 3)) * [20, 20, 5]


ROTATIONS = Rotation.random(50, random_state=1).as_matrix()
PLAIN = sorted(kind for kind, known in MEASUREMENTS.items() if known.frame != "relative")
CONSTANTS = [0.1]


class Symbolic:
    """CasADi as the namespace of a formula."""

    sqrt, sin, cos, atan2, where = ca.sqrt, ca.sin, ca.cos, ca.atan2, ca.if_else


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", PLAIN)
def test_derivative_equals_casadis(kind: str, dimension: int) -> None:
    known = MEASUREMENTS[kind]
    if dimension == 2 and known.plane is None:
        pytest.skip(f"{kind} does not exist in the plane")
    v, given, size = ca.SX.sym("v", dimension), CONSTANTS[: known.constants], known.size(dimension)
    formula = ca.vertcat(*known.residual(ca.vertsplit(v), [0.0] * size, given, Symbolic))
    reference = ca.Function("h", [v], [formula, ca.jacobian(formula, v)])
    vectors = VECTORS[:, :dimension]
    zero, constants = np.zeros((len(vectors), size)), np.broadcast_to(given, (len(vectors), len(given)))
    value, derivative = known.differentiate(vectors, None, zero, constants)
    derivative = np.broadcast_to(derivative, (len(vectors), size, dimension))
    for i, vector in enumerate(vectors):
        h, J = (np.asarray(a) for a in reference(vector))
        assert value[i] == pytest.approx(h[:, 0], abs=1e-13)
        assert derivative[i] == pytest.approx(J, abs=1e-13)
    assert known.predict(vectors, given) == pytest.approx(value, abs=1e-13)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", ["relative_pose", "relative_pose_log", "relative_pose_chordal"])
def test_derivative_of_a_pose_equals_casadis(kind: str, dimension: int) -> None:
    """By the position and by a right turn R Exp(w), w = 0, for a small and for any error of the rotation."""
    known, space = MEASUREMENTS[kind], Space(dimension, has_rotation=True)
    v, w = ca.SX.sym("v", dimension), ca.SX.sym("w", space.angles)
    turn, d = ca.SX.sym("R", dimension, dimension), dimension
    skew = ca.skew(w) if d == 3 else ca.vertcat(ca.horzcat(0, -w), ca.horzcat(w, 0))
    turned = turn @ (ca.SX.eye(d) + skew)
    z = ca.SX.sym("z", space.ambient)
    local = [*ca.vertsplit(v), *(turned[i, j] for i in range(d) for j in range(d))]
    formula = ca.vertcat(*known.residual(local, ca.vertsplit(z), [], Symbolic))
    derivatives = [ca.substitute(ca.jacobian(formula, s), w, 0) for s in (v, w)]
    reference = ca.Function("h", [v, turn, z], [ca.substitute(formula, w, 0), ca.horzcat(*derivatives)])
    if d == 3:
        turns, others = ROTATIONS, ROTATIONS[::-1]
    else:
        angles = np.linspace(-3.0, 3.0, 50)
        turns, others = exp(angles[:, None]), exp(angles[::-1, None])
    near = turns @ exp(np.full((50, space.angles), 1e-3))
    for measured in (others, near, turns):
        z_values = space.join(VECTORS[::-1, :d], measured)
        value, derivative = known.differentiate(VECTORS[:, :d], turns, z_values, np.empty((50, 0)))
        for i in range(50):
            h, J = (np.asarray(a) for a in reference(VECTORS[i, :d], turns[i], z_values[i]))
            assert value[i] == pytest.approx(h[:, 0], abs=1e-9)
            assert derivative[i] == pytest.approx(J, abs=1e-9)


def test_a_relative_pose_is_scipys_logarithm() -> None:
    known, space = MEASUREMENTS["relative_pose"], Space(3, has_rotation=True)
    z = space.join(VECTORS[::-1], ROTATIONS[::-1])
    found = known.difference(VECTORS, ROTATIONS, z, np.empty((50, 0)))
    back = Rotation.from_matrix(ROTATIONS[::-1]).inv()
    assert found[:, :3] == pytest.approx(back.apply(VECTORS - VECTORS[::-1]), abs=1e-12)
    assert found[:, 3:] == pytest.approx((back * Rotation.from_matrix(ROTATIONS)).as_rotvec(), abs=1e-9)


@pytest.mark.parametrize("far", [1.0, 1e-2, 1e-6])
def test_the_logarithm_of_a_relative_pose_is_scipys(far: float) -> None:
    """scipy.linalg.logm of the homogeneous matrix Tz^-1 T, near the measured pose and far from it."""
    known, space = MEASUREMENTS["relative_pose_log"], Space(3, has_rotation=True)
    near = ROTATIONS @ exp(far * VECTORS / np.linalg.norm(VECTORS, axis=1, keepdims=True))
    found = known.difference(VECTORS, near, space.join(VECTORS[::-1], ROTATIONS), np.empty((50, 0)))
    for k in range(50):
        pair = np.tile(np.eye(4), (2, 1, 1))
        pair[0, :3, :3], pair[0, :3, 3] = ROTATIONS[k], VECTORS[::-1][k]
        pair[1, :3, :3], pair[1, :3, 3] = near[k], VECTORS[k]
        twist = logm(np.linalg.inv(pair[0]) @ pair[1]).real
        assert found[k, :3] == pytest.approx(twist[:3, 3], abs=1e-7)
        assert found[k, 3:] == pytest.approx([twist[2, 1], twist[0, 2], twist[1, 0]], abs=1e-7)


@pytest.mark.parametrize("kind", sorted(MEASUREMENTS))
def test_torch_runs_the_same_formula(kind: str) -> None:
    known, space = MEASUREMENTS[kind], Space(3, has_rotation=True)
    z = space.join(VECTORS, ROTATIONS[::-1]) if known.compares_poses else np.zeros((50, known.size()))
    rotation = ROTATIONS if known.frame == "relative" else None
    constants = np.full((50, known.constants), 0.1)
    local = VECTORS if rotation is None else space.join(VECTORS, rotation)
    columns = (torch.tensor(a).unbind(-1) for a in (local, z, constants))
    parts = torch.stack(known.residual(*columns, torch), -1).numpy()
    assert known.wrapped(parts) == pytest.approx(known.difference(VECTORS, rotation, z, constants), abs=1e-13)


def test_dual_arithmetic_equals_casadis() -> None:
    def formula(x, y, z, m):
        return 2.0 / x - (3.0 - y) / (x * x + 1.0) + m.sqrt(y**2 + z * z) * m.atan2(z, -x) / 4.0 - 1.0

    v = ca.SX.sym("v", 3)
    expression = formula(v[0], v[1], v[2], ca)
    reference = ca.Function("f", [v], [expression, ca.jacobian(expression, v)])
    ours = formula(*seeds(VECTORS), dual_numbers)
    for i, vector in enumerate(VECTORS):
        value, derivative = (np.asarray(a).ravel() for a in reference(vector))
        assert ours.value[i] == pytest.approx(value[0], rel=1e-12)
        assert ours.derivative[:, i] == pytest.approx(derivative, rel=1e-11, abs=1e-12)


def test_angles_wrap() -> None:
    """A bearing measured just beyond -x from a point just before it is a small residual, whatever the turn."""
    problem = Problem(("a", "b")).add("azimuth", ("a", "b"), np.pi - 0.01, std=1.0)
    x = np.array([[0, 0, 0], [-10.0, -0.1, 0]])
    residual, _ = problem.whiten(x)
    assert residual[0] == pytest.approx(0.02, abs=1e-4)
    same = Problem(("a", "b")).add("azimuth", ("a", "b"), -np.pi - 0.01, std=1.0)
    assert same.whiten(x)[0] == pytest.approx(residual)


def test_a_decorated_function_is_all_it_takes() -> None:
    """A new measurement, the squared range, is at once in every backend."""

    with pytest.raises(InputError, match=r"frame = 'bodi': .* Did you mean body\?"):
        measurement("squared range", arity=2, components=("coordinate",), frame="bodi")  # type: ignore[arg-type]

    @measurement("squared range", arity=2, components=("coordinate",))
    def squared(dx, dy, dz, m=np):
        return (dx * dx + dy * dy + dz * dz,)

    try:
        problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
        problem = problem.add("squared range", ("a", "b"), 100.0, std=1e-3)
        for backend in sorted(set(backends()) - {"cvxpy"}):
            solution = solve(problem, backend)
            assert np.linalg.norm(solution["b"] - solution["a"]) == pytest.approx(10.0, abs=1e-5)
        with pytest.raises(InputError, match="registered already"):
            measurement("squared range", arity=2, components=("coordinate",))(squared)
    finally:
        del MEASUREMENTS["squared range"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"arity": 3}, "arity = 3"),
        ({"components": ("length",)}, "'coordinate', 'distance', 'angle'"),
        ({"components": ()}, "one per number"),
        ({"linear": True}, "the vector itself"),
    ],
)
def test_a_measurement_that_cannot_be(options: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        measurement("odd", **{"arity": 2, "components": ("distance",), **options})
    assert "odd" not in MEASUREMENTS
