"""The posterior Cramer-Rao bound against GTSAM's marginals, a closed form, and the filters that it bounds."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy import stats

from coopoc import V2X, Fleet, InputError, JointFilter, Kalman, Sensors, observe
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.evaluate.metrics import rt_le
from coopoc.world.sensing import find_links
from coopoc.world.spherical import spherical, vector_cov

S2 = replace(Sensors.paper_scenario2(), velocity_reading="speed")


def test_solo_bound_tends_to_the_riccati_solution() -> None:
    """Closed form: p = -q/2 + sqrt(q^2/4 + q r) after the update."""
    fleet = Fleet(("a",), np.arange(900) * 0.1, np.zeros((900, 1, 3)), np.full((900, 1, 3), 10 / np.sqrt(3)))
    q, r = (0.1 * 1.5) ** 2, 3.5**2
    assert posterior_bound(fleet, S2, 0)[-1] == pytest.approx(
        (-q / 2 + np.sqrt(q * q / 4 + q * r)) * np.eye(3), rel=1e-6
    )


def gtsam_graph(fleet: Fleet, steps: int, v2x: V2X) -> gtsam.Marginals:
    """Fixes, motions and converted measurements of the star of vehicle 0, all at the truth, as GTSAM factors."""
    links = find_links(fleet, [0], v2x.max_neighbours, v2x.radius, S2.min_range)
    graph, values, before = gtsam.NonlinearFactorGraph(), gtsam.Values(), set()
    for t in range(steps):
        members = {0, *links.neighbour[links.step == t].tolist()}
        for m in members:
            key, here = gtsam.symbol(chr(97 + m), t), fleet.position[t, m]
            values.insert(key, here)
            graph.add(gtsam.PriorFactorPoint3(key, here, gtsam.noiseModel.Diagonal.Sigmas(np.array(S2.gnss_std))))
            if m in before:
                motion = gtsam.noiseModel.Diagonal.Sigmas(0.1 * S2.velocity_std(fleet.velocity[t, m]))
                graph.add(
                    gtsam.BetweenFactorPoint3(
                        gtsam.symbol(chr(97 + m), t - 1), key, here - fleet.position[t - 1, m], motion
                    )
                )
            if m:
                vector = here - fleet.position[t, 0]
                cov = vector_cov(np.array(spherical(*vector)), S2.relative_std)
                graph.add(
                    gtsam.BetweenFactorPoint3(
                        gtsam.symbol("a", t), key, vector, gtsam.noiseModel.Gaussian.Covariance(cov)
                    )
                )
        before = members
    return gtsam.Marginals(graph, values)


@pytest.mark.parametrize("neighbours", [0, 2, 5])
def test_bounds_equal_gtsam_marginals(neighbours: int, crossing: Fleet) -> None:
    """Independent check: a graph up to step t gives the filtering bound at t, the whole graph the smoothing bound."""
    v2x = V2X(max_neighbours=neighbours, radius=30.0)
    filtering, smoothing = (posterior_bound(crossing, S2, 0, v2x, smoothing=s) for s in (False, True))
    for t in (1, 17, 40):
        expected = gtsam_graph(crossing, t + 1, v2x).marginalCovariance(gtsam.symbol("a", t))
        assert filtering[t] == pytest.approx(expected, rel=1e-6, abs=1e-9)
    whole = gtsam_graph(crossing, 60, v2x)
    for t in (0, 13, 59):
        assert smoothing[t] == pytest.approx(whole.marginalCovariance(gtsam.symbol("a", t)), rel=1e-6, abs=1e-9)


def test_more_information_lowers_the_bound(crossing: Fleet) -> None:
    solo, star = (bound_rt_le(posterior_bound(crossing, S2, 0, V2X(max_neighbours=k))) for k in (0, 5))
    smooth = bound_rt_le(posterior_bound(crossing, S2, 0, V2X(max_neighbours=5), smoothing=True))
    assert smooth < star < solo


@pytest.mark.parametrize(
    ("method", "neighbours"), [(Kalman("nominal"), 0), (JointFilter("nominal"), 6)], ids=["solo", "star"]
)
def test_no_filter_beats_the_bound_of_its_own_information(method, neighbours: int, formation: Fleet) -> None:
    """rms RT-LE against the bound beyond its interval (chi-square on the runs), and not far above it."""
    fleet = formation.between(0, 400)
    v2x = V2X(max_neighbours=neighbours)
    recording = observe(fleet, S2, v2x, runs=40, observers=[0], seed=2)
    square = (rt_le(method(recording, [0]), fleet) ** 2).mean(axis=1)
    bound = bound_rt_le(posterior_bound(fleet, S2, 0, v2x)) ** 2
    half = stats.t.ppf(0.995, 39) * square.std(ddof=1) / np.sqrt(40)
    assert square.mean() + half > bound
    assert square.mean() < 1.15 * bound


def test_exact_fixes_have_no_bound(crossing: Fleet) -> None:
    with pytest.raises(InputError, match="relative_std"):
        posterior_bound(crossing, Sensors(range_std=0), 0, V2X(max_neighbours=2))
    with pytest.raises(InputError, match="vehicle"):
        posterior_bound(crossing, S2, -1)
    with pytest.raises(InputError, match="gnss_std"):
        posterior_bound(crossing, Sensors(gnss_std=(0, 1, 1)), 0)
