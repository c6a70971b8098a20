"""Measurements: one formula for NumPy, torch and CasADi; our derivative against CasADi's own differentiation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch

from coopoc import InputError
from coopoc.optimize import MEASUREMENTS, Problem, backends, measurement, solve
from coopoc.optimize import dual as dual_numbers
from coopoc.optimize.dual import seeds

VECTORS = np.random.default_rng(0).normal(size=(50, 3)) * [20, 20, 5]


@pytest.mark.parametrize("kind", sorted(MEASUREMENTS))
def test_derivative_equals_casadis(kind: str) -> None:
    known = MEASUREMENTS[kind]
    v = ca.SX.sym("v", 3)
    formula = ca.vertcat(*known.formula(v[0], v[1], v[2], ca))
    reference = ca.Function("h", [v], [formula, ca.jacobian(formula, v)])
    value, slope = known.differentiate(VECTORS)
    slope = np.broadcast_to(slope, (len(VECTORS), known.size, 3))
    for i, vector in enumerate(VECTORS):
        h, J = (np.asarray(a) for a in reference(vector))
        assert value[i] == pytest.approx(h[:, 0], abs=1e-13)
        assert slope[i] == pytest.approx(J, abs=1e-13)


@pytest.mark.parametrize("kind", sorted(MEASUREMENTS))
def test_torch_runs_the_same_formula(kind: str) -> None:
    known = MEASUREMENTS[kind]
    parts = known.formula(*torch.tensor(VECTORS).unbind(-1), torch)
    assert torch.stack(parts, -1).numpy() == pytest.approx(known.predict(VECTORS), abs=1e-13)


def test_dual_arithmetic_equals_casadis() -> None:
    def formula(x, y, z, m):
        return 2.0 / x - (3.0 - y) / (x * x + 1.0) + m.sqrt(y**2 + z * z) * m.atan2(z, -x) / 4.0 - 1.0

    v = ca.SX.sym("v", 3)
    expression = formula(v[0], v[1], v[2], ca)
    reference = ca.Function("f", [v], [expression, ca.jacobian(expression, v)])
    ours = formula(*seeds(VECTORS), dual_numbers)
    for i, vector in enumerate(VECTORS):
        value, slope = (np.asarray(a).ravel() for a in reference(vector))
        assert ours.value[i] == pytest.approx(value[0], rel=1e-12)
        assert ours.slope[:, i] == pytest.approx(slope, rel=1e-11, abs=1e-12)


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

    @measurement("squared range", arity=2, components=("coordinate",))
    def squared(dx, dy, dz, m=np):
        return (dx * dx + dy * dy + dz * dz,)

    try:
        problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
        problem = problem.add("squared range", ("a", "b"), 100.0, std=1e-3)
        for backend in backends():
            solution = solve(problem, backend)
            assert np.linalg.norm(solution["b"] - solution["a"]) == pytest.approx(10.0, abs=1e-5)
        with pytest.raises(InputError, match="registered already"):
            measurement("squared range", arity=2, components=("coordinate",))(squared)
    finally:
        del MEASUREMENTS["squared range"]


@pytest.mark.parametrize(
    ("options", "words"),
    [({"arity": 3}, "arity = 3"), ({"components": ("length",)}, "'coordinate', 'distance', 'angle'"),
     ({"components": ()}, "one per number"), ({"linear": True}, "the vector itself")],
)  # fmt: skip
def test_a_measurement_that_cannot_be(options: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        measurement("odd", **{"arity": 2, "components": ("distance",), **options})
    assert "odd" not in MEASUREMENTS
