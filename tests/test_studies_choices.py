"""The studies of choices (backend, window, rounds, knowledge), and any methods side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coopoc.errors import InputError
from coopoc.fleets import load_fleet
from coopoc.methods.catalogue import METHODS
from coopoc.studies import ablation, backends, scene
from coopoc.study.run import run_study
from coopoc.world.sensing import observe

TWO = {"egos": "2", "runs": 2}


def test_a_choice_at_its_default_is_the_method_of_that_name(tmp_path: Path, short_town: str) -> None:
    chosen = {
        **TWO,
        "data": short_town,
        "method": "gbp,joint,bound",
        "value": "0,1,3",
        "choice": "rounds,exact step,none",
    }
    results = run_study("ablation", tmp_path, settings=chosen, progress=False)
    p = {**ablation.STUDY.settings, **TWO, "data": short_town}
    seen = observe(load_fleet(short_town), scene.sensors(p), scene.channel(p), runs=2, seed=0)
    same = {"gbp": ablation.at("gbp", "rounds", 3), "lkf-sa-edge": ablation.at("joint", "exact step", 0)}
    for name, where in same.items():
        egos = scene.egos(short_town, "2")
        track = METHODS[name]("nominal")(seen, egos)
        distance = np.linalg.norm(track.x - load_fleet(short_town).position[None][:, :, list(track.egos)], axis=-1)
        expected = np.sqrt((distance**2).mean(axis=1)).T
        assert results.values("rt_le_m", where) == pytest.approx(expected, rel=1e-12)
    table = (tmp_path / "ablation" / "tables" / "choices.md").read_text()
    assert "| Joint filter       | exact step |       1 |" in table
    assert "| default" in table


@pytest.mark.slow
def test_backends_are_held_against_scipy(tmp_path: Path, short_town: str) -> None:
    few = {"egos": "1", "samples": 2, "data": short_town, "max_neighbours": "2"}
    results = run_study("backends", tmp_path, settings=few, progress=False)
    assert results.failed == 0
    assert set(results.frame["method"]) == set(backends.BACKENDS)
    assert (results.frame["same"] == 1.0).all()
    assert (results.frame["gap_m"] > 0).any()  # the referee is somebody else
    found = backends.STUDY.found(results)
    assert list(found) == ["minima"]
    assert "100.0 % end where SciPy's least squares does, and 0 in a worse minimum." in found["minima"]


def test_the_referee_solves_a_linear_problem_as_lstsq_does(short_town: str) -> None:
    p = {**backends.STUDY.settings, "data": short_town, "max_neighbours": 6, "runs": 1}
    seen = scene.recording(p)
    problem = backends.PROBLEMS["converted"](seen, 40, scene.egos(short_town, "1")[0], 0)
    zero = np.zeros((len(problem.names), 3))
    residual, jacobian = problem.whiten(zero)
    closed = np.linalg.lstsq(jacobian.toarray(), -residual, rcond=None)[0].reshape(zero.shape)
    assert backends.referee(problem) == pytest.approx(closed, abs=1e-6)


def test_ranges_keep_their_noise_and_lose_their_angles(short_town: str) -> None:
    p = {**backends.STUDY.settings, "data": short_town, "max_neighbours": 6, "runs": 1}
    seen, ego = scene.recording(p), scene.egos(short_town, "1")[0]
    whole, less = (backends.PROBLEMS[name](seen, 40, ego, 0) for name in ("snapshot", "ranges"))
    sighted, ranged = (next(f for f in made.factors if f.kind != "position") for made in (whole, less))
    assert (sighted.kind, ranged.kind) == ("spherical", "range")
    assert np.array_equal(ranged.z, sighted.z[..., :1])
    assert ranged.std == pytest.approx(seen.sensors.range_std)


@pytest.mark.slow
def test_side_by_side_takes_any_methods_and_conditions(tmp_path: Path, short_town: str) -> None:
    harsh = {**TWO, "data": short_town, "max_neighbours": "0,4", "latency_s": 0.2, "common_share": 0.5}
    results = run_study("side_by_side", tmp_path, settings={**harsh, "method": "joint,bound"}, progress=False)
    caption = (tmp_path / "side_by_side" / "tables" / "rt_le.md").read_text()
    assert "With latency_s 0.2, common_share 0.5." in caption
    mild = run_study(
        "side_by_side",
        tmp_path / "mild",
        settings={**harsh, "method": "joint", "latency_s": None, "common_share": 0.0},
        progress=False,
    )
    where = {"method": "joint", "max_neighbours": 4}
    assert results.values("rt_le_m", where).mean() > mild.values("rt_le_m", where).mean()
    assert (results.values("rt_le_m", {"method": "bound", "max_neighbours": 4}) > 0).all()


def test_what_no_cell_can_be_computed_with_is_refused_before_any(tmp_path: Path, short_town: str) -> None:
    for wrong, said in (
        ({"method": "kalman,jont"}, r"method = 'jont': must be one of .* Did you mean joint\?"),
        ({"runs": 0}, r"runs = 0: must be >= 1"),
    ):
        with pytest.raises(InputError, match=said):
            run_study("side_by_side", tmp_path, settings={"data": short_town, **wrong}, progress=False)
    assert not (tmp_path / "side_by_side").exists()
