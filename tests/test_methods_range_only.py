"""Ranges without directions, and fixes that come late: a neighbour is used from its first position on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import coopoc as co
from coopoc.methods.drift_filter import DriftFilter

RUNS = 10


def ranged() -> tuple[co.Fleet, co.Recording]:
    """Three cars that range each other at every step; those beside the ego have their first fix a step later."""
    t = 0.5 * np.arange(200)
    ego = np.stack([8 * t, 3 * np.sin(0.05 * t), 0 * t], axis=-1)
    around = np.stack([25 * np.cos(0.03 * t), 4 + 20 * np.sin(0.03 * t), 0 * t], axis=-1)
    behind = np.stack([8 * t - 15, 0 * t - 12, 0 * t], axis=-1)
    x = np.stack([ego, ego + around, behind], axis=1)
    velocity = np.diff(x, axis=0, prepend=x[:1]) / 0.5
    velocity[0] = velocity[1]
    fleet = co.Fleet(("ego", "around", "behind"), t, x, velocity)
    noise = co.Sensors(gnss_std=(2.0, 2.0, 0.01), velocity_std_ratio=0.02, velocity_floor=0.05, range_std=0.5)
    seen = co.observe(fleet, noise, co.V2X(max_neighbours=2, radius=200), runs=RUNS)
    relative, gnss = seen.relative.copy(), seen.gnss.copy()
    relative[..., 1:], gnss[:, 0, 1:] = np.nan, np.nan
    return fleet, replace(seen, relative=relative, gnss=gnss)


@pytest.mark.parametrize(
    "method",
    [
        co.JointFilter(),
        co.JointFilter(exact=False),
        DriftFilter(),
        co.FixedLagSmoother(lag=5),
        co.MovingHorizon(horizon=5),
    ],
    ids=lambda method: f"{method.name}-{getattr(method, 'exact', '')}",
)
def test_a_range_to_a_neighbour_whose_first_fix_comes_late_does_no_harm(method: co.Method) -> None:
    """Against the Kalman filter alone, and the whole-fleet filter, which has the same measurements."""
    fleet, seen = ranged()
    alone, central = (co.rt_le(m(seen, ["ego"]), fleet).mean() for m in (co.Kalman(), co.CentralFilter()))
    track = method(seen, ["ego"])
    assert co.rt_le(track, fleet).mean() < 0.5 * (alone + central)
    assert track.covariance is not None
    band = co.nees(track, fleet)[:, 10:].mean()
    assert 2.0 < band < 4.5
