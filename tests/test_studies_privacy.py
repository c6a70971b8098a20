"""The privacy study at a size that a test can afford: its price, its references, its views."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import coopoc as co
from coopoc.data.fleet_files import write_table
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.evaluate.metrics import rt_le
from coopoc.learned import GainNet, LearnedGain, Schedule, clients, federate
from coopoc.methods.kalman import Kalman
from coopoc.studies import privacy, scene, weights
from coopoc.study.publish import views as published
from coopoc.study.results import Results
from coopoc.study.run import run_study

EPSILONS = (1.0, 1000.0, math.inf)


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three vehicles of a bundled fleet for 31 s: three pieces each."""
    path = tmp_path_factory.mktemp("clients") / "few.csv"
    write_table(co.load_fleet("town04").between(0, 310).select([0, 1, 2]), path)
    return str(path)


@pytest.fixture(scope="module")
def ran(few: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Results]:
    """Both methods at a strict and at a loose epsilon and without privacy, and the references."""
    out, own = tmp_path_factory.mktemp("runs"), pytest.MonkeyPatch()
    own.setitem(privacy.PLANS, "fedkalmannet", privacy.Plan(0.5, 1.0, 2, 1, 3e-3, 0.3))
    grid = [{"clients": few, "method": m, "epsilon": e} for m in privacy.PLANS for e in EPSILONS]
    grid += [{"clients": few, "method": m, "epsilon": math.inf} for m in ("kalman", "bound")]
    study = replace(privacy.STUDY, grid=grid).override({"runs": 2, "egos": "1", "train_seeds": 2})
    results = run_study(study, out, progress=False)
    own.undo()
    return out / "privacy", results


def mean(results: Results, **where: object) -> float:
    return results.interval("rt_le_m", measure="rt_le", **where).mean


@pytest.mark.slow
def test_without_privacy_it_is_federate_and_the_references_are_the_filters(ran: tuple[Path, Results], few: str) -> None:
    results = ran[1]
    assert results.failed == 0
    p = {**results.settings, "clients": few, "method": "kalman", "epsilon": math.inf}
    recording, who, drive = scene.recording(p), scene.egos(p["data"], "1"), scene.fleet(p["data"])
    score = rt_le(Kalman(weights.fitted(p))(recording, who), drive)
    assert results.values("rt_le_m", method="kalman") == pytest.approx(score.T)
    bound = bound_rt_le(posterior_bound(drive, scene.sensors(p), 0, scene.channel(p)))
    assert results.values("rt_le_m", method="bound") == pytest.approx(bound)
    made = federate(
        GainNet(seed=1), clients(co.load_fleet(few), seed=1), 2, "uniform", 1, 1, Schedule(learning_rate=3e-3)
    )
    for measure, number in (("rt_le", 2), ("untrained", 0)):
        score = rt_le(LearnedGain(made.after(number))(recording, who), drive)  # type: ignore[arg-type]
        found = results.values("rt_le_m", measure=measure, method="fedkalmannet", epsilon=math.inf, train_seed=1)
        assert found == pytest.approx(score.T, rel=1e-3)


def test_noise_costs_and_nine_numbers_pay_less_than_a_net(ran: tuple[Path, Results]) -> None:
    results = ran[1]
    for method in privacy.PLANS:
        assert mean(results, method=method, epsilon=1.0) > 1.2 * mean(results, method=method, epsilon=math.inf)
    loose = mean(results, method="okf", epsilon=1000.0)
    assert loose < 1.3 * mean(results, method="okf", epsilon=math.inf)
    assert loose < 0.9 * results.interval("rt_le_m", measure="untrained", method="okf").mean
    assert mean(results, method="fedkalmannet", epsilon=1.0) == pytest.approx(privacy.LOST, abs=5)
    assert results.frame["rt_le_m"].max() <= privacy.LOST


def test_the_price_is_that_of_the_gaussian_mechanism(ran: tuple[Path, Results]) -> None:
    """z / sqrt(rounds) has delta 1e-5 at epsilon, and a third of the noise has it at the epsilon of single updates:
    Balle and Wang 2018, theorem 8."""
    rows = ran[1].select(method="okf", measure="rt_le").drop_duplicates("epsilon").set_index("epsilon")
    for epsilon in (1.0, 1000.0):
        z = rows.loc[epsilon, "noise_multiplier"] / math.sqrt(privacy.PLANS["okf"].rounds)
        for noise, price in ((z, epsilon), (z / math.sqrt(3), rows.loc[epsilon, "epsilon_alone"])):
            ends = [0.5 / noise - price * noise, -0.5 / noise - price * noise]
            logs = stats.norm.logcdf(ends) + np.array([0.0, price])
            assert np.exp(logs[0]) - np.exp(logs[1]) == pytest.approx(1e-5, rel=1e-3)
    assert rows.loc[math.inf, "noise_multiplier"] == 0.0


def test_the_probe_counts_every_candidate_once(ran: tuple[Path, Results]) -> None:
    """Two of three pieces are members, of three clients and two seeds; intervals hold their AUC."""
    rows = ran[1].select(measure="probe")
    assert len(rows) == 6 * len(privacy.ATTACKS)
    assert (rows["members"] == 12).all()
    assert (rows["others"] == 6).all()
    assert ((rows["auc_low"] <= rows["auc"]) & (rows["auc"] <= rows["auc_high"])).all()


def test_views(ran: tuple[Path, Results]) -> None:
    folder, results = ran
    shown = published(folder)
    assert [view["name"] for view in shown["tables"]] == ["rt_le", "price", "probe"]
    assert [view["name"] for view in shown["figures"]] == ["rt_le", "probe"]
    assert all((folder / "figures" / f"{name}.png").stat().st_size > 10_000 for name in ("rt_le", "probe"))
    assert all("1 ego of town10, 2 training seeds" in view["caption"] for view in shown["tables"] + shown["figures"])
    net, okf = shown["findings"].values()
    assert net.startswith("FedKalmanNet, 3 clients: ")
    assert f"{mean(results, method='okf', epsilon=math.inf):.2f} m without privacy" in okf


def test_views_of_references_alone(few: str, tmp_path: Path) -> None:
    grid = [{"clients": few, "method": m, "epsilon": math.inf} for m in ("kalman", "bound")]
    study = replace(privacy.STUDY, grid=grid).override({"runs": 2, "egos": "1"})
    assert run_study(study, tmp_path, progress=False).failed == 0
    shown = published(tmp_path / "privacy")
    assert [shown[kind] for kind in ("tables", "figures", "findings")] == [[], [], {}]


def test_the_grid_has_few_and_many_clients() -> None:
    cells = privacy.STUDY.cells()
    assert {(c.given["clients"], c.given["method"]) for c in cells} >= {
        (fleet, method) for fleet in privacy.FLEETS for method in privacy.PLANS
    }
    assert len({c.name for c in cells}) == len(cells) == 26
    with pytest.raises(co.InputError, match="epsilon"):
        privacy.STUDY.override({"epsilon": "2"})
