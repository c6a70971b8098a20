"""The road filter: dense and filterpy's oracles, the tuned Kalman filter on exact odometry, streams, calibration, real
cars."""

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import measured, refused, winding
from numpy.testing import assert_allclose
from oracles.road import road

import coopoc as co
from coopoc import V2X, Fleet, Kalman, NoiseModel, Recording, RoadErrors, RoadFilter, Sensors, observe
from coopoc.arrays import Floats
from coopoc.evaluate.metrics import rt_le
from coopoc.methods.road import ROAD, from_logs, to_logs
from coopoc.studies import benchmark
from coopoc.studies.roads import ROADS, road_row, roads
from coopoc.studies.roads import seen as thinned

PLAIN = replace(ROAD, gate=1e9, window=np.inf, correlation=0.0, fix=1.0, motion=1.0, least=1.0)
"""No gate, white errors: an extended Kalman filter."""


def turned(recording: Recording, angle: float, scale: float) -> Recording:
    """With odometry whose heading errs by `angle` rad and whose speeds by a share."""
    c, s = np.cos(angle), np.sin(angle)
    velocity = recording.velocity @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    return replace(recording, velocity=(1 + scale) * velocity)


def seen(steps: int = 300, runs: int = 2, **noise: float) -> tuple[Recording, Fleet]:
    fleet = winding(steps, 10.0, 7.0)
    recording = observe(fleet, Sensors(**noise), V2X(max_neighbours=0), runs=runs, seed=3)  # type: ignore[arg-type]
    gnss = recording.gnss.copy()
    gnss[:, 40:80] = np.nan
    gnss[:, 100::3] = np.nan
    gnss[:, 121:140, :, 0] += 30.0
    return turned(replace(recording, gnss=gnss), 0.15, 0.05), fleet


def noise_of(recording: Recording, errors: RoadErrors) -> tuple[Floats, Floats]:
    known = NoiseModel.nominal(recording.sensors)
    return errors.motion**2 * known.process_variance(recording), errors.fix**2 * known.gnss_variance


@pytest.mark.parametrize("errors", [ROAD, PLAIN, RoadErrors(gate=0.7, window=4.0, correlation=0.4)])
def test_equals_the_dense_filter(errors: RoadErrors) -> None:
    """Through gaps, jumps and missing fixes, to rounding."""
    recording, _ = seen()
    track = RoadFilter(errors=errors)(recording)
    assert track.covariance is not None
    q, r = noise_of(recording, errors)
    for run in range(recording.runs):
        x, p = road(recording.gnss[run, :, 0], recording.velocity[run, :, 0], q[run, :, 0], r, recording.dt, errors)
        assert_allclose(track.x[run, :, 0], x[:, [0, 1, 4]], rtol=0, atol=1e-8)
        assert_allclose(track.covariance[run, :, 0], p[:, [0, 1, 4]][:, :, [0, 1, 4]], rtol=1e-8, atol=1e-10)
        assert_allclose(track.extras["heading_error"][run, :, 0], x[:, 2], atol=1e-9)
        assert_allclose(track.extras["scale_error_std"][run, :, 0] ** 2, p[:, 3, 3], rtol=1e-7)


@pytest.fixture
def rivals(monkeypatch: pytest.MonkeyPatch) -> Any:
    """benchmarks/rivals.py."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module("rivals")


@pytest.mark.parametrize("name", ["EKF", "StoneSoup"])
def test_without_a_gate_it_is_the_extended_filter_of_others(rivals: Any, name: str) -> None:
    if name == "StoneSoup":
        pytest.importorskip("stonesoup", reason="pip install stonesoup")
    recording, _ = seen(runs=1)
    mine, other = RoadFilter(errors=PLAIN)(recording), getattr(rivals, name)()(recording)
    assert mine.covariance is not None
    assert_allclose(mine.x[..., :2], other.x[..., :2], atol=1e-8)
    assert_allclose(mine.covariance[..., :2, :2], other.covariance[..., :2, :2], rtol=1e-7, atol=1e-10)


def test_rivals_do_what_they_are_for(rivals: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The smoother is better where fixes jump, and the filter with a wide kernel; calibrated a rival is better."""
    recording, fleet = seen(runs=1)
    wrong = rt_le(rivals.EKF()(recording), fleet)
    assert rt_le(rivals.FixedLag()(recording), fleet) < 0.7 * wrong
    unmoved = replace(rivals.FixedLag(), known=replace(PLAIN, gate=1e4))(recording)
    assert rt_le(unmoved, fleet) == pytest.approx(wrong, rel=0.05)
    monkeypatch.setattr(rivals, "EVALUATIONS", 40)
    fitted = rivals.EKF().fitted(recording, fleet)
    assert rt_le(fitted(recording), fleet) < 0.9 * wrong


