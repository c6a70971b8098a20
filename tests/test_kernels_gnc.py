"""Compiled robust windows against SciPy and gtsam; `test_kernels_window` holds them against the dense oracle."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from test_kernels_window import FITTED as KNOWN
from test_kernels_window import S2

from coopoc import V2X, CooperativeMAP, Fleet, Recording, observe
from coopoc.world.links import spherical, to_vector, wrap

FITTED = replace(KNOWN, gnss_std=S2.gnss_std)


def formed(formation: Fleet, **options: float) -> Recording:
    """A star of four, of which one neighbour is spoofed by 20 m and more."""
    fleet = formation.select(range(4)).between(0, 6)
    seen = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    gnss = seen.gnss.copy()
    gnss[:, :, 2] += [20.0, -15.0, 3.0]
    return replace(seen, gnss=gnss)


def test_the_robust_window_is_the_least_squares_solution_of_scipy_without_the_outlier(formation: Fleet) -> None:
    """The last of three steps, the weights being those that the truth gives, and J^T J inverted."""
    recording = formed(formation)
    track = CooperativeMAP(window=3, noise_model=FITTED, robust="truncated", threshold=1 - 1e-9)(recording, [0])
    assert track.covariance is not None
    seen = recording.relative[1].reshape(6, 3, 3)[3:]
    columns = np.array([0, *recording.links.neighbour[:3]])
    fix, moved = recording.gnss[1, 3:, columns], recording.dt * recording.velocity[1, 4:, columns]
    trust = (columns != 2)[:, None, None]

    def residual(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(4, 3, 3)
        motion = (np.diff(x, axis=1) - moved.reshape(4, 2, 3)) / FITTED.process_std
        gap = np.moveaxis(x[1:] - x[:1], 0, 1)
        off = np.stack(spherical(*np.moveaxis(gap, -1, 0)), axis=-1) - seen
        off[..., 1:] = wrap(off[..., 1:])
        wide = np.maximum(S2.min_range / seen[..., :1], 1.0) ** [0, 1, 1]
        std = np.minimum(wide * S2.relative_std, [math.inf, math.pi, math.pi])
        return np.concatenate([(trust * (x - fix) / FITTED.gnss_std).ravel(), motion.ravel(), (off / std).ravel()])

    best = least_squares(residual, np.asarray(fix).ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    assert track.x[1, 5, 0] == pytest.approx(best.x.reshape(4, 3, 3)[0, 2], abs=1e-5)
    inverse = np.linalg.inv(best.jac.T @ best.jac)[6:9, 6:9]
    assert track.covariance[1, 5, 0] == pytest.approx(inverse, abs=1e-4 * inverse.max())


def test_robust_snapshots_are_those_of_gtsam(formation: Fleet) -> None:
    """GncLMOptimizer on unit vectors and fixes, the neighbours' being its outlier candidates: the same points."""
    recording = formed(formation)
    track = CooperativeMAP(noise_model="identity", robust="truncated")(recording, [0])
    unit, columns = gtsam.noiseModel.Unit.Create(3), [0, *recording.links.neighbour[:3]]
    rejected = 0
    for run in range(2):
        for t in range(6):
            graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
            vectors = to_vector(recording.relative[run, 3 * t : 3 * t + 3])
            graph.add(gtsam.PriorFactorPoint3(0, recording.gnss[run, t, 0], unit))
            for k in range(3):
                graph.add(gtsam.BetweenFactorPoint3(0, k + 1, vectors[k], unit))
            for k in range(1, 4):
                graph.add(gtsam.PriorFactorPoint3(k, recording.gnss[run, t, columns[k]], unit))
            for k in range(4):
                start.insert(k, recording.gnss[run, t, columns[k]])
            params = gtsam.GncLMParams()
            params.setKnownInliers(list(range(4)))
            params.setRelativeCostTol(0.0)
            optimiser = gtsam.GncLMOptimizer(graph, start, params)
            theirs = optimiser.optimize()
            points = np.array([theirs.atPoint3(k) for k in range(4)])
            assert track.x[run, t, 0] == pytest.approx(points[0], abs=1e-6)
            assert track.neighbours[run, 3 * t : 3 * t + 3] == pytest.approx(points[1:], abs=1e-6)
            square = np.square(recording.gnss[run, t, columns[1:]] - points[1:]).sum(axis=1)
            assert np.array_equal(optimiser.getWeights()[4:], square <= chi2.ppf(0.99, 3))
            rejected += int((optimiser.getWeights() == 0).sum())
    assert rejected >= 12
