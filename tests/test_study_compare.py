"""compare: means against pandas, intervals against what the draws were made of."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused

from coopoc.study.compare import compare
from coopoc.study.results import Results
from coopoc.study.run import run_study
from coopoc.study.study import Params, Row, Study
from coopoc.study.tables import Table

GRID = {"method": ("kf", "net"), "k": (0, 4)}
SETTINGS = {"runs": 40, "seed": 0, "shift": 0.0, "spread": 0.0, "fails": "", "own": "–"}


def cell(p: Params) -> list[Row]:
    """Errors around 2 m: noise of the seed that all methods share, `shift` for the net, `spread` of what is its own."""
    if f"{p['method']}{p['k']}" in p["fails"].split("+"):
        raise FloatingPointError("diverged")
    shared = np.random.default_rng([p["seed"], p["k"]]).normal(2.0, 0.5, (3, 500))[:, : p["runs"]]
    own = np.random.default_rng([len(p["own"]), ord(p["own"][0]), p["k"]]).normal(0.0, 1.0, (3, 500))
    error = shared + (p["shift"] if p["method"] == "net" else 0.0) + p["spread"] * own[:, : p["runs"]]
    return [{"run": r, "ego": f"v{e}", "rt_le_m": error[e, r], "word": "a"} for e in range(3) for r in range(p["runs"])]


def runner(folder: Path, cell: Callable[[Params], list[Row]] = cell) -> Callable[..., Path]:
    def ran(name: str, **settings: Any) -> Path:
        study = Study("demo", "?", cell, GRID, SETTINGS)
        run_study(study, folder / name, settings=settings, progress=False)
        return folder / name / "demo"

    return ran


@pytest.fixture
def ran(tmp_path: Path) -> Callable[..., Path]:
    return runner(tmp_path)


def changes(table: Table) -> pd.DataFrame:
    return pd.DataFrame(table.rows, columns=table.header)


def test_a_run_is_the_same_as_itself(ran: Callable[..., Path]) -> None:
    found = compare(ran("a"), ran("b"))
    assert set(changes(found)["Change"]) == {"same"}
    assert len(found.notes) == 1
    assert "0 of 4 groups changed beyond noise" in found.render("markdown")


def test_means_are_those_of_pandas_and_what_is_shared_cancels(ran: Callable[..., Path]) -> None:
    a, b = ran("a", spread=0.05, own="x"), ran("b", spread=0.05, own="yy", shift=0.03)
    found = changes(compare(a, b))
    for folder, side in ((a, "A"), (b, "B")):
        means = Results.load(folder).frame.groupby(["method", "k"], sort=False)["rt_le_m"].mean()
        np.testing.assert_allclose(found[side].astype(float), means, rtol=1e-12)
    for _, row in found.iterrows():
        assert row["B - A"].mean == pytest.approx(row["B"] - row["A"], abs=1e-12)
        assert row["B - A"].high - row["B - A"].low < 0.1  # the shared noise alone would make it 0.4 m wide
    assert set(found[found["Method"] == "net"]["Change"]) == {"higher"}
    back = changes(compare(b, a))
    assert set(back[back["Method"] == "net"]["Change"]) == {"lower"}


def test_noise_alone_is_seldom_called_a_change(tmp_path: Path) -> None:
    """100 groups of the same mean, 94 % intervals: 17 or more would be marked once in 10,000 times."""

    def noise(p: Params) -> list[Row]:
        draws = np.random.default_rng([p["seed"], p["stream"], p["k"]]).normal(2.0, 0.5, 30)
        return [{"run": r, "ego": "v", "rt_le_m": x} for r, x in enumerate(draws)]

    study = Study("noise", "?", noise, {"k": tuple(range(100))}, {"seed": 0, "stream": 0})
    run_study(study, tmp_path / "a", progress=False)
    run_study(study, tmp_path / "b", settings={"stream": 1}, progress=False)
    found = compare(tmp_path / "a/noise", tmp_path / "b/noise")
    assert 0 < changes(found)["Change"].isin(["higher", "lower"]).sum() < 17
    assert "by chance alone about 5.0 would" in found.notes[0]


def test_groups_that_only_one_has_are_counted(ran: Callable[..., Path]) -> None:
    found = compare(ran("a", fails="kf4"), ran("b", method="kf", k="0,4,9"))
    assert changes(found).shape[0] == 1
    assert "4 groups have finished in one of the two runs only." in found.notes


def test_an_axis_that_became_a_setting_still_matches(tmp_path: Path) -> None:
    ran = runner(tmp_path)
    wide = Study("demo", "?", cell, {**GRID, "shift": (0.0, 0.5)}, {k: v for k, v in SETTINGS.items() if k != "shift"})
    run_study(wide, tmp_path / "wide", progress=False)
    found = compare(ran("a", shift=0.5), tmp_path / "wide/demo")
    assert changes(found)["Change"].tolist() == ["same"] * 4


def test_several_rows_of_one_draw_need_a_name(tmp_path: Path) -> None:
    def rounds(p: Params) -> list[Row]:
        return [{"round": n, "run": r, "ego": 0, "rt_le_m": n + p["shift"] + 0.1 * r} for n in (0, 1) for r in range(9)]

    ran = runner(tmp_path, rounds)
    a, b = ran("a"), ran("b", shift=0.5)
    with refused(r"several rows per ego, run and training seed.*--by round"):
        compare(a, b)
    found = changes(compare(a, b, by=["round"], where=["method=kf", "k=0"]))
    assert found["Round"].tolist() == ["0", "1"]
    assert [row.mean for row in found["B - A"]] == pytest.approx([0.5, 0.5])


def test_a_value_that_is_not_finite_leaves_its_ego_out(tmp_path: Path) -> None:
    def gaps(p: Params) -> list[Row]:
        rows = cell(p)
        rows[0]["rt_le_m"] = float("nan") if p["shift"] else 1.0
        return [{**row, "nees": float("nan")} for row in rows]

    ran = runner(tmp_path, gaps)
    a, b = ran("a"), ran("b", shift=0.5)
    found = compare(a, b, where=["k=0"])
    assert "2 egos are left out" in found.notes[1]
    assert changes(found)["B - A"][1].mean == pytest.approx(0.5)
    assert set(changes(compare(a, b, "nees"))["Change"]) == {"no finite value"}


def test_what_cannot_be_compared_is_named(ran: Callable[..., Path], tmp_path: Path) -> None:
    a, b = ran("a"), ran("b")
    run_study(Study("other", "?", cell, GRID, SETTINGS), tmp_path, progress=False)
    with refused(r"must be one study of one noise seed, not demo .* and other"):
        compare(a, tmp_path / "other")
    with refused("not demo with noise seed 0 and demo with noise seed 1"):
        compare(a, ran("c", seed=1))
    with refused(r"holds no manifest\.json"):
        compare(a, tmp_path)
    with refused(r"metric = 'rt_le'.*Did you mean rt_le_m"):
        compare(a, b, "rt_le")
    with refused("metric = 'word': must be a column of numbers"):
        compare(a, b, "word")
    with refused(r"column = 'metod'.*Did you mean method"):
        compare(a, b, where=["metod=kf"])
    with refused("must have a row in one of the runs"):
        compare(a, b, where=["method=okf"])
