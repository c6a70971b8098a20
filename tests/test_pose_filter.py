"""Pose filters against a dense oracle, filterpy, GTSAM, the group's exponential, and the position filter."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import pose_filter as oracle
from scipy.linalg import expm

import coopoc as co
from coopoc.kernels.poses.pose_filter import PoseOptions, follow
from coopoc.methods import pose_unit
from coopoc.world.body_frames import in_world
from coopoc.world.inbox import inbox

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


def with_gaps(recording: co.Recording, seed: int = 0) -> co.Recording:
    """A third of the fixes and compasses after the first step, and of each relative component, are missing."""
    rng, body = np.random.default_rng(seed), recording.body
    assert body is not None
    gnss, heading, relative = recording.gnss.copy(), body.heading.copy(), recording.relative.copy()
    moving = ~np.isin(np.arange(len(recording.ids)), recording.landmarks)
    for values in (gnss, heading):
        lost = (rng.random(values.shape[:3]) < 0.3) & moving
        lost[:, 0] = False
        values[lost] = np.nan
    relative[rng.random(relative.shape) < 0.3] = np.nan
    return replace(recording, gnss=gnss, relative=relative, body=co.Body(body.yaw_rate, heading))


def with_masts(fleet: co.Fleet) -> co.Fleet:
    """Two landmarks more."""
    masts = np.broadcast_to([[5.0, 5.0, 3.0], [-10.0, 4.0, 2.0]], (len(fleet.t), 2, 3))
    position, velocity = (np.append(a, b, axis=1) for a, b in ((fleet.position, masts), (fleet.velocity, 0 * masts)))
    return co.Fleet((*fleet.ids, "mast", "tower"), fleet.t, position, velocity)


@pytest.fixture(scope="module")
def rough(crossing: co.Fleet) -> co.Recording:
    marks = ["mast", "tower"]
    return with_gaps(co.observe(with_masts(crossing), NOISE, LATE, runs=2, seed=4, frame="body", landmarks=marks))


def unit_of(recording: co.Recording, kind: str) -> tuple[Any, Any]:
    """Members and links of vehicle 0 or of the fleet."""
    links, mine = recording.links, recording.links.of(0)
    if kind == "star":
        return pose_unit.star(recording, 0, inbox(recording, 0, co.PoseFilter().message)), mine
    if kind == "solo":
        return pose_unit.alone(recording, 0), mine[np.isin(links.neighbour[mine], recording.landmarks)]
    return pose_unit.fleet(recording), np.arange(len(links))


@pytest.mark.parametrize(("kind", "d", "passes"), [("solo", 6, 1), ("star", 4, 2), ("star", 6, 1), ("fleet", 6, 2)])
def test_the_kernel_is_the_dense_oracle(rough: co.Recording, kind: str, d: int, passes: int) -> None:
    """Gaps, losses, delays, members that come and go, landmarks, range only and bearing only."""
    members, links = unit_of(rough, kind)
    seen, noise = pose_unit.seen(rough, members, links), pose_unit.pose_noise(NOISE, rough.dt, np.inf)
    begin, spread = np.full((2, 10, 4), np.nan), np.array([1.0, 1.0, 1.0, 0.1])
    begin[:, 0] = [*rough.gnss[0, 0, 0], 0.3]
    options, memory = PoseOptions(d, passes, False, 0, 0), pose_unit.memory(int(np.diff(members.start).max()), d)
    x, cov, _ = follow(seen, noise, begin, spread, options, memory)
    for run in range(2):
        wanted, covariance = oracle.pose_filter(seen, noise, begin, spread, options, run)
        scale = np.sqrt(np.einsum("...ii->...i", covariance)) + 1e-3
        assert np.abs((x[run] - wanted) / scale).max() < 1e-3  # derivatives of the oracle are numerical
        assert np.abs((cov[run] - covariance) / (scale[..., None] * scale[..., None, :])).max() < 1e-3


@pytest.mark.parametrize("neighbours", [0, 2, 10])
def test_with_a_perfect_heading_it_is_the_position_filter(formation: co.Fleet, neighbours: int) -> None:
    """Same draws turned into the world by the exact compass: the position filter's RT-LE within 1 %."""
    drive = formation.between(0, 200)
    exact = co.Sensors(gnss_std=(3.5,) * 3, heading_std=0.0, yaw_rate_std=0.0, velocity_reading="speed")
    body = co.observe(drive, exact, co.V2X(max_neighbours=neighbours), runs=8, frame="body", observers=[0])
    here = co.rt_le(co.PoseFilter()(body), drive).mean()
    there = co.rt_le(co.JointFilter()(in_world(body)), drive).mean()
    assert here == pytest.approx(there, rel=0.01)


