"""Rollout of many GainNets at once: S models, each on its own batch of B pieces, in stacked matrix products."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from .clients import Batch
from .net import CELLS, SIZE, GainNet


def flatten(models: Sequence[GainNet]) -> Tensor:
    """(S, P) weights of S models of one shape, in the order of `parameters()`."""
    return torch.stack([torch.nn.utils.parameters_to_vector(m.parameters()).detach() for m in models])


def views(theta: Tensor, like: GainNet) -> dict[str, Tensor]:
    """Named (S, *shape) views into flat weights, or gradients, (S, P) of models shaped as `like`."""
    named, at = {}, 0
    for name, parameter in like.named_parameters():
        named[name] = theta[:, at : at + parameter.numel()].view(len(theta), *parameter.shape)
        at += parameter.numel()
    return named


class Tape:
    """Stacked linear layers that remember what went in and out of them.

    Autograd then carries gradients through the recursion only as far as each layer's output; the weight gradient is one
    product over all T steps at the end. Adding T outer products one by one would be most of the cost of training.
    """

    def __init__(self, named: dict[str, Tensor]) -> None:
        self.named = named
        self.used: dict[tuple[str, str], tuple[list[tuple[Tensor, ...]], list[Tensor]]] = {}
        self.operands: dict[tuple[str, str], list[Tensor]] = {}

    def linear(self, layer: str, *parts: Tensor, kind: str = "") -> Tensor:
        """Output (S, B, out) of a layer whose input (S, B, in) comes in parts; `kind` is "_ih" or "_hh" for a GRU."""
        key = (layer, kind)
        if key not in self.operands:
            weight, bias = self.named[f"{layer}.weight{kind}"], self.named[f"{layer}.bias{kind}"]
            pieces = weight.transpose(1, 2).split([p.shape[-1] for p in parts], dim=1)
            self.operands[key] = [bias.unsqueeze(1), *(piece.contiguous() for piece in pieces)]
        out, *matrices = self.operands[key]
        for part, matrix in zip(parts, matrices, strict=True):
            out = torch.baddbmm(out, part, matrix)
        if torch.is_grad_enabled():
            out.requires_grad_()
            inputs, outputs = self.used.setdefault(key, ([], []))
            inputs.append(parts)
            outputs.append(out)
        return out

    def gru(self, layer: str, state: Tensor, *parts: Tensor) -> Tensor:
        """New state (S, B, 9) of a GRU: r, z = sigmoid(.), n = tanh(. + r .), h <- n + z (h - n)."""
        given = self.linear(layer, *parts, kind="_ih").split([2 * CELLS, CELLS], dim=-1)
        kept = self.linear(layer, state, kind="_hh").split([2 * CELLS, CELLS], dim=-1)
        reset, keep = torch.sigmoid(given[0] + kept[0]).chunk(2, dim=-1)
        fresh = torch.addcmul(given[1], reset, kept[1]).tanh()
        return torch.lerp(fresh, state, keep)

    def gradient(self, loss: Tensor, out: dict[str, Tensor]) -> None:
        """Write d loss / d weights into the views `out`."""
        taps = [tensor for _, outputs in self.used.values() for tensor in outputs]
        found = list(torch.autograd.grad(loss, taps, materialize_grads=True))
        for (layer, kind), (inputs, outputs) in self.used.items():
            delta = torch.cat(found[: len(outputs)], dim=1)
            del found[: len(outputs)]
            columns = [torch.cat(parts, dim=1).detach() for parts in zip(*inputs, strict=True)]
            sizes = [c.shape[-1] for c in columns]
            for column, target in zip(columns, out[f"{layer}.weight{kind}"].split(sizes, dim=2), strict=True):
                target.copy_(torch.bmm(delta.transpose(1, 2), column))
            out[f"{layer}.bias{kind}"].copy_(delta.sum(1))


class Step(NamedTuple):
    """One step of S models x B lanes: estimate x (S, B, 3) m, GRU states (S, B, 9) and gain (S, B, 9)."""

    x: Tensor
    process: Tensor
    prior: Tensor
    innovation: Tensor
    gain: Tensor


def steps(tape: Tape, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float) -> Iterator[Step]:
    """The T steps after the start: the same arithmetic as `GainNet.step`, for S models x B lanes.

    Args:
        tape: the models. gnss, velocity: (T, S, B, 3) m, m/s. x0: (S, B, 3) m. dt: s.
    """
    unit = torch.eye(SIZE, dtype=x0.dtype).flatten().expand(*x0.shape[:2], CELLS)
    process, memory, innovation = unit, torch.zeros_like(unit), unit
    x = x_before = prior_before = gnss_before = x0
    for fix, speed in zip(gnss.unbind(), velocity.unbind(), strict=True):
        x_prior = torch.add(x, speed, alpha=dt)
        surprise = fix - x_prior
        features = torch.stack([fix - gnss_before, surprise, x - x_before, x - prior_before], dim=2)
        observed, evolved, updated = normalize(features, dim=-1).flatten(2).split([2 * SIZE, SIZE, SIZE], dim=2)

        process = tape.gru("process", process, tape.linear("update", updated).relu())
        prior = tape.gru("prior", memory, process, tape.linear("evolution", evolved).relu())
        expected = tape.linear("prior_to_innovation", prior).relu()
        innovation = tape.gru("innovation", innovation, expected, tape.linear("observation", observed).relu())
        gain = tape.linear("gain", tape.linear("gain_hidden", prior, innovation).relu())
        back = tape.linear("posterior_hidden", innovation, gain).relu()
        memory = tape.linear("posterior", prior, back).relu()

        x_before, prior_before, gnss_before = x, x_prior, fix
        x = x_prior + (gain.unflatten(2, (SIZE, SIZE)) * surprise.unsqueeze(2)).sum(-1)
        yield Step(x, process, prior, innovation, gain)


def loss(tape: Tape, batch: Batch) -> Tensor:
    """(S, B) squared error of each piece, mean over time, sum over components, m^2 (equation 7 without its norm)."""
    estimates = torch.stack([s.x for s in steps(tape, batch.gnss, batch.velocity, batch.x0, batch.dt)])
    return (estimates - batch.truth).square().sum(-1).mean(0)


def loss_and_gradient(theta: Tensor, like: GainNet, batch: Batch) -> tuple[Tensor, Tensor]:
    """Loss (S,) m^2, mean over the batch, and its gradient (S, P) for S models with weights theta (S, P)."""
    tape, gradient = Tape(views(theta, like)), torch.empty_like(theta)
    with torch.enable_grad():
        losses = loss(tape, batch).mean(1)
        tape.gradient(losses.sum(), views(gradient, like))
    return losses.detach(), gradient
