"""Posterior Cramer-Rao bounds against GTSAM's marginals, closed forms, and the filters that they bound."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from conftest import coming_and_going, half_width, refused, standing
from scipy.linalg import block_diag
from test_pose_methods import convoy

import coopoc as co
from coopoc import V2X, Fleet, JointFilter, Kalman, Sensors, observe
from coopoc.evaluate.bounds import bound_rt_le, fleet_bound, posterior_bound
from coopoc.evaluate.metrics import rt_le
from coopoc.world.body_frames import body_motion, midway, true_heading, turned
from coopoc.world.links import spherical, vector_cov
from coopoc.world.sensing import find_links

S2 = replace(Sensors.paper_scenario2(), velocity_reading="speed")
NOISE = co.Sensors(
    gnss_std=(0.3, 0.3, 0.3),
    velocity_reading="speed",
    velocity_std_ratio=0.05,
    heading_std=0.03,
    yaw_rate_std=0.02,
    range_std=0.1,
    azimuth_std=0.01,
    inclination_std=0.01,
)
UNSEEN = 1e3
"""m and rad."""
NEAR = co.V2X(max_neighbours=2, radius=60.0)


def test_solo_bound_tends_to_the_riccati_solution():
    """Closed form: p = -q/2 + sqrt(q^2/4 + q r) after the update."""
    fleet = Fleet(("a",), np.arange(900) * 0.1, np.zeros((900, 1, 3)), np.full((900, 1, 3), 10 / np.sqrt(3)))
    q, r = (0.1 * 1.5) ** 2, 3.5**2
    assert posterior_bound(fleet, S2, 0)[-1] == pytest.approx(
        (-q / 2 + np.sqrt(q * q / 4 + q * r)) * np.eye(3), rel=1e-6
    )


@pytest.mark.parametrize("z", [0.0, 9.0])
def test_two_vehicles_are_at_best_one_with_two_fixes(z):
    """At one place, and one straight above the other, where an azimuth has no direction."""
    bound = posterior_bound(standing([[0, 0, 0], [0, 0, z]]), replace(S2, min_range=0.0), 0, V2X(1))[0]
    assert (np.diag(bound) > 0.499 * 3.5**2).all()


def node(vehicle, step):
    return int(gtsam.symbol(chr(97 + vehicle), step))


def point_marginals(fleet, steps, v2x, observers, seen=None):
    """Fixes, motions and converted measurements of observers and those they measure, at the truth, as GTSAM factors.

    What a recording lacks in its first run has no factor, or, of one component, a standard deviation of UNSEEN.
    """
    links = find_links(fleet, observers, v2x, S2.min_range)
    graph, values, before = gtsam.NonlinearFactorGraph(), gtsam.Values(), set()
    for t in range(steps):
        mine = np.flatnonzero(links.step == t)
        members = {*np.flatnonzero(fleet.present[t]).tolist()} & {*observers, *links.neighbour[mine].tolist()}
        for m in members:
            key, here = node(m, t), fleet.position[t, m]
            values.insert(key, here)
            if seen is None or np.isfinite(seen.gnss[0, t, m, 0]):
                graph.add(gtsam.PriorFactorPoint3(key, here, sigmas(*S2.gnss_std)))
            if m in before:
                gap, motion = here - fleet.position[t - 1, m], 0.1 * S2.velocity_std(fleet.velocity[t, m])
                graph.add(gtsam.BetweenFactorPoint3(node(m, t - 1), key, gap, sigmas(*motion)))
        for link, i, j in zip(mine, links.observer[mine], links.neighbour[mine], strict=True):
            vector = fleet.position[t, j] - fleet.position[t, i]
            std = (
                S2.relative_std if seen is None else np.where(np.isnan(seen.relative[0, link]), UNSEEN, S2.relative_std)
            )
            noise = gtsam.noiseModel.Gaussian.Covariance(vector_cov(np.array(spherical(*vector)), std))
            ends = node(i, t), node(j, t)
            graph.add(gtsam.BetweenFactorPoint3(*ends, vector, noise))
        before = members
    return gtsam.Marginals(graph, values)


@pytest.mark.parametrize(("neighbours", "everyone"), [(0, False), (5, False), (3, True)])
def test_bounds_equal_gtsam_marginals(neighbours, everyone, crossing):
    """A graph up to step t gives the filtering bound at t, the whole graph the smoothing bound."""
    v2x, ego = V2X(max_neighbours=neighbours, radius=30.0), 7 if everyone else 0
    fleet = coming_and_going(crossing).between(15, 45) if everyone else crossing
    who = range(8) if everyone else [0]
    if everyone:
        filtering, smoothing = (fleet_bound(fleet, S2, v2x, smoothing=s)[:, ego] for s in (False, True))
    else:
        filtering, smoothing = (posterior_bound(fleet, S2, ego, v2x, smoothing=s) for s in (False, True))
    for t in (1, 17, 27):
        expected = point_marginals(fleet, t + 1, v2x, who).marginalCovariance(node(ego, t))
        assert filtering[t] == pytest.approx(expected, rel=1e-6, abs=1e-9)
    whole = point_marginals(fleet, len(fleet.t), v2x, who)
    for t in (0, 13, 29):
        expected = whole.marginalCovariance(node(ego, t))
        assert smoothing[t] == pytest.approx(expected, rel=1e-6, abs=1e-9)


WRONG = co.Outliers(
    ranges=co.Fault(0.2, (3.0, 20.0)),
    angles=co.Fault(0.2),
    fixes=co.Fault(0.3, (10.0, 50.0), lasts=1.0),
    outages=co.Fault(0.2, lasts=1.0),
)


@pytest.mark.parametrize(("neighbours", "everyone"), [(0, False), (4, False), (3, True)])
def test_an_estimator_that_is_told_what_is_wrong_has_gtsams_bound_without_it(neighbours, everyone, crossing):
    """What is wrong is not in the recording (test_outliers), and has no factor in GTSAM's graph."""
    v2x, who = V2X(max_neighbours=neighbours, radius=30.0), range(8) if everyone else [0]
    clean, told = (
        observe(crossing, replace(S2, outliers=o), v2x, runs=2, observers=list(who), remove_outliers=True)
        for o in (co.Outliers(), WRONG)
    )

    def bound(seen, smoothing=False):
        if everyone:
            return fleet_bound(crossing, S2, v2x, smoothing=smoothing, recording=seen)[:, 0]
        return posterior_bound(crossing, S2, 0, v2x, smoothing=smoothing, recording=seen)

    one, smooth = (bound(told.of_runs(slice(0, 1)), smoothing) for smoothing in (False, True))
    for t in (3, 17, 41):
        for found, end in ((one, t + 1), (smooth, len(crossing.t))):
            expected = point_marginals(crossing, end, v2x, who, told).marginalCovariance(node(0, t))
            assert found[t] == pytest.approx(expected, rel=1e-3, abs=1e-6)
    mean = (one + bound(told.of_runs(slice(1, 2)))) / 2
    assert bound(told) == pytest.approx(mean, rel=1e-12)
    assert bound_rt_le(mean) > 1.1 * bound_rt_le(bound(clean))


