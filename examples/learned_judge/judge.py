"""Training of a judge: likelihood of the true errors of sources, in worlds where the judge itself has filtered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from star import FEATURES, HEADS, HIDDEN, LEAST, SIZE, SPAN, Floats, Forest, Pack, Rows, follow

PHASES, SAMPLED, ROUNDS = 3, 60, 12
"""Times that rows are drawn with the judge of the last time; steps of a run that give rows, in the mean;
rounds of a federation in each phase."""
BATCH, STEPS, RATE = 1024, 1000, 3e-3
"""Rows of each head, optimiser steps of a phase, and the first step size."""


def rows_of(packs: Sequence[Pack], judge: Floats | None, shown: Floats, seed: int) -> list[Rows]:
    """Rows of each head from drives with a judge."""
    each = [
        follow(one, judge, shown, min(1.0, SAMPLED / (len(one.start) - 1)), seed + k)[2]
        for k, one in enumerate(packs)
    ]
    none = [np.zeros((0, FEATURES + 1), np.float32)] * HEADS
    return joined([none, *each])


def begin(seed: int) -> Floats:
    """(HEADS, SIZE) weights of a judge that believes what is stated."""
    rng = np.random.default_rng(seed)
    made = []
    for width, wide in ((HIDDEN[0], FEATURES), (HIDDEN[1], HIDDEN[0]), (1, HIDDEN[1])):
        std = np.sqrt(2.0 / wide) if width > 1 else 0.01
        bias = np.zeros((HEADS, width, 1))
        if width == 1:
            bias[:, 0, 0] = -np.log(-np.array(SPAN) / LEAST - 1.0)
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
    return LEAST + torch.tensor(SPAN)[:, None] * torch.sigmoid(x[:, :, 0])


def loss(weights: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Sum over heads of the mean Huber loss of logarithms."""
    found, span = logarithms(weights, rows[:, :, :FEATURES]), torch.tensor(SPAN)[:, None]
    target = torch.minimum(rows[:, :, FEATURES].clamp(min=LEAST), LEAST + span)
    return torch.nn.functional.huber_loss(found, target, reduction="none", delta=2.0).mean(dim=1).sum()


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
                each[torch.from_numpy(rng.integers(0, len(each), BATCH))] if len(each) else torch.zeros(BATCH, FEATURES + 1)
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


def federate(clients: Sequence[Sequence[Pack]], seed: int, phases: int = PHASES, steps: int = STEPS) -> Floats:
    """Weights of a judge as the mean of those of clients, after each round; their drives stay where they are."""
    shown = np.ones((HEADS, FEATURES))
    weights, seen, rounds = begin(seed), [list[list[Rows]]() for _ in clients], ROUNDS
    for phase in range(phases):
        for c, packs in enumerate(clients):
            seen[c].append(rows_of(packs, weights, shown, 1000 * seed + 100_000 * phase + 10_000 * c))
        for r in range(rounds):
            rate = RATE * 0.5 * (1.0 + np.cos(np.pi * r / rounds))
            each = [
                fit(weights, joined(rows[-2:]), max(steps // rounds, 1), seed + 1000 * phase + 10 * r + c, (rate, rate))
                for c, rows in enumerate(seen)
            ]
            weights = np.mean(each, axis=0)
    return weights


def size() -> npt.NDArray[np.int64]:
    """Weights, and bytes of a message with them in single precision."""
    return np.array([HEADS * SIZE, 4 * HEADS * SIZE])


def fit_forest(rows: Sequence[Rows], seed: int, count: int = 20, most: int = 50_000) -> Forest | None:
    """Regression trees of the same rows; None without scikit-learn."""
    try:
        from sklearn.ensemble import RandomForestRegressor
    except ImportError:
        return None
    roots, first, parts, nodes = [0], [], list[npt.NDArray[np.float64]](), 0
    for head, each in enumerate(rows):
        some = each[np.random.default_rng(seed).permutation(len(each))[:most]]
        target = np.clip(some[:, FEATURES], LEAST, LEAST + SPAN[head])
        made = RandomForestRegressor(count, max_depth=12, min_samples_leaf=30, max_features=0.4, random_state=seed)
        for tree in made.fit(some[:, :FEATURES], target).estimators_:
            t = tree.tree_
            leaf = t.children_left < 0
            links = np.where(leaf, -1, t.feature), t.children_left + nodes, t.children_right + nodes
            parts.append(np.array([*links, np.where(leaf, t.value[:, 0, 0], t.threshold)]))
            first.append(nodes)
            nodes += len(leaf)
        roots.append(len(first))
    feature, left, right, value = np.concatenate(parts, axis=1)
    return Forest(np.array(roots), np.array(first), *(each.astype(np.int64) for each in (feature, left, right)), value)
