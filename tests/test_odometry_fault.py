"""Odometry that fails for good, and what only looks like it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import slow_fixes
from filterpy.kalman import KalmanFilter
from numpy import arange, array, eye, sqrt, square, where
from numpy.testing import assert_allclose

import coopoc as co
from coopoc import V2X, CooperativeFilter, JointFilter, Kalman, NoiseModel, observe
from coopoc.arrays import Floats
from coopoc.kernels.odometry_fault import MAX_Q, NOISIER, PACES, UNKNOWN
from coopoc.methods.odometry_fault import with_odometry
from coopoc.world.body_frames import turned
from coopoc.world.recording import NOTHING_SIMULATED

S2, EGOS, STEPS, BEGINS = co.Sensors.paper_scenario2(), [3, 8], 600, 200
FAULTS: dict[str, Callable[[Floats], Floats]] = {
    "wheels stand": lambda u: 0.0 * u,
    "wheels spin": lambda u: 2.0 * u,
    "a unit is wrong": lambda u: u / 3.6,
    "a speed freezes": lambda u: u[:, :1] + 0.0 * u,
    "a compass turns": lambda u: turned(u, np.full(u.shape[:-1], 1.0)),
}
LOOK_ALIKE: dict[str, Callable[[Floats], Floats]] = {
    "a receiver jumps": lambda z: z + array([30.0, 0.0, 0.0]),
    "it is displaced at times": lambda z: z + 60.0 * (arange(z.shape[1]) % 100 < 30)[:, None, None],
    "it leaps at times": lambda z: (
        z + 20.0 * np.random.default_rng(0).normal(size=z.shape) * (arange(z.shape[1]) % 100 < 20)[:, None, None]
    ),
    "it holds its fix": lambda z: where(arange(z.shape[1])[:, None, None] < 100, z[:, :1], z),
}


def drive(every, std, most=0, act=1.0):
    """A minute in town with a fix at every so many steps, and the truth."""
    town = co.load_fleet("town10").between(0, STEPS)
    stated = replace(S2, gnss_std=(std,) * 3)
    seen = observe(town, replace(stated, gnss_std=(act * std,) * 3), V2X(most), runs=2, observers=EGOS, assumed=stated)
    return slow_fixes(seen, every), town.position[:, EGOS]


@pytest.mark.parametrize("begins", [0, BEGINS])
@pytest.mark.parametrize(("every", "std"), [(10, 1.5), (2, 1.5), (1, 3.5)])
@pytest.mark.parametrize("fault", FAULTS)
def test_odometry_that_fails_for_good_costs_no_more_than_doing_without(fault, every, std, begins):
    """The last 30 s, beside raw fixes, which are held: where errors grew to 80 m and more."""
    seen, truth = drive(every, std)
    velocity = seen.velocity.copy()
    velocity[:, begins:, EGOS] = FAULTS[fault](velocity[:, begins:, EGOS])
    broken = replace(seen, velocity=velocity)

    def late(method):
        track = method(broken, EGOS)
        return float(sqrt(square(track.x - truth)[:, 300:].sum(-1).mean())), track

    raw = late(co.GNSS())[0]
    for method in (Kalman(), JointFilter(), CooperativeFilter()):
        error, track = late(method)
        assert error < 1.1 * raw
        assert sum("fails, or its fixes drift" in note for note in track.notes) == len(EGOS)


def test_a_neighbour_whose_wheels_spin_costs_the_joint_filter_little():
    """Healthy egos erred by 1.18 m, not 0.58: their filters now know the variance of a corrected neighbour, too."""
    seen, truth = drive(10, 1.5, most=3)
    velocity = seen.velocity.copy()
    velocity[:, BEGINS:, np.setdiff1d(arange(len(seen.ids)), EGOS)[::2]] *= 2.0
    errors = [
        sqrt(square(JointFilter()(one, EGOS).x - truth).sum(-1).mean())
        for one in (seen, replace(seen, velocity=velocity))
    ]
    assert errors[1] < 1.5 * errors[0]


@pytest.mark.parametrize("beside", [0, 1])
@pytest.mark.parametrize(
    ("fault", "every"), [("current", 1), ("current", 5), ("current", 30), ("noisy", 1), ("stands", 5), ("slips", 1)]
)
def test_odometry_that_errs_a_little(fault, every, beside):
    """The second half of half an hour. Ships in a current of a ninth of their speed: Kalman and joint filter were 46,
    97 and 205 m off, the cooperative 19, 39 and 147, with fixes of 30 m 470, as receivers might wander by 900; if their
    odometry then stands still, it is 143 where the slow pace is preferred. Mowers that slip for 10 s a minute: it
    was 30 m off."""
    t, ships = arange(1800.0), fault != "slips"
    course = 0.9 * np.sin(0.008 * t) if ships else np.pi * np.cumsum((t % 29 > 25) / 3.0)
    u = where(ships, 7.0, 0.8) * np.stack([np.cos(course), np.sin(course), 0.0 * t], axis=-1)[:, None]
    wrong = array([-0.6, -0.5, 0.0]) if ships else u * (t % 60 < 10)[:, None, None]
    velocity = np.broadcast_to(u - wrong * ships, (1800, 2, 3))
    wrong = where((t[:, None, None] > 900) & (fault == "stands"), -velocity, wrong)
    fleet = co.Fleet(("a", "b"), t, velocity.cumsum(0) + array([[0.0] * 3, [0.0, 40.0, 0.0]]), velocity)
    std, floor, ranges = (30.0 if fault == "noisy" else 3.0, 0.05, 5.0) if ships else (0.5, 0.05, 0.1)
    sensors = co.Sensors(gnss_std=(std,) * 3, velocity_std_ratio=0.0, velocity_floor=floor, range_std=ranges)
    seen = slow_fixes(observe(fleet, sensors, V2X(beside, radius=100.0), runs=4), every)
    relative = where([True, False, False], seen.relative, np.nan)
    log = replace(seen, velocity=seen.velocity + wrong, relative=relative, notes=(NOTHING_SIMULATED,))
    kalman, joint, mine = (
        sqrt(square(m(log, (0, 1)).x - fleet.position)[:, 900:, :, :2].sum(-1).mean())
        for m in (Kalman(), JointFilter(), CooperativeFilter())
    )
    most = 10.0 if fault == "stands" else 2.0
    assert (max(kalman, joint, mine) < most * std) if ships else (mine < 1.1 * kalman)


@pytest.mark.parametrize("act", [1.0, 3.0])
@pytest.mark.parametrize("alike", [None, *LOOK_ALIKE])
def test_a_receiver_that_errs_is_no_fault_of_odometry(alike, act):
    """Right odometry is left as it is, whatever fixes do, and if they err three times as far as is stated."""
    seen, _ = drive(2, 1.5, most=3, act=act)
    gnss = seen.gnss.copy()
    if alike:
        gnss[:, BEGINS:] = LOOK_ALIKE[alike](gnss[:, BEGINS:])
    seen, known = replace(seen, gnss=gnss), NoiseModel.nominal(seen.sensors)
    assert with_odometry(seen, EGOS, known)[1] is known


@pytest.mark.parametrize(("turn", "most"), [(0.0, 0.7), (0.3, 3.0)])
def test_fixes_weigh_by_their_own_deviations(turn, most):
    """Of 1.5 and 15 m, by chance: right odometry was "corrected", 1.1 m; turned by 0.3 rad it led 12 m away."""
    seen, truth = drive(1, 1.5)
    factor = np.ones(seen.gnss.shape[1:3])
    factor[:, EGOS] = 10.0 ** np.random.default_rng(4).integers(2, size=(STEPS, 2))
    gnss, velocity = seen.gnss.copy(), seen.velocity.copy()
    gnss[:, :, EGOS] += (factor[:, EGOS, None] - 1.0) * (gnss[:, :, EGOS] - truth)
    velocity[:, BEGINS:] = turned(velocity[:, BEGINS:], np.full(velocity[:, BEGINS:].shape[:-1], turn))
    track = Kalman()(replace(seen, gnss=gnss, velocity=velocity, fix_factor=factor), EGOS)
    assert sqrt(square(track.x - truth)[:, 300:].sum(-1).mean()) < most


def test_the_correction_is_the_velocity_of_filterpys_filter():
    """Position and error of the velocity, a random walk, from a fix a second, whose noise is as loud as they show."""
    seen, _ = drive(10, 3.5)
    velocity = seen.velocity.copy()
    velocity[:, BEGINS:] = turned(velocity[:, BEGINS:], np.full(velocity[:, BEGINS:].shape[:-1], 0.5))
    broken, known = replace(seen, velocity=velocity), NoiseModel.nominal(seen.sensors)
    corrected, noise = with_odometry(broken, EGOS, known)
    by = (corrected.velocity - velocity)[0, :, EGOS[0], :2]
    peer, level, u = KalmanFilter(dim_x=4, dim_z=2), UNKNOWN, velocity[0, :, EGOS[0], :2]
    peer.x, peer.P = array([*seen.gnss[0, 0, EGOS[0], :2], 0.0, 0.0]), np.diag([12.25, 12.25, 1.0, 1.0])
    peer.H, found = eye(2, 4), []
    for k in range(10, STEPS, 10):
        way, r = 0.1 * u[k - 9 : k + 1].sum(0), 12.25 * level
        process = UNKNOWN * (0.1 * S2.velocity_std_ratio) ** 2 * (way**2).sum() * 10
        walk = np.kron(PACES[1][0] * array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), eye(2))
        peer.F, peer.R = eye(4) + eye(4, k=2), r * eye(2)
        peer.predict(Q=walk + np.diag([process, process, 0.0, 0.0]))
        peer.x[:2] += way
        peer.update(seen.gnss[0, k, EGOS[0], :2])
        level = max(level * (1 + NOISIER * (0.5 * min(float(peer.y @ peer.SI @ peer.y), MAX_Q) - 1)), 1.0)
        found.append(peer.x[2:].copy())
    wrong = np.flatnonzero(noise.extra[0, 10:, EGOS[0]]) + 10
    assert len(wrong) > 150
    assert_allclose(by[wrong[10:]], array(found)[(wrong[10:] - 1) // 10 - 1], atol=0.02)
