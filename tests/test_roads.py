"""Filters alone on roads: filterpy's and Stone Soup's extended filters, real cars, logs of one's own."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import rivals
from conftest import measured, winding
from numpy.testing import assert_allclose

import coopoc as co
from coopoc import V2X, CooperativeFilter, Kalman, Sensors, observe
from coopoc.evaluate.metrics import rt_le
from coopoc.methods.cooperative_filter import AS_STATED, ON_ROADS
from coopoc.studies import benchmark
from coopoc.studies.pose_drives import hashed
from coopoc.studies.roads import ROADS, road_row, thinned

TURNS = AS_STATED._replace(heading=0.1, scale=0.03, lasts=300.0, absent=-np.inf)
"""Errors of heading and scale, and no guard: the rivals' extended Kalman filter."""


def turned(recording, angle, scale):
    """With odometry whose heading errs by `angle` rad and whose speeds by a share."""
    c, s = np.cos(angle), np.sin(angle)
    velocity = recording.velocity @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    return replace(recording, velocity=(1 + scale) * velocity)


def seen(steps=300, runs=2, **noise: Any):
    """A winding drive with gaps, missing fixes and some 30 m off."""
    fleet = winding(steps, 10.0, 7.0)
    recording = observe(fleet, Sensors(**noise), V2X(max_neighbours=0), runs=runs, seed=3)
    gnss = recording.gnss.copy()
    gnss[:, 40:80] = np.nan
    gnss[:, 100::3] = np.nan
    gnss[:, 121:140, :, 0] += 30.0
    return turned(replace(recording, gnss=gnss), 0.15, 0.05), fleet


@pytest.mark.parametrize("name", ["EKF", "StoneSoup"])
def test_without_priors_it_is_the_extended_filter_of_others(name):
    if name == "StoneSoup":
        pytest.importorskip("stonesoup", reason="pip install stonesoup")
    recording, _ = seen(runs=1)
    mine, other = CooperativeFilter(priors=TURNS)(recording), getattr(rivals, name)()(recording)
    assert_allclose(mine.x[..., :2], other.x[..., :2], atol=1e-5)  # its first fix meets a prior of 1e6 m^2
    assert_allclose(mine.covariance[..., :2, :2], other.covariance[..., :2, :2], rtol=1e-4, atol=1e-5)


def test_heading_and_scale_are_found():
    """-0.15 rad turns the odometry back and 1 / 1.05 its scale; the errors cost a Kalman filter twice as much."""
    recording, fleet = seen(900, runs=10, gnss_std=(1.0, 1.0, 1.0))
    track = CooperativeFilter(priors=ON_ROADS._replace(heading=0.1))(recording)
    assert track.extras["heading_error"][:, -1].mean() == pytest.approx(-0.15, abs=0.03)
    assert track.extras["scale_error"][:, -1].mean() == pytest.approx(1 / 1.05 - 1, abs=0.02)
    assert 2 * rt_le(track, fleet).mean() < rt_le(Kalman()(recording), fleet).mean()


def test_a_log_of_ones_own_is_a_task(tmp_path):
    """Odometry turned by 0.15 rad: the cooperative filter alone is better."""
    recording, fleet = seen(6000, runs=1)
    data = tmp_path / "own"
    data.mkdir()
    frame = pd.DataFrame({"t": fleet.t, "vehicle": "a"})
    frame[["x", "y"]] = fleet.position[:, 0, :2]
    frame.to_csv(data / "truth.csv")
    frame[["x", "y"]], frame[["vx", "vy"]] = recording.gnss[0, :, 0, :2], recording.velocity[0, :, 0, :2]
    frame.to_csv(data / "car.csv")
    kept = np.isfinite(thinned("own", data)[0].gnss[0, :, 0, 0])
    assert 0.05 < kept.sum() / np.isfinite(recording.gnss[0, :, 0, 0]).sum() < 0.1
    assert not kept[recording.t % 180.0 >= 150.0].any()
    mine, usual = (road_row("own", data, method) for method in (CooperativeFilter(), Kalman()))
    assert mine["rt_le_m"][0] < 0.7 * usual["rt_le_m"][0]
    assert mine["nees"] < usual["nees"]
    assert mine["data"] == hashed(data)
    assert np.mean(mine["blocks_m"]) == pytest.approx(mine["rt_le_m"][0], abs=1e-4)
    cards = [{"method": name, "tasks": [row]} for name, row in (("cooperative-filter", mine), ("kalman", usual))]
    less = co.paired_difference(np.array(usual["blocks_m"]), np.array(mine["blocks_m"]))
    assert f"| {less} " in benchmark.page(cards)


@pytest.mark.parametrize("task", ["f9k", "kitti", "comma2k19"])
def test_alone_it_is_the_best_on_real_roads(task):
    for name in ROADS[task]:
        measured(name)
    mine, usual = (road_row(task, measured(), m) for m in (CooperativeFilter(), Kalman()))
    assert mine["rt_le_m"][0] < usual["rt_le_m"][0]
    assert 0.35 < mine["nees"] < 4.0
