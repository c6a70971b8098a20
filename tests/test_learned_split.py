"""SplitGain, against an independent wiring of its published architecture with torch's own GRU."""

from __future__ import annotations

import numpy as np
import torch
from conftest import winding
from torch import Tensor, nn

from coopoc import Sensors, observe
from coopoc.learned import Schedule, clients, fit
from coopoc.learned.nets.split import SplitGain
from coopoc.learned.nets.stack import flatten
from coopoc.learned.training.clients import Batch
from coopoc.methods.stream import Stream


def batch(models: int, lanes: int, steps: int) -> Batch:
    """Random drives, one fix of which is missing."""
    torch.manual_seed(1)
    velocity = 5 * torch.randn(1, models, lanes, 3, dtype=torch.float64).expand(steps, -1, -1, -1)
    truth, dice = torch.cumsum(0.1 * velocity, 0), torch.randn(2, steps, models, lanes, 3, dtype=torch.float64)
    gnss = truth + 2 * dice[0]
    gnss[4, 0, 1] = torch.nan
    return Batch(gnss, velocity + dice[1], truth, 2 * dice[0, 0], 0.1)


def published(net: SplitGain, seen: Batch, lane: int) -> Tensor:
    """Estimates (T, 3) of model 0: K = G_1 H^T G_2, with nn.GRU over sequences of one step and the net's weights."""
    grus = []
    for cell in net.cell:
        gru = nn.GRU(net.hidden, net.hidden).double()
        gru.load_state_dict({f"{key}_l0": value for key, value in cell.state_dict().items()})
        grus.append(gru)
    states = [torch.zeros(1, 1, net.hidden, dtype=torch.float64) for _ in range(2)]
    x = x_old = prior_old = z_old = seen.x0[0, lane]
    found = []
    for z, u in zip(seen.gnss[:, 0, lane], seen.velocity[:, 0, lane], strict=True):
        prior = x + seen.dt * u
        if z.isnan().any():
            x, x_old = prior, x
            found.append(x)
            continue
        factors = []
        for i, pair in enumerate([(x - x_old, x - prior_old), (z - z_old, z - prior)]):
            given = torch.relu(net.see[i](torch.arcsinh(torch.cat(pair) / 0.5) / 2))
            _, states[i] = grus[i](given[None, None], states[i])
            factors.append(net.factor[i](states[i][0, 0]).view(3, 3))
        gain = factors[0] @ torch.eye(3, dtype=torch.float64).T @ factors[1]
        x, x_old, prior_old, z_old = prior + gain @ (z - prior), x, prior, z
        found.append(x)
    return torch.stack(found)


def test_it_is_the_published_wiring() -> None:
    net, seen = SplitGain(6, seed=3).double(), batch(1, 2, 12)
    x = net.rollout(flatten([net]), *seen[:2], seen.x0, seen.dt)
    for lane in range(2):
        torch.testing.assert_close(x[:, 0, lane], published(net, seen, lane), rtol=1e-10, atol=1e-10)


def test_many_nets_in_one_rollout_are_each_step_by_step() -> None:
    nets, seen = [SplitGain(5, seed=seed).double() for seed in range(3)], batch(3, 2, 10)
    x = nets[0].rollout(flatten(nets), *seen[:2], seen.x0, seen.dt)
    for s, net in enumerate(nets):
        memory = net.start(seen.x0[s])
        for t in range(10):
            memory, gain = net.step(memory, seen.gnss[t, s], seen.velocity[t, s], 0.1)
            torch.testing.assert_close(memory.x, x[t, s])
            assert bool((gain[1] == 0).all()) == (s == 0 and t == 4), "a missing fix has a gain of zero"


def test_parameter_count() -> None:
    """Two nets of a layer 6 -> h, a GRU h -> h and a layer h -> 9: closed form 12 h^2 + 44 h + 18 of both."""
    for hidden in (5, 24):
        assert sum(p.numel() for p in SplitGain(hidden).parameters()) == 12 * hidden**2 + 44 * hidden + 18


def test_the_start_is_a_stable_loop_near_a_constant_gain() -> None:
    recording = observe(winding(900), Sensors(), runs=4)
    method = SplitGain().method("split")
    track = method(recording)
    assert track.notes == ()
    x = recording.gnss[:, 0, 0]
    for t in range(1, 900):
        x = x + 0.1 * recording.velocity[:, t, 0]
        x = x + 0.1 * (recording.gnss[:, t, 0] - x)
    np.testing.assert_allclose(track.x[:, -1, 0], x, atol=0.7)


def test_it_sees_magnitudes() -> None:
    """Ten times the noise of still vehicles gives another gain; a net of directions alone would not notice."""
    gains, torch_dice = [], torch.randn(30, 1, 3, generator=torch.Generator().manual_seed(0))
    net = SplitGain(seed=1)
    for scale in (1.0, 10.0):
        memory = net.start(torch.zeros(1, 3))
        for fix in scale * torch_dice:
            memory, gain = net.step(memory, fix, torch.zeros(1, 3), 0.1)
        gains.append(gain)
    assert float((gains[0] - gains[1]).detach().abs().max()) > 1e-3


def test_stream_is_the_method() -> None:
    recording = observe(winding(), Sensors(), runs=1)
    method = SplitGain(seed=2).method("split")
    stream: Stream[object] = method.start()  # type: ignore[attr-defined]
    stream.step(recording.gnss[0, 0, 0], np.zeros(3), dt=0.1)
    track = method(recording)
    for t in range(1, 60):
        x, _ = stream.step(recording.gnss[0, t, 0], recording.velocity[0, t, 0], dt=0.1)
        np.testing.assert_allclose(x, track.x[0, t, 0], atol=1e-4)


def test_training_lowers_the_loss() -> None:
    """The start's gain of 0.1 is far too much for fixes of 6 m."""
    (only,) = clients(winding(900), Sensors(gnss_std=(6.0, 6.0, 6.0)), piece=40)
    schedule = Schedule(epochs=30, batch=6, learning_rate=0.01, checks=3)
    found = fit(SplitGain(8), only.training, only.validation, schedule)
    assert found.best.validation_loss < 0.95 * found.history[0].validation_loss
