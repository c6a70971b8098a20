"""The compiled engine against plain torch: values, gradients, missing fixes, rows that do not know of each other."""

import copy

import numpy as np
import pytest
import torch
from conftest import refused
from numba import njit
from numpy.testing import assert_allclose
from torch.testing import assert_close

from coopoc.learned import GainNet
from coopoc.learned.engine.backward import Moments, Update
from coopoc.learned.engine.layers import sigmoid, tanh
from coopoc.learned.nets.gain import Gain, Recurrent, flatten
from coopoc.learned.training.clients import Batch
from coopoc.learned.training.schedule import one_core


@pytest.fixture(autouse=True)
def _one_core():
    with one_core():
        yield


def batch(models, lanes, steps, dtype=torch.float64, gaps=0.0):
    """Drives at constant speed; a share `gaps` of the fixes is missing."""
    torch.manual_seed(1)
    velocity = 5 * torch.randn(1, models, lanes, 3, dtype=dtype).expand(steps, -1, -1, -1)
    truth = torch.cumsum(0.1 * velocity, 0)
    noise = torch.randn(2, steps, models, lanes, 3, dtype=dtype)
    gnss = torch.where(torch.rand(steps, models, lanes, 1) < gaps, torch.nan, truth + noise[0])
    return Batch(gnss, velocity + noise[1], truth, 0.5 * noise[0, 0], 0.1)


def plain(nets, data, dt):
    """(T, S, B, 3) of the reference, a net after the other."""
    rows = [
        Recurrent.forward(net, data.gnss[:, s].transpose(0, 1), data.velocity[:, s].transpose(0, 1), data.x0[s], dt)
        for s, net in enumerate(nets)
    ]
    return torch.stack([row.transpose(0, 1) for row in rows], 1)


def loss_and_gradient(net, theta, data):
    """Of an optimiser step from theta (S, P)."""
    rows = np.arange(len(theta))
    outcome = net.descend(
        Moments(*(theta.numpy().copy() for _ in range(3))), data, Update(rows, 1, 0.1 * rows, 0.0, np.inf)
    )
    return torch.from_numpy(outcome.losses), torch.from_numpy(outcome.gradient)


def gradients(nets, data, dt):
    """Estimates and gradients of the squared error, of the engine and by torch's autograd through the reference."""
    theta = flatten(nets)
    found = nets[0].rollout(theta, data.gnss, data.velocity, data.x0, dt)
    mine = loss_and_gradient(nets[0], theta, data._replace(dt=dt))[1]
    expected = plain(nets, data, dt)
    (expected - data.truth).square().sum(-1).mean((0, 2)).sum().backward()
    by_torch = torch.stack([torch.cat([grad(p).flatten() for p in net.parameters()]) for net in nets])
    return found, mine, expected.detach(), by_torch


def grad(leaf):
    assert leaf.grad is not None
    return leaf.grad


def test_tanh_and_sigmoid_against_numpy():
    @njit(error_model="numpy")
    def both(x, out):
        for i in range(len(x)):
            out[0, i], out[1, i] = tanh(x[i], x.dtype.type), sigmoid(x[i], x.dtype.type)

    wide = np.concatenate([np.linspace(-30, 30, 20_001), np.logspace(-9, 2, 2_001), [np.inf, -np.inf]])
    for dtype, tolerance in ((np.float32, 4e-7), (np.float64, 3e-13)):
        x = wide.astype(dtype)
        out = np.empty((2, len(x)), dtype)
        both(x, out)
        exact = x.astype(float)
        assert_allclose(out[0], np.tanh(exact), rtol=tolerance)
        assert_allclose(out[1], 0.5 + 0.5 * np.tanh(0.5 * exact), atol=tolerance)
    both(np.full(1, np.nan), out := np.empty((2, 1)))
    assert np.isnan(out).all()


