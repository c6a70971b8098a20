"""Reference numbers: verdicts by hand, and cheap cells of each study at full size against what was committed."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from conftest import refused

from coopoc.plugins import find, names
from coopoc.study.reference import Reference, check, measure, reference, table
from coopoc.study.run import run_study
from coopoc.study.study import Study

CHEAP: Mapping[str, dict[str, Any]] = {
    "correlated_gnss": {"method": "kalman", "max_neighbours": "0", "own_share": "0.5"},
    "neighbours": {"method": "kalman,joint,msmv-r", "max_neighbours": "1", "noise_model": "nominal"},
    "budget": {"method": "joint", "channel": "bsm", "max_neighbours": "10", "noise_model": "nominal"},
    "latency_loss": {"method": "lkf-sa,joint", "latency_s": "0.3"},
    "robustness": {
        "method": "joint,split-ci",
        "spoofed_share": "0.2",
        "spoofed_from_s": "0.0",
        "spoofed_collude": "False",
    },
}
"""Cells that need no training and take a second or two each."""
AS_RUN = ("weights", "metric")
"""Settings that do not change the numbers."""


def cell(p):
    """Two egos, three runs: known means and deviations."""
    return [
        {"run": r, "ego": ego, "rt_le_m": p["x"] * p["scale"] * (1 + 0.1 * r), "nees": 3.0 + p["shift"]}
        for r in range(p["runs"])
        for ego in "ab"
    ]


STUDY = Study("made", "What?", cell, {"x": (1.0, 2.0)}, {"scale": 1.0, "shift": 0.0, "runs": 3, "weights": "here"})
METRICS: dict[str, str | float] = {"rt_le_m": "lower", "nees": 3.0}


@pytest.fixture
def results(tmp_path):
    return run_study(STUDY, tmp_path)


def verdicts(now, known):
    return {(c.was.where["x"], c.was.metric): c.verdict for c in check(now, known, METRICS)}


def changed(tmp_path, **settings: float):
    """Rows of other settings, as if the code had changed under the same ones."""
    now = run_study(STUDY, tmp_path / "now", settings=settings)
    return replace(now, settings={**STUDY.settings, "runs": now.settings["runs"]})


def test_a_number_is_the_mean_and_its_runs_spread(results, tmp_path):
    known = measure(results, METRICS)
    first = known.numbers[0]
    assert (first.where, first.metric, first.value, first.runs) == ({"x": 1.0}, "rt_le_m", pytest.approx(1.1), 3)
    assert first.run_std == pytest.approx(0.1)  # of 1.0, 1.1, 1.2
    known.save(tmp_path / "numbers.json")
    assert Reference.load(tmp_path / "numbers.json") == known


@pytest.mark.parametrize("field", ["value", "run_std", "tolerance"])
def test_a_reference_that_is_no_number_is_damaged(results, tmp_path, field):
    known = measure(results, METRICS)
    replace(known, numbers=(replace(known.numbers[0], **{field: float("nan")}),)).save(tmp_path / "numbers.json")
    with refused("is damaged .nan is no finite number"):
        Reference.load(tmp_path / "numbers.json")
    (tmp_path / "numbers.json").write_text("{")
    with refused("Write them with coopoc reference"):
        Reference.load(tmp_path / "numbers.json")


def test_verdicts_know_the_direction(results, tmp_path):
    known = measure(results, METRICS)
    assert set(verdicts(results, known).values()) == {"within noise"}
    assert set(verdicts(changed(tmp_path / "0", scale=1.009), known).values()) == {"within noise"}
    worse, better = (verdicts(changed(tmp_path / str(s), scale=s), known) for s in (1.02, 0.98))
    assert {at for at, verdict in worse.items() if verdict == "worse"} == {(1.0, "rt_le_m"), (2.0, "rt_le_m")}
    assert better[1.0, "rt_le_m"] == "better"
    off = changed(tmp_path / "off", shift=-0.5)
    assert verdicts(off, known)[1.0, "nees"] == "worse"
    assert verdicts(results, measure(off, METRICS))[1.0, "nees"] == "better"  # nearer to 3
    assert table(check(off, known, METRICS)).caption == "2 of 4 reference numbers hold; 2 worse."


def test_nothing_to_compare_is_no_pass(results, tmp_path, monkeypatch):
    monkeypatch.setattr("coopoc.study.reference.find_study", lambda name: replace(STUDY, metrics=METRICS))
    replace(measure(results, METRICS), numbers=()).save(file := tmp_path / "numbers.json")
    assert reference(tmp_path / "made", study="made", file=file) == 1


def test_other_runs_are_allowed_their_standard_errors(results, tmp_path):
    """3 runs against 12 whose mean is 1.55: 0.45 away, 2 x 0.1 sqrt(1/3 + 1/12) + 0.011 = 0.14 allowed."""
    known = measure(results, METRICS)
    first = check(changed(tmp_path, runs=12), known, METRICS)[0]
    allowed = (first.difference.high - first.difference.low) / 2
    assert allowed == pytest.approx(0.01 * 1.1 + 2 * 0.1 * (1 / 3 + 1 / 12) ** 0.5, rel=1e-5)
    assert first.verdict == "worse"
    fewer = changed(tmp_path / "2", runs=2)  # mean 1.05
    assert check(fewer, known, METRICS)[0].verdict == "within noise"


def test_numbers_of_other_settings_are_refused(results, tmp_path):
    known = measure(results, METRICS)
    other = run_study(STUDY, tmp_path / "other", settings={"scale": 2.0, "weights": "there"})
    with refused(r"is not the reference's in scale\. Run it with its own settings"):
        check(other, known, METRICS)


@pytest.mark.slow
def test_every_study_that_names_metrics_has_numbers_of_its_own_settings():
    for name in names("coopoc.studies"):
        study: Study = find("coopoc.studies", name)
        if study.metrics:
            assert study.reference is not None
            known = Reference.load(study.reference)
            assert known.study == name
            settings = {k: list(v) if isinstance(v, tuple) else v for k, v in study.settings.items()}
            mine, its = ({k: v for k, v in d.items() if k not in AS_RUN} for d in (settings, known.settings))
            assert mine == its
            points = {json.dumps(dict(cell.params), sort_keys=True) for cell in study.cells()}
            assert {json.dumps(dict(n.where), sort_keys=True) for n in known.numbers} <= points


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEAP)
def test_committed_numbers_come_out_again(name, tmp_path):
    study: Study = find("coopoc.studies", name)
    results = run_study(study, tmp_path, settings=CHEAP[name])
    assert results.failed == 0
    assert study.reference is not None
    found = check(results, Reference.load(study.reference), study.metrics)
    assert found
    assert not table(found).rows, table(found).to_markdown()