def test_a_recording_of_something_else_is_refused(crossing):
    v2x = V2X(max_neighbours=4)
    for other in (observe(crossing.between(0, 9), S2, v2x), observe(crossing, S2, V2X(max_neighbours=1))):
        with refused("record"):
            posterior_bound(crossing, S2, 0, v2x, recording=other)


@pytest.mark.parametrize("what", ["gnss_std", "range_std", "azimuth_std", "velocity_std_ratio"])
def test_more_noise_is_never_more_information(what, crossing):
    more = replace(S2, **{what: np.multiply(getattr(S2, what), 1.5).tolist()})
    small, large = (posterior_bound(crossing, noise, 0, V2X(3, 60.0)) for noise in (S2, more))
    assert np.linalg.eigvalsh(large - small).min() > -1e-9
    assert bound_rt_le(large) > bound_rt_le(small)


@pytest.mark.parametrize(("method", "neighbours"), [(Kalman(), 0), (JointFilter(), 6)], ids=["solo", "star"])
def test_no_filter_beats_the_bound_of_its_own_information(method, neighbours, formation):
    """rms RT-LE against the bound beyond its interval (chi-square on the runs), and not far above it."""
    fleet = formation.between(0, 400)
    v2x = V2X(max_neighbours=neighbours)
    square = (rt_le(method(observe(fleet, S2, v2x, runs=40, observers=[0], seed=2), [0]), fleet) ** 2).mean(1)
    least = bound_rt_le(posterior_bound(fleet, S2, 0, v2x)) ** 2
    assert least - half_width(square) < square.mean() < 1.15 * least


