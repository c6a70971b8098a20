"""Compiled rollout of RecursiveGains with its own backward pass; the tests compare it with `RecursiveGain.step`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from coopoc.arrays import AnyArray
from coopoc.kernels.compiling.compile import compiled

from ..engine.arithmetic import part, sigmoid, tanh
from ..training.clients import Batch
from .levels import FADE, FEATURES, FORGET, GNSS_STD, POOL, STILL, VELOCITY_SHARE, WEIGHT
from .stack import layers

LIMIT = 3.0
"""Largest correction of a logarithm: at any weights the net stays within exp(+-3) of the filter."""
HEADS = 4
"""Corrections of the net: process variance, odds of the gain, Joseph's second term, claimed GNSS variance."""
Arrays = tuple[Any, ...]
"""For S nets, T steps, L lanes:

seen: fix m, motion m, q / r, r m^2 (S, T, L), one axis in each lane; x0 m and its relative variance (S, L).
net: weights of the GRU's input that read the filter (S, 3 H, 3); of its state, with bias; of the heads, with bias.
tape: estimate, relative variance, its prior, gain, innovation e m (NaN where the fix is missing), e normalised
    (S, T, L); the net's inputs from the filter, states before the step, gates r, z, n with
    the part of n that r scales, corrections.
"""


def rollout(theta: Tensor, like: nn.Module, batch: Batch) -> tuple[Tensor, Tensor]:
    """Estimates m and variances m^2 (T, S, B, 3) of S nets theta (S, P), differentiable in theta and in nothing else.

    >>> from coopoc.learned import RecursiveGain
    >>> still = torch.zeros(5, 1, 2, 3)
    >>> rollout(torch.zeros(1, 1364), RecursiveGain(), Batch(still, still, still, still[0], 0.1))[0].abs().max().item()
    0.0
    """
    shape, (models, lanes) = batch.gnss.shape, batch.x0.shape[:2]
    fix, velocity = (a.to(theta.dtype).transpose(0, 1).contiguous() for a in (batch.gnss, batch.velocity))
    x0 = batch.x0.to(theta.dtype).contiguous()
    gnss, ratio, features = torch.empty_like(fix), torch.empty_like(fix), fix.new_empty(*fix.shape, FEATURES)
    _levels(fix.numpy(), velocity.numpy(), x0.numpy(), batch.dt, gnss.numpy(), ratio.numpy(), features.numpy())
    relative0 = torch.ones_like(x0) if batch.known is None else (~batch.known)[..., None].to(x0.dtype).expand_as(x0)
    flat = [
        a.reshape(models, *a.shape[1:-2], 3 * lanes) for a in (fix, batch.dt * velocity, ratio, gnss, x0, relative0)
    ]
    net = layers(theta, like)
    into = torch.baddbmm(
        net["cell_ih"].bias, features.view(models, -1, FEATURES), net["cell_ih"].transposed[:, :FEATURES]
    )
    into = into.view(models, shape[0], 3 * lanes, -1)
    weights = (
        net["cell_ih"].weight[:, :, FEATURES:],
        net["cell_hh"].weight,
        net["cell_hh"].bias[:, 0],
        net["heads"].weight,
        net["heads"].bias[:, 0],
    )
    given = tuple(a.contiguous().numpy() for a in flat)
    found = _Rollout.apply(given, into, *weights)  # type: ignore[no-untyped-call]
    x, variance = (a.view(models, shape[0], lanes, 3).transpose(0, 1) for a in found)
    return x, variance