def test_exact_odometry_gives_the_tuned_kalman_filter() -> None:
    """The paper's scenarios: the numbers of the Kalman filter without its gate, as nothing reaches that of EXACT."""
    fleet = winding(300, 10.0, 7.0)
    for sensors in (Sensors.paper_training(), Sensors.paper_scenario1(), Sensors.paper_scenario2()):
        recording = observe(fleet, sensors, V2X(max_neighbours=0), runs=5)
        mine, known = RoadFilter()(recording), Kalman(robust=False)(recording)
        assert mine.covariance is not None
        assert known.covariance is not None
        assert_allclose(mine.x, known.x, atol=1e-9)
        assert_allclose(mine.covariance, known.covariance, rtol=1e-9, atol=1e-12)


def test_heading_and_scale_are_found() -> None:
    """-0.15 rad turns the odometry back and 1 / 1.05 its scale; a heading error costs a Kalman filter twice as much."""
    recording, fleet = seen(900, runs=10, gnss_std=(1.0, 1.0, 1.0))  # type: ignore[arg-type]
    track = RoadFilter(errors=ROAD)(recording)
    assert track.extras["heading_error"][:, -1].mean() == pytest.approx(-0.15, abs=0.03)
    assert track.extras["scale_error"][:, -1].mean() == pytest.approx(1 / 1.05 - 1, abs=0.02)
    assert 2 * rt_le(track, fleet).mean() < rt_le(Kalman()(recording), fleet).mean()


def test_a_fix_counts_less_the_farther_it_is() -> None:
    """A wild fix moves the estimate less than one that is a tenth as far, and after it all is as it was."""
    recording, _ = seen(100, runs=1)
    filtered = []
    for jump in (0.0, 100.0, 1000.0):
        gnss = recording.gnss.copy()
        gnss[:, 90, :, :2] += jump
        filtered.append(RoadFilter(errors=ROAD)(replace(recording, gnss=gnss)).x[0, :, 0])
    moved = [np.linalg.norm(x - filtered[0], axis=1) for x in filtered[1:]]
    assert 0 < moved[1][90] < moved[0][90] < 10.0


def test_stated_errors_are_taken_from_the_sensors() -> None:
    recording, _ = seen()
    told = replace(recording.sensors, speed_scale_std=0.07, heading_bias_std=0.2, odometry_error_time=50.0)
    assumed = RoadFilter().assumed(replace(recording, sensors=told))
    assert (assumed.scale, assumed.heading, assumed.lasts) == (0.07, 0.2, 50.0)
    assert RoadFilter().assumed(replace(recording, notes=("nothing is simulated",))) == ROAD


def test_a_stream_is_the_drive() -> None:
    recording, _ = seen(runs=1)
    method = RoadFilter(NoiseModel.nominal(recording.sensors), ROAD)
    track, stream = method(recording), method.start()
    assert track.covariance is not None
    for t in range(len(recording.t)):
        x, cov = stream.step(recording.gnss[0, t, 0], recording.velocity[0, t, 0], recording.dt)
        assert_allclose(x, track.x[0, t, 0], atol=1e-9)
        assert cov is not None
        assert_allclose(cov, track.covariance[0, t, 0], atol=1e-9)
    late, _ = method.start().step(None, [1.0, 0.0, 0.0], 0.1)
    assert np.isnan(late).all()