@pytest.mark.parametrize(
    ("models", "lanes", "steps"),
    [(3, 1, 100), pytest.param(1, 2, 900, marks=pytest.mark.slow), (2, 7, 100), (1, 72, 100)],
)
def test_float32_agrees_with_the_reference(models, lanes, steps):
    """Values to 1e-5. Gradients are about as near to float64's as torch's own float32 ones: rounding turns the
    direction of a short vector, so that torch itself is up to 1e-4 off."""
    nets = [GainNet(seed=s) for s in range(models)]
    data = batch(models, lanes, steps, torch.float32, 0.1)
    found, mine, expected, theirs = gradients(nets, data, 0.1)
    assert_close(found, expected, rtol=1e-5, atol=1e-5 * expected.abs().max().item())
    wide = Batch(data.gnss.double(), data.velocity.double(), data.truth.double(), data.x0.double(), 0.1)
    exact = gradients([copy.deepcopy(net).double() for net in nets], wide, 0.1)[3]
    far, near = (mine - exact).norm(dim=1), (theirs - exact).norm(dim=1)
    assert (far < 2 * near + 3e-5 * exact.norm(dim=1)).all()


def test_float64_agrees_with_the_reference_with_gaps_and_variable_dt():
    nets = [GainNet(4, 2, seed=s).double() for s in range(2)]
    dt = torch.linspace(0.05, 0.3, 60, dtype=torch.float64)
    found, mine, expected, theirs = gradients(nets, batch(2, 9, 60, gaps=0.4), dt)
    assert_close(found, expected, rtol=1e-9, atol=1e-9)
    assert_close(mine, theirs, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("descend", [GainNet.descend, Gain.descend], ids=["whole", "by parts"])
def test_descent_is_that_of_torch(descend):
    """torch.optim.AdamW after clip_grad_norm_ on autograd's gradient of the reference; other rows stay, and so does a
    row whose loss is not finite."""
    nets, data = [GainNet(2, 1, seed=s).double() for s in range(4)], batch(3, 3, 12, gaps=0.2)
    data.velocity[:, 1] = torch.inf
    theta, rates = flatten(nets), np.array([1e-2, 2e-2, 3e-2])
    started, state = theta.clone(), Moments(theta.numpy(), np.zeros(theta.shape), np.zeros(theta.shape))
    leaves = {0: nets[0], 2: nets[3]}
    optimisers = {row: torch.optim.AdamW(net.parameters(), rates[row], weight_decay=0.3) for row, net in leaves.items()}
    for step in range(1, 4):
        outcome = descend(nets[0], state, data, Update(np.array([0, 1, 3]), step, rates, 0.3, 0.5))
        assert outcome.finite.tolist() == [True, False, True]
        for row, net in leaves.items():
            gnss, velocity, truth = (part[:, row].transpose(0, 1) for part in data[:3])
            loss = (Recurrent.forward(net, gnss, velocity, data.x0[row], 0.1) - truth).square().sum(-1).mean()
            assert_close(outcome.losses[row], loss.item(), rtol=1e-10, atol=1e-12)
            optimisers[row].zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 0.5)
            optimisers[row].step()
    assert_close(theta[[0, 3]], flatten([*leaves.values()]), rtol=1e-8, atol=1e-10)
    assert torch.equal(theta[1:3], started[1:3])


def test_gradients_of_inputs_go_through_the_reference():
    data, net = batch(1, 2, 5), GainNet(2, 1).double()
    gnss = data.gnss[:, 0].transpose(0, 1).clone().requires_grad_()
    net(gnss, data.velocity[:, 0].transpose(0, 1), data.x0[0], 0.1).sum().backward()
    assert float(grad(gnss).abs().sum()) > 0


def test_what_does_not_fit_is_named():
    data, net = batch(1, 2, 5), GainNet(2, 1)
    theta = flatten([net])
    with refused("theta"):
        net.rollout(theta[:, :-1], data.gnss, data.velocity, data.x0, 0.1)
    with refused("theta"):
        net.rollout(theta.half(), data.gnss, data.velocity, data.x0, 0.1)
    with refused("velocity"):
        net.rollout(theta, data.gnss, data.velocity[1:], data.x0, 0.1)
    with refused("truth"):
        loss_and_gradient(net, theta, data._replace(truth=data.truth[1:]))
    with refused("dt"):
        net.rollout(theta, data.gnss, data.velocity, data.x0, torch.ones(4))
