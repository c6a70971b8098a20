"""Results: means against pandas' own, and what must not be mixed."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from coopoc.errors import InputError
from coopoc.study.results import Results
from coopoc.study.tables import pivot


def results(frame: pd.DataFrame, axes: tuple[str, ...] = ("method", "noise_model", "k")) -> Results:
    return Results("demo", "?", axes, {}, frame, pd.DataFrame(), 0, {})


@pytest.fixture
def rows() -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    return [
        {"method": m, "noise_model": kn, "k": k, "ego": ego, "run": run, "rt_le_m": rng.gamma(4.0)}
        for m, kn in (("gnss", "identity"), ("kalman", "identity"), ("kalman", "fitted"), ("bound", "nominal"))
        for k in (0, 4)
        for ego in ("b", "a")
        for run in range(6)
    ]


def test_means_are_those_of_pandas(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows)
    by = ["method", "noise_model", "k"]
    summary = results(frame).summary(by, "rt_le_m").set_index(by)["mean"]
    expected = frame.groupby(by)["rt_le_m"].mean()
    for name, value in expected.items():
        assert summary[name] == pytest.approx(value)
    assert list(dict.fromkeys(summary.index.get_level_values("method"))) == ["gnss", "kalman", "bound"]


def test_values_are_paired_by_ego_and_run_whatever_the_order_of_rows(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows)
    where = {"noise_model": "identity", "k": 0}
    straight = results(frame).values("rt_le_m", where, method="gnss")
    mixed = results(frame.sample(frac=1.0, random_state=1)).values("rt_le_m", where, method="gnss")
    assert straight.shape == (2, 6)
    np.testing.assert_array_equal(straight, mixed)
    first = frame.query("method == 'gnss' and k == 0 and ego == 'a'").sort_values("run")["rt_le_m"]
    np.testing.assert_array_equal(straight[0], first)


def test_training_seeds_are_averaged_before_the_interval(rows: list[dict[str, Any]]) -> None:
    one = pd.DataFrame(rows).query("method == 'gnss'")
    many = pd.concat([one.assign(train_seed=s, rt_le_m=one["rt_le_m"] + s) for s in (0, 1, 2)])
    found = results(many, ("method", "noise_model", "k", "train_seed")).interval("rt_le_m", k=0)
    assert found.mean == pytest.approx(one.query("k == 0")["rt_le_m"].mean() + 1)
    assert found.n == 12


def test_what_would_be_mixed_is_named(rows: list[dict[str, Any]]) -> None:
    found = results(pd.DataFrame(rows))
    with pytest.raises(InputError, match="noise_model = identity, fitted: would be averaged together"):
        found.interval("rt_le_m", method="kalman", k=0)
    with pytest.raises(InputError, match=r"k = 0, 4: would be averaged together\. Name k in where, rows or columns"):
        found.summary(["method", "noise_model"], "rt_le_m")
    with pytest.raises(InputError, match=r"column = 'metod'.*Did you mean method\?"):
        found.summary(["metod"], "rt_le_m")
    with pytest.raises(InputError, match=r"metric = 'rt_le'.*Did you mean rt_le_m\?"):
        found.interval("rt_le", method="gnss", k=0)
    with pytest.raises(InputError, match="k = 7: must be among 0, 4"):
        found.select(k=7)


def test_an_ego_without_all_its_runs_is_left_out_and_said_so(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows)
    gone = frame.drop(frame.query("method == 'gnss' and k == 0 and ego == 'b' and run == 3").index)
    summary = results(gone).summary(["method", "noise_model", "k"], "rt_le_m")
    assert summary.query("method == 'gnss' and k == 0")[["n", "missing"]].to_numpy().tolist() == [[6, 1]]
    table = pivot(results(gone), ["k"], "method", "rt_le_m", where={"noise_model": ["identity"]})
    assert "1 egos are left out" in table.notes[0]


def test_a_seed_that_diverged_is_not_averaged_away(rows: list[dict[str, Any]]) -> None:
    """The mean over the other seeds would look like a mean over all."""
    one = pd.DataFrame(rows).query("method == 'gnss' and k == 0")
    many = pd.concat([one.assign(train_seed=s) for s in (0, 1)], ignore_index=True)
    many.loc[many.query("train_seed == 1 and ego == 'b' and run == 2").index, "rt_le_m"] = np.nan
    summary = results(many, ("method", "train_seed")).summary(["method"], "rt_le_m")
    assert summary[["n", "missing"]].to_numpy().tolist() == [[6, 1]]
    many.loc[many.query("train_seed == 0 and ego == 'a' and run == 1").index, "rt_le_m"] = np.nan
    summary = results(many, ("method", "train_seed")).summary(["method"], "rt_le_m")
    assert summary[["n", "missing"]].to_numpy().tolist() == [[0, 2]]


def test_values_that_no_row_has_together_are_no_empty_table(rows: list[dict[str, Any]]) -> None:
    with pytest.raises(InputError, match=r"where = .*gnss.*must have a row with all of these"):
        pivot(results(pd.DataFrame(rows)), "k", "method", "rt_le_m", where={"method": "gnss", "noise_model": "fitted"})


def test_words_are_no_metric(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows).assign(quantiles=[[0.1, 0.2]] * len(rows))
    for name in ("ego", "quantiles"):
        with pytest.raises(InputError, match=f"metric = '{name}': must be a column of numbers"):
            results(frame).interval(name, method="gnss", k=0)


def test_the_bound_is_not_the_best_under_any_knowledge(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows).assign(rt_le_m=lambda f: np.where(f["method"] == "bound", 0.1, f["rt_le_m"]))
    table = pivot(results(frame), "k", ["method", "noise_model"], "rt_le_m", intervals=False)
    assert table.header[-1] == "Cramér-Rao bound, nominal"
    for line in table.to_markdown().splitlines()[4:6]:
        assert line.count("**") == 2
        assert "**" not in line.split("|")[-2]


def test_a_metric_that_a_method_does_not_have_is_no_failure(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows).query("noise_model == 'identity'").copy()
    frame["nees"] = np.where(frame["method"] == "gnss", np.nan, 3.0)
    table = pivot(results(frame), "k", "method", "nees")
    assert table.rows[0][1] is None
    assert table.notes == ()
    with pytest.raises(InputError, match="nees = no finite value"):
        results(frame).interval("nees", method="gnss", k=0)


def test_selection_from_text(rows: list[dict[str, Any]]) -> None:
    found = results(pd.DataFrame(rows))
    assert found.parsed(["k=0,4", "method=gnss"]) == {"k": [0, 4], "method": ["gnss"]}
    with pytest.raises(InputError, match="k = 'x': must be a whole number"):
        found.parsed(["k=x"])


def test_parquet_holds_every_digit(rows: list[dict[str, Any]], tmp_path: Any) -> None:
    frame = pd.DataFrame(rows).assign(quantiles=[[0.1, 0.2]] * len(rows))
    results(frame).to_parquet(tmp_path / "r.parquet")
    back = pd.read_parquet(tmp_path / "r.parquet")
    np.testing.assert_array_equal(back["rt_le_m"], frame["rt_le_m"])
    assert back["quantiles"].iloc[0].tolist() == [0.1, 0.2]


def test_tables_over_several_columns(rows: list[dict[str, Any]]) -> None:
    frame = pd.DataFrame(rows).query("method == 'kalman'")
    table = pivot(results(frame), "k", ["method", "noise_model"], "rt_le_m", along="column")
    assert table.header == ("K", "KF, identity", "KF, fitted")
    assert table.along == "column"
    assert table.rows[1][2].mean == pytest.approx(frame.query("k == 4 and noise_model == 'fitted'")["rt_le_m"].mean())
