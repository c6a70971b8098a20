"""Every filter of a star against its dense textbook oracle and filterpy: gaps, absences, losses, delays, any batch."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial as partial_of
from typing import Any

import numpy as np
import pytest
from conftest import holed, slow_fixes, standing, textbook, without
from filterpy.kalman import KalmanFilter
from numpy import diag, nan
from numpy.linalg import eigvalsh, inv
from numpy.testing import assert_allclose
from oracles import covariance_intersection, joint, lkf_sa, messages, msmv
from scipy.linalg import block_diag

from coopoc import (
    LKFSA,
    MSMV,
    V2X,
    CovarianceIntersection,
    JointFilter,
    NoiseModel,
    Sensors,
    load_fleet,
    observe,
    stars,
)
from coopoc.kernels.geometry import angle
from coopoc.kernels.solo import FixNoise
from coopoc.kernels.stars.messages import ESTIMATE_GROWTH
from coopoc.methods.kalman import solo_filter
from coopoc.methods.noise_model import resolve
from coopoc.world.links import spherical, to_vector

S2 = Sensors.paper_scenario2()
CHANNELS = {
    "ideal": V2X(max_neighbours=4),
    "all": V2X(max_neighbours=20),
    "late": V2X(max_neighbours=7, loss=0.3, latency=0.2),
    "silent": V2X(max_neighbours=3, loss=1.0),
    "slow": V2X(max_neighbours=4, rate=2.5, latency=0.2, loss=0.3, max_age=0.6),
    "capped": V2X(max_neighbours=5, bytes_per_second=1000.0),
    "alone": V2X(max_neighbours=0),
}


def partial(recording):
    """Every third measurement a range only, others without inclination."""
    relative = recording.relative.copy()
    draw = np.random.default_rng(6).uniform(size=relative.shape[:2])
    relative[draw < 0.3, 1:] = nan
    relative[draw > 0.8, 2] = nan
    return replace(recording, relative=relative)


def gappy(fleet):
    """Vehicles that appear and vanish."""
    return without(fleet, (slice(20), slice(2, 5)), (slice(40, None), slice(5, 7)))


def known_of(method, recording):
    return resolve(method.noise_model, recording)


def by_joint(method, recording, stars):
    known = known_of(method, recording)
    return joint.follow(stars, partial_of(joint.update, noise_model=known, exact=method.exact and known.exact_relative))


def by_lkf(method, recording, stars):
    return joint.follow(stars, partial_of(lkf_sa.update, noise_model=known_of(method, recording)))


def by_msmv(method, recording, stars):
    return msmv.follow(stars, known_of(method, recording))


def by_ci(method, recording, stars):
    return covariance_intersection.follow(stars, known_of(method, recording), method.split)


ORACLES: list[tuple[Any, Callable[..., Any]]] = [
    (textbook(JointFilter()), by_joint),
    (textbook(JointFilter(exact=False)), by_joint),
    (JointFilter("identity"), by_joint),
    (LKFSA(), by_lkf),
    (LKFSA("nominal"), by_lkf),
    (MSMV("nominal"), by_msmv),
    (MSMV(), by_msmv),
    (textbook(CovarianceIntersection()), by_ci),
    (textbook(CovarianceIntersection(split=True)), by_ci),
]


def label(pair):
    return (
        "-".join(str(v) for v in vars(pair[0]).values() if isinstance(v, str | bool)) if isinstance(pair, tuple) else ""
    )


def assert_is_the_oracle(method, oracle, recording, near=1e-7):
    known, ego = known_of(method, recording), 0
    track, sent = method(recording, [ego]), {}
    if isinstance(method, MSMV | CovarianceIntersection):
        own = solo_filter(recording, range(len(recording.ids)), known, FixNoise(known.gnss_variance))[:2]
        sent = {"sent": own, "growth": ESTIMATE_GROWTH}
    if isinstance(method, MSMV):
        sent |= {"growth": (0.0, 1.0), "acceleration_std": 0.0}
    steps = list(stars(recording, ego, known, method.message, **sent))
    for run in range(recording.runs):
        each = [messages.members(star, run) for star in steps]
        x, cov, *others = oracle(method, recording, each)
        if sent:  # the positions in messages, brought forward
            held = [[np.where(np.isfinite(m.variance), m.position, nan) for m in star[1:]] for star in each]
            others = [[np.reshape(star, (-1, 3)) for star in held]]
        assert_allclose(track.x[run, :, 0], x, atol=near)
        assert_allclose(track.covariance[run, :, 0], cov, atol=near * abs(cov).max())
        if others and len(track.neighbours[run]):
            assert_allclose(track.neighbours[run], np.concatenate(others[0]), atol=1e-5)


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("pair", ORACLES, ids=label)
def test_the_filter_is_its_oracle(crossing, pair, channel):
    """Vehicles join and leave; messages are lost, late, slow and rejected; K = 0 and K > N; one to seven runs."""
    runs = 1 + list(CHANNELS).index(channel)
    assert_is_the_oracle(*pair, observe(gappy(crossing), S2, CHANNELS[channel], runs=runs, observers=[0]))


@pytest.mark.parametrize("damage", [holed, slow_fixes, partial], ids=lambda f: f.__name__)
@pytest.mark.parametrize("pair", ORACLES, ids=label)
def test_it_is_with_missing_fixes_and_measurements(crossing, pair, damage):
    """A missing component is no row of the dense oracle; in the kernel of covariance intersection its deviation of 1e3
    leaves it 1e-8 of the information of others."""
    recording = damage(observe(gappy(crossing), S2, V2X(4, loss=0.2), runs=2, observers=[0]))
    if damage is partial and isinstance(pair[0], MSMV | LKFSA):
        assert np.isfinite(pair[0](recording, [0]).x).all()
        return
    coarse = damage is partial and isinstance(pair[0], CovarianceIntersection)
    assert_is_the_oracle(*pair, recording, 1e-4 if coarse else 1e-6)


NOISES = {
    "fitted": (S2, lambda fleet: NoiseModel("fitted", S2, (0.3, 0.2, 0.01))),
    "still": (S2, lambda fleet: NoiseModel("fitted", S2, (1e-4, 1e-4, 1e-4))),
    "oracle": (S2, lambda fleet: NoiseModel.oracle(S2, fleet)),
    "speed": (replace(S2, velocity_reading="speed", velocity_floor=0.5), lambda fleet: "nominal"),
}


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("pair", [ORACLES[0], ORACLES[5], ORACLES[6], ORACLES[8]], ids=label)
def test_it_is_whatever_the_noise(crossing, pair, noise):
    """Little, constant and true process noise, and noise that grows with the speed."""
    sensors, known = NOISES[noise]
    recording = observe(crossing, sensors, V2X(max_neighbours=4, loss=0.2, latency=0.1), runs=2, observers=[0])
    method = replace(pair[0], noise_model=known(crossing))
    assert_is_the_oracle(method, pair[1], recording, 1e-5 if noise == "still" else 1e-7)


def test_a_state_without_process_noise_stays_finite(crossing):
    known = NoiseModel("fitted", S2, (1e-60, 1e-30, 1e-60))
    still = standing(crossing.position[0], 60)
    recording = observe(still, S2, V2X(max_neighbours=4, loss=0.2), runs=2)
    track = textbook(JointFilter(known))(recording, [1])
    mean = recording.gnss[:, :, 1].mean(1)
    assert np.isfinite(track.x).all()
    assert abs(track.x[:, -1, 0] - still.position[-1, 1]).mean() < abs(mean - still.position[-1, 1]).mean() + 0.5


@pytest.mark.parametrize("laplacian", [False, True])
def test_linear_filters_equal_filterpy(formation, laplacian):
    """The joint filter, and LKF-SA: the stacked star of a formation that never changes, from its first estimate on, in
    which filterpy's own update would lose seven digits to the flat prior."""
    recording = observe(formation.select(range(4)).between(0, 40), S2, V2X(max_neighbours=3), runs=2, observers=[0])
    known = NoiseModel("fitted", S2, process_std=(0.08, 0.07, 0.01), gnss_std=(3.0, 3.5, 4.0))
    track = (LKFSA(known) if laplacian else textbook(JointFilter(known, exact=False)))(recording, [0])
    order, edges = [0, *recording.links.neighbour[:3]], np.hstack([-np.ones((3, 1)), np.eye(3)])
    rows = np.kron(edges.T @ edges if laplacian else edges, np.eye(3))
    peer, n = KalmanFilter(dim_x=12, dim_z=12 + len(rows), dim_u=12), np.eye(12)
    peer.B, peer.H, peer.Q = 0.1 * n, np.vstack([n, rows]), diag(np.square(known.process_std * 4))
    for t, seen in enumerate(recording.relative[1].reshape(40, 3, 3)):
        vectors = to_vector(seen)
        if t:
            peer.predict(u=recording.velocity[1, t, order].ravel())
            ahead = peer.x[3:].reshape(3, 3) - peer.x[:3]
        else:
            ahead = vectors
        cov = known.relative_cov(seen if laplacian else np.array([spherical(*vector) for vector in ahead]))
        cov = [np.trace(cov.mean(0)) / 3 * diag(diag(rows))] if laplacian else cov
        noise = block_diag(diag([*known.gnss_variance] * 4), *cov)
        fixes = recording.gnss[1, t, order].ravel()
        z = np.append(fixes, edges.T @ vectors if laplacian else vectors)
        if t:
            peer.update(z, R=noise)
        else:
            weight, at = peer.H.T @ inv(noise), np.append(fixes[:3], fixes[:3] + vectors)
            peer.P = inv(n / 1e6 + weight @ peer.H)
            peer.x = at + peer.P @ weight @ (z - peer.H @ at)
        assert track.x[1, t, 0] == pytest.approx(peer.x[:3], abs=1e-9)
        assert track.covariance[1, t, 0] == pytest.approx(peer.P[:3, :3], rel=1e-9, abs=1e-12)


def test_the_angle_is_atan2():
    for turn in np.concatenate([np.linspace(-3.14, 3.14, 301), [0.0, 1e-9, -1e-300, 0.2449, -0.245]]):
        assert angle(3 * math.sin(turn), 3 * math.cos(turn)) == pytest.approx(turn, rel=1e-15, abs=0)


def test_a_range_of_almost_nothing_leaves_covariances_positive():
    seen = observe(
        load_fleet("town10").between(0, 100),
        replace(S2, azimuth_std=0.01, inclination_std=0.01),
        V2X(6),
        runs=4,
        observers=[8],
    )
    relative = seen.relative.copy()
    relative[:, ::7, 0] /= 1e5
    assert eigvalsh(JointFilter()(replace(seen, relative=relative), [8]).covariance).min() > 0
