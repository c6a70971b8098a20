"""Laplacian and pseudo-fix filters against filterpy and numpy.linalg; tests/test_oracles_star.py has the oracles."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from coopoc import LKFSA, MSMV, V2X, Fleet, NoiseModel, Sensors, observe
from coopoc.kernels.compiling.vectors import LANES
from coopoc.world.links import to_vector, vector_cov

S2 = Sensors.paper_scenario2()
KNOWN = {
    "identity": "identity",
    "nominal": "nominal",
    "fitted": NoiseModel("fitted", S2, (0.3, 0.2, 0.01)),
    "still": NoiseModel("fitted", S2, (1e-30, 1e-60, 1e-30)),
}
RUNS = LANES + 1
"""One group and a run of the next."""


@pytest.mark.parametrize("noise_model", ["identity", "fitted"])
def test_a_run_does_not_depend_on_those_beside_it(crossing: Fleet, noise_model: str) -> None:
    method, channel = LKFSA(KNOWN[noise_model]), V2X(max_neighbours=4)
    many, few = (method(observe(crossing, S2, channel, runs=runs), [0]) for runs in (RUNS, 3))
    assert np.array_equal(many.x[:3], few.x)


def test_the_laplacian_filter_equals_filterpy(formation: Fleet) -> None:
    """Per axis, over the star of a formation that never changes, from its first estimate on."""
    fleet = formation.select(range(4)).between(0, 40)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    known = NoiseModel("fitted", S2, process_std=(0.08, 0.07, 0.01), gnss_std=(3.0, 3.5, 4.0))
    track = LKFSA(known)(recording, [0])
    assert track.covariance is not None
    order, laplacian = [0, *recording.links.neighbour[:3]], np.diag([3.0, 1.0, 1.0, 1.0])
    laplacian[0, 1:] = laplacian[1:, 0] = -1.0
    seen = recording.relative[1].reshape(40, 3, 3)
    ahead = to_vector(seen)
    variance = np.trace(vector_cov(seen, S2.relative_std, S2.min_range), axis1=-2, axis2=-1).mean(axis=1) / 3
    for c in range(3):
        peer = KalmanFilter(dim_x=4, dim_z=8, dim_u=4)
        peer.B, peer.H = 0.1 * np.eye(4), np.vstack([laplacian, np.eye(4)])
        peer.Q = known.process_std[c] ** 2 * np.eye(4)
        for t in range(40):
            noise = np.diag([*(np.diag(laplacian) * variance[t]), *np.full(4, known.gnss_variance[c])])
            z = np.array([-ahead[t, :, c].sum(), *ahead[t, :, c], *recording.gnss[1, t, order, c]])
            if t:
                peer.predict(u=recording.velocity[1, t, order, c])
                peer.update(z, R=noise)
            else:  # filterpy's own update would lose seven digits to the flat prior
                weight = peer.H.T @ np.linalg.inv(noise)
                peer.P = np.linalg.inv(np.eye(4) / 1e6 + weight @ peer.H)
                first = z[4] + np.array([0.0, *z[1:4]])
                peer.x = first + peer.P @ weight @ (z - peer.H @ first)
            assert track.x[1, t, 0, c] == pytest.approx(peer.x[0], abs=1e-9)
            assert track.covariance[1, t, 0, c, c] == pytest.approx(peer.P[0, 0], rel=1e-9)


def test_pseudo_fixes_are_fused_as_information(formation: Fleet) -> None:
    """The first step in closed form: fix, and each neighbour's fix less the measurement, weighted by their
    covariances."""
    fleet = formation.select(range(4)).between(0, 2)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    track = MSMV("nominal")(recording, [0])
    assert track.covariance is not None
    at = recording.links.of(0)[:3]
    fixes, seen = recording.gnss[1, 0], recording.relative[1, at]
    own = np.diag(np.square(S2.gnss_std))
    weight = np.linalg.inv([own, *(own + vector_cov(seen, S2.relative_std, S2.min_range))])
    positions = np.stack([fixes[0], *(fixes[recording.links.neighbour[at]] - to_vector(seen))])
    cov = np.linalg.inv(np.eye(3) / 1e6 + weight.sum(axis=0))
    x = fixes[0] + cov @ np.einsum("kij,kj->i", weight, positions - fixes[0])
    assert track.x[1, 0, 0] == pytest.approx(x, abs=1e-9)
    assert track.covariance[1, 0, 0] == pytest.approx(cov, rel=1e-9, abs=1e-12)
