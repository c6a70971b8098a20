"""Studies of conditions on few cells: channel, spoofing, GNSS errors, consistency, bounds."""

import json
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from conftest import formation_fleet, refused
from test_study_figures import FILES

import coopoc as co
from coopoc import Sensors, run_study
from coopoc.studies import conditions as study
from coopoc.studies import scene
from coopoc.study import numbers


def conditions(file):
    """Every condition of a study with the marks of its methods and bounds."""
    found: dict[str, dict[tuple[str, str], dict[str, Any]]] = defaultdict(dict)
    for number in json.loads(file.read_text())["numbers"]:
        where = dict(number["where"])
        pair = (where.pop("method"), where.pop("noise_model", ""))
        if number["metric"] == "rt_le_m":
            found[json.dumps(where, sort_keys=True)][pair] = number
    for where, marks in found.items():
        yield json.loads(where), marks


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_mark_lies_below_its_bound(file):
    for where, marks in conditions(file):
        bounds = {known: mark["value"] for (method, known), mark in marks.items() if method == "bound"}
        for (method, known), mark in marks.items():
            if method == "bound" or not bounds:
                continue
            past = bounds.get("with its past") if method == "cooperative-filter" else None  # its messages bring it
            own = past or max(bounds.values())
            error = mark["run_std"] / mark["runs"] ** 0.5
            rms = (mark["value"] ** 2 + mark["run_std"] ** 2) ** 0.5  # bounds are of squares, values means over runs
            assert rms + 3.0 * error > own, (where, method, known, rms, own)


def test_most_studies_show_a_bound():
    shown = {file.stem for file in FILES for _, marks in conditions(file) if any(m == "bound" for m, _ in marks)}
    assert {"budget", "correlated_gnss", "neighbours"} <= shown


def test_late_and_lost_messages_cost_and_the_table_says_so(tmp_path, short_town):
    wanted = {
        "data": short_town,
        "runs": 3,
        "egos": "1",
        "method": "kalman,joint",
        "latency_s": "0.0,0.3",
        "loss": "0.0,0.6",
    }
    results = run_study("latency_loss", tmp_path, settings=wanted)
    perfect, late, lossy = (
        numbers.mean(results, {**study.PERFECT, "method": "joint", **change}) or np.nan
        for change in ({}, {"latency_s": 0.3}, {"loss": 0.6})
    )
    assert perfect < late
    assert perfect < lossy
    table = (tmp_path / "latency_loss" / "tables" / "rt_le.md").read_text()
    assert "lost in runs of 10" in table
    assert "0.3 s" in table


def test_what_is_wrong_harms_those_who_use_it(tmp_path, short_town):
    wanted = {
        "data": short_town,
        "runs": 1,
        "egos": "1",
        "method": "kalman,lkf-sa,joint,bound",
        "outliers": ",fixes=0.05:0",
        "spoofed_share": "0.0,0.2",
        "spoofed_from_s": "0.0",
        "spoofed_collude": "False",
    }
    results = run_study("robustness", tmp_path, settings=wanted)
    clean, wild, spoofed = "nothing wrong", "5 % wild fixes", "20 % spoofed"
    error = {
        (method, case): np.array(numbers.mean(results, {"method": method, **study.WRONG[case]}))
        for method in str(wanted["method"]).split(",")
        for case in (clean, wild, spoofed)
    }
    harm = {
        (method, title): float(error[method, case] / error[method, clean])
        for method in str(wanted["method"]).split(",")
        for title, case in (("wild", wild), ("spoofed", spoofed))
    }
    assert harm["kalman", "spoofed"] == 1
    assert harm["lkf-sa", "spoofed"] > 3 > 1.5 > harm["joint", "spoofed"]
    assert min(harm["kalman", "wild"], harm["lkf-sa", "wild"]) > 1.02
    assert 1 < harm["bound", "spoofed"] < harm["lkf-sa", "spoofed"]
    assert 1 < harm["bound", "wild"] < 1.2
    assert "without the wrong measurements" in (tmp_path / "robustness" / "tables" / "rt_le.md").read_text()


QUICK = {"method": "kalman,joint,cooperative-filter,bound", "max_neighbours": "0,6,10", "runs": 3, "egos": "2"}


def test_own_errors_average_out_over_neighbours_and_common_ones_do_not(tmp_path, short_town):
    wanted = {"own_share": "0.9,0.0", "common_share": "0.0,0.9"}
    results = run_study("correlated_gnss", tmp_path, settings={**QUICK, **wanted, "data": short_town})
    value = {
        name: [
            numbers.rms(results, {**study.LASTING_CASES[f"{name}, K = {k}"], "method": "cooperative-filter"}) or np.nan
            for k in (0, 6)
        ]
        for name in ("white", "own", "common")
    }
    own, common = value["own"], value["common"]
    assert own[1] < 0.5 * own[0]
    assert common[1] > 0.8 * common[0]
    names = [text.partition(":")[0] for text in study.CORRELATED_GNSS.answers(results)]
    assert names == [f"{name}, K = 10" for name in ("white", "own", "common")]
    folder = tmp_path / "correlated_gnss"
    assert "Cramér-Rao bound, star" in (folder / "tables" / "rt_le.md").read_text()
    assert (folder / "figures" / "rms.pdf").stat().st_size > 5_000


def test_shares_keep_the_variance_of_a_fix():
    noise = scene.lasting(Sensors.paper_scenario2(), 0.45, 0.45)
    assert noise.fix_std == pytest.approx((3.5, 3.5, 3.5))
    assert noise.gnss_drift_std == pytest.approx(3.5 * np.sqrt(0.45))
    for own, common in ((0.6, 0.4), (-0.1, 0.0)):
        with refused("own_share"):
            scene.lasting(Sensors(), own, common)


def test_bound_with_the_past_is_the_stars_where_nobody_comes_or_goes():
    fleet, noise = formation_fleet(5, 40), co.Sensors.paper_scenario2()
    for k in (0, 4):
        past, star = (co.posterior_bound(fleet, noise, 0, co.V2X(k), past=past) for past in (True, False))
        np.testing.assert_allclose(past, star, rtol=1e-9)


def test_bound_with_the_past_is_lower_where_they_do(crossing):
    noise, v2x = co.Sensors.paper_scenario2(), co.V2X(3)
    past, star = (
        np.trace(co.posterior_bound(crossing, noise, 1, v2x, past=past), axis1=1, axis2=2) for past in (True, False)
    )
    assert (past <= star * (1 + 1e-9)).all()
    assert past[-1] < 0.98 * star[-1]