class _Rollout(torch.autograd.Function):
    """The kernels as one operation of torch."""

    @staticmethod
    def forward(ctx: Any, seen: Arrays, into: Tensor, *weights: Tensor) -> tuple[Tensor, Tensor]:
        size = weights[1].shape[2]
        widths = [()] * 6 + [(3,), (size,), (4, size), (HEADS,)]
        tape = [into.new_empty(*into.shape[:3], *width) for width in widths]
        ctx.seen, ctx.tape = seen, tuple(a.numpy() for a in tape)
        ctx.net = tuple(w.detach().contiguous().numpy() for w in weights)
        _forward(ctx.seen, ctx.net, into.detach().numpy(), ctx.tape)
        return tape[0], tape[1] * tape[-1][..., 3].exp() * torch.from_numpy(seen[3])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, adjoint_x: Tensor, adjoint_variance: Tensor) -> tuple[Tensor | None, ...]:
        own, before, gates = (torch.from_numpy(a) for a in ctx.tape[6:9])
        size = before.shape[-1]
        into, state, heads = (own.new_empty(*own.shape[:3], n) for n in (3 * size, 3 * size, HEADS))
        adjoints = (adjoint_x.contiguous().numpy(), adjoint_variance.contiguous().numpy())
        _backward(ctx.seen, ctx.net, ctx.tape, *adjoints, into.numpy(), state.numpy(), heads.numpy())
        after = torch.lerp(gates[..., 2, :], before, gates[..., 1, :])
        return (
            None,
            into,
            _product(into, own),
            _product(state, before),
            state.sum((1, 2)),
            _product(heads, after),
            heads.sum((1, 2)),
        )


def _product(delta: Tensor, given: Tensor) -> Tensor:
    """Weight gradient (S, out, in) of deltas (S, T, L, out) and inputs (S, T, L, in)."""
    return delta.flatten(1, 2).mT @ given.flatten(1, 2)


@compiled
def _levels(
    fix: AnyArray, velocity: AnyArray, x0: AnyArray, dt: float, gnss: AnyArray, ratio: AnyArray, features: AnyArray
) -> None:
    """`levels.noise` at every step (S, T, B, 3), written to gnss, ratio and features, in double precision."""
    for s in range(fix.shape[0]):
        for b in range(fix.shape[2]):
            last, driven, before = x0[s, b].astype(np.float64), np.zeros(3), velocity[s, 0, b].astype(np.float64)
            count, jumps = np.full(3, WEIGHT), np.full(3, WEIGHT * GNSS_STD**2)
            turns, squares = np.full(3, WEIGHT * VELOCITY_SHARE**2), np.full(3, WEIGHT)
            for t in range(fix.shape[1]):
                speed = STILL**2
                for a in range(3):
                    v = np.float64(velocity[s, t, b, a])
                    driven[a] += dt * v
                    jump = fix[s, t, b, a] - last[a] - driven[a]
                    count[a], jumps[a] = FORGET * count[a], FORGET * jumps[a]
                    if not np.isnan(jump):
                        last[a], driven[a] = fix[s, t, b, a], 0.0
                        count[a], jumps[a] = count[a] + 1.0, jumps[a] + 0.5 * jump * jump
                    turns[a] = FADE * turns[a] + 0.5 * (v - before[a]) ** 2
                    squares[a] = FADE * squares[a] + (v * v if t else 0.0)
                    before[a] = v
                    speed += v * v
                pooled = jumps.sum() / count.sum()
                for a in range(3):
                    weight, share, now = POOL**2 / (POOL + count[a]), turns[a] / squares[a], before[a] ** 2
                    r = (jumps[a] + weight * pooled) / (count[a] + weight)
                    gnss[s, t, b, a] = r
                    ratio[s, t, b, a] = dt**2 * (share * now + STILL**2) / r
                    f = features[s, t, b, a]
                    f[0], f[1] = 0.5 * np.log(r) - 0.7, 0.5 * np.log(share) + 2.3
                    f[2], f[3] = 0.5 * np.log(now + STILL**2) - 1.0, 0.5 * np.log(speed) - 2.0
                    f[4], f[5] = 0.5 * np.log(count[a]) - 2.0, 0.5 * np.log((1.0 - FADE) * turns[a] + STILL**2)


