"""GainNet and its method, against an independent wiring of the published architecture and filters by hand."""

import numpy as np
import pytest
import torch
from conftest import refused, winding
from numpy.testing import assert_allclose
from test_learned_engine import batch
from torch import nn

from coopoc import Fleet, Sensors, observe
from coopoc.learned import GainNet, LearnedGain
from coopoc.learned.nets.gain import flatten
from coopoc.learned.training.schedule import one_core
from coopoc.methods.track import Method


@pytest.fixture(autouse=True)
def _one_core():
    with one_core():
        yield


@pytest.mark.parametrize(("in_mult", "out_mult", "count"), [(40, 5, 19_938), (5, 40, 23_928), (5, 32, 19_896)])
def test_parameter_count(in_mult, out_mult, count):
    """Published: "almost 20K" (the paper), 23,928 at KalmanNet_TSP's defaults; closed form 390 i + 504 o + 1818."""
    assert sum(p.numel() for p in GainNet(in_mult, out_mult).parameters()) == count
    assert count == 390 * in_mult + 504 * out_mult + 1818


class Published(nn.Module):
    """KalmanNet architecture 2 as described in its paper, with nn.GRU over sequences of one step; same weights."""

    def __init__(self, net):
        super().__init__()
        self.net = net
        self.grus = {}
        for name in ("process", "prior", "innovation"):
            cell = getattr(net, name)
            gru = nn.GRU(cell.input_size, 9).to(next(net.parameters()).dtype)
            gru.load_state_dict({f"{key}_l0": value for key, value in cell.state_dict().items()})
            self.grus[name] = gru

    def run(self, name, x, h):
        return self.grus[name](x[None], h[None])[1][0]

    def forward(self, gnss, velocity, x0, dt):
        def unit(v):
            return v / torch.clamp(torch.sqrt((v * v).sum(1, keepdim=True)), min=1e-12)

        n, eye = self.net, torch.eye(3, dtype=gnss.dtype).reshape(1, 9).repeat(len(gnss), 1)
        h_q, h_sigma, h_s = eye, 0 * eye, eye
        y_old, m, m_old, m_prior_old, out = x0, x0, x0, x0, []
        for t in range(gnss.shape[1]):
            m_prior = m + dt * velocity[:, t]
            y = gnss[:, t]
            f1, f2, f3, f4 = unit(y - y_old), unit(y - m_prior), unit(m - m_old), unit(m - m_prior_old)
            fc5, fc6 = torch.relu(n.update(f4)), torch.relu(n.evolution(f3))
            fc7 = torch.relu(n.observation(torch.cat((f1, f2), 1)))
            h_q = self.run("process", fc5, h_q)
            sigma = self.run("prior", torch.cat((h_q, fc6), 1), h_sigma)
            h_s = self.run("innovation", torch.cat((torch.relu(n.prior_to_innovation(sigma)), fc7), 1), h_s)
            k = n.gain(torch.relu(n.gain_hidden(torch.cat((sigma, h_s), 1))))
            h_sigma = torch.relu(
                n.posterior(torch.cat((sigma, torch.relu(n.posterior_hidden(torch.cat((h_s, k), 1)))), 1))
            )
            correction = torch.einsum("bij,bj->bi", k.reshape(-1, 3, 3), y - m_prior)
            m_old, m_prior_old, y_old, m = m, m_prior, y, m_prior + correction
            out.append(m)
        return torch.stack(out, 1)


def test_wiring_and_features_as_published():
    net, data = GainNet(seed=3).double(), batch(1, 4, 12)
    gnss, velocity = data.gnss[:, 0].transpose(0, 1), data.velocity[:, 0].transpose(0, 1)
    with torch.no_grad():
        net.gain.weight.mul_(10)
        expected = Published(net)(gnss, velocity, data.x0[0], 0.1)
        compiled = net.rollout(flatten([net]), data.gnss, data.velocity, data.x0, 0.1)[:, 0].transpose(0, 1)
        for found in (compiled, net(gnss, velocity, data.x0[0], 0.1)):
            torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def constant(gain):
    """A net whose gain is constant: the last layer's weights are zero and its bias is the gain."""
    net = GainNet()
    with torch.no_grad():
        net.gain.weight.zero_()
        net.gain.bias.copy_(torch.from_numpy(gain.flatten()))
    return net


def test_constant_gain_equals_the_constant_gain_filter_by_hand():
    gain = np.array([[0.1, 0.02, 0.0], [-0.03, 0.2, 0.0], [0.0, 0.0, 0.5]])
    rec = observe(winding(vehicles=2), Sensors(), runs=3)
    track = LearnedGain(constant(gain))(rec, [0, 1])
    x = rec.gnss[:, 0]
    for t in range(1, len(rec.t)):
        prior = x + 0.1 * rec.velocity[:, t]
        x = prior + (rec.gnss[:, t] - prior) @ gain.T
        assert_allclose(track.x[:, t], x, atol=2e-4)


def test_nothing_is_sent_online_and_no_covariance_is_claimed():
    method = LearnedGain(GainNet())
    assert isinstance(method, Method)
    track = method(observe(winding(), Sensors(), runs=2))
    assert not method.cooperative
    assert track.received_bytes.sum() == track.sent_bytes.sum() == method.message.payload == 0
    assert track.covariance is None


def test_translating_the_world_translates_the_estimate():
    here = winding()
    there = Fleet(here.ids, here.t, here.position + np.array([4e5, -5e6, 100.0]), here.velocity)
    tracks = [LearnedGain(GainNet())(observe(f, Sensors(), runs=2)).x for f in (here, there)]
    assert_allclose(tracks[1] - tracks[0], np.broadcast_to([4e5, -5e6, 100.0], tracks[0].shape), atol=1e-4)


def test_divergence_is_reported_and_nan_is_refused():
    rec = observe(winding(200), Sensors(), runs=2)
    assert LearnedGain(constant(0.1 * np.eye(3)))(rec).notes == ()
    (note,) = LearnedGain(constant(2.05 * np.eye(3)))(rec).notes
    assert note.startswith("fixes, a: far from its estimates; ")
    with refused("not finite in run 0"):
        LearnedGain(constant(1e30 * np.eye(3)))(rec)
