"""The paper's optimiser taken literally: learning rate and weight decay 0.3, batch 1.

`python -m coopoc.learned.training.literal` prints the table of docs/learned.md.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from tqdm import tqdm

from coopoc.world.fleet import Fleet
from coopoc.world.sensors import stream

from ..nets.gain_net import GainNet
from ..nets.stack import flatten
from .clients import Segments, clients
from .fit import Judge
from .machine import one_core

OPTIMISERS = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam, "adamw": torch.optim.AdamW}


@dataclass(frozen=True)
class Outcome:
    """Outcome of one literal training: the optimiser steps that stayed finite, and the best validation loss, m^2, of
    the checks on the way (the constant-gain filter has about 0.37 on the bundled clients)."""

    optimiser: str
    learning_rate: float
    clipped: bool
    start: str
    seed: int
    steps: int
    best: float
    untrained: float


@one_core()
def literal(
    fleet: Fleet,
    optimiser: str = "sgd",
    learning_rate: float = 0.3,
    *,
    clipped: bool = False,
    start_gain: float | None = None,
    steps: int = 150,
    seed: int = 0,
) -> Outcome:
    """Train centrally with torch's own optimiser at batch 1 and weight decay 0.3, and report when it breaks.

    Args:
        fleet: clients' drives.
        optimiser: "sgd", "adam" or "adamw".
        learning_rate: constant.
        clipped: limit the gradient's norm to 1.
        start_gain: None for torch's initial weights as published, or a stable start.
        steps: at most so many.
        seed: of noise, split, start and batches.

    References:
        arXiv 2411.05847, section IV.A: "Batch size is equal to 1, while learning rate and weight decay are set to 0.3".

    >>> line = Fleet(("a",), np.arange(303) / 10, np.zeros((303, 1, 3)), np.zeros((303, 1, 3)))
    >>> literal(line, "adamw", 1e-3, start_gain=0.1, steps=1).steps
    1
    """
    group = clients(fleet, seed=seed)
    training, validation = (Segments.join([getattr(c, part) for c in group]) for part in ("training", "validation"))
    like = GainNet(start_gain=start_gain, seed=seed)
    theta = flatten([like]).requires_grad_()
    judge, draw = Judge([[validation]], like), stream(seed, "literal", 0, optimiser)
    step = OPTIMISERS[optimiser]([theta], lr=learning_rate, weight_decay=0.3)
    untrained, best = float(judge(theta.detach())), math.inf
    for done in range(steps):
        batch = training.batch(torch.from_numpy(draw.integers(len(training), size=(1, 1))))
        found, gradient = like.loss_and_gradient(theta.detach(), batch)
        if not (found.isfinite().all() and gradient.isfinite().all()):
            return Outcome(optimiser, learning_rate, clipped, _named(start_gain), seed, done, best, untrained)
        theta.grad = gradient
        if clipped:
            torch.nn.utils.clip_grad_norm_([theta], 1.0)
        step.step()
        if (done + 1) % 10 == 0:
            best = min(best, float(judge(theta.detach())))
    return Outcome(optimiser, learning_rate, clipped, _named(start_gain), seed, steps, best, untrained)


def _named(start_gain: float | None) -> str:
    return "torch's" if start_gain is None else "stable"


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: of each way to train, how many seeds stayed finite and the best validation loss of each seed before
    and during the training."""
    lines = [
        "| optimiser | rate | clipped | start | finite to the end | median steps before NaN | untrained, m^2 | "
        "best validation, m^2 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    ways = dict.fromkeys((o.optimiser, o.learning_rate, o.clipped, o.start) for o in outcomes)
    most = max(o.steps for o in outcomes)
    for way in ways:
        mine = [o for o in outcomes if (o.optimiser, o.learning_rate, o.clipped, o.start) == way]
        alive = [o for o in mine if o.steps == most]
        broken = [o.steps for o in mine if o.steps < most]
        median = f"{np.median(broken):.0f}" if broken else "-"
        before, best = (
            ", ".join(f"{score:.3g}" for score in scores)
            for scores in ([o.untrained for o in mine], [o.best for o in mine])
        )
        name, rate, clipped, start = way
        lines.append(
            f"| {name} | {rate:g} | {'yes' if clipped else 'no'} | {start} | {len(alive)} of {len(mine)} | "
            f"{median} | {before} | {best} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the table of docs/learned.md for the bundled clients."""
    from coopoc import load_fleet

    fleet, ways = (
        load_fleet("town10-clients"),
        [
            (name, rate, clipped, gain)
            for rate, clipped in ((0.3, False), (0.3, True), (1e-3, True))
            for gain in (None, 0.1)
            for name in OPTIMISERS
        ],
    )
    jobs = [(way, seed) for way in ways for seed in range(3)]
    bar = tqdm(jobs, desc="literal training", unit="run", file=sys.stderr)
    print(table([literal(fleet, n, r, clipped=c, start_gain=g, seed=seed) for (n, r, c, g), seed in bar]))


if __name__ == "__main__":
    main()
