"""NoiseNet and the cooperative gain: filterpy's filter, closed forms, known noise, and the laws of a star."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import crossing_fleet, formation_fleet
from filterpy.kalman import KalmanFilter
from scipy import stats

from coopoc import V2X, Fleet, InputError, JointFilter, Kalman, Sensors, observe
from coopoc.evaluate.metrics import nees_inside
from coopoc.learned.checkpoint import Checkpoint, load, save
from coopoc.learned.federation.federate import federate
from coopoc.learned.nets.cooperative import CooperativeGain, NetNoise
from coopoc.learned.nets.noise_net import NoiseFilter, NoiseNet, Variances, filtered, guess, lanes
from coopoc.learned.nets.stack import flatten
from coopoc.learned.training.clients import Batch, clients
from coopoc.learned.training.schedule import Schedule
from coopoc.methods.covariance_intersection import CovarianceIntersection
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.world.recording import Recording

NOISE = Sensors.paper_scenario2()


def net(seed: int = 0) -> NoiseNet:
    """A net that is no longer at its start, where its corrections are zero."""
    made = NoiseNet(hidden=3, seed=seed)
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return made


def around(steps: int, seed: int = 0) -> Fleet:
    """One vehicle that drives round a bend and up and down."""
    t = np.arange(steps) / 10
    velocity = np.stack([9 * np.cos(t / 9), 9 * np.sin(t / 9), 2 * np.cos(t / 5)], axis=-1)[:, None]
    return Fleet(("a",), t, np.cumsum(0.1 * velocity, axis=0), velocity)


def batch(count: int = 2, steps: int = 12) -> Batch:
    """Two models, `count` pieces, in float64."""
    rng = np.random.default_rng(5)
    arrays = [torch.from_numpy(rng.normal(0, s, (steps, 2, count, 3))) for s in (3.0, 8.0, 1.0)]
    return Batch(*arrays, torch.zeros(2, count, 3, dtype=torch.float64), 0.1)


def drive(fleet: Fleet, v2x: V2X, runs: int = 2, noise: Sensors = NOISE, **more: object) -> Recording:
    return observe(fleet, noise, v2x, runs=runs, seed=3, **more)  # type: ignore[arg-type]


def test_filter_is_filterpys_while_the_noise_of_fixes_stays(formation: Fleet) -> None:
    """Process noise changes at every step, and two fixes are missing."""
    rng = np.random.default_rng(0)
    gnss, velocity = rng.normal(0, 3, (20, 3)), rng.normal(0, 8, (20, 3))
    gnss[[4, 5]] = np.nan
    process, r = rng.uniform(0.01, 1, (20, 3)), np.array([4.0, 9.0, 1.0])
    given = Variances(
        *(torch.from_numpy(np.broadcast_to(a, (20, 1, 1, 3)).copy()) for a in (r, process[:, None, None]))
    )
    x, p = filtered(lanes(gnss[None, :, None]), lanes(velocity[None, :, None]), given, 0.1)
    theirs = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
    theirs.x, theirs.P, theirs.R = gnss[0].copy(), 1e6 * np.eye(3), np.diag(r)
    theirs.H, theirs.B = np.eye(3), 0.1 * np.eye(3)
    for t in range(20):
        if t:
            theirs.predict(u=velocity[t], Q=np.diag(process[t]))
        theirs.update(None if np.isnan(gnss[t]).any() else gnss[t])
        np.testing.assert_allclose(x[t, 0, 0], theirs.x.ravel(), atol=1e-9)
        np.testing.assert_allclose(p[t, 0, 0], np.diag(theirs.P), rtol=1e-9)


def test_a_standing_vehicle_is_at_the_mean_of_its_fixes_whatever_their_variance() -> None:
    """Without motion noise the estimate is the mean, and its variance the last one given over their number."""
    rng = np.random.default_rng(1)
    fixes, r = torch.from_numpy(rng.normal(0, 3, (9, 1, 1, 3))), torch.from_numpy(rng.uniform(1, 16, (9, 1, 1, 3)))
    x, p = filtered(fixes, 0 * fixes, Variances(r, 0 * r), 0.1)
    np.testing.assert_allclose(x[-1], fixes.mean(0), atol=1e-4)  # not 1e-9: before the first fix 1e6 m^2 are known
    np.testing.assert_allclose(p[-1], r[-1] / 9, rtol=1e-4)


@pytest.mark.parametrize(("reading", "shares"), [("axis", (0.15, 0.0)), ("speed", (0.0, 0.15))])
def test_guess_finds_the_noise_that_acts(reading: str, shares: tuple[float, float]) -> None:
    """Known: 3.5 m, 15 % of each axis's velocity or of the speed. Fifty runs of 20 s; the last step, over runs."""
    seen = drive(around(200), V2X(max_neighbours=0), 50, replace(NOISE, velocity_reading=reading))  # type: ignore[arg-type]
    found = guess(lanes(seen.gnss), lanes(seen.velocity), 0.1)
    r, axis, speed = (getattr(found, name)[-1].exp().mean().item() for name in ("gnss", "axis", "speed"))
    assert r == pytest.approx(3.5, rel=0.03)
    assert (axis, speed) == pytest.approx(shares, abs=0.035)  # a share is never negative, so none is found as a few %