def test_exact_fixes_have_no_bound(crossing):
    with refused("relative_std"):
        posterior_bound(crossing, Sensors(range_std=0), 0, V2X(max_neighbours=2))
    with refused("vehicle"):
        posterior_bound(crossing, S2, -1)
    with refused("gnss_std"):
        posterior_bound(crossing, Sensors(gnss_std=(0, 1, 1)), 0)


def sigmas(*std):
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(std))


def pose_marginals(fleet, steps, sensors):
    """Fixes, compasses, odometry, bearings and ranges in the plane at the truth, as GTSAM's own factors."""
    marks = [k for k, name in enumerate(fleet.ids) if name[0] == "m"]
    links = find_links(fleet, range(len(fleet.ids)), NEAR, sensors.min_range, marks)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    heading, (u, _) = true_heading(fleet), body_motion(fleet)
    middle, dt, before = midway(heading), fleet.dt, {}
    for m in marks:
        values.insert(gtsam.symbol("m", m), fleet.position[0, m, :2])
        graph.add(gtsam.NonlinearEqualityPoint2(gtsam.symbol("m", m), fleet.position[0, m, :2]))
    for t in range(steps):
        mine = np.flatnonzero(links.step == t)
        now = {
            k: gtsam.Pose2(*fleet.position[t, k, :2], heading[t, k]) for k in range(len(fleet.ids)) if k not in marks
        }
        for k, pose in now.items():
            key = node(k, t)
            values.insert(key, pose)
            graph.add(gtsam.PoseTranslationPrior2D(key, pose, sigmas(*sensors.gnss_std[:2])))
            if sensors.compass:
                graph.add(gtsam.PoseRotationPrior2D(key, pose, sigmas(sensors.heading_std)))
            if k in before:
                moved, std = dt * turned(u[t, k], middle[t, k]), sensors.velocity_std(u[t, k])[:2]
                c, s = np.cos(middle[t, k]), np.sin(middle[t, k])
                effect = dt * np.array([[c, -s, -moved[1] / 2], [s, c, moved[0] / 2], [0, 0, 1]])
                cov = effect @ np.diag(np.square([*std, sensors.yaw_rate_std])) @ effect.T
                world = block_diag(pose.rotation().matrix(), 1.0)
                noise = gtsam.noiseModel.Gaussian.Covariance(world.T @ cov @ world)
                graph.add(gtsam.BetweenFactorPose2(node(k, t - 1), key, before[k].between(pose), noise))
            else:  # a new member's heading lies within a turn
                graph.add(gtsam.PoseRotationPrior2D(key, pose, sigmas(np.pi / 3**0.5)))
        for i, j in zip(links.observer[mine], links.neighbour[mine], strict=True):
            vector, own = fleet.position[t, j] - fleet.position[t, i], node(i, t)
            range_, azimuth, _ = spherical(*vector)
            seen = gtsam.Rot2(azimuth - heading[t, i]), range_, sigmas(sensors.azimuth_std, sensors.range_std)
            if j in marks:
                graph.add(gtsam.BearingRangeFactor2D(own, gtsam.symbol("m", j), *seen))
            else:
                graph.add(gtsam.BearingRangeFactorPose2(own, node(j, t), *seen))
        before = now
    return gtsam.Marginals(graph, values)


