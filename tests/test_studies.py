"""The studies themselves, at a size that a test can afford, and what a user does wrong with them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import coopoc as co
from coopoc.evaluate.metrics import rt_le
from coopoc.learned.recipes import load_method
from coopoc.study.run import run

CLASSIC = {"method": "gnss,kalman,lkf-sa,joint,bound", "runs": 4, "egos": "2", "max_neighbours": "0,2,6"}


@pytest.fixture(scope="module")
def town10() -> co.Fleet:
    return co.load("town10")


def test_neighbours_runs_without_any_training(tmp_path: Path) -> None:
    """Only what is asked for is made: no weights for classical methods; findings need the nets and say so."""
    from coopoc.plugins import find

    study = find("coopoc.studies", "neighbours").override({**CLASSIC, "weights": str(tmp_path / "weights")})
    from dataclasses import replace

    results = run(replace(study, findings=None, recipe=None, figures={}, tables={}), out=tmp_path, progress=False)
    assert results.failed == 0
    assert not (tmp_path / "weights").exists()
    ideal = {"rate_hz": 10.0, "cap_bytes_per_second": 0.0}
    bound = [results.interval("rt_le_m", method="bound", max_neighbours=k, **ideal).mean for k in (0, 2, 6)]
    joint = [
        results.interval("rt_le_m", method="joint", knowledge="nominal", max_neighbours=k, **ideal).mean
        for k in (0, 2, 6)
    ]
    assert bound == sorted(bound, reverse=True)
    assert np.array(joint) == pytest.approx(np.array(bound), rel=0.15)


def test_order_of_the_paper_under_identity_and_the_honest_order(town10: co.Fleet) -> None:
    """Scenario 2, three egos: federated < LKF-SA < GNSS at every K >= 1 and LKF-SA falls with K under identity
    covariances; with fitted or known noise the joint filter is ahead of the net. No run of the net diverges."""
    egos, sensors = ["town10-00", "town10-24", "town10-48"], co.Sensors.paper_scenario2()
    score: dict[str, list[float]] = {}
    for k in (1, 4, 10):
        seen = co.observe(town10, sensors, co.V2X(max_neighbours=k), runs=8, observers=egos)
        for method in (
            co.Gnss(),
            load_method("fedkalmannet"),
            co.LaplacianKalman("identity"),
            co.JointFilter("nominal"),
        ):
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
        (["run", "neighbors"], "neighbours"),
        (["run", "neighbours", "--set", "max_neighbours=-1"], "max_neighbours = -1"),
        (["run", "neighbours", "--set", "method=magic"], "magic"),
        (["run", "neighbours", "--set", "egos=nobody"], "nobody"),
        (["run", "neighbours", "--set", "scenario=3"], "scenario = 3"),
        (["run", "neighbours", "--data", "nowhere.csv"], "nowhere.csv"),
        (["run", "error_cdf", "--set", "velocity_reading=both"], "velocity_reading"),
        (["data", "show", "town11"], "town10"),
    ],
)
def test_mistakes_end_with_a_sentence_and_status_2(arguments: list[str], words: str, tmp_path: Path) -> None:
    command = [str(Path(sys.executable).with_name("coopoc")), *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_train_command_makes_a_checkpoint_that_loads(tmp_path: Path) -> None:
    coopoc = str(Path(sys.executable).with_name("coopoc"))
    command = [coopoc, "train", "okf", "--seed", "3", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    method = load_method(tmp_path / "okf-gnss-axis-3.safetensors")
    assert np.array(method.gnss_std) == pytest.approx([1.5, 1.5, 1.5], rel=0.1)
    unknown = subprocess.run([coopoc, "train", "magic"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert unknown.returncode == 2
    assert "fedkalmannet" in unknown.stderr


def test_real_measurements_run_and_say_what_is_simulated(shared: Path, tmp_path: Path) -> None:
    """MR.CLAM set 6: K <= 4, real range and bearing, labels on every table."""
    from dataclasses import replace

    from coopoc.plugins import find

    study = find("coopoc.studies", "neighbours").override(
        {"data": str(shared / "mrclam" / "MRCLAM_Dataset6"), "method": "gnss,kalman,joint", "knowledge": "nominal,none",
         "max_neighbours": "0,4", "runs": 2, "egos": "2"}
    )  # fmt: skip
    study = replace(study, findings=None, recipe=None, tables={"nominal": study.tables["nees"]},
                    figures={"innovations": study.figures["innovations"]})  # fmt: skip
    with pytest.raises(co.InputError, match="lkf-sa"):
        run(study, out=tmp_path, progress=False)
    results = run(replace(study, tables={}), out=tmp_path, progress=False)
    assert results.frame["max_neighbours"].max() == 4
    assert (tmp_path / "neighbours" / "figures" / "innovations.png").stat().st_size > 10_000
    kalman = results.interval("rt_le_m", method="kalman", max_neighbours=0)
    joint = results.interval("rt_le_m", method="joint", max_neighbours=4)
    assert joint.mean < kalman.mean < 0.12