def test_guess_finds_the_noise_of_fixes_once_a_second() -> None:
    """Known: 3.5 m, with odometry at 10 Hz. Each fix is compared with the one before, moved by ten steps."""
    seen = drive(around(600), V2X(max_neighbours=0), 50)
    rare = np.where((np.arange(600) % 10 == 0)[:, None, None], seen.gnss, np.nan)
    found = guess(lanes(rare), lanes(seen.velocity), 0.1).gnss[-1]
    assert float((2.0 * found).exp().mean().sqrt()) == pytest.approx(3.5, rel=0.07)


def test_loss_is_the_log_likelihood_of_the_true_error() -> None:
    given, model = batch(), net()
    theta = flatten([model, model]).double()
    gnss, velocity = torch.cat([given.x0[None], given.gnss]), torch.cat([given.velocity[:1], given.velocity])
    x, p = filtered(gnss, velocity, model.variances(theta, gnss, velocity, 0.1), 0.1)
    theirs = -stats.norm.logpdf(given.truth, x[1:], p[1:].sqrt()) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(model.losses(theta, given), theirs.sum(-1).mean(0), rtol=1e-9)


def test_gradient_is_that_of_finite_differences_and_models_do_not_touch() -> None:
    given, model = batch(1, 6), net()
    theta = flatten([model, net(1)]).double()
    assert torch.autograd.gradcheck(lambda w: model.losses(w, given), theta.requires_grad_())
    other = torch.cat([theta[:1], 0 * theta[1:]]).detach()
    torch.testing.assert_close(model.losses(other, given)[0], model.losses(theta, given)[0])


def test_a_known_start_is_certain() -> None:
    given = batch()
    known = given._replace(exact=torch.ones(2, 2, dtype=torch.bool))
    gnss, velocity = torch.cat([known.x0[None], known.gnss]), torch.cat([known.velocity[:1], known.velocity])
    given = Variances(torch.ones_like(gnss), torch.full_like(gnss, 0.25))
    x, p = filtered(gnss, velocity, given, 0.1, known.exact)
    assert p[0].abs().max() == 0
    np.testing.assert_allclose(p[1], 0.25 / 1.25, rtol=1e-9)
    np.testing.assert_allclose(x[1], x[0] + 0.1 * velocity[1] + 0.2 * (gnss[1] - x[0] - 0.1 * velocity[1]), rtol=1e-9)


def test_training_alone_gives_the_unknown_noise_of_a_fleet(tmp_path: Path) -> None:
    """Federated on one second-long pieces: the loss falls, the covariance holds, and a checkpoint reads the same."""
    fleet = around(1300)
    fed = federate(
        NoiseNet(),
        clients(fleet, noise="wide", piece=60),
        rounds=2,
        local_epochs=4,
        schedule=Schedule(batch=8, learning_rate=0.01, weight_decay=0.01),
    )
    assert fed.best.number > 0
    assert fed.history[1].sent_bytes == 4 * 100 + 4
    seen = drive(around(300), V2X(max_neighbours=0), 30)
    track = NoiseFilter(fed.model)(seen)  # type: ignore[arg-type]
    assert nees_inside(track, around(300))[0] >= 0.95
    again = load(save(tmp_path / "net.safetensors", Checkpoint(fed.model, {}))).model.method("again")(seen)
    np.testing.assert_array_equal(track.x, again.x)


