"""Training of a judge on the true errors of all sources, in worlds where it has filtered itself."""

from collections.abc import Sequence

import numpy as np
import torch
from star import FEATURES, HEADS, HIDDEN, LEAST, NET, SPAN, Floats, Judge, Pack, Rows, follow

SAMPLED, ROUNDS = 60, 10
"""Steps of a run that give rows, in the mean, and rounds of a federation in each phase."""
BATCH, RATE = 1024, 3e-3
"""Rows of each head, and the first step size."""
NEUTRAL = -np.log(-np.array(SPAN) / LEAST - 1.0)
"""(HEADS,) outputs of nets for multipliers of one."""
ALL = Judge(NET).shown


def rows_of(packs: Sequence[Pack], judge: Judge, seed: int) -> list[Rows]:
    """Rows of each head from drives with a judge."""
    each = [follow(one, judge, SAMPLED / (len(one.start) - 1), seed + k)[2] for k, one in enumerate(packs)]
    return joined([[np.zeros((0, FEATURES + 1), np.float32)] * HEADS, *each])


def joined(parts: Sequence[Sequence[Rows]]) -> list[Rows]:
    """Rows of several drives or phases as one set."""
    return [np.concatenate([rows[head] for rows in parts]) for head in range(HEADS)]


def begin(seed: int) -> Floats:
    """(HEADS, SIZE) weights of a judge that believes what is stated."""
    rng, parts = np.random.default_rng(seed), []
    for width, wide in ((HIDDEN[0], FEATURES), (HIDDEN[1], HIDDEN[0]), (1, HIDDEN[1])):
        std, bias = (np.sqrt(2.0 / wide), 0.0 * NEUTRAL) if width > 1 else (0.01, NEUTRAL)
        layer = std * rng.normal(size=(HEADS, width, wide))
        parts.append(np.append(layer, np.tile(bias[:, None, None], (1, width, 1)), axis=2).reshape(HEADS, -1))
    return np.concatenate(parts, axis=1)


def logarithms(weights: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """(HEADS, B) logarithms of multipliers of features (HEADS, B, FEATURES)."""
    x, at = features, 0
    for width in (*HIDDEN, 1):
        wide = x.shape[2]
        layer = weights[:, at : at + width * (wide + 1)].reshape(HEADS, width, wide + 1)
        x = x @ layer[:, :, :wide].transpose(1, 2) + layer[:, None, :, wide]
        x = torch.relu(x) if width > 1 else x
        at += width * (wide + 1)
    return LEAST + torch.tensor(SPAN)[:, None] * torch.sigmoid(x[:, :, 0])


def fit(weights: Floats, rows: Sequence[Rows], steps: int, seed: int, first: float = RATE, last: float = 0.0) -> Floats:
    """Weights after Adam on the Huber loss of logarithms; its step falls along a cosine from the first to the last."""
    rng, kept = np.random.default_rng(seed), [torch.from_numpy(each) for each in rows]
    theta, span = torch.tensor(weights, dtype=torch.float32, requires_grad=True), torch.tensor(SPAN)[:, None]
    there, nothing = torch.tensor([float(len(each) > 0) for each in rows])[:, None], torch.zeros(BATCH, FEATURES + 1)
    adam = torch.optim.Adam([theta], lr=first)
    for step in range(steps):
        adam.param_groups[0]["lr"] = last + (first - last) * 0.5 * (1.0 + np.cos(np.pi * step / steps))
        some = [each[torch.from_numpy(rng.integers(0, len(each), BATCH))] if len(each) else nothing for each in kept]
        batch = torch.stack(some)
        target = torch.minimum(batch[:, :, FEATURES].clamp(min=LEAST), LEAST + span)
        found = logarithms(theta, batch[:, :, :FEATURES])
        loss = torch.nn.functional.huber_loss(found, target, reduction="none", delta=2.0).mean(dim=1, keepdim=True)
        adam.zero_grad()
        (there * loss).sum().backward()
        torch.nn.utils.clip_grad_norm_([theta], 5.0)
        adam.step()
    made: Floats = theta.detach().numpy().astype(float)
    return made


def train(packs: Sequence[Pack], seed: int, phases: int, steps: int, shown: Floats = ALL) -> Floats:
    """Weights of a judge from drives of one client, or of all.

    Args:
        packs: stars, with the truth.
        seed: of start, rows and batches.
        phases: times that rows are drawn, with the judge of the last time; the rows of the last two count.
        steps: of the optimiser in each.
        shown: (HEADS, FEATURES) 0 for features that are hidden.
    """
    weights, seen = begin(seed), list[list[Rows]]()
    for phase in range(phases):
        seen.append(rows_of(packs, Judge(NET, weights, shown), 1000 * seed + 100_000 * phase))
        weights = fit(weights, joined(seen[-2:]), steps, seed + phase)
    return weights


def federate(clients: Sequence[Sequence[Pack]], seed: int, phases: int, steps: int) -> Floats:
    """Weights of a judge as the mean of those of clients, after each round; their drives stay where they are."""
    weights, seen = begin(seed), [list[list[Rows]]() for _ in clients]
    for phase in range(phases):
        for c, packs in enumerate(clients):
            seen[c].append(rows_of(packs, Judge(NET, weights), 1000 * seed + 100_000 * phase + 10_000 * c))
        mine = [joined(rows[-2:]) for rows in seen]
        for r in range(ROUNDS):
            rate, local = RATE * 0.5 * (1.0 + np.cos(np.pi * r / ROUNDS)), max(steps // (2 * ROUNDS), 1)
            each = [
                fit(weights, rows, local, seed + 1000 * phase + 10 * r + c, rate, rate) for c, rows in enumerate(mine)
            ]
            weights = np.mean(each, axis=0)
    return weights