def test_a_star_is_filterpys_extended_kalman_filter(formation: co.Fleet) -> None:
    """filterpy's predict and update with this model's derivatives, four members, 40 steps."""
    filterpy = pytest.importorskip("filterpy.kalman")
    drive = formation.between(0, 40)
    noise = replace(NOISE, speed_scale_std=0.0, yaw_rate_bias_std=0.0)
    seen = co.observe(drive, noise, co.V2X(max_neighbours=3), frame="body", observers=[0])
    track = co.PoseFilter(exact=False)(seen)
    members, links = unit_of(seen, "star")
    packed = pose_unit.seen(seen, members, links)
    assert seen.body is not None
    order = members.column[:4]
    ekf = filterpy.ExtendedKalmanFilter(16, 1)
    ekf.x = np.concatenate([[*seen.gnss[0, 0, n], seen.body.heading[0, 0, n]] for n in order])
    ekf.P = np.diag([1e6, 1e6, 1e6, np.pi**2 / 3] * 4)
    for t in range(40):
        assert set(members.column[4 * t : 4 * t + 4]) == set(order)
        if t:
            F, Q = np.eye(16), np.zeros((16, 16))
            for k, n in enumerate(order):
                u = np.append(seen.velocity[0, t, n], seen.body.yaw_rate[0, t, n])
                b, state = slice(4 * k, 4 * k + 4), ekf.x[4 * k : 4 * k + 4]
                F[b, b] = oracle.jacobian(lambda s, u=u: oracle.motion(s, u, seen.dt), state)
                G = oracle.jacobian(lambda v, s=state: oracle.motion(s, v, seen.dt), u)
                q = np.append(np.maximum(0.1 * np.abs(u[:3]), 0.05) ** 2, 0.02**2)
                Q[b, b], ekf.x[b] = G @ np.diag(q) @ G.T, oracle.motion(state, u, seen.dt)
            ekf.P = F @ ekf.P @ F.T + Q
        for k, n in enumerate(order):
            H = np.zeros((4, 16))
            H[:, 4 * k : 4 * k + 4] = np.eye(4)
            z = np.append(seen.gnss[0, t, n], seen.body.heading[0, t, n])
            z[3] = ekf.x[4 * k + 3] + oracle.wrapped(z[3] - ekf.x[4 * k + 3], True)
            ekf.update(z, lambda x, H=H: H, lambda x, H=H: H @ x, np.diag([1.0, 1.0, 0.25, 0.05**2]))
        mine = range(packed.first[t], packed.first[t + 1])
        places = [list(order).index(seen.links.neighbour[links[k]]) for k in mine]

        def h(x: Any, places: Any = places) -> Any:
            return np.concatenate([oracle.spherical(x[:4], x[4 * p : 4 * p + 3]) for p in places])

        z, angle = np.concatenate([packed.relative[0, k] for k in mine]), np.tile([False, True, True], 3)
        z = h(ekf.x) + oracle.wrapped(z - h(ekf.x), angle)
        ekf.update(z, lambda x, h=h: oracle.jacobian(h, x), h, np.diag(np.tile(np.square([0.3, 0.03, 0.03]), 3)))
        assert np.allclose(track.x[0, t, 0], ekf.x[:3], atol=1e-5)
        assert np.allclose(track.covariance[0, t, 0], ekf.P[:3, :3], rtol=1e-4, atol=1e-7)  # type: ignore[index]


def lone(steps: int = 12) -> co.Fleet:
    """A vehicle on a circle with a landmark at its side."""
    t = np.arange(steps) * 0.1
    way = np.stack([10 * np.sin(t), 10 - 10 * np.cos(t), 0 * t], axis=1)
    position = np.stack([way, np.broadcast_to([3.0, 4.0, 0.0], way.shape)], axis=1)
    velocity = np.diff(position, axis=0, prepend=position[:1]) / 0.1
    return co.Fleet(("a", "mast"), t, position, velocity, heading=np.stack([t, 0 * t], axis=1))


def landmark_only(steps: int = 12, **noise: Any) -> co.Recording:
    """Its recording without fixes, compass and inclinations."""
    sensors = replace(NOISE, speed_scale_std=0.0, yaw_rate_bias_std=0.0, compass=False, **noise)
    seen = co.observe(lone(steps), sensors, co.V2X(max_neighbours=0), frame="body", landmarks=["mast"], seed=2)
    gnss, relative = seen.gnss.copy(), seen.relative.copy()
    gnss[:, :, 0], relative[..., 2] = np.nan, np.nan
    return replace(seen, gnss=gnss, relative=relative)


