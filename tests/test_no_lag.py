"""No estimate falls behind because slow readings of a velocity weigh more: process noise follows the pace before."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy import arange
from numpy.testing import assert_allclose
from oracles.pace import heard
from oracles.solo import filterpys

from coopoc import V2X, Fleet, Kalman, NoiseModel, Sensors, observe
from coopoc.methods.catalogue import METHODS
from coopoc.world.inbox import inbox
from coopoc.world.v2x import FIX_AND_VELOCITY

NOISY = Sensors(gnss_std=(3.5,) * 3, velocity_std_ratio=0.15)
SPEED, RUNS = 15.0, 100
MOST, SMOOTHED = 0.11, 0.01
"""m behind, at most, where readings are wrong by 2.3 m a step: the pace of late readings knows what has brought the
estimate forward. A smoother sees the road from both sides."""


@cache
def road(vehicles=3, steps=60):
    """A straight road eastward, in steps of 1 s, and noise that is white and known."""
    t = arange(float(steps))
    x, u = np.zeros((2, steps, vehicles, 3))
    u[..., 0], x[..., 1] = SPEED, 5.0 * arange(vehicles)
    x[..., 0] = SPEED * t[:, None] + 20.0 * arange(vehicles)
    fleet = Fleet(tuple("abcdef"[:vehicles]), t, x, u)
    return fleet, observe(fleet, NOISY, V2X(vehicles), runs=RUNS, seed=1)


@pytest.mark.parametrize("name", sorted(METHODS.keys() - {"gnss"}))
def test_no_method_falls_behind(name):
    """Along the road, within three standard errors of where it is with the true speed, or within MOST. With the
    variance of each reading it was 0.19 m (kalman) to 0.55 m (of the whole fleet)."""
    fleet, seen = road()

    def ahead(method):
        error = method(seen, [0]).x[:, 10:, 0, 0] - fleet.position[10:, 0, 0]
        return np.asarray(error.mean(1))

    models = NoiseModel.nominal(NOISY), NoiseModel.oracle(NOISY, fleet)
    found = np.subtract(*(ahead(METHODS[name](known)) for known in models))
    assert abs(found.mean()) < max(3 * found.std() / np.sqrt(RUNS), SMOOTHED if name == "batch-smoother" else MOST)


@pytest.mark.parametrize("reading", ["axis", "speed"])
@pytest.mark.parametrize("v2x", [V2X(4), V2X(3, loss=0.5, burst=2.0, max_age=0.3), V2X(4, latency=0.3, rate=2.0)])
def test_a_receiver_knows_the_pace_of_what_it_has_received(crossing, v2x, reading):
    """Neighbours come and go; textbook: `oracles.pace`. Where nothing is lost it is the sender's own."""
    seen = observe(crossing, Sensors(velocity_reading=reading), v2x, runs=2, observers=[0])
    box, known = inbox(seen, 0, FIX_AND_VELOCITY), NoiseModel.nominal(seen.sensors)
    found, own = known.process_variance(seen, [0], box), known.process_variance(seen)
    for run in range(2):
        wanted = heard(seen, box, known, run, 0)
        assert_allclose(found[run, :, 0], wanted[:, 0], rtol=1e-12)
        assert_allclose(own[run], heard(seen, None, known, run, 0), rtol=1e-12)
        come = box.arrival[run] >= 0
        step, neighbour = (part[box.link[come]] for part in (seen.links.step, seen.links.neighbour))
        assert len(step)
        assert_allclose(found[run, step, neighbour], wanted[step, neighbour], rtol=1e-12)
    always = observe(road()[0], NOISY, V2X(3, radius=100.0), runs=2)
    known, box = NoiseModel.nominal(NOISY), inbox(always, 0, FIX_AND_VELOCITY)
    assert_allclose(known.process_variance(always, [0], box), known.process_variance(always), rtol=1e-12)


def test_the_pace_of_a_step_does_not_know_its_velocity():
    """A wrong one changes the noise of later steps alone, by no more than twice the pace and 10 m/s^2 allow, and
    a third of that is left a second later."""
    seen, known = road()[1], NoiseModel.nominal(NOISY)
    velocity = seen.velocity.copy()
    velocity[0, 10, 0, 0] = 1e4
    before, after = (known.process_variance(one)[0, :, 0, 0] for one in (seen, replace(seen, velocity=velocity)))
    gained = after - before
    assert not gained[:11].any()
    assert 0 < gained[11] < 3 * before[10] + (0.15 * 10.0) ** 2
    assert_allclose(gained[12:16] / gained[11], 3.0 ** -arange(1, 5), rtol=1e-9)


def test_it_is_filterpys_filter_with_the_noise_of_the_pace():
    seen = road()[1]
    track, q = Kalman(robust=False)(seen, [1]), heard(seen, None, NoiseModel.nominal(NOISY), 7, 1)
    peer = filterpys(seen.gnss[7, 0, 1], 3.5**2 * np.eye(3), 1.0)
    for t in range(1, 60):
        peer.predict(u=seen.velocity[7, t, 1], Q=np.diag(q[t, 1]))
        peer.update(seen.gnss[7, t, 1])
        assert_allclose(track.x[7, t, 0], peer.x, atol=1e-9)
        assert_allclose(track.covariance[7, t, 0], peer.P, atol=1e-9)