def test_solo_laws(formation: Fleet) -> None:
    """Translation moves the estimate; zero noise leaves zero error; axes exchanged are axes exchanged."""
    fleet = formation.between(0, 80)
    seen = drive(fleet, V2X(max_neighbours=0))
    track = NoiseFilter(net())(seen, [0, 3])
    far = replace(seen, gnss=seen.gnss + np.array([5e4, -2e4, 100.0]))
    away = NoiseFilter(net())(far, [0, 3]).x - track.x
    np.testing.assert_allclose(away, np.broadcast_to([5e4, -2e4, 100.0], away.shape), atol=1e-6)
    turned = replace(seen, gnss=seen.gnss[..., [1, 0, 2]], velocity=seen.velocity[..., [1, 0, 2]])
    np.testing.assert_allclose(NoiseFilter(net())(turned, [0, 3]).x[..., [1, 0, 2]], track.x, atol=1e-9)
    silent = observe(fleet, Sensors((0.0,) * 3, velocity_std_ratio=0.0), V2X(max_neighbours=0), assumed=Sensors())
    np.testing.assert_allclose(NoiseFilter(net())(silent, [0]).x[0, :, 0], fleet.position[:, 0], atol=1e-9)


def rms(method: Method, seen: Recording, fleet: Fleet) -> float:
    """Of the ego, m."""
    return float(np.sqrt(np.square(method(seen).x[:, :, 0] - fleet.position[:, 0]).sum(-1).mean()))


@pytest.mark.parametrize("v2x", [V2X(5), V2X(5, loss=0.5, burst=4.0), V2X(5, rate=2.0, latency=0.2)])
def test_net_noise_serves_other_filters_of_a_star(v2x: V2X) -> None:
    """Constants given fix by fix are constants, with messages of any age."""
    seen = drive(crossing_fleet(), v2x)
    known = NoiseModel.nominal(NOISE)
    shape = seen.gnss.shape
    given = NetNoise(
        "net",
        NOISE,
        fix=np.broadcast_to(known.gnss_variance, shape).copy(),
        process=np.broadcast_to(known.process_variance(seen), shape).copy(),
    )
    np.testing.assert_allclose(JointFilter(given)(seen).x, JointFilter(known)(seen).x, atol=1e-12)


def test_bytes_are_those_of_what_arrived(crossing: Fleet) -> None:
    seen = drive(crossing, V2X(4, loss=0.5), observers=[2])
    assert CooperativeGain(net())(seen, [2]).received_bytes[:, 0].tolist() == [
        56 * (row[seen.links.of(2)] >= 0).sum() for row in seen.arrival
    ]


def test_neighbours_help_without_anybody_knowing_the_noise() -> None:
    fleet = formation_fleet(6, 200)
    seen, unaware = drive(fleet, V2X(5, loss=0.3), 10), NoiseNet()
    together, solo = rms(CooperativeGain(unaware), seen, fleet), rms(NoiseFilter(unaware), seen, fleet)
    assert together < 0.6 * solo
    assert together < 1.1 * rms(JointFilter("nominal"), seen, fleet)
    assert solo < 1.1 * rms(Kalman("nominal"), seen, fleet)


def test_what_it_cannot_do_is_said(crossing: Fleet) -> None:
    late = drive(crossing, V2X(2, latency=0.2))
    assert np.isfinite(CooperativeGain(net())(late).x).all()
    with pytest.raises(InputError, match="changes from fix to fix"):
        CovarianceIntersection(NetNoise.by(net(), late))(late)
    with pytest.raises(InputError, match=r"x0 = shape \(3,\): must be"):
        NoiseFilter(net(), x0=np.zeros(3))(late)
