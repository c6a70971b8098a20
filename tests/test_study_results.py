"""Results and tables: means against pandas, what must not be mixed, tables in every format."""

import json

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from latex import compiled
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from test_report import Page

from coopoc.evaluate.statistics import Interval
from coopoc.study.results import Results
from coopoc.study.style import look
from coopoc.study.tables import Table, pivot


def results(frame, axes=("method", "noise_model", "k")):
    return Results("demo", "?", axes, {}, frame, pd.DataFrame(), 0, {})


@pytest.fixture
def frame():
    rng = default_rng(0)
    rows = [
        {"method": m, "noise_model": kn, "k": k, "ego": ego, "run": run, "rt_le_m": rng.gamma(4.0)}
        for m, kn in (("gnss", "identity"), ("kalman", "identity"), ("kalman", "fitted"), ("bound", "nominal"))
        for k in (0, 4)
        for ego in ("b", "a")
        for run in range(6)
    ]
    return pd.DataFrame(rows)


def test_means_are_those_of_pandas(frame):
    by = ["method", "noise_model", "k"]
    summary = results(frame).summary(by, "rt_le_m").set_index(by)["mean"]
    for name, value in frame.groupby(by)["rt_le_m"].mean().items():
        assert summary[name] == pytest.approx(value)
    assert list(dict.fromkeys(summary.index.get_level_values("method"))) == ["gnss", "kalman", "bound"]


def test_values_are_paired_by_ego_and_run_whatever_the_order_of_rows(frame):
    where = {"noise_model": "identity", "k": range(1)}
    straight = results(frame).values("rt_le_m", where, method="gnss")
    mixed = results(frame.sample(frac=1.0, random_state=1)).values("rt_le_m", where, method="gnss")
    assert straight.shape == (6, 2)
    assert_array_equal(straight, mixed)


def test_training_seeds_are_averaged_before_the_interval(frame):
    one = frame.query("method == 'gnss'")
    many = pd.concat([one.assign(train_seed=s, rt_le_m=one["rt_le_m"] + s) for s in (0, 1, 2)])
    found = results(many, ("method", "noise_model", "k", "train_seed")).interval("rt_le_m", k=0)
    assert found.mean == pytest.approx(one.query("k == 0")["rt_le_m"].mean() + 1)
    assert found.n == 12


def test_what_would_be_mixed_is_named(frame):
    found = results(frame)
    with refused("noise_model = identity, fitted: would be averaged together"):
        found.interval("rt_le_m", method="kalman", k=0)
    with refused(r"k = 0, 4: would be averaged together\. Name k in where, rows or columns"):
        found.summary(["method", "noise_model"], "rt_le_m")
    with refused(r"column = 'metod'.*Did you mean method\?"):
        found.summary(["metod"], "rt_le_m")
    with refused("by = 'method': must be a sequence"):
        found.summary("method", "rt_le_m")
    with refused(r"metric = 'rt_le'.*Did you mean rt_le_m\?"):
        found.interval("rt_le", method="gnss", k=0)
    with refused("k = 7: must be among 0, 4"):
        found.select(k=7)


def test_classes_of_one_name_are_told_apart_by_their_files():
    names = ["a.py:A", "b.py:A", "c.py:B", "d.py:C"]
    results(pd.DataFrame({"method": names, "label": ["Mine", "Mine", look("kalman").label, "Other"]}))
    assert [look(name).label for name in names] == ["Mine (a.py:A)", "Mine (b.py:A)", "KF (c.py:B)", "Other"]


def test_an_ego_without_all_its_runs_is_left_out_and_said_so(frame):
    gone = frame.drop(frame.query("method == 'gnss' and k == 0 and ego == 'b' and run == 3").index)
    summary = results(gone).summary(["method", "noise_model", "k"], "rt_le_m")
    assert summary.query("method == 'gnss' and k == 0")[["n", "missing"]].to_numpy().tolist() == [[6, 6]]
    table = pivot(results(gone), ["k"], "method", "rt_le_m", where={"noise_model": ["identity"]})
    assert "6 values of GNSS are left out of 1 means" in table.notes[0]


def test_a_seed_that_diverged_is_not_averaged_away(frame):
    """The mean over the other seeds would look like a mean over all."""
    one = frame.query("method == 'gnss' and k == 0")
    many = pd.concat([one.assign(train_seed=s) for s in (0, 1)], ignore_index=True)
    for which, counts in (("1 and ego == 'b' and run == 2", [6, 6]), ("0 and ego == 'a' and run == 1", [0, 12])):
        many.loc[many.query(f"train_seed == {which}").index, "rt_le_m"] = np.nan
        summary = results(many, ("method", "train_seed")).summary(["method"], "rt_le_m")
        assert summary[["n", "missing"]].to_numpy().tolist() == [counts]


def test_a_metric_that_a_method_does_not_have_is_no_failure(frame):
    frame = frame.query("noise_model == 'identity'").copy()
    frame["nees"] = np.where(frame["method"] == "gnss", np.nan, 3.0)
    table = pivot(results(frame), "k", "method", "nees")
    assert table.rows[0][1] is None
    assert table.notes == ()
    with refused("nees = no finite value"):
        results(frame).interval("nees", method="gnss", k=0)


