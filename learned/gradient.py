"""Loss and gradient of many GainNets at once: backpropagation through time, written out."""

from __future__ import annotations

from collections import defaultdict

import torch
from torch import Tensor

from .clients import Batch
from .net import CELLS, SIZE, GainNet
from .rollout import Gru, Step, steps
from .stack import Layers, layers

Taps = defaultdict[str, list[Tensor]]
"""Of each layer, its inputs (S, B, in) or the gradients of its outputs (S, B, out), last step first."""


def loss(net: Layers, batch: Batch) -> Tensor:
    """(S, B) squared error of each piece, mean over time, sum over components, m^2 (equation 7 without its norm)."""
    estimates = torch.stack([s.x for s in steps(net, batch.gnss, batch.velocity, batch.x0, batch.dt)])
    return (estimates - batch.truth).square().sum(-1).mean(0)


@torch.no_grad()
def loss_and_gradient(theta: Tensor, like: GainNet, batch: Batch) -> tuple[Tensor, Tensor]:
    """Loss (S,) m^2, mean over the batch, and its gradient (S, P) for S models with weights theta (S, P).

    Each layer's input and output gradient are kept, and its weight gradient is one product over all T steps at the end:
    adding T outer products one by one, as autograd does, would be most of the cost of training.

    >>> still = torch.zeros(2, 1, 4, 3)
    >>> loss_and_gradient(torch.zeros(1, 19938), GainNet(), Batch(still, still, still, still[0], 0.1))[0].item()
    0.0
    """
    net = layers(theta, like)
    tape = list(steps(net, batch.gnss, batch.velocity, batch.x0, batch.dt))
    error = torch.stack([step.x for step in tape]) - batch.truth
    inputs, deltas = _backward(net, tape, error * (2.0 / (len(tape) * error.shape[2])))
    gradient = torch.empty_like(theta)
    for name, into in layers(gradient, like).items():
        delta = torch.cat(deltas[name], dim=1)
        torch.bmm(delta.mT, torch.cat(inputs[name], dim=1), out=into.weight)
        torch.sum(delta, dim=1, keepdim=True, out=into.bias)
    return error.square().sum(-1).mean(dim=(0, 2)), gradient


def _backward(net: Layers, tape: list[Step], error: Tensor) -> tuple[Taps, Taps]:
    """Inputs and output gradients of every layer, from d loss / d estimate `error` (T, S, B, 3)."""
    inputs, deltas = Taps(list), Taps(list)

    def through(name: str, x: Tensor, delta: Tensor) -> Tensor:
        inputs[name].append(x)
        deltas[name].append(delta)
        return torch.bmm(delta, net[name].weight)

    def through_gru(name: str, cell: Gru, after: Tensor) -> tuple[Tensor, Tensor]:
        reset, keep = cell.gates.chunk(2, 2)
        fresh = (after - after * keep) * (1.0 - cell.fresh.square())
        gates = torch.cat([fresh * cell.kept, after * (cell.before - cell.fresh)], 2)
        gates.mul_(cell.gates - cell.gates.square())
        given = through(f"{name}_ih", cell.given, torch.cat([gates, fresh], 2))
        before = through(f"{name}_hh", cell.before, torch.cat([gates, fresh * reset], 2))
        return given, before.addcmul_(after, keep)

    def relu(gradient: Tensor, value: Tensor) -> Tensor:
        passed: Tensor = torch.ops.aten.threshold_backward(gradient, value, 0.0)
        return passed

    nothing = torch.zeros_like(tape[0].memory)
    memory, process, innovation = nothing, nothing, nothing
    from_prior = from_change = torch.zeros_like(error[0])
    x = torch.zeros_like(error[0])
    for step, wrong in zip(reversed(tape), reversed(error.unbind()), strict=True):
        x = x + wrong
        gain = (x.unsqueeze(3) * step.surprise.unsqueeze(2)).flatten(2)
        surprise = (step.gain.unflatten(2, (SIZE, SIZE)) * x.unsqueeze(3)).sum(2)

        both = through("posterior", step.posterior_input, relu(memory, step.memory))
        prior, back = both.split(CELLS, 2)
        both = through("posterior_hidden", step.back_input, relu(back, step.posterior_input[..., CELLS:]))
        innovation, gain = (a + b for a, b in zip((innovation, gain), both.split(CELLS, 2), strict=True))
        hidden = through("gain", step.gain_hidden, gain)
        both = through("gain_hidden", step.pair, relu(hidden, step.gain_hidden))
        prior, innovation = (a + b for a, b in zip((prior, innovation), both.split(CELLS, 2), strict=True))

        given, innovation = through_gru("innovation", step.innovation, innovation)
        seen, moved, corrected = step.features.split([2 * SIZE, SIZE, SIZE], 2)
        active = relu(given, step.innovation.given)
        prior = prior + through("prior_to_innovation", step.prior.after, active[..., :CELLS])
        observed = through("observation", seen, active[..., CELLS:])
        given, memory = through_gru("prior", step.prior, prior)
        evolved = through("evolution", moved, relu(given[..., CELLS:], step.prior.given[..., CELLS:]))
        given, process = through_gru("process", step.process, process + given[..., :CELLS])
        updated = through("update", corrected, relu(given, step.process.given))

        turned = torch.cat([observed, evolved, updated], 2).unflatten(2, (4, SIZE))
        unit = step.features.unflatten(2, (4, SIZE))
        changes = (turned - unit * (unit * turned).sum(-1, keepdim=True)) / step.norms
        _, in_surprise, in_evolution, in_update = changes.unbind(2)
        prediction = x + from_prior - surprise - in_surprise
        x = prediction + in_evolution + in_update + from_change
        from_prior, from_change = -in_update, -in_evolution
    return inputs, deltas
