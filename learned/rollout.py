"""Rollout of many GainNets at once: S models, each on its own batch of B lanes, in stacked matrix products."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from .net import CELLS, SIZE
from .stack import Layers

EPS = 1e-12
"""Least norm that a feature is divided by, as in `torch.nn.functional.normalize`."""


class Gru(NamedTuple):
    """One GRU step: input (S, B, in), state before and after, reset and update gates, candidate, and the candidate's
    part from the state (S, B, 9)."""

    given: Tensor
    before: Tensor
    after: Tensor
    gates: Tensor
    fresh: Tensor
    kept: Tensor


class Step(NamedTuple):
    """One step of S models x B lanes: the estimate x (S, B, 3) m, the gain (S, B, 9), and all that led to them."""

    x: Tensor
    gain: Tensor
    surprise: Tensor
    features: Tensor
    norms: Tensor
    process: Gru
    prior: Gru
    innovation: Gru
    pair: Tensor
    """Prior and innovation state, (S, B, 18); `gain_hidden` is the layer that reads it."""
    gain_hidden: Tensor
    back_input: Tensor
    posterior_input: Tensor
    memory: Tensor


def gru(net: Layers, name: str, given: Tensor, state: Tensor) -> Gru:
    """r, z = sigmoid(W x + U h), n = tanh(W x + r (U h)), h <- n + z (h - n), with biases inside W and U."""
    gates, fresh = net[f"{name}_ih"](given).split([2 * CELLS, CELLS], 2)
    more, kept = net[f"{name}_hh"](state).split([2 * CELLS, CELLS], 2)
    reset, keep = gates.add_(more).sigmoid_().chunk(2, 2)
    fresh = torch.addcmul(fresh, reset, kept).tanh_()
    return Gru(given, state, torch.lerp(fresh, state, keep), gates, fresh, kept)


def steps(net: Layers, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float) -> Iterator[Step]:
    """The T steps after the start: the same arithmetic as `GainNet.step`, for S models x B lanes.

    Args:
        net: the models. gnss, velocity: (T, S, B, 3) m, m/s. x0: (S, B, 3) m. dt: s.
    """
    unit = torch.eye(SIZE, dtype=x0.dtype).flatten().repeat(*x0.shape[:2], 1)
    process, memory, innovation = unit, torch.zeros_like(unit), unit
    x = x_before = prior_before = gnss_before = x0
    for fix, speed in zip(gnss.unbind(), velocity.unbind(), strict=True):
        x_prior = torch.add(x, speed, alpha=dt)
        surprise = fix - x_prior
        changes = torch.stack([fix - gnss_before, surprise, x - x_before, x - prior_before], dim=2)
        norms = torch.linalg.vector_norm(changes, dim=-1, keepdim=True).clamp_(min=EPS)
        features = changes.div_(norms).flatten(2)

        seen, moved, corrected = features.split([2 * SIZE, SIZE, SIZE], 2)
        updated, evolved = net["update"](corrected).relu_(), net["evolution"](moved).relu_()
        observed = net["observation"](seen).relu_()
        q = gru(net, "process", updated, process)
        p = gru(net, "prior", torch.cat([q.after, evolved], 2), memory)
        expected = net["prior_to_innovation"](p.after).relu_()
        s = gru(net, "innovation", torch.cat([expected, observed], 2), innovation)
        pair = torch.cat([p.after, s.after], 2)
        hidden = net["gain_hidden"](pair).relu_()
        gain = net["gain"](hidden)
        back_input = torch.cat([s.after, gain], 2)
        posterior_input = torch.cat([p.after, net["posterior_hidden"](back_input).relu_()], 2)
        memory = net["posterior"](posterior_input).relu_()

        process, innovation = q.after, s.after
        x_before, prior_before, gnss_before = x, x_prior, fix
        x = x_prior + (gain.unflatten(2, (SIZE, SIZE)) * surprise.unsqueeze(2)).sum(-1)
        yield Step(x, gain, surprise, features, norms, q, p, s, pair, hidden, back_input, posterior_input, memory)