def test_tables_over_several_columns(frame):
    frame = frame.query("method == 'kalman'")
    table = pivot(results(frame), "k", ["method", "noise_model"], "rt_le_m")
    assert table.header == ("K", "KF, identity", "KF, fitted")
    assert table.rows[1][2].mean == pytest.approx(frame.query("k == 4 and noise_model == 'fitted'")["rt_le_m"].mean())


def test_what_noise_or_training_explains_is_not_the_best():
    """20 draws of a common noise: the joint filter is better by 0.1 m at k = 4; trainings differ by as much."""
    draws = default_rng(0).normal(1.5, [[0.2], [0.01], [0.01]], (3, 20))
    for other, seeds, bold in (("joint", (None,), [0, 2]), ("fedkalmannet", (0, 1, 2, 3, 4), [0, 0])):
        rows = [
            {"k": k, "method": method, "noise_model": "a", "train_seed": seed, "ego": "e", "run": run, "rt_le_m": value}
            for k, better in ((0, 0.0), (4, 0.1))
            for method, noise, trainings in (("kalman", draws[1], (None,)), (other, draws[2], seeds))
            for seed in trainings
            for run, value in enumerate(draws[0] + noise + (method == other) * ((seed or 0) * better - better))
        ]
        made = pivot(results(pd.DataFrame(rows)), "k", "method", "rt_le_m")
        assert ("Bold: " in made.caption) == any(bold)
        assert [line.count("**") for line in made.to_markdown().splitlines()[4:]] == bold
        assert Table.from_data(json.loads(json.dumps(vars(made), default=vars))) == made


TABLE = Table(
    ("K", "KF & co", "50 %_x", "Cramér-Rao bound"),
    (("0", Interval(0.8047, 0.75, 0.85, 30), Interval(1.2, 1.1, 1.3, 30), 0.5), ("4", 0.912, None, 0.4)),
    "RT-LE [m] at σ = 3.5 m, ±4°.",
    best="min",
    notes=("A note.",),
)


def test_markdown():
    assert TABLE.to_markdown().splitlines() == [
        "RT-LE [m] at σ = 3.5 m, ±4°.",
        "",
        "| K   |               KF & co |            50 %_x |   Cramér-Rao bound |",
        "|:----|----------------------:|------------------:|-------------------:|",
        "| 0   | **0.80** [0.75, 0.85] | 1.20 [1.10, 1.30] |               0.50 |",
        "| 4   |                  0.91 |                 – |               0.40 |",
        "",
        "A note.",
    ]


def test_latex():
    assert TABLE.to_latex().splitlines() == [
        r"\begin{table}",
        r"\centering",
        r"\caption{RT-LE [m] at $\sigma$ = 3.5 m, $\pm$4$^\circ$. A note.}",
        r"\smallskip",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        r"\begin{tabular}{lrrr}",
        r"\toprule",
        r"K & KF \& co & 50 \%\_x & Cramér-Rao bound \\",
        r"\midrule",
        r"0 & \textbf{0.80} {\scriptsize [0.75, 0.85]} & 1.20 {\scriptsize [1.10, 1.30]} & 0.50 \\",
        r"4 & 0.91 & -- & 0.40 \\",
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table}",
    ]


def test_csv_keeps_every_digit_and_the_interval():
    assert TABLE.to_csv().splitlines() == [
        "K,KF & co,KF & co low,KF & co high,50 %_x,50 %_x low,50 %_x high,Cramér-Rao bound",
        "0,0.8047,0.75,0.85,1.2,1.1,1.3,0.5",
        "4,0.912,,,,,,0.4",
    ]


def test_html_is_well_formed_and_escaped():
    html = TABLE.to_html()
    assert Page(html).open == []
    assert "KF &amp; co" in html
    assert "<strong>0.80</strong>" in html


def test_best_is_sought_among_methods_and_never_the_bound():
    rows = (("GNSS", 6.0, 5.0), ("KF", 1.0, 2.0), ("OKF", 1.001, 1.5), ("Oracle KF", 0.5, 0.5))
    lines = Table(("Method", "a", "b"), rows, "", best="min", along="column").to_markdown().splitlines()[2:]
    assert [line.count("**") for line in lines] == [0, 2, 4, 0]  # KF and OKF tie as shown
    assert Table(("K", "KF"), (("0", 1.0),), "", best="min").to_markdown().count("**") == 0
    assert "**6.00**" in Table(("Method", "a"), tuple(r[:2] for r in rows), "", "max", "column").to_markdown()


def test_what_cannot_be_shown_is_named():
    with refused("must have 2 entries"):
        Table(("a", "b"), ((1,),), "")
    with refused("format = 'word': must be one of markdown, csv, latex, html"):
        TABLE.render("word")


def test_latex_compiles(tmp_path):
    odd = Table(tuple(r"[%$#_{}~^\<>&"), (tuple("[–≤Δ×σ°²−é🚗o|"), tuple("*αΩ→∇≈±µ“”yz|")), "100 % & more_")
    wide = Table(("Method", *map(str, range(12))), (("KF", *(Interval(0.5, 0.4, 0.6, 30),) * 12),), "Wide.")
    assert "Overfull" not in compiled(TABLE.to_latex() + odd.to_latex() + wide.to_latex(), tmp_path)
