"""RecursiveGain: equals filterpy's filter before training, and its covariance is calibrated where the noise is not
given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import winding
from filterpy.kalman import KalmanFilter

from coopoc import V2X, Fleet, Sensors, load_fleet, observe
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.evaluate.metrics import nees_inside, rt_le
from coopoc.learned import Schedule, clients, fit, load_method
from coopoc.learned.nets.recursive import POOL, RecursiveFilter, RecursiveGain, after, first, noise
from coopoc.learned.nets.stack import flatten
from coopoc.learned.training.clients import Batch


def batch(models: int, lanes: int, steps: int, dtype: torch.dtype = torch.float64) -> Batch:
    """Random drives, some of whose fixes are missing and one of which starts at the truth."""
    torch.manual_seed(1)
    velocity = 5 * torch.randn(1, models, lanes, 3, dtype=dtype).expand(steps, -1, -1, -1)
    truth, dice = torch.cumsum(0.1 * velocity, 0), torch.randn(2, steps, models, lanes, 3, dtype=dtype)
    gnss = truth + 2 * dice[0]
    gnss[3:5, 0, 1] = gnss[2, -1, 0, 2] = torch.nan
    known = torch.zeros(models, lanes, dtype=torch.bool)
    known[0, 0] = True
    return Batch(gnss, velocity + dice[1], truth, 2 * dice[0, 0], 0.1, known)


def trained(models: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Weights that are far from the start, where the heads are zero."""
    torch.manual_seed(2)
    theta = flatten([RecursiveGain(5, seed=seed) for seed in range(models)]).to(dtype)
    return theta + 0.3 * torch.randn_like(theta)


def test_untrained_net_is_filterpys_filter() -> None:
    """With the noise that the levels tell: R and Q of each step, and P rescaled as R is learned."""
    recording = observe(winding(), Sensors(gnss_std=(1.0, 2.0, 3.0)), runs=1)
    fixes, speeds = (torch.tensor(a[0, :, 0]) for a in (recording.gnss, recording.velocity))
    levels, track = first(fixes[0]), RecursiveFilter(RecursiveGain())(recording)
    theirs = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
    theirs.x, theirs.H, theirs.B, before = fixes[0].numpy(), np.eye(3), 0.1 * np.eye(3), np.full(3, 2.5**2)
    theirs.P = np.diag(before)
    assert track.covariance is not None
    for t in range(1, 60):
        levels = after(levels, fixes[t], speeds[t], 0.1)
        levels_noise = noise(levels, 0.1)
        r = levels_noise.gnss.numpy()
        theirs.P, theirs.R = theirs.P * (r / before), np.diag(r)
        theirs.predict(u=speeds[t].numpy(), Q=np.diag((levels_noise.ratio * levels_noise.gnss).numpy()))
        theirs.update(fixes[t].numpy())
        before = r
        np.testing.assert_allclose(track.x[0, t, 0], theirs.x, atol=1e-9)
        np.testing.assert_allclose(track.covariance[0, t, 0], theirs.P, atol=1e-9)


def test_loss_is_torchs_gaussian_likelihood() -> None:
    seen, like, theta = batch(1, 2, 9), RecursiveGain(5), trained(1)
    x, variance = like.rollout(theta, seen)
    theirs = torch.nn.functional.gaussian_nll_loss(x, seen.truth, variance, reduction="none").sum(-1).mean(0)
    torch.testing.assert_close(like.losses(theta, seen), theirs)


def test_levels_hold_the_noise() -> None:
    """1 m, 2 m and 4 m, drawn a little towards their mean square, and 15 % of a velocity that turns."""
    recording = observe(winding(300), Sensors(gnss_std=(1.0, 2.0, 4.0), velocity_std_ratio=0.15), runs=60)
    fixes, speeds = (torch.tensor(a[:, :, 0]) for a in (recording.gnss, recording.velocity))
    levels, shares = first(fixes[:, 0]), []
    for t in range(1, 300):
        levels = after(levels, fixes[:, t], speeds[:, t], 0.1)
        shares.append(levels.turns / levels.squares)
    count = float(levels.fixes[0, 0])
    weight = POOL**2 / (POOL + count)
    shrunk = (count * np.array([1.0, 4.0, 16.0]) + weight * 7.0) / (count + weight)
    np.testing.assert_allclose(noise(levels, 0.1).gnss.mean(0), shrunk, rtol=0.06)
    np.testing.assert_allclose(torch.stack(shares[50:])[..., :2].mean().sqrt(), 0.15, rtol=0.1)


