"""Training of a judge: likelihood of the true errors of sources, in worlds where the judge itself has filtered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from star import FEATURES, HEADS, HIDDEN, LEAST, SIZE, SPAN, Floats, Pack, Rows, follow

PHASES, SAMPLED = 3, 60
"""Times that rows are drawn with the judge of the last time; steps of a run that give rows, in the mean."""
BATCH, STEPS, RATE = 1024, 1500, 3e-3
"""Rows of each head, optimiser steps of a phase, and the first step size."""
TAIL = 20.0
"""Squared normalised errors beyond it count as their logarithm: a filter that is lost teaches nothing."""


def rows_of(packs: Sequence[Pack], weights: Floats | None, shown: Floats, seed: int) -> list[Rows]:
    """Rows of each head from drives with a judge."""
    each = [
        follow(one, weights, shown, min(1.0, SAMPLED / (len(one.start) - 1)), seed + k)[2]
        for k, one in enumerate(packs)
    ]
    return [np.concatenate([rows[head] for rows in each]) for head in range(HEADS)]


def begin(seed: int) -> Floats:
    """(HEADS, SIZE) weights of a judge that believes what is stated."""
    rng = np.random.default_rng(seed)
    made = []
    for width, wide in ((HIDDEN[0], FEATURES), (HIDDEN[1], HIDDEN[0]), (1, HIDDEN[1])):
        std = np.sqrt(2.0 / wide) if width > 1 else 0.01
        bias = np.full((HEADS, width, 1), 0.0 if width > 1 else -np.log(-SPAN / LEAST - 1.0))
        made.append(np.concatenate([std * rng.normal(size=(HEADS, width, wide)), bias], axis=2).reshape(HEADS, -1))
    return np.concatenate(made, axis=1)


def logarithms(weights: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """(HEADS, B) logarithms of multipliers of features (HEADS, B, FEATURES)."""
    x, at = features, 0
    for width in (*HIDDEN, 1):
        wide = x.shape[2]
        layer = weights[:, at : at + width * (wide + 1)].reshape(HEADS, width, wide + 1)
        x = x @ layer[:, :, :wide].transpose(1, 2) + layer[:, None, :, wide]
        x = torch.relu(x) if width > 1 else x
        at += width * (wide + 1)
    return LEAST + SPAN * torch.sigmoid(x[:, :, 0])


def loss(weights: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    r"""Minus the log-likelihood of the true error e of a source, given its innovation.

    With the prediction's variance p and the assumed one 1 times m, the error is
    $N(\nu \, m / (p + m), \; p \, m / (p + m))$: where all is as assumed, m = 1 is best whatever the innovation is.
    """
    m = torch.exp(logarithms(weights, rows[:, :, :FEATURES]))[:, :, None]
    e, gap, p = (rows[:, :, FEATURES + 3 * i : FEATURES + 3 * i + 3] for i in range(3))
    axes = torch.arange(3) < rows[:, :, FEATURES + 9, None]
    p = torch.where(axes, p, torch.ones_like(p)).clamp(min=1e-6)
    v = p * m / (p + m)
    q = (e - gap * m / (p + m)) ** 2 / v
    q = torch.where(q < TAIL, q, TAIL * (1.0 + torch.log(q.clamp(min=TAIL) / TAIL)))
    return torch.where(axes, 0.5 * (torch.log(v) - torch.log(p) + q), torch.zeros_like(v)).sum(dim=2).mean(dim=1).sum()


def fit(weights: Floats, rows: Sequence[Rows], steps: int, seed: int, rates: tuple[float, float] = (RATE, 0.0)) -> Floats:
    """Weights after Adam, whose step falls along a cosine between two sizes."""
    rng, kept = np.random.default_rng(seed), [torch.from_numpy(each) for each in rows]
    theta = torch.tensor(weights, dtype=torch.float32, requires_grad=True)
    there = torch.tensor([float(len(each) > 0) for each in rows])[:, None]
    adam = torch.optim.Adam([theta], lr=rates[0])
    for step in range(steps):
        adam.param_groups[0]["lr"] = rates[1] + (rates[0] - rates[1]) * 0.5 * (1.0 + np.cos(np.pi * step / steps))
        batch = torch.stack(
            [
                each[torch.from_numpy(rng.integers(0, len(each), BATCH))] if len(each) else torch.zeros(BATCH, FEATURES + 10)
                for each in kept
            ]
        )
        adam.zero_grad()
        value = loss(theta, batch)
        value.backward()  # type: ignore[no-untyped-call]
        theta.grad = theta.grad * there  # type: ignore[operator]
        torch.nn.utils.clip_grad_norm_([theta], 5.0)
        adam.step()
    return theta.detach().numpy().astype(float)


def joined(parts: Sequence[Sequence[Rows]]) -> list[Rows]:
    """Rows of several drives or phases as one set."""
    return [np.concatenate([rows[head] for rows in parts]) for head in range(HEADS)]


def train(packs: Sequence[Pack], seed: int, shown: Floats | None = None, phases: int = PHASES, steps: int = STEPS) -> Floats:
    """Weights of a judge from drives of one client, or of all.

    Args:
        packs: stars, with the truth.
        seed: of start, rows and batches.
        shown: (HEADS, FEATURES) 0 for features that are hidden.
        phases: times that rows are drawn.
        steps: of the optimiser in each.
    """
    shown = np.ones((HEADS, FEATURES)) if shown is None else shown
    weights, seen = begin(seed), list[list[Rows]]()
    for phase in range(phases):
        seen.append(rows_of(packs, weights, shown, 1000 * seed + 100_000 * phase))
        weights = fit(weights, joined(seen[-2:]), steps, seed + phase)
    return weights


def federate(clients: Sequence[Sequence[Pack]], seed: int, phases: int = PHASES, rounds: int = 12, steps: int = 60) -> Floats:
    """Weights of a judge as the mean of those of clients, after each round; their drives stay where they are."""
    shown = np.ones((HEADS, FEATURES))
    weights, seen = begin(seed), [list[list[Rows]]() for _ in clients]
    for phase in range(phases):
        for c, packs in enumerate(clients):
            seen[c].append(rows_of(packs, weights, shown, 1000 * seed + 100_000 * phase + 10_000 * c))
        for r in range(rounds):
            rate = RATE * 0.5 * (1.0 + np.cos(np.pi * r / rounds))
            each = [
                fit(weights, joined(rows[-2:]), steps, seed + 1000 * phase + 10 * r + c, (rate, rate))
                for c, rows in enumerate(seen)
            ]
            weights = np.mean(each, axis=0)
    return weights


def size() -> npt.NDArray[np.int64]:
    """Weights, and bytes of a message with them in single precision."""
    return np.array([HEADS * SIZE, 4 * HEADS * SIZE])
