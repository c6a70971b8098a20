"""The range-only example: the bound holds, tight points are global optima, local minima get no certificate."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.optimize import least_squares

from coopoc.arrays import Floats
from coopoc.optimize import Problem

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "range_only.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("range_only", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["range_only"] = module
    spec.loader.exec_module(module)
    return module


def test_the_example_tells_local_from_global(example: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    rows = example.main()
    printed = capsys.readouterr().out
    assert printed.count("\n") == len(rows) + 3
    local = [row for row in rows if row.blind > row.cost * (1 + 1e-6)]
    assert len(local) >= 2
    assert f"{len(local)} of {len(rows)} blind starts ended in a local minimum" in printed
    assert not any(row.certified for row in local)
    assert sum(row.tight for row in rows) >= 2
    for row in rows:
        assert row.bound <= row.cost * (1 + 1e-9)
        assert row.cost <= row.blind * (1 + 1e-9)
        if row.tight:
            assert row.cost == pytest.approx(row.bound, rel=1e-5)
        if row.certified:
            assert row.blind == pytest.approx(row.cost, rel=1e-6)


def brute(problem: Problem, start: Floats) -> float:
    """Cost of the minimum that scipy reaches from a start."""

    def residual(y: Floats) -> Floats:
        return problem.whiten(y.reshape(-1, 2))[0]

    return float(least_squares(residual, start, jac=lambda y: problem.whiten(y.reshape(-1, 2))[1].toarray()).cost)


def test_no_start_of_scipys_beats_the_bound(example: ModuleType) -> None:
    """Fifteen random starts of scipy.optimize.least_squares stay above; the best of them is the relaxation's point."""
    for seed in (1, 2):
        problem = example.scene(seed)
        row = example.judge(problem, seed)
        rng = np.random.default_rng(0)
        found = [brute(problem, rng.uniform(-20, 20, 12)) for _ in range(15)]
        assert min(found) >= row.bound * (1 - 1e-6)
        assert row.cost <= min(found) * (1 + 1e-6)
