"""The examples run as they stand; the lazy names of the package are those that types see."""

import ast
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shell import ran

import coopoc
from coopoc.studies.world_faults import KINDS
from coopoc.studies.worlds import World, world

ROOT = Path(__file__).resolve().parents[1]


def test_first_steps_runs() -> None:
    script = ROOT / "examples" / "first_steps.py"
    out = ran([sys.executable, "-W", "error", script], check=True).stdout
    assert out.count("SOLVED") == 4
    assert "FedKalmanNet" in out


def test_lazy_names_are_the_typed_names() -> None:
    tree = ast.parse((ROOT / "coopoc" / "__init__.pyi").read_text())
    typed = {alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert typed - {None} == set(coopoc.__all__)
    for name in coopoc.__all__:
        assert getattr(coopoc, name).__name__.split(".")[-1] == name


@pytest.fixture(scope="module")
def judged() -> tuple[Any, Any]:
    """star.py and judge.py of the learned judge."""
    pytest.importorskip("torch")
    made = []
    for name in ("star", "judge"):
        spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / "learned_judge" / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        made.append(importlib.util.module_from_spec(spec))
        sys.modules[name] = made[-1]
        spec.loader.exec_module(made[-1])
    return made[0], made[1]


WITH_AND_WITHOUT = (world(9, "development", without=[*KINDS]), world(12, "development"))


@pytest.mark.parametrize("drawn", WITH_AND_WITHOUT, ids=("nothing wrong", "faults"))
def test_a_judge_of_ones_is_the_textbook_filter(drawn: World, judged: tuple[Any, Any]) -> None:
    star, judge = judged
    expected = coopoc.JointFilter(robust=False)(drawn.recording, list(drawn.egos))
    believing = judge.begin(0)
    believing[:, -star.HIDDEN[1] - 1 : -1] = 0.0
    for e, ego in enumerate(drawn.egos):
        stars = star.pack(drawn.recording, ego, drawn.fleet)
        for one in (star.Judge(star.NONE), star.Judge(star.NET, believing)):
            x, covariance, _ = star.follow(stars, one)
            np.testing.assert_allclose(x, expected.x[:, :, e], atol=1e-7)
            np.testing.assert_allclose(covariance, expected.covariance[:, :, e], atol=1e-9, rtol=1e-6)


def test_a_judge_learns_its_targets(judged: tuple[Any, Any]) -> None:
    star, judge = judged
    packs = [star.pack(drawn.recording, drawn.egos[0], drawn.fleet) for drawn in WITH_AND_WITHOUT]
    rows = judge.rows_of(packs, star.Judge(star.NONE), 0)
    assert sum(map(len, rows)) > 100
    assert all(np.isfinite(each).all() for each in rows)
    before = judge.begin(0)
    after = judge.fit(before, rows, 100, 0)

    def loss(weights: Any, head: int) -> float:
        every = np.tile(rows[head], (star.HEADS, 1, 1))
        found = judge.logarithms(*map(judge.torch.from_numpy, (weights.astype(np.float32), every[:, :, :-1])))
        return float(np.abs(found[head].numpy() - every[head, :, -1]).mean())

    for head in (star.OWN, star.MOTION):
        assert loss(after, head) < loss(before, head)
