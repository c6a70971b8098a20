"""The range-only example: the semidefinite relaxation bounds the cost, and is tight where it says so."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.optimize import least_squares

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "range_only.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("range_only", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["range_only"] = module
    spec.loader.exec_module(module)
    return module


def test_the_bound_holds_and_is_tight(example: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    rows = example.main(seeds=2)
    assert capsys.readouterr().out.count("\n") == len(rows) + 2
    for row in rows:
        assert row.bound <= row.cost * (1 + 1e-6)
        assert row.cost <= row.from_fixes * (1 + 1e-9)
    tight = [row for row in rows if row.rank_ratio < 1e-5]
    assert len(tight) >= 4
    for row in tight:
        assert row.cost == pytest.approx(row.bound, rel=1e-5)


def test_the_eliminated_cost_is_the_cost(example: ModuleType) -> None:
    """y^T C y at unit vectors along the solution's own edges is the problem's cost there."""
    problem = example.snapshot(5, seed=1)
    x = example.solve(problem).x
    cost, positions = example.eliminate_positions(problem)
    units = (x[1:] - x[0]) / np.linalg.norm(x[1:] - x[0], axis=1, keepdims=True)
    y = np.concatenate([[1.0], units.ravel()])
    assert y @ cost @ y == pytest.approx(problem.cost(x), rel=1e-9)
    assert positions(units) == pytest.approx(x, abs=1e-5)


def test_no_start_of_scipys_beats_the_bound(example: ModuleType) -> None:
    """Forty random starts of scipy.optimize.least_squares stay above, and the best of them reaches it."""
    problem = example.snapshot(6, seed=0)
    row = example.bound_and_refine(problem, example.shor(6))
    rng = np.random.default_rng(0)
    found = [
        least_squares(lambda f: problem.whiten(f.reshape(-1, 3))[0], rng.normal(0, 20, 21)).cost for _ in range(40)
    ]
    assert min(found) >= row.bound * (1 - 1e-6)
    assert min(found) == pytest.approx(row.bound, rel=1e-4)