def test_calibration_beats_the_defaults_on_its_own_drive_and_the_rest() -> None:
    """Odometry whose noise is ten times what is assumed, fixes that are a third: with a truth and without one."""
    fleet = winding(1800, 10.0, 7.0)
    acting = Sensors(gnss_std=(0.5,) * 3, velocity_std_ratio=1.0)
    recording = turned(observe(fleet, acting, V2X(max_neighbours=0), assumed=Sensors()), 0.1, 0.0)
    first, rest, truth = recording.between(0, 900), recording.between(900, 1800), fleet.between(900, 1800)
    usual = rt_le(RoadFilter(errors=ROAD)(rest), truth).mean()
    assert rt_le(RoadFilter.fitted(first, fleet.between(0, 900))(rest), truth).mean() < 0.8 * usual
    blind = RoadFilter.fitted(first)
    assert rt_le(blind(rest), truth).mean() < 0.5 * usual
    assert blind.errors is not None
    assert blind.errors.fix == pytest.approx(ROAD.fix)


def test_what_cannot_be_calibrated_is_refused() -> None:
    recording, fleet = seen(30)
    with refused("must be on the steps"):
        RoadFilter.fitted(recording, fleet.between(0, 20))
    with refused("without a break"):
        RoadFilter.fitted(recording.between(0, 10))
    with refused("gate"):
        RoadErrors(gate=0.0)


def test_logarithms_and_back() -> None:
    assert to_logs(from_logs(to_logs(ROAD))) == pytest.approx(to_logs(ROAD))


def test_a_log_of_ones_own_is_a_task(tmp_path: Path) -> None:
    """Odometry turned by 0.2 rad: the road filter is better as it comes, and no worse calibrated."""
    recording, fleet = seen(6000, runs=1)
    rows = ["t,vehicle,x,y,vx,vy"]
    for t, fix, u in zip(recording.t, recording.gnss[0, :, 0], recording.velocity[0, :, 0], strict=True):
        rows.append(f"{t},a,{fix[0]},{fix[1]},{u[0]},{u[1]}".replace("nan", ""))
    true = [f"{t},a,{x},{y}" for t, (x, y, _) in zip(fleet.t, fleet.position[:, 0], strict=True)]
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "car.csv").write_text("\n".join(rows))
    (tmp_path / "own" / "truth.csv").write_text("\n".join(["t,vehicle,x,y", *true]))
    data = tmp_path / "own"
    assert list(roads(data)) == ["own"]
    kept = np.isfinite(thinned("own", data)[0].gnss[0, :, 0, 0])
    assert 0.05 < kept.sum() / np.isfinite(recording.gnss[0, :, 0, 0]).sum() < 0.1
    clock = recording.t % 180.0
    assert not kept[clock >= 150.0].any()
    mine, usual = (road_row("own", data, method) for method in (RoadFilter(), Kalman()))
    assert mine["rt_le_m"][0] < 0.7 * usual["rt_le_m"][0]
    assert mine["calibrated_m"][0] < 1.02 * mine["rt_le_m"][0]
    assert mine["nees"] < usual["nees"]
    assert np.mean(mine["calibrated_blocks_m"]) == pytest.approx(mine["calibrated_m"][0], abs=1e-4)
    cards = [{"method": name, "tasks": [row]} for name, row in (("road-kalman", mine), ("kalman", usual))]
    less = co.paired_difference(np.array(usual["blocks_m"]), np.array(mine["blocks_m"]))
    assert f"| {less} " in benchmark.page(cards)


@pytest.mark.parametrize("task", ["f9k", "kitti", "comma2k19"])
def test_calibrated_it_is_the_best_on_real_roads(task: str) -> None:
    """Before Kalman filters, as they come or calibrated; NEES of (x, y) between 1 and 4, as it comes from 0.4 on."""
    for name in ROADS[task]:
        measured(name)
    mine, usual, adaptive = (road_row(task, measured(), m) for m in (RoadFilter(), Kalman(), co.AdaptiveKalman()))
    others = usual["rt_le_m"][0], usual["calibrated_m"][0], adaptive["rt_le_m"][0]
    assert mine["calibrated_m"][0] < 0.97 * min(others)
    assert 1.0 < mine["calibrated_nees"] < 4.0
    assert 0.4 < mine["nees"] < 4.0
