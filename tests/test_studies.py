"""The studies themselves, at a size that a test can afford, and what a user does wrong with them."""

import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from make_fleet import write_table
from shell import ran

import coopoc as co
from coopoc.evaluate.metrics import rt_le
from coopoc.learned.checkpoint import Checkpoint, load, save
from coopoc.learned.method import LearnedGain
from coopoc.learned.nets.gain import flatten
from coopoc.learned.nets.gain_net import GainNet
from coopoc.learned.recipes import WEIGHTS, Setting, jobs_of, load_method
from coopoc.plugins import find
from coopoc.studies import convergence, error_cdf, lineup, scene, weights
from coopoc.study.numbers import seed_std
from coopoc.study.publish import views as published
from coopoc.study.results import Results
from coopoc.study.run import run_study
from coopoc.study.study import Study

CLASSIC = {"method": "gnss,kalman,lkf-sa,joint,bound", "runs": 4, "egos": "2", "max_neighbours": "0,2,6"}


@pytest.fixture(scope="module")
def town10():
    return co.load_fleet("town10")


def study(name, **changes: object):
    found: Study = find("coopoc.studies", name)
    return found.override(changes)


def drawn(name, frame, *axes, **settings: object):
    """Results of a study whose rows are given: what may be said of them is known beforehand."""
    return Results(name, "", axes, {**study(name).settings, **settings}, frame, pd.DataFrame(), 0, {})


def test_the_clients_are_drawn_where_they_drive():
    _, _, panel, _ = convergence._clients(drawn("convergence", pd.DataFrame())).figure.axes
    np.testing.assert_array_equal(panel.lines[0].get_xydata(), co.load_fleet("town10-clients").position[:1450, 2, :2])
    assert panel.get_title() == "Client 3: 1450 steps\n0.4 to 10.8 m/s"


def test_data_that_changed_are_read_again(tmp_path):
    for steps in (3, 4):
        (tmp_path / "mine.py").write_text(f"import coopoc as co\nown = co.load_fleet('town10').between(0, {steps})\n")
        assert len(scene.fleet(f"{tmp_path}/mine.py:own").t) == steps


def test_neighbours_runs_without_any_training(tmp_path):
    """Only what is asked for is made: no weights for classical methods, and views of what was run."""
    results = run_study(study("neighbours", **CLASSIC, weights=str(tmp_path / "weights")), out=tmp_path)
    assert results.failed == 0
    assert not (tmp_path / "weights").exists()
    bound = [results.interval("rt_le_m", method="bound", max_neighbours=k).mean for k in (0, 2, 6)]
    joint = [
        results.interval("rt_le_m", method="joint", noise_model="nominal", max_neighbours=k).mean for k in (0, 2, 6)
    ]
    assert bound == sorted(bound, reverse=True)
    assert np.array(joint) == pytest.approx(np.array(bound), rel=0.15)
    shown = published(tmp_path / "neighbours")
    said = "\n".join(shown["findings"])
    assert "federated" not in said  # there is no net to compare with
    rms = np.sqrt(
        (results.values("rt_le_m", method="joint", noise_model="nominal", max_neighbours=6) ** 2).mean(0)
    ).mean()
    assert "K = 6, rms over runs: KF alone" in said
    assert f"joint filter {rms:.3g} m, bound {bound[-1]:.3g} m." in said
    captions = {view["name"]: view["caption"] for kind in ("tables", "figures") for view in shown[kind]}
    assert "bound is for the rms over runs" in captions["rt_le_nominal"]


@pytest.mark.parametrize("rate", [10.0, 2.0])
def test_the_bound_receives_what_the_channel_sends(rate):
    """As many bytes as the joint filter counts by itself, at every step and at a fifth of them."""
    p = {**study("neighbours", runs=1, egos="1").settings, "max_neighbours": 4, "rate_hz": rate}
    (bound,) = lineup.cell({**p, "method": "bound", "noise_model": "bound"})
    (joint,) = lineup.cell({**p, "method": "joint", "noise_model": "nominal"})
    assert bound["bytes_per_second"] == pytest.approx(joint["bytes_per_second"], rel=0.1)


def cdf(net):
    """The fitted KF at about 1 m, and a federated net that differs from it by a constant for each training seed."""
    both = {"scenario": 1, "velocity_ratio": 0.15, "method": "kalman", "noise_model": "fitted"}
    noise = np.random.default_rng(0).uniform(0.9, 1.1, (2, 4))
    rows = [{**both, "ego": e, "run": r, "rt_le_m": value} for (e, r), value in np.ndenumerate(noise)]
    rows += [
        {**row, "method": "fedkalmannet", "noise_model": "trained", "train_seed": s, "rt_le_m": row["rt_le_m"] + gap}
        for s, gap in enumerate(net)
        for row in rows
    ]
    return drawn("error_cdf", pd.DataFrame(rows), "method", "noise_model", "scenario", "velocity_ratio")


