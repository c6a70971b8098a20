"""casadi: it ends where SciPy ends, refuses what it cannot, and moves rotations as SciPy does."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
from conftest import refused
from random_graphs import scipys, star
from scipy.spatial.transform import Rotation

from coopoc.optimize import Loss, Status, solve
from coopoc.optimize.model.derivatives import cayley
from coopoc.optimize.starts.initial import initial_guess


@pytest.mark.parametrize("start", [None, 20.0])
def test_ranges_end_where_scipy_ends(start):
    """From the linear start and from 20 m off; SciPy's trust region may go elsewhere from there."""
    for seed in range(12):
        problem, rng = star("range", seed, 8, 3.0), np.random.default_rng(seed)
        if start is not None:
            problem = replace(problem, x0=problem.factors[0].z + rng.normal(0, start, (9, 3)))
        found = solve(problem, "casadi")
        assert found.status is Status.SOLVED
        if start is None:
            assert found.cost == pytest.approx(
                scipys(problem, initial_guess(problem), xtol=1e-15, ftol=1e-15).cost, rel=1e-9
            )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"max_iterations": -1}, "must be >= 0"),
        ({"tolerance": 0}, "must be a number > 0"),
        ({"structure": 0}, "is no option of casadi"),
    ],
)
def test_wrong_options(options, words):
    with refused(words):
        solve(star("range", 0, 8, 3.0), "casadi", **options)


def test_a_truncated_loss_is_refused_with_the_way_out():
    problem = star("range", 0, 8, 3.0)
    doubted = replace(problem, factors=tuple(replace(f, loss=Loss("truncated", 3.0)) for f in problem.factors))
    with refused(r"loss truncated: cannot be solved by casadi, only by .*gauss-newton"):
        solve(doubted, "casadi")


@pytest.mark.parametrize("w", [(0.3, -0.2, 0.9), (1e-9, 0.0, 0.0), (-2.0, 1.0, 3.0)])
def test_steps_of_a_rotation_are_scipys(w):
    """Cayley's map turns about w by 2 atan(|w| / 2), to first order by |w|."""
    size = float(np.linalg.norm(w))
    wanted = Rotation.from_rotvec(2.0 * np.arctan(size / 2.0) * np.array(w) / size).as_matrix()
    found = np.array([[float(entry) for entry in row] for row in cayley([casadi.DM(value) for value in w])])
    np.testing.assert_allclose(found, wanted, atol=1e-14)
