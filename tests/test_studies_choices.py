"""Studies of choices on few cells: aggregation rules, any methods side by side."""

from typing import Any

import aggregation
import pandas as pd
import pytest
import torch
from conftest import refused

import coopoc as co
from coopoc.evaluate.metrics import rt_le
from coopoc.learned import GainNet
from coopoc.learned.federation.federate import federate
from coopoc.study.publish import views as published
from coopoc.study.results import Results
from coopoc.study.run import run_study

TWO = {"egos": "2", "runs": 2}


@pytest.mark.slow
def test_side_by_side_takes_any_methods_and_conditions(tmp_path, short_town):
    harsh = {**TWO, "data": short_town, "max_neighbours": "0,4", "latency_s": 0.2, "common_share": 0.5}
    results = run_study("side_by_side", tmp_path, settings={**harsh, "method": "joint,kalman,bound"})
    assert "Noise may explain the difference from" in published(tmp_path / "side_by_side")["findings"][-1]
    assert "With latency_s 0.2, common_share 0.5." in (tmp_path / "side_by_side" / "tables" / "rt_le.md").read_text()
    mild = run_study(
        "side_by_side", tmp_path / "mild", settings={**harsh, "method": "joint", "latency_s": None, "common_share": 0.0}
    )
    where = {"method": "joint", "max_neighbours": 4}
    assert results.values("rt_le_m", where).mean() > mild.values("rt_le_m", where).mean()
    assert (results.values("rt_le_m", {"method": "bound", "max_neighbours": 4}) > 0).all()


def test_what_no_cell_can_be_computed_with_is_refused_before_any(tmp_path, short_town):
    for wrong, said in (
        ({"method": "kalman,jont"}, r"method = 'jont': must be one of .* Did you mean joint\?"),
        ({"runs": 10**9}, r"runs = 1000000000: must be in 1..\d"),
        ({"seed": -1}, "seed = -1: must be >= 0"),
        ({"method": "okf", "train_seeds": 10**9}, r"train_seeds = 1000000000: must be in 1..1000"),
        ({"noise_model": "nominl"}, r"Did you mean nominal\?"),
        ({"rate_hz": 0}, r"rate = 0: must be > 0"),
    ):
        with refused(said):
            run_study("side_by_side", tmp_path, settings={"data": short_town, **wrong})
    assert not (tmp_path / "side_by_side").exists()


TINY = {
    "members": 6,
    "runs": 2,
    "egos": "2",
    "train_seeds": 2,
    "rounds": 2,
    "local_epochs": 1,
    "steps": 4,
    "in_mult": 2,
    "out_mult": 1,
}


def given(**more: Any):
    """Parameters of a tiny cell."""
    return {**aggregation.STUDY.settings, **TINY, "condition": "iid", "method": "mean", "scenario": 1, **more}


def test_every_condition_is_what_it_says():
    """Noise of each client against its sensors, amounts, the moved truth."""
    plain, unlike = (aggregation.clients(given(condition=c, members=12), 0) for c in ("iid", "heterogeneous"))
    noise = aggregation.noise(given(condition="heterogeneous", members=12))
    assert len({(s.gnss_std, s.velocity_std_ratio) for s in noise}) == 12
    for client, sensors in zip(unlike, noise, strict=True):
        off = torch.cat([part.gnss - part.truth for part in (client.training, client.validation)])
        assert float(off.std()) == pytest.approx(sensors.gnss_std[0], rel=0.1)
    assert [len(c.training) for c in plain] == [6] * 12
    assert [len(c.training) for c in unlike] == [6, 4, 2] * 4
    misled = aggregation.clients(given(condition="poisoned data", members=12), 0)
    shift = [float((a.training.truth - b.training.truth).mean()) for a, b in zip(misled, plain, strict=True)]
    assert shift == pytest.approx([0.0] * 6 + [10.0] + [0.0] * 5, abs=1e-4)


def test_no_cell_for_a_rule_without_enough_clients():
    cells = aggregation.STUDY.override({"members": "6"}).cells()
    there = {(c.settings["condition"], c.settings["method"]) for c in cells}
    assert ("iid", "krum") in there
    assert ("half absent", "krum") not in there
    assert ("half absent", "median") in there
    with refused("members = 61"):
        aggregation.STUDY.override({"members": "61"}).cells()


def test_a_cell_is_the_federation_of_its_seed():
    """Its rows are the RT-LE of `federate` by hand, on the noise that all methods share."""
    p = given(scenario=2)
    rows = aggregation.cell(p)
    fed = federate(GainNet(2, 1, seed=1), aggregation.clients(p, 1), 2, "mean", 1, seed=1)
    fleet = co.load_fleet("town10")
    seen = co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(0), runs=2, observers=["town10-00", "town10-30"])
    by_hand = rt_le(fed.model.method("x")(seen, ["town10-00", "town10-30"]), fleet)
    aggregation.trained.cache_clear()
    assert [row["rt_le_m"] for row in aggregation.cell(p)] == [row["rt_le_m"] for row in rows]
    mine = [row["rt_le_m"] for row in rows if row["train_seed"] == 1]
    assert mine == pytest.approx(by_hand.T.ravel().tolist(), rel=1e-6)


@pytest.mark.slow
def test_the_study_runs_and_says_what_it_found(tmp_path):
    wanted = {**TINY, "runs": 1, "method": "mean,centralised,kalman,bound", "condition": "iid,poisoned update"}
    study = aggregation.STUDY.override({name: str(value) for name, value in wanted.items()})
    assert run_study(study, out=tmp_path).failed == 0
    shown = published(tmp_path / "aggregation")
    assert [t["name"] for t in shown["tables"]] == [*aggregation.STUDY.tables]
    assert "equal sensors, equal amounts of data" in shown["tables"][0]["caption"]
    assert any(text.startswith("Scenario 2, poisoned update: mean") for text in shown["findings"])


@pytest.mark.parametrize(
    ("gaps", "words"),
    [
        ((-0.1, -0.11, -0.12), "Better than the mean over training seeds (95 %): median -0.110 m; worse: no rule."),
        ((0.1, 0.11, 0.12), "Better than the mean over training seeds (95 %): no rule; worse: median +0.110 m."),
        ((-0.1, 0.12, 0.05), "Better than the mean over training seeds (95 %): no rule; worse: no rule."),
    ],
)
def test_a_rule_is_better_only_if_all_training_seeds_agree(gaps, words):
    at = {"condition": "iid", "scenario": 1}
    places: list[dict[str, Any]] = [
        {"train_seed": s, "ego": e, "run": r} for s in range(3) for e in range(2) for r in range(3)
    ]
    rows = [{**at, **place, "method": "mean", "rt_le_m": 1.0 + 0.1 * place["ego"]} for place in places]
    rows += [{**row, "method": "median", "rt_le_m": row["rt_le_m"] + gaps[row["train_seed"]]} for row in rows]
    axes, settings = ("condition", "method", "scenario"), dict(aggregation.STUDY.settings)
    results = Results("aggregation", "", axes, settings, pd.DataFrame(rows), pd.DataFrame(), 0, {})
    (text,) = aggregation.STUDY.answers(results)
    assert text.startswith("Scenario 1, iid: ")
    assert words in text
