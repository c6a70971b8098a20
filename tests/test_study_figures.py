"""Figures: the same bytes twice, one look per method, and what is drawn is what was measured."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib import style
from numpy.testing import assert_allclose
from shell import ROOT

from coopoc.plugins import find
from coopoc.studies import weights
from coopoc.studies.error_cdf import quantile
from coopoc.study import figures
from coopoc.study.results import Results
from coopoc.study.style import METHODS, Panel, look
from coopoc.study.tables import pivot


@pytest.fixture(scope="module")
def results():
    rng = np.random.default_rng(0)
    rows = []
    lines = [
        ("gnss", "identity", 6.0, 0),
        ("kalman", "identity", 4.0, 0),
        ("kalman", "fitted", 0.9, 0),
        ("joint", "fitted", 0.7, 320),
        ("fedkalmannet", "trained", 1.1, 0),
        ("bound", "nominal", 0.5, 320),
    ]
    for method, noise_model, level, bytes_each in lines:
        for k in (0, 2, 10):
            for run in range(5):
                errors = abs(rng.normal(size=200)) * level
                rows.append(
                    {
                        "method": method,
                        "noise_model": noise_model,
                        "max_neighbours": k,
                        "ego": "a",
                        "run": run,
                        "rt_le_m": level * rng.uniform(0.9, 1.1) / (1 + 0.02 * k * bool(bytes_each)),
                        "bytes_per_second": float(k * bytes_each),
                        "error_quantiles_m": np.quantile(errors, np.linspace(0, 1, 51)).tolist(),
                    }
                )
    axes = ("method", "noise_model", "max_neighbours")
    return Results("demo", "?", axes, {}, pd.DataFrame(rows), pd.DataFrame(), 0, {})


GNSS = {"method": "gnss", "noise_model": "identity", "max_neighbours": 0}
LINES = [{"method": "joint"}, {"method": "bound"}]


PLOTS: dict[str, Callable[[Results], Any]] = {
    "sweep": lambda results: figures.sweep(results, "max_neighbours", log=True),
    "pareto": lambda results: figures.pareto(results, "c"),
    "curves": lambda results: figures.curves(results, [Panel({k: {"max_neighbours": k} for k in (0, 2)})], LINES, "c"),
}


@pytest.mark.parametrize("make", PLOTS.values(), ids=PLOTS)
def test_the_same_numbers_give_the_same_bytes(results, tmp_path, make):
    with style.context(["dark_background", {"text.usetex": True}]):
        assert make(results).save(tmp_path / "a")
    make(results).save(tmp_path / "b")
    for suffix in ("pdf", "png", "svg"):
        first, second = ((tmp_path / f"{n}.{suffix}").read_bytes() for n in "ab")
        assert first == second
    assert b"/Type /Font" in (tmp_path / "a.pdf").read_bytes()  # text stays text
    assert b"<image" not in (tmp_path / "a.svg").read_bytes()


def test_no_two_methods_look_alike():
    looks = [(m.color, m.marker) for m in METHODS.values()]
    assert len(set(looks)) == len(looks)
    assert len({m.label for m in METHODS.values()}) == len(METHODS)
    assert look("msmv_r") == look("msmv-r")
    assert look("my own") == look("my own") != look("another")


def test_a_sweep_draws_the_means_in_the_method_colour(results):
    where = {"noise_model": ["fitted", "nominal"]}
    axes = figures.sweep(results, "max_neighbours", where=where, log=True).figure.axes[0]
    drawn = {line.get_color(): line for line in axes.lines}
    assert set(drawn) == {look(m).color for m in ("kalman", "joint", "bound")}
    expected = results.frame.query("method == 'joint'").groupby("max_neighbours")["rt_le_m"].mean()
    assert_allclose(drawn[look("joint").color].get_ydata(), expected.to_numpy())
    assert drawn[look("bound").color].get_linestyle() == "--"
    assert len(axes.collections) == 3
    axes.set_ylim(1.0, 2e4)
    assert [axes.yaxis.get_major_formatter()(value) for value in (10.0, 20.0)] == ["10", ""]
    *_, one, other = figures.sweep(results, "max_neighbours").figure.axes[0].get_legend().get_texts()
    assert (one.get_text(), other.get_text()) == ("identity", "fitted / trained")


def test_a_distribution_is_that_of_all_steps(results):
    where = {"max_neighbours": 2, "method": "joint"}
    errors = np.concatenate(results.select(where)["error_quantiles_m"].to_list())
    found = quantile(results, {**where, "share": 0.9})
    assert found is not None
    assert np.mean(errors <= found) == pytest.approx(0.9, abs=1 / len(errors))
    assert quantile(results, {**where, "method": "okf", "share": 0.9}) is None


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_no_letter_of_the_legend_is_cut_off(results, tmp_path, suffix):
    """Letters are hinted wider at the 72 dpi of PDF and SVG than at others, and the legend must fit in all of them."""
    frames = [results.frame.assign(method=f"{number}.py:{'long' * 20}{number}") for number in range(20)]
    plot = PLOTS["sweep"](replace(results, frame=pd.concat(frames).assign(noise_model="a")))
    plot.save(tmp_path / "a")
    plot.figure.set_dpi({"svg": 72, "png": 200}[suffix])
    plot.figure.draw_without_rendering()
    assert plot.figure.axes[0].get_legend().get_window_extent().x1 <= plot.figure.bbox.x1


def test_a_front_joins_what_no_cheaper_method_beats(results):
    axes = figures.pareto(results, "c", where={"method": ["joint", "gnss", "bound"]}).figure.axes[0]
    marks, front, level, _ = axes.lines
    means = (
        results.frame.query("method == 'joint' and max_neighbours > 0").groupby("bytes_per_second")["rt_le_m"].mean()
    )
    assert dict(zip(*marks.get_data(), strict=True)) == pytest.approx(means.to_dict())
    assert (np.diff(front.get_ydata()) < 0).all()
    assert level.get_ydata()[0] == pytest.approx(
        results.select(method="gnss").groupby("max_neighbours")["rt_le_m"].mean().min()
    )


def test_curves_draw_numbers_of_their_selections(results):
    panel = Panel({k: {"max_neighbours": k} for k in (0, 2, 10, 99)}, {"noise_model": "fitted"}, "a title")
    plot = figures.curves(results, [panel], LINES, "c", levels=[GNSS])
    joint, level = plot.figure.axes[0].lines  # the bound has another noise model, and no K = 99 was run
    expected = results.frame.query("method == 'joint'").groupby("max_neighbours")["rt_le_m"].mean()
    assert_allclose(joint.get_ydata(), expected.to_numpy())
    assert level.get_ydata()[0] == pytest.approx(results.select(GNSS)["rt_le_m"].mean())
    assert figures.curves(results, [panel], [{"method": "okf"}], "c") is None
    mine, alike = {"method": "kalman", "label": "mine"}, [LINES[0], dict(LINES[0])]
    both = figures.curves(results, [panel], [*alike, mine], "c")
    assert [text.get_text() for text in both.figure.axes[0].get_legend().get_texts()][1:] == ["mine"]
    known = replace(results, frame=results.frame.assign(noise_model="nominal"))
    plot = figures.curves(
        known,
        [replace(panel, where={})],
        [{**LINES[0], "noise_model": "nominal"}],
        "c",
        levels=[{"method": "gnss", "max_neighbours": 0}],
    )
    assert plot.figure.axes[0].lines[0].get_linestyle() == "-"  # as no line has another noise model


def test_every_line_that_coincides_is_named(results):
    """Also where a method has two, each with another method's line: the last one's name replaced the others."""
    kalman = results.frame.query("method == 'kalman'")
    names = {"identity": "fedkalmannet", "fitted": "okf"}
    frame = pd.concat([kalman, kalman.assign(method=kalman["noise_model"].map(names), noise_model="trained")])
    lines = [
        *({"method": "kalman", "noise_model": model} for model in names),
        *({"method": m, "noise_model": "trained"} for m in names.values()),
    ]
    plot = figures.curves(
        replace(results, frame=frame), [Panel({k: {"max_neighbours": k} for k in (0, 2)})], lines, "c"
    )
    first, *_ = plot.figure.axes[0].get_legend().get_texts()
    assert first.get_text() == "KF\nidentity ≈ FedKalmanNet\nfitted ≈ OKF"


def test_a_failed_cell_is_a_gap_with_its_reason(results):
    failed = results.frame.query("method == 'gnss' or method == 'joint' and max_neighbours == 2")
    once = failed.query("run == 0").assign(status="failed", reason="Boom").reset_index()
    known = replace(results, frame=results.frame.drop(failed.index), failures=once)
    plot, table = PLOTS["sweep"](known), pivot(known, ["method", "noise_model"], "max_neighbours", "rt_le_m")
    assert np.isnan(plot.figure.axes[0].lines[2].get_ydata()).tolist() == [False, True, False]
    assert table.rows[-1] == ("GNSS", "identity", None, None, None)
    assert plot.caption.endswith(" ".join(table.notes))
    assert "Failed cells of GNSS: 3, first reason: Boom. Failed cells of Joint filter: 1, " in table.words


def from_reference(file):
    """Results whose means and spread over runs are the committed ones: two egos that are alike, eight runs, errors of
    one law, a tenth more before training."""
    known = json.loads(file.read_text())
    points: dict[str, dict[str, Any]] = {}
    for number in known["numbers"]:
        point = points.setdefault(json.dumps(number["where"]), dict(number["where"]))
        point[number["metric"]] = (number["value"], number["run_std"])
    rows = [
        {
            name: (value[0] + (-1) ** run * value[1]) * (1.1 - number / 200) if isinstance(value, tuple) else value
            for name, value in {"train_seed": None, **point}.items()
        }
        | {name: 100.0 * point.get("max_neighbours", 0) for name in ("bytes_per_second", "payload_bytes_per_second")}
        | {"ego": ego, "run": run, "round": number, "error_quantiles_m": list(point["rt_le_m"][0] * LAW)}
        for number in ROUNDS.get(file.stem, (20,))
        for point in points.values()
        for ego in ("a", "b")
        for run in range(8 if point["rt_le_m"][1] else 1)
    ]
    axes = tuple(known["numbers"][0]["where"])
    return Results(known["study"], "?", axes, known["settings"], pd.DataFrame(rows), pd.DataFrame(), 0, {})


LAW, ROUNDS = np.sqrt(np.linspace(0, 2, 51)), {"convergence": (0, 10, 20)}
FILES = sorted((ROOT / "studies" / "reference").glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_figure_of_the_gallery_hides_a_line(file):
    results, lines_seen = from_reference(file), 0
    for view in find("coopoc.studies", file.stem).figures.values():
        plot = view(results)
        for panel in plot.figure.axes if plot is not None else ():
            panel.figure.draw_without_rendering()
            assert panel.figure.get_figwidth() < 14.0
            texts = [text.get_text() for text in panel.texts]
            lines = [line for line in panel.lines if len(line.get_xdata()) > 1 and line.get_linestyle() != "None"]
            lines_seen += len(lines)
            for first, second in combinations(
                [
                    line
                    for line in lines
                    if line.get_linestyle() not in ("--", ":") or line.get_marker() not in ("", "None")
                ],
                2,
            ):
                if first.get_color() != second.get_color():
                    a, b = (line.get_transform().transform(line.get_xydata()) for line in (first, second))
                    at = [x for x in (*a[:, 0], *b[:, 0]) if all(line[0, 0] <= x <= line[-1, 0] for line in (a, b))]
                    gaps = abs(np.interp(at, *a.T) - np.interp(at, *b.T))
                    apart = max(gaps, default=np.inf) * 72 / panel.figure.dpi > first.get_linewidth() / 2
                    assert apart or any(" ≈ " in text for text in texts), (first.get_color(), second.get_color())
    assert lines_seen or not find("coopoc.studies", file.stem).figures


def test_the_first_finding_of_the_paper_says_what_both_cost(monkeypatch):
    card = {"history": [{"sent_bytes": 3e6, "received_bytes": 5e6}], "clients": "abcd"}
    monkeypatch.setattr(weights, "checkpoint", lambda *_: SimpleNamespace(card=card))
    (reference,) = (file for file in FILES if file.stem == "neighbours")
    first, *_ = find("coopoc.studies", "neighbours").answers(from_reference(reference))
    assert re.search(r"10 neighbours give 0\.5\d m for 1,000 B/s of messages, .* m for 2\.0 MB, once", first), first
