"""Convoys: pieces of one real drive side by side keep its errors; star filters get rows on them."""

import json

import numpy as np
import pytest
from conftest import measured, refused
from numpy.linalg import norm

import coopoc as co
from coopoc.studies import benchmark, roads

TASKS = ("convoy-kitti", "convoy-f9k", "convoy-comma2k19")


@pytest.mark.parametrize("task", TASKS)
def test_vehicles_err_as_the_pieces_of_the_drive(task):
    for name in roads.ROADS[roads.CONVOYS[task]]:
        measured(name)
    recording, fleet = roads.convoy(task, measured())
    drive, truth = roads.thinned(roads.CONVOYS[task], measured())
    column, count, length = drive.observers[0], len(fleet.ids), len(fleet.t)
    assert count == (2 if task == "convoy-comma2k19" else 4)
    assert count * length <= len(drive.t)
    assert np.isfinite(recording.gnss[:, 0]).all()
    assert norm(fleet.position[0] - fleet.position[0].mean(0), axis=-1).max() < 2 * roads.START_SPREAD
    error = (recording.gnss[0] - fleet.position)[..., :2]
    real = (drive.gnss[0, :, column] - truth.position[:, column])[:, :2]
    begins = roads._pieces(drive, column)[0]
    for k, begin in enumerate(begins):
        piece = real[begin : begin + length]
        known = np.isfinite(piece[:, 0])
        assert known.sum() > 2
        assert error[known, k] == pytest.approx(piece[known], abs=1e-6)
        assert (np.isfinite(error[:, k, 0]) >= known).all()
    speed, true = (norm(values, axis=-1) for values in (recording.velocity[0], fleet.velocity))
    fast = true[:, 0] > 2.0
    assert fast.any()
    assert speed[fast, 0] == pytest.approx(
        norm(drive.velocity[0, begins[0] :][:length, column], axis=-1)[fast], rel=0.02
    )
    assert np.array_equal(recording.gnss[0], recording.gnss[1], equal_nan=True)
    assert not np.array_equal(recording.relative[0], recording.relative[1])


def test_star_filters_get_rows_on_convoys(tmp_path):
    measured("KITTI_00_gt.txt")
    assert benchmark.benchmark(("joint", "kalman"), data=measured(), tasks=("convoy-kitti",), out=tmp_path) == 0
    joint, alone = (json.loads((tmp_path / f"{name}.json").read_text())["tasks"][0] for name in ("joint", "kalman"))
    recording, fleet = roads.convoy("convoy-kitti", measured())
    gap = (co.JointFilter()(recording, recording.ids).x - fleet.position)[..., :2]
    assert joint["rt_le_m"][0] == pytest.approx(np.sqrt(np.vecdot(gap, gap).mean()), rel=0.15)  # a mean over blocks
    assert joint["rt_le_m"][0] < alone["rt_le_m"][0]
    assert (joint["received_bytes_per_second"] > 0, alone["received_bytes_per_second"]) == (True, 0)
    assert len(joint["blocks_m"]) == len(alone["blocks_m"])
    with refused("must name the|must be of|must hold"):
        benchmark.benchmark(("pose-solo",), data=measured(), tasks=("convoy-kitti",), out=tmp_path)