def test_a_solo_filter_moves_and_updates_covariances_as_gtsam() -> None:
    """GTSAM's InvariantEKFPose2, whose covariance is of a step in the body: turned into the world it is the plain
    filter's, after a prediction and after an update at the same state."""
    gtsam = pytest.importorskip("gtsam")
    seen, start = landmark_only(2), np.array([[0.1, -0.2, 0.0, 0.05], [0, 0, 0, 0]])
    track = co.PoseFilter("solo", exact=False, begin=start, spread=(0.3, 0.2, 0.1, 0.1))(seen)
    noise = np.square([0.3, 0.03])

    def turned(pose: Any) -> Any:
        T = np.eye(3)
        T[:2, :2] = pose.rotation().matrix()
        return T

    def update(ekf: Any, z: Any) -> Any:
        pose, T = ekf.state(), turned(ekf.state())
        own = np.array([pose.x(), pose.y(), 0.0, pose.theta()])
        h = lambda s: oracle.spherical(s, np.array([3.0, 4.0, 0.0]))[:2]  # noqa: E731
        H = oracle.jacobian(h, own)[:, [0, 1, 3]] @ T
        ekf.updateWithVector(h(own), H, z, np.diag(noise), False)
        return T @ ekf.covariance() @ T.T

    first = gtsam.Pose2(0.1, -0.2, 0.05)
    spread = np.diag(np.square([0.3, 0.2, 0.1]))
    ekf = gtsam.InvariantEKFPose2(first, turned(first).T @ spread @ turned(first))
    wanted = [update(ekf, seen.relative[0, 0, :2])]
    assert seen.body is not None
    u, w = seen.velocity[0, 1, 0], seen.body.yaw_rate[0, 1, 0]
    state = np.array([*track.x[0, 0, 0], track.heading[0, 0, 0]])  # type: ignore[index]
    after = oracle.motion(state, np.append(u, w), 0.1)
    before, then = (gtsam.Pose2(s[0], s[1], s[3]) for s in (state, after))
    cov = turned(before).T @ wanted[0] @ turned(before)
    ekf = gtsam.InvariantEKFPose2(before, cov)
    G = oracle.jacobian(lambda v: oracle.motion(state, v, 0.1), np.append(u, w))[[0, 1, 3]]
    q = np.append(np.maximum(0.1 * np.abs(u), 0.05) ** 2, 0.02**2)
    T = turned(then)
    ekf.predict(before.between(then), T.T @ G @ np.diag(q) @ G.T @ T)
    wanted.append(update(ekf, seen.relative[0, 1, :2]))
    for t in range(2):
        found = np.zeros((3, 3))
        found[:2, :2] = track.covariance[0, t, 0, :2, :2]  # type: ignore[index]
        found[2, :2] = found[:2, 2] = track.heading_covariance[0, t, 0, :2]  # type: ignore[index]
        found[2, 2] = track.heading_covariance[0, t, 0, 3]  # type: ignore[index]
        assert np.allclose(found, wanted[t], rtol=1e-6, atol=1e-9)
    assert track.heading[0, 1, 0] == pytest.approx(ekf.state().theta(), abs=1e-9)  # type: ignore[index]


def test_the_invariant_filter_is_that_of_the_group() -> None:
    """SciPy's matrix exponential: X' = Exp(K r) X, in the coordinates of the right-invariant error, over 12 steps."""
    seen, start = landmark_only(), np.array([[0.1, -0.2, 0.0, 0.3], [0, 0, 0, 0]])
    spread = (0.3, 0.2, 0.1, 0.4)
    track = co.PoseFilter("solo", exact=False, invariant=True, begin=start, spread=spread)(seen)
    assert seen.body is not None
    state, place = start[0].copy(), np.array([3.0, 4.0, 0.0])

    def coordinates(s: Any) -> Any:
        """Of the error (dp - dth J p, dth) in those of (dp, dth)."""
        return np.array([[1.0, 0.0, s[1]], [0.0, 1.0, -s[0]], [0.0, 0.0, 1.0]])

    cov = coordinates(state) @ np.diag(np.square(spread))[np.ix_([0, 1, 3], [0, 1, 3])] @ coordinates(state).T
    for t in range(12):
        if t:
            v = np.append(seen.velocity[0, t, 0], seen.body.yaw_rate[0, t, 0])
            G = oracle.jacobian(lambda v, s=state: oracle.motion(s, v, 0.1), v)[[0, 1, 3]]
            state = oracle.motion(state, v, 0.1)
            G = coordinates(state) @ G
            cov = cov + G @ np.diag(np.append(np.maximum(0.1 * np.abs(v[:3]), 0.05) ** 2, 0.02**2)) @ G.T
        h = lambda s: oracle.spherical(s, place)[:2]  # noqa: E731
        H = oracle.jacobian(h, state)[:, [0, 1, 3]] @ np.linalg.inv(coordinates(state))
        K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.diag(np.square([0.3, 0.03])))
        xi = K @ oracle.wrapped(seen.relative[0, t, :2] - h(state), np.array([False, True]))
        cov = cov - K @ H @ cov
        c, s = np.cos(state[3]), np.sin(state[3])
        step = expm(np.array([[0, -xi[2], xi[0]], [xi[2], 0, xi[1]], [0, 0, 0]]))
        pose = step @ np.array([[c, -s, state[0]], [s, c, state[1]], [0, 0, 1]])
        state = np.array([pose[0, 2], pose[1, 2], state[2], state[3] + xi[2]])
        back = np.linalg.inv(coordinates(state))
        assert np.allclose(track.x[0, t, 0, :2], state[:2], atol=1e-6)
        assert np.allclose(track.covariance[0, t, 0, :2, :2], (back @ cov @ back.T)[:2, :2], atol=1e-6)  # type: ignore[index]


@pytest.mark.slow
def test_no_kernel_of_poses_reads_beyond_its_arrays(tmp_path: Path) -> None:
    """numba's bounds checks, over members that come and go, in a process of its own."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, "-k", "dense_oracle"]
    env = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(words, capture_output=True, text=True, env=env, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stdout[-2000:]