@pytest.mark.parametrize("compass", [True, False])
@pytest.mark.parametrize("masts", [0, 1])
def test_pose_bounds_equal_gtsam_marginals(masts, compass):
    """A graph up to step t gives the filtering bound at t; GTSAM's covariance is of a step in the body."""
    fleet, sensors = convoy(4, 16, masts), replace(NOISE, compass=compass)
    flat = co.Fleet(fleet.ids, fleet.t, fleet.position * [1, 1, 0], fleet.velocity)
    found = co.pose_bound(flat, sensors, NEAR, landmarks=[name for name in fleet.ids if name[0] == "m"])[:, 0]
    for t in (0, 5, 15):
        marginal = pose_marginals(flat, t + 1, sensors).marginalCovariance(node(0, t))
        world = block_diag(gtsam.Rot2(true_heading(flat)[t, 0]).matrix(), 1.0)
        assert found[t][np.ix_([0, 1, 3], [0, 1, 3])] == pytest.approx(world @ marginal @ world.T, rel=1e-6, abs=1e-9)


def test_a_compass_and_a_gyro_alone_are_a_scalar_filter():
    """Closed form at rest: p = -q/2 + sqrt(q^2/4 + q r); a bias of the compass adds its variance."""
    fleet = standing([[0, 0, 0]], 2000)
    sensors = co.Sensors(heading_std=0.1, yaw_rate_std=0.02)
    q, r = (0.1 * 0.02) ** 2, 0.1**2
    level = -q / 2 + np.sqrt(q * q / 4 + q * r)
    assert co.pose_bound(fleet, sensors)[-1, 0, 3, 3] == pytest.approx(level, rel=1e-6)
    biased = co.pose_bound(fleet, replace(sensors, heading_bias_std=0.05))[:, 0]
    assert biased.shape == (2000, 5, 5)
    assert biased[-1, 3, 3] == pytest.approx(level + 0.05**2, rel=0.02)


CASES = [
    (co.PoseFilter("solo"), 0, 0),
    (co.PoseFilter("solo", lasting=True), 0, 3),
    (co.PoseFilter("fleet"), 2, 3),
    (co.PoseFilter("fleet", fusion="naive"), 2, 0),
    (co.PoseFilter("fleet", fusion="intersection"), 2, 0),
]


@pytest.mark.parametrize(("method", "k", "masts"), CASES, ids=lambda value: getattr(value, "name", value))
def test_no_pose_filter_beats_its_bound_and_the_optimum_reaches_it(method, k, masts):
    """Monte Carlo at small noise: mean squares of position and heading over 120 runs, t intervals of the runs."""
    fleet = convoy(4, 120, masts)
    lasting = (
        {"speed_scale_std": 0.02, "yaw_rate_bias_std": 0.02, "odometry_error_time": 20.0} if method.lasting else {}
    )
    sensors, v2x = replace(NOISE, **lasting), co.V2X(max_neighbours=k, radius=60.0)
    marks = [name for name in fleet.ids if name[0] == "m"]
    track = method(co.observe(fleet, sensors, v2x, runs=120, seed=3, frame="body", landmarks=marks), [0])
    bound = co.pose_bound(fleet, sensors, v2x, landmarks=marks)[:, 0]
    position = np.square(track.x - fleet.position[:, :1]).sum(-1)[:, 10:, 0].mean(1)
    heading = np.square(co.heading_error(track, fleet))[:, 10:, 0].mean(1)
    for square, least in (
        (position, np.trace(bound[10:, :3, :3], axis1=1, axis2=2).mean()),
        (heading, bound[10:, 3, 3].mean()),
    ):
        half = half_width(square)
        assert square.mean() + half > least
        if method.fusion == "joint":
            assert square.mean() - half < 1.02 * least


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda f: co.pose_bound(f, replace(NOISE, heading_std=0.0)), "heading_std"),
        (lambda f: co.pose_bound(f, replace(NOISE, gnss_drift_std=1.0)), "gnss_drift_std"),
        (lambda f: co.pose_bound(f, replace(NOISE, range_std=0.0), landmarks=["m0"]), "relative_std"),
        (lambda f: co.pose_bound(f, NOISE, landmarks=["m9"]), "landmarks"),
    ],
)
def test_mistakes_are_named(make, words):
    with refused(words):
        make(convoy(2, 5, 1))
