"""Solo filters over whole drives against their textbook oracles, with gaps, absences and known starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import solo as oracle

from coopoc import GNSS, V2X, AdaptiveKalman, Fleet, NoiseModel, Recording, Sensors, observe
from coopoc.kernels.solo import FixNoise
from coopoc.methods.kalman import solo_filter

S2 = Sensors.paper_scenario2()


def gaps(fleet: Fleet, absent: bool, runs: int = 3) -> Recording:
    """Some fixes missing everywhere, and one vehicle that is away for a while."""
    position, velocity = fleet.position.copy(), fleet.velocity.copy()
    if absent:
        position[20:30, 1], velocity[20:30, 1] = np.nan, np.nan
    recording = observe(replace(fleet, position=position, velocity=velocity), S2, V2X(max_neighbours=0), runs=runs)
    gnss, gone = recording.gnss.copy(), np.random.default_rng(2).uniform(size=recording.gnss.shape[:3]) < 0.4
    gone[:, 0] = False
    gone[:, 30] = False
    gnss[gone] = np.nan
    return replace(recording, gnss=gnss)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("noise", ["nominal", "identity"])
def test_kalman(crossing: Fleet, noise: str, known: bool) -> None:
    seen = gaps(crossing, absent=True)
    model = NoiseModel.identity() if noise == "identity" else NoiseModel.nominal(S2)
    q, r = np.broadcast_to(model.process_variance(seen), seen.gnss.shape), model.gnss_variance
    start = crossing.position[0] if known else None
    x, p, _ = solo_filter(seen, range(len(seen.ids)), model, FixNoise(r), start)
    for run, n, c in np.ndindex(3, 4, 3):
        series = (seen.gnss[run, :, n, c], seen.velocity[run, :, n, c], q[run, :, n, c], r[c], seen.dt)
        mean, variance = oracle.kalman(*series, None if start is None else start[n, c])
        np.testing.assert_allclose(x[run, :, n, c], mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(p[run, :, n, c], variance, rtol=1e-10)


@pytest.mark.parametrize("runs", [1, 3])
def test_adaptive(crossing: Fleet, runs: int) -> None:
    seen, method = gaps(crossing, absent=False, runs=runs), AdaptiveKalman(window=20.0)
    model = NoiseModel.nominal(method.assumed)
    q, r = model.process_variance(seen), model.gnss_variance
    track, std = method(seen, [2, 0]), method.gnss_std(seen, [2, 0])
    for run, (e, n), c in ((a, b, c) for a in range(runs) for b in enumerate([2, 0]) for c in range(3)):
        series = (seen.gnss[run, :, n, c], seen.velocity[run, :, n, c], q[run, :, n, c], r[c], seen.dt)
        mean, noise = oracle.adaptive(*series, 5.0, 20.0)
        np.testing.assert_allclose(track.x[run, :, e, c], mean, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(std[run, :, e, c] ** 2, noise, rtol=1e-10)


def test_gnss_holds_the_last_fix(crossing: Fleet) -> None:
    seen = gaps(crossing, absent=False)
    track = GNSS()(seen, [1])
    for t in range(len(seen.t)):
        newest = max(k for k in range(t + 1) if np.isfinite(seen.gnss[0, k, 1]).all())
        np.testing.assert_array_equal(track.x[0, t, 0], seen.gnss[0, newest, 1])
    missing = np.isnan(seen.gnss[:, :, 1, 0]).mean()
    assert track.notes == (f"holds the last fix where there is none: {100 * missing:.0f} % of the steps",)