def test_axes_and_signs_are_all_alike() -> None:
    seen, like, theta = batch(1, 3, 12), RecursiveGain(5), trained(1)
    turned = Batch(*(-a[..., [2, 0, 1]] for a in seen[:4]), seen.dt, seen.exact)
    for ours, theirs, sign in zip(like.rollout(theta, seen), like.rollout(theta, turned), (-1, 1), strict=True):
        torch.testing.assert_close(sign * ours[..., [2, 0, 1]], theirs)


def test_missing_fixes_only_predict() -> None:
    recording = observe(winding(40), Sensors(), runs=2)
    gnss = recording.gnss.copy()
    gnss[1, 20:] = np.nan
    track = load_method("recursive")(replace(recording, gnss=gnss))
    driven = 0.1 * recording.velocity[1, 20:, 0].cumsum(axis=0)
    np.testing.assert_allclose(track.x[1, 20:, 0], track.x[1, 19, 0] + driven, atol=1e-9)
    assert track.covariance is not None
    claimed = np.trace(track.covariance[:, :, 0], axis1=-2, axis2=-1)
    assert claimed[1, -1] > 1.3 * claimed[1, 19]
    assert claimed[0, -1] < claimed[0, 19]


def test_stream_is_the_method() -> None:
    recording = observe(winding(), Sensors(), runs=1)
    method = load_method("recursive")
    track, stream = method(recording), method.start()
    assert track.covariance is not None
    stream.step(recording.gnss[0, 0, 0], np.zeros(3), dt=0.1)
    for t in range(1, 60):
        x, covariance = stream.step(recording.gnss[0, t, 0], recording.velocity[0, t, 0], dt=0.1)
        np.testing.assert_allclose(x, track.x[0, t, 0], atol=1e-9)
        np.testing.assert_allclose(covariance, track.covariance[0, t, 0], rtol=1e-9)


def test_a_known_start_is_exact_and_a_late_fix_counts_less() -> None:
    recording = observe(winding(), Sensors(), runs=2)
    truth = winding().position[0]
    track = RecursiveFilter(RecursiveGain(), x0=truth)(recording)
    assert track.covariance is not None
    np.testing.assert_array_equal(track.x[:, 0, 0], np.broadcast_to(truth[0], (2, 3)))
    assert (track.covariance[:, 0] == 0).all()
    moves = []
    for age in (0.0, 1.0):
        stream = RecursiveFilter(RecursiveGain()).start(np.zeros(3))
        for _ in range(20):
            stream.step(None, [9.0, 1.0, 0.0], dt=0.1)
        x, _ = stream.step([30.0, 30.0, 0.0], [9.0, 1.0, 0.0], dt=0.1, fix_age=age)
        moves.append(x[1] / (30.0 + 0.1 * 10 * age))
    assert moves[1] < moves[0]


def test_training_learns_what_the_levels_do_not_know() -> None:
    """Fixes whose errors last for a second look better than they are; the claimed variance learns to be larger."""
    rng, t = np.random.default_rng(0), np.arange(1300) / 10
    velocity = np.stack([8 * np.cos(t / 9), 8 * np.sin(t / 9), 0 * t], axis=-1)[:, None]
    fleet = Fleet(("a",), t, np.cumsum(0.1 * velocity, axis=0), velocity)
    (only,) = clients(fleet, piece=60)
    slow = np.repeat(rng.normal(0, 2, (len(only.training), 7, 3)), 10, axis=1)[:, :61]
    pieces = replace(only.training, gnss=only.training.gnss + torch.tensor(slow, dtype=torch.float32))
    found = fit(RecursiveGain(), pieces, pieces, Schedule(epochs=40, batch=8, learning_rate=0.01, checks=4))
    assert found.best.validation_loss < found.history[0].validation_loss - 0.5


SETTINGS = [Sensors.paper_training(), Sensors.paper_scenario2(0.10), Sensors.paper_scenario2(0.15)]


@pytest.mark.parametrize("sensors", SETTINGS)
def test_one_set_of_weights_is_near_the_bound_and_calibrated_at_all_noises(sensors: Sensors) -> None:
    """Bar-Shalom's NEES band and the posterior Cramer-Rao bound, with fewer runs and egos than docs/learned.md."""
    fleet = load_fleet("town10-validation")
    some = fleet.select(fleet.ids[::20])
    recording = observe(some, sensors, V2X(max_neighbours=0), runs=40)
    track = load_method("recursive")(recording, range(len(some.ids)))
    bound = [bound_rt_le(posterior_bound(some, sensors, ego)) for ego in some.ids]
    assert (np.sqrt((rt_le(track, some) ** 2).mean(axis=0)) < 1.07 * np.array(bound)).all()
    assert nees_inside(track, some).mean() > 0.95
    assert track.notes == ()
