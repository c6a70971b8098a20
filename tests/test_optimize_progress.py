"""Solves that last show their steps and their cost on stderr; others show nothing."""

from __future__ import annotations

import numpy as np
import pytest

import coopoc as co
from coopoc.optimize.descent import progress


def ranged() -> co.Problem:
    anchors = {f"a{k}": np.array(at) for k, at in enumerate(([0.0, 0], [9, 0], [0, 9]))}
    names = (*anchors, "x")
    x0 = np.array([*anchors.values(), [5.0, 5.0]])
    problem = co.Problem(names, x0=x0, dimension=2)
    for name, at in anchors.items():
        problem = problem.add("position", name, at, 1e-3).add(
            "range", ("x", name), np.linalg.norm(at - [3.0, 4.0]), 0.1
        )
    return problem


@pytest.mark.parametrize("backend", ["gauss-newton", "osqp"])
def test_a_bar_shows_steps_and_cost(
    backend: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    co.solve(ranged(), backend)  # the first call on a machine compiles
    capsys.readouterr()
    quick = co.solve(ranged(), backend)
    assert "solve" not in capsys.readouterr().err
    monkeypatch.setattr(progress, "DELAY", -1.0)
    shown = co.solve(ranged(), backend)
    assert "cost" in capsys.readouterr().err
    assert np.array_equal(shown.position, quick.position)
