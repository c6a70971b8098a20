"""The study of the cooperative gain at a size that a test can afford: its grid, its bounds, its views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import crossing_fleet, formation_fleet

import coopoc as co
from coopoc.data.fleet_files import write_table
from coopoc.evaluate.bounds import past_bound, posterior_bound
from coopoc.learned.checkpoint import Checkpoint, save
from coopoc.learned.nets.noise_net import NoiseNet
from coopoc.learned.recipes import Setting, jobs_of
from coopoc.studies import cooperative_gain
from coopoc.studies.cooperative_gain import STUDY
from coopoc.study.publish import views as published
from coopoc.study.run import run_study


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with a net that is taken for a trained one: training has its own tests."""
    folder, clients = tmp_path_factory.mktemp("weights"), co.load_fleet("town10-clients")
    (job,) = jobs_of("cooperative", Setting(), clients)
    save(folder / f"{job.label}.safetensors", Checkpoint(NoiseNet(), {"key": job.key(clients)}))
    return str(folder)


@pytest.mark.slow
def test_views_say_what_was_run(tmp_path: Path, weights: str) -> None:
    """On eight vehicles of six seconds."""
    write_table(crossing_fleet(), tmp_path / "crossing.csv")
    study = STUDY.override(
        {
            "runs": 4,
            "train_seeds": 1,
            "weights": weights,
            "data": str(tmp_path / "crossing.csv"),
            "max_neighbours": "0,6",
            "loss": "0.0,0.7",
        }
    )
    results = run_study(study, out=tmp_path, progress=False)
    assert results.failed == 0
    at = {"receivers": "alike", "max_neighbours": 6, "method": "cooperative"}
    heard = [results.interval("bytes_per_second", {**at, "loss": loss}).mean for loss in (0.0, 0.7)]
    assert heard[1] == pytest.approx(0.3 * heard[0], rel=0.1)
    clear = results.values("rt_le_m", {**at, "loss": 0.0}).mean()
    assert clear < results.values("rt_le_m", {**at, "loss": 0.7}).mean()
    shown = published(tmp_path / "cooperative_gain")
    assert [view["name"] for view in shown["tables"]] == ["rt_le", "bytes", "nees", "nees_inside", "receivers"]
    assert [view["name"] for view in shown["figures"]] == ["rt_le"]
    assert list(shown["findings"]) == ["0 % loss", "70 % loss"]
    assert all(said.startswith(f"{key}, K = 6: ") for key, said in shown["findings"].items())
    assert f"the cooperative gain has {clear:.3f} m" in shown["findings"]["0 % loss"]


def test_nothing_is_shown_of_what_was_not_run(tmp_path: Path) -> None:
    write_table(crossing_fleet(steps=20), tmp_path / "crossing.csv")
    chosen = {"method": "joint", "noise_model": "nominal", "receivers": "alike", "loss": "0.3"}
    study = STUDY.override({"runs": 2, "data": str(tmp_path / "crossing.csv"), **chosen})
    results = run_study(study, out=tmp_path, progress=False)
    assert results.failed == 0
    shown = published(tmp_path / "cooperative_gain")
    assert [view["name"] for view in shown["tables"]] == ["rt_le", "bytes", "nees", "nees_inside"]
    assert shown["findings"] == {}


def test_bound_with_the_past_is_the_stars_where_nobody_comes_or_goes() -> None:
    fleet, noise = formation_fleet(5, 40), co.Sensors.paper_scenario2()
    for k in (0, 4):
        np.testing.assert_allclose(
            past_bound(fleet, noise, 0, co.V2X(k)), posterior_bound(fleet, noise, 0, co.V2X(k)), rtol=1e-9
        )


def test_bound_with_the_past_is_lower_where_they_do(crossing: co.Fleet) -> None:
    noise, v2x = co.Sensors.paper_scenario2(), co.V2X(3)
    past, star = (np.trace(b(crossing, noise, 1, v2x), axis1=1, axis2=2) for b in (past_bound, posterior_bound))
    assert (past <= star * (1 + 1e-9)).all()
    assert past[-1] < 0.98 * star[-1]


@pytest.mark.parametrize("receivers", cooperative_gain.RECEIVERS)
def test_receivers_differ_as_the_caption_says(receivers: str) -> None:
    """Noise of every fix over 20 runs, and what nominal filters are told of all."""
    p = {**STUDY.settings, "runs": 20, "egos": "1", "receivers": receivers, "max_neighbours": 0, "loss": 0.0}
    fleet, seen = co.load_fleet("town10"), cooperative_gain.recording(p)
    acting = np.sqrt(np.square(seen.gnss - fleet.position).mean(axis=(0, 3)))
    poor = np.zeros((900, 60), dtype=bool)
    poor[300 : 600 if receivers == "changing" else 300] = True
    if receivers == "mixed":
        poor[:, [c for c in range(60) if c % 5 < 2]] = True
    assert acting[poor].mean() == pytest.approx(5.0, rel=0.01)
    assert acting[~poor].mean() == pytest.approx(1.5, rel=0.01)
    assert seen.sensors.gnss_std[0] == pytest.approx(np.sqrt(np.square(seen.gnss - fleet.position).mean()), rel=0.01)