@pytest.mark.parametrize(
    ("net", "words"),
    [
        ((-0.1, -0.11, -0.12), "beats the fitted KF"),
        ((0.1, 0.11, 0.12), "is worse than the fitted KF"),
        ((-0.1, 0.12, -0.05), "cannot be distinguished from the fitted KF"),
        ((0.5, 0.01), "cannot be distinguished from the fitted KF"),  # every run is worse, yet two seeds do not agree
        ((0.1,), "of one training seed, whose spread is unknown"),
    ],
)
def test_a_verdict_needs_runs_and_training_seeds(net, words):
    results = cdf(net)
    (text,) = error_cdf.STUDY.answers(results)
    spread = seed_std(results, {"method": "fedkalmannet"}) or 0.0
    assert spread**2 * max(len(net) - 1, 1) == pytest.approx(np.var(net) * len(net))
    assert words in text
    assert re.match(r"Scenario 1: federated [\d.]+ m, fitted KF [\d.]+ m; the federated net ", text)


def plant(folder, name, p, rounds=2):
    """The shipped weights of a method as the first seed's checkpoint of a training that these parameters ask for."""
    shipped = load(WEIGHTS / f"{name}.safetensors")
    drives = co.load_fleet(str(p["clients"]))
    (job,) = jobs_of(name, Setting(0, p["start"], p["velocity_reading"]), drives)
    card, history = {**shipped.card, "key": job.key(drives)}, None
    if isinstance(shipped.model, GainNet):
        card["history"] = shipped.card["history"][: rounds + 1]
        history = flatten([shipped.model]).repeat(rounds + 1, 1)
    made = Checkpoint(shipped.model, card, history)
    save(folder / f"{job.label}.safetensors", made)
    return made


def test_weights_of_another_training_are_refused(tmp_path):
    """Two client fleets share a folder in one process: what one has trained is not taken for the other's."""
    p = {**study("error_cdf", weights=str(tmp_path), train_seeds=1).settings, "method": "okf"}
    plant(tmp_path, "okf", p)
    assert weights.checkpoint("okf", p, 0).card["fleet"] == "town10-clients"
    assert " optimiser steps; " in weights.described(drawn("error_cdf", pd.DataFrame({"method": ["okf"]}), **p))["okf"]
    with refused(r"weights = .*okf-gnss-axis-0.*were trained otherwise"):
        weights.checkpoint("okf", {**p, "clients": "town04"}, 0)


def test_there_are_as_many_individual_nets_as_clients(tmp_path):
    write_table(co.load_fleet("town10-clients").select([0, 2]), tmp_path / "two.csv")
    for name in ("convergence", "error_cdf"):
        cells = study(name, clients=str(tmp_path / "two.csv"), train_seeds=1).cells()
        named = {c.settings["method"] for c in cells}
        assert {m for m in named if m.startswith("individual")} == {"individual1", "individual2"}
    with refused("individual9"):
        study("convergence", method="individual9").cells()


def test_convergence_counts_federated_rounds_and_starts_where_it_is_told(tmp_path, town10):
    """The start moves the result; the last row is the net itself from that start."""
    for start in ("gnss", "true"):
        p = {
            **study("convergence", weights=str(tmp_path), start=start, runs=2, egos="1", train_seeds=1).settings,
            "method": "fedkalmannet",
            "train_seed": 0,
        }
        net = plant(tmp_path, "fedkalmannet", p, rounds=2)
        found = convergence.cell(p)
        assert [row["round"] for row in found] == [0, 0, 1, 1, 2, 2]
        seen = co.observe(town10, scene.sensors(p), co.V2X(max_neighbours=0), runs=2, observers=["town10-00"])
        alone = LearnedGain(net.after(2), x0=town10.position[0, :1] if start == "true" else None)(seen, ["town10-00"])
        assert [row["rt_le_m"] for row in found[-2:]] == pytest.approx(rt_le(alone, town10)[:, 0])


def test_order_of_the_paper_under_identity_and_the_honest_order(town10):
    """Scenario 2, three egos: federated < LKF-SA < GNSS at every K >= 1 and LKF-SA falls with K under identity
    covariances; with fitted or known noise the joint filter is ahead of the net. No run of the net diverges."""
    egos, sensors = ["town10-00", "town10-24", "town10-48"], co.Sensors.paper_scenario2()
    score: dict[str, list[float]] = {}
    for k in (1, 4, 10):
        seen = co.observe(town10, sensors, co.V2X(max_neighbours=k), runs=8, observers=egos)
        for method in (co.GNSS(), load_method("fedkalmannet"), co.LKFSA("identity"), co.JointFilter()):
            each = rt_le(method(seen, egos), town10)
            assert (each < 7.0).all()
            score.setdefault(method.name, []).append(float(each.mean()))
    fed, lkf, gnss, joint = (score[name] for name in ("fedkalmannet", "lkf-sa", "gnss", "joint"))
    assert all(f < a < g for f, a, g in zip(fed, lkf, gnss, strict=True))
    assert lkf == sorted(lkf, reverse=True)
    assert all(j < f for j, f in zip(joint, fed, strict=True))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run neighbors", "neighbours"),
        ("run neighbours --set max_neighbours=-1", "max_neighbours = -1"),
        ("run neighbours --set method=magic", "magic"),
        ("run neighbours --set egos=nobody", "nobody"),
        ("run neighbours --set scenario=3", "scenario = 3"),
        ("run neighbours --data nowhere.csv", "nowhere.csv"),
        ("run error_cdf --set velocity_reading=both", "velocity_reading"),
        ("data show town11", "town10"),
    ],
)
def test_mistakes_end_with_a_sentence_and_status_2(arguments, words, tmp_path):
    done = ran([str(Path(sys.executable).with_name("coopoc")), *arguments.split()], cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
