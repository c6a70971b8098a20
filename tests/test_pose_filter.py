"""Pose filters against a dense oracle, filterpy, GTSAM, the position filter; streams against Tracks."""

import os
from dataclasses import replace

import numpy as np
import pytest
from conftest import refused, textbook, with_masts, without
from numpy import nan
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import pose_filter as oracle
from shell import ROOT, python

import coopoc as co
from coopoc.methods.poses.pose_inputs import pose_measurements, pose_noise, to_landmarks
from coopoc.world.body_frames import in_world

NOISE = co.Sensors(
    gnss_std=(1.0, 1.0, 0.5),
    heading_std=0.05,
    yaw_rate_std=0.02,
    speed_scale_std=0.05,
    yaw_rate_bias_std=0.02,
    odometry_error_time=30.0,
    range_std=0.3,
    azimuth_std=0.03,
    inclination_std=0.03,
)
LATE = co.V2X(max_neighbours=3, radius=40.0, rate=5.0, loss=0.3, latency=0.2)


def with_gaps(recording):
    """A third of the fixes and compasses after the first step, and of each relative component, are missing."""
    rng, body = default_rng(0), recording.body
    gnss, heading, relative = recording.gnss.copy(), body.heading.copy(), recording.relative.copy()
    moving = ~np.isin(np.arange(len(recording.ids)), recording.landmarks)
    for values in (gnss, heading):
        lost = (rng.random(values.shape[:3]) < 0.3) & moving
        lost[:, 0] = False
        values[lost] = nan
    gnss[:, 30:33, 1] = nan
    relative[rng.random(relative.shape) < 0.3] = nan
    return replace(recording, gnss=gnss, relative=relative, body=co.Body(body.yaw_rate, heading))


@pytest.fixture(scope="module")
def rough(crossing):
    """Vehicle 1 is away for a while and comes back without a fix, vehicle 2 comes late."""
    moving, masts = without(crossing, (slice(25, 30), 1), (slice(10), 2)), [[5, 5, 3], [-10, 4, 2]]
    fleet = with_masts(moving, masts)
    return with_gaps(co.observe(fleet, NOISE, LATE, runs=2, seed=4, frame="body", landmarks=["m0", "m1"]))


@pytest.mark.parametrize(
    ("kind", "d", "exact", "arm"),
    [
        ("solo", 6, False, 1.0),
        ("fleet", 4, True, 2.0),
        ("fleet", 6, False, 0.0),
        ("fleet", 7, True, 0.0),
        ("fleet", 10, True, 0.5),
    ],
)
def test_the_kernel_is_the_dense_oracle(rough, kind, d, exact, arm):
    """Gaps, losses, members that come and go, landmarks, range only and bearing only; the first one without a fix."""
    rough = replace(rough, tags=arm * np.eye(10)[:, [1, 0, 2]] + 0.3 * arm * (np.arange(10)[:, None] < 8))
    mine = rough.links.of(0)
    members = [0] if kind == "solo" else [1, 0, *range(2, 8)]
    links = to_landmarks(rough, mine) if kind == "solo" else np.arange(len(rough.links))
    begin, spread = np.full((2, 10, 4), nan), (1.0, 1.0, 1.0, 0.1)
    begin[:, 0] = [*rough.gnss[0, 0, 0], 0.3]
    told = replace(NOISE, range_offset_std=0.5 * (d > 6), velocity_bias_std=0.2 * (d > 7))
    method = textbook(co.PoseFilter(kind, lasting=d > 4, exact=exact, spread=spread, assumed=told))  # type: ignore[arg-type]
    x, cov, _ = method._run_filter(rough, members, links, begin)
    measured, noise = pose_measurements(rough, members, links), pose_noise(told, rough.dt, np.inf)
    for run in range(2 - exact):
        first = begin[run, members], spread
        wanted, covariance = oracle.pose_filter(measured, noise, first, d, 3 if exact else 1, run)
        scale, here = np.sqrt(np.einsum("...ii->...i", covariance)) + 1e-3, measured.active
        assert (np.isfinite(x[run]).all(-1) == here).all()
        assert (abs(x[run] - wanted) / scale)[here].max() < 1e-3  # derivatives of the oracle are numerical
        assert (abs(cov[run] - covariance) / (scale[..., None] * scale[..., None, :]))[here].max() < 1e-3


@pytest.mark.parametrize("neighbours", [0, 3])
def test_with_a_perfect_heading_it_is_the_position_filter(neighbours, formation):
    """Same draws turned into the world by the exact compass: alone it is the Kalman filter, together near the bound of
    all positions."""
    drive = formation.select(range(4)).between(0, 200)
    exact = co.Sensors(gnss_std=(3.5,) * 3, heading_std=0.0, yaw_rate_std=0.0, velocity_reading="speed")
    v2x = co.V2X(max_neighbours=neighbours)
    body = co.observe(drive, exact, v2x, runs=8, frame="body")
    here = textbook(co.PoseFilter("fleet"))(body, range(4))
    if neighbours == 0:
        assert_allclose(here.x, textbook(co.Kalman())(in_world(body), range(4)).x, atol=1e-4)
    square = np.trace(co.fleet_bound(drive, exact, v2x), axis1=-2, axis2=-1).mean()
    assert 1.0 < np.square(co.rt_le(here, drive)).mean() / square < 1.2