@compiled
def _forward(seen: Arrays, net: Arrays, into: AnyArray, tape: Arrays) -> None:
    """All steps of all nets; `into` (S, T, L, 3 H) is what the GRU's input makes of the levels."""
    fixes, motion, ratio, gnss, x0, relative0 = seen
    w_own, w_state, state_bias, w_heads, heads_bias = net
    estimates, relatives, priors, gains, es, innovations, owns, befores, gates, all_logs = tape
    models, steps, lanes = fixes.shape
    real = gnss.dtype.type
    zero, one = real(0.0), real(1.0)
    for s in range(models):
        state, heads = np.ascontiguousarray(w_state[s].T), np.ascontiguousarray(w_heads[s].T)
        h = np.zeros((lanes, len(state)), into.dtype)
        back, logs = np.empty((lanes, 3 * len(state)), into.dtype), np.empty((lanes, HEADS), into.dtype)
        x, relative, innovation = x0[s].copy(), relative0[s].copy(), np.zeros(lanes, into.dtype)
        for t in range(steps):
            np.dot(h, state, back)
            befores[s, t] = h
            for lane in range(lanes):
                at = s, t, lane
                p = relative[lane] + ratio[at]
                e = fixes[at] - (x[lane] + motion[at])
                es[at] = e
                unit = zero if np.isnan(e) else e / np.sqrt((one + p) * gnss[at])
                own = owns[at]
                own[0], own[1] = real(0.25) * np.log(p), np.log1p(unit * unit)
                own[2] = tanh(unit * innovation[lane], real)
                innovation[lane] = innovations[at] = unit
                _gru(into[at], own, w_own[s], state_bias[s], back[lane], gates[at], h[lane])
            np.dot(h, heads, logs)
            for lane in range(lanes):
                at = s, t, lane
                c = all_logs[at]
                for k in range(HEADS):
                    c[k] = real(LIMIT) * tanh((logs[lane, k] + heads_bias[s, k]) / real(LIMIT), real)
                p = relative[lane] + ratio[at] * np.exp(c[0])
                odds, e = p * np.exp(c[1]), es[at]
                gain = zero if np.isnan(e) else odds / (one + odds)
                x[lane] += motion[at] + (zero if np.isnan(e) else gain * e)
                relative[lane] = (one - gain) ** 2 * p + gain * gain * np.exp(c[2])
                priors[at], gains[at] = p, gain
                estimates[at], relatives[at] = x[lane], relative[lane]


@part
def _gru(
    into: AnyArray, own: AnyArray, weight: AnyArray, bias: AnyArray, back: AnyArray, gates: AnyArray, h: AnyArray
) -> None:
    """r, z = sigmoid(W x + U h), n = tanh(W x + r (U h)), h <- n + z (h - n) of one lane, biases inside W and U."""
    size, real = len(h), h.dtype.type
    for k in range(size):
        for gate in range(2):
            j = k + gate * size
            v = into[j] + weight[j, 0] * own[0] + weight[j, 1] * own[1] + weight[j, 2] * own[2]
            gates[gate, k] = sigmoid(v + back[j] + bias[j], real)
        j = k + 2 * size
        v = into[j] + weight[j, 0] * own[0] + weight[j, 1] * own[1] + weight[j, 2] * own[2]
        gates[3, k] = back[j] + bias[j]
        gates[2, k] = tanh(v + gates[0, k] * gates[3, k], real)
        h[k] = gates[2, k] + gates[1, k] * (h[k] - gates[2, k])


