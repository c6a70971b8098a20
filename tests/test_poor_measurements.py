"""Poor measurements: fixes that are missing or late, ranges without directions, headings that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import holed
from numpy import nan, stack
from numpy.testing import assert_array_equal

from coopoc import (
    LKFSA,
    MSMV,
    V2X,
    CovarianceIntersection,
    Fleet,
    JointFilter,
    Kalman,
    Sensors,
    nees,
    observe,
    rt_le,
)
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.learned import GainNet, LearnedGain
from coopoc.methods.cooperative_filter import AS_STATED, CooperativeFilter
from coopoc.methods.noise_model import NoiseModel
from coopoc.world.links import wrap

SOLO = (Kalman(), LearnedGain(GainNet(4, 1)))
STARS = (
    JointFilter(),
    JointFilter(exact=False),
    LKFSA("nominal"),
    CooperativeFilter(priors=AS_STATED),
    MSMV("nominal"),
    CovarianceIntersection(split=True),
)


@pytest.mark.parametrize("method", [*SOLO, *STARS], ids=lambda m: f"{m.name}{getattr(m, 'exact', '')}")
def test_missing_fixes_cost_and_do_not_crash(crossing, method):  # type: ignore[no-untyped-def]
    whole = observe(crossing, Sensors(gnss_std=(4, 4, 4)), V2X(4, 80.0), runs=6)
    some, few = (rt_le(method(holed(whole, share), [0, 3]), crossing).mean() for share in (0.0, 0.7))
    assert np.isfinite(few)
    assert few < 4 * np.sqrt(3)
    assert method.name in ("fedkalmannet", "lkf-sa") or few > some


def test_a_drive_starts_with_a_fix(crossing):
    seen = observe(crossing, Sensors(), V2X(0))
    gnss = seen.gnss.copy()
    gnss[:, 0] = nan
    absent = Kalman()(replace(seen, gnss=gnss), [0]).absent
    assert absent is not None
    assert np.flatnonzero(absent).tolist() == [0]


RUNS = 10


def ranged():
    """Three cars that range each other at every step; those beside the ego have their first fix a step later."""
    t = 0.5 * np.arange(200)
    ego = stack([8 * t, 3 * np.sin(0.05 * t), 0 * t], -1)
    around = stack([25 * np.cos(0.03 * t), 4 + 20 * np.sin(0.03 * t), 0 * t], axis=-1)
    x = stack([ego, ego + around, stack([8 * t - 15, 0 * t - 12, 0 * t], -1)], 1)
    velocity = np.diff(x, axis=0, prepend=x[:1]) / 0.5
    velocity[0] = velocity[1]
    fleet = Fleet(("ego", "around", "behind"), t, x, velocity)
    noise = Sensors(gnss_std=(2.0, 2.0, 0.01), velocity_std_ratio=0.02, velocity_floor=0.05, range_std=0.5)
    seen = observe(fleet, noise, V2X(max_neighbours=2, radius=200), runs=RUNS)
    relative, gnss = seen.relative.copy(), seen.gnss.copy()
    relative[..., 1:], gnss[:, 0, 1:] = nan, nan
    return fleet, replace(seen, relative=relative, gnss=gnss)


@pytest.mark.parametrize(
    "method",
    [JointFilter(), JointFilter(exact=False), CooperativeFilter(priors=AS_STATED)],
    ids=lambda method: f"{method.name}-{getattr(method, 'exact', '')}",
)
def test_a_range_to_a_neighbour_whose_first_fix_comes_late_does_no_harm(method):
    """Against the Kalman filter alone, and the bound of the same measurements."""
    fleet, seen = ranged()
    bound = bound_rt_le(posterior_bound(fleet, seen.sensors, "ego", seen.v2x, recording=seen))
    track = method(seen, ["ego"])
    assert rt_le(track, fleet).mean() < min(1.1 * bound, 0.9 * rt_le(Kalman()(seen, ["ego"]), fleet).mean())
    assert track.covariance is not None
    assert 2.0 < nees(track, fleet)[:, 10:].mean() < 4.5


NOISE = Sensors(heading_std=0.05)
BIAS = Sensors(heading_bias_std=0.05)


def test_a_heading_turns_all_that_is_seen_at_a_step_alike(crossing):
    """Against the same draws without it: azimuths of one observer and step move by one number, nothing else moves."""
    v2x, plain = V2X(4, 80.0), observe(crossing, Sensors(), V2X(4, 80.0), runs=30)
    for sensors, per_step in ((NOISE, True), (BIAS, False)):
        seen = observe(crossing, sensors, v2x, runs=30)
        assert_array_equal(seen.gnss, plain.gnss)
        assert_array_equal(seen.relative[..., [0, 2]], plain.relative[..., [0, 2]])
        turned, mine = wrap(seen.relative[..., 1] - plain.relative[..., 1]), plain.links.of(2)
        steps = plain.links.step[mine]
        for t in np.unique(steps):
            assert np.ptp(turned[:, mine[steps == t]], axis=1) == pytest.approx(np.zeros(30), abs=1e-9)
        assert (np.ptp(turned[:, mine], axis=1) > 1e-3).all() == per_step
        assert turned.std() == pytest.approx(0.05, rel=0.2)


def test_nominal_knowledge_adds_the_heading_to_the_azimuth():
    known = NoiseModel.nominal(replace(replace(NOISE, heading_bias_std=0.12, azimuth_std=0.0), azimuth_std=1e-12))
    assert known.sensors.azimuth_std == pytest.approx(0.13)
    assert NoiseModel.nominal(Sensors()).sensors == Sensors()