def test_an_update_of_the_oracle_is_filterpys():
    """One pass of what the dense oracle stacks is the update of filterpy's extended Kalman filter."""
    filterpy = pytest.importorskip("filterpy.kalman")
    rng, variances = default_rng(0), np.array([0.3, 0.03, 0.03]) ** 2
    root, begin = rng.normal(size=(8, 8)), np.array([0.0, 1.0, 2.0, 0.3, 9.0, 4.0, 3.0, -0.5])

    def seen(x):
        return oracle.spherical(x[:4], x[4:7])

    z, ekf = seen(begin) + 0.1 * rng.normal(size=3), filterpy.ExtendedKalmanFilter(8, 3)
    ekf.x, ekf.P = begin.copy(), root @ root.T
    x, cov = oracle.update(begin, ekf.P.copy(), seen, z, lambda _: variances, [False] * 3)
    ekf.update(z, lambda x: oracle.jacobian(seen, x), seen, np.diag(variances))
    assert_allclose(x, ekf.x, atol=1e-9)
    assert_allclose(cov, ekf.P, atol=1e-9)


def test_it_is_as_good_as_with_ten_passes(crossing, monkeypatch):
    """Where headings are vague beside ranges and bearings."""
    drive, errors = crossing.select(range(4)), []
    sharp = replace(NOISE, gnss_std=(3.5,) * 3, heading_std=0.09, speed_scale_std=0.0, yaw_rate_bias_std=0.0)
    sharp = replace(sharp, range_std=0.1, azimuth_std=0.01, inclination_std=0.01)
    seen = co.observe(drive, sharp, co.V2X(max_neighbours=3, radius=100.0), runs=3, seed=2, frame="body")
    for passes in (3, 10):
        monkeypatch.setattr("coopoc.methods.poses.pose_filter.PASSES", passes)
        errors.append(co.rt_le(textbook(co.PoseFilter("fleet"))(seen, range(4)), drive).mean())
    assert errors[0] < 1.02 * errors[1]


@pytest.mark.parametrize("how", [{}, {"lasting": True, "exact": False, "gate": 3.0}])
def test_a_stream_gives_the_numbers_of_its_track(rough, how):
    method, links = co.PoseFilter("solo", assumed=replace(NOISE, range_offset_std=0.5), **how), rough.links
    track, mine = method(rough, [0]), to_landmarks(rough, rough.links.of(0))
    for run in range(2):
        stream = method.start(rough.dt)
        for t in range(len(rough.t)):
            now = mine[links.step[mine] == t]
            marks = [
                co.LandmarkMeasurement(rough.relative[run, k], rough.gnss[run, t, links.neighbour[k]]) for k in now
            ]
            own = (each[run, t, 0] for each in (rough.velocity, rough.body.yaw_rate, rough.gnss, rough.body.heading))
            x, cov = stream.step(co.OwnMeasurement(*own), marks)
            assert_array_equal(x[:3], track.x[run, t, 0])
            assert_array_equal(x[3], track.heading[run, t, 0])  # type: ignore[index]
            assert_array_equal(cov[:3, :3], track.covariance[run, t, 0])  # type: ignore[index]
            assert_array_equal(cov[3, :4], track.heading_covariance[run, t, 0])  # type: ignore[index]


def test_a_known_start_needs_no_compass():
    method = co.PoseFilter("solo", assumed=co.Sensors(heading_std=0.05))
    still = co.OwnMeasurement([1.0, 0.0, 0.0], 0.0)
    stream = method.start(0.1, [1.0, 2.0, 0.0, 0.5])
    assert stream.step(still).x == pytest.approx([1.0, 2.0, 0.0, 0.5])
    assert stream.step(still).x[:2] == pytest.approx([1 + 0.1 * np.cos(0.5), 2 + 0.1 * np.sin(0.5)])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: co.PoseFilter("fleet", assumed=NOISE).start(0.1), "cannot be streamed"),
        (lambda: co.PoseFilter("solo").start(0.1), "assumed"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.0), "dt"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.1, np.zeros(3)), "begin"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.1).step(co.OwnMeasurement([1, 0, 0], 0.0)), "begin"),
        (lambda: co.PoseFilter("solo", assumed=NOISE).start(0.1, np.zeros(4)).step(None), "own"),
        (lambda: co.LandmarkMeasurement([0.0, 0.4, 1.4], [1.0, 2.0, 3.0]), "the range first and > 0"),
    ],
)
def test_mistakes_of_streams_are_named(make, words):
    with refused(words):
        make()


@pytest.mark.slow
def test_no_kernel_of_poses_reads_beyond_its_arrays(tmp_path):
    """numba's bounds checks, over members that come and go, in a process of its own."""
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, "-k", "dense_oracle"]
    python(*words, env={**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}, cwd=ROOT)