@compiled
def _backward(
    seen: Arrays,
    net: Arrays,
    tape: Arrays,
    adjoint_x: AnyArray,
    adjoint_variance: AnyArray,
    into: AnyArray,
    state: AnyArray,
    heads: AnyArray,
) -> None:
    """Gradients (S, T, L, n) of what enters the gates from the input and from the state, and of the heads' outputs."""
    (fixes, _, ratio, gnss, _, relative0), (w_own, w_state, _, w_heads, _) = seen, net
    _, relatives, _, gains, es, innovations, owns, befores, gates, _ = tape
    models, steps, lanes = fixes.shape
    real = gnss.dtype.type
    zero, one = real(0.0), real(1.0)
    for s in range(models):
        size = w_state.shape[2]
        h, more, own = np.zeros((lanes, size), real), np.empty((lanes, size), real), np.empty((lanes, 3), real)
        x, relative, innovation = np.zeros(lanes, real), np.zeros(lanes, real), np.zeros(lanes, real)
        for t in range(steps - 1, -1, -1):
            for lane in range(lanes):
                at = s, t, lane
                x[lane] += adjoint_x[at]
                relative[lane] = _filter_back(seen, tape, at, x[lane], relative[lane], adjoint_variance[at], heads[at])
            np.dot(heads[s, t], w_heads[s], more)
            for lane in range(lanes):
                at = s, t, lane
                _gru_back(gates[at], befores[at], more[lane], h[lane], into[at], state[at])
            np.dot(state[s, t], w_state[s], more)
            np.dot(into[s, t], w_own[s], own)
            h += more
            for lane in range(lanes):
                at = s, t, lane
                last = innovations[s, t - 1, lane] if t else zero
                before = relatives[s, t - 1, lane] if t else relative0[s, lane]
                p = before + ratio[at]
                unit, turned = innovations[at], own[lane, 2] * (one - owns[at][2] ** 2)
                adjoint = innovation[lane] + own[lane, 1] * real(2.0) * unit / (one + unit * unit) + turned * last
                innovation[lane] = turned * unit
                relative[lane] += real(0.25) * own[lane, 0] / p - adjoint * unit / (real(2.0) * (one + p))
                if not np.isnan(es[at]):
                    x[lane] *= one - gains[at]
                    x[lane] -= adjoint / np.sqrt((one + p) * gnss[at])


@part
def _filter_back(seen: Arrays, tape: Arrays, at: Any, x: Any, relative: Any, variance: Any, heads: AnyArray) -> Any:
    """Adjoint of the relative variance before a step from those of x, of it and of the variance after; of the heads."""
    _, relatives, priors, gains, es, _, _, _, _, logs = tape
    real, (_, _, ratio, gnss, _, _) = heads.dtype.type, seen
    one = real(1.0)
    c, gain, p, e = logs[at], gains[at], priors[at], es[at]
    claim, second, scale = np.exp(c[3]) * gnss[at], np.exp(c[2]), np.exp(c[1])
    left = one - gain
    relative = relative + variance * claim
    odds = real(0.0)
    if not np.isnan(e):
        odds = (x * e + relative * real(2.0) * (gain * second - left * p)) * left * left
    prior = relative * left * left + odds * scale
    heads[0] = prior * ratio[at] * np.exp(c[0])
    heads[1] = odds * p * scale
    heads[2] = relative * gain * gain * second
    heads[3] = variance * relatives[at] * claim
    for k in range(HEADS):
        heads[k] *= one - (c[k] / real(LIMIT)) ** 2
    return prior


@part
def _gru_back(gates: AnyArray, before: AnyArray, more: AnyArray, h: AnyArray, into: AnyArray, state: AnyArray) -> None:
    """Adjoints of one lane's GRU step; h, the adjoint of its state, becomes the direct part of that one step before."""
    size, one = len(h), h.dtype.type(1.0)
    for k in range(size):
        reset, keep, fresh, kept = gates[0, k], gates[1, k], gates[2, k], gates[3, k]
        after = h[k] + more[k]
        candidate = after * (one - keep) * (one - fresh * fresh)
        into[k] = state[k] = candidate * kept * reset * (one - reset)
        into[k + size] = state[k + size] = after * (before[k] - fresh) * keep * (one - keep)
        into[k + 2 * size], state[k + 2 * size] = candidate, candidate * reset
        h[k] = after * keep
