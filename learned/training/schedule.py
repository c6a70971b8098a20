"""Schedule: how a net is optimised, plans of batches and rates; one core per process, a line of the terminal."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
import torch
from numpy.random import Generator

from coopoc.arrays import Floats, Ints, Limits, check_fields
from coopoc.errors import InputError, shown
from coopoc.workers import progress_bar

Epoch = Literal["step", "pass"]
COUNT_LIMITS, POSITIVE_LIMITS = (1, 10**7, "> 0"), (sys.float_info.min, sys.float_info.max, "> 0 and finite")
LIMITS: Limits = {
    **dict.fromkeys(("epochs", "batch", "checks"), COUNT_LIMITS),
    **dict.fromkeys(("learning_rate", "clip"), POSITIVE_LIMITS),
    "weight_decay": (0.0, sys.float_info.max, ">= 0, and 0 for none"),
}
"""Of a Schedule's numbers."""


@dataclass(frozen=True)
class Schedule:
    """Optimiser settings, the same for every recipe so that only the data and its distribution differ."""

    epochs: int = 1500
    """The paper's 1500 (centralised) and 500 (individual)."""
    epoch: Epoch = "step"
    """"step": one optimiser step on one random batch, as KalmanNet's published loop counts. "pass": all the data."""
    batch: int = 2
    """Segments per step, at most all. The paper's 1 is as accurate and takes half as long again (docs/learned.md)."""
    learning_rate: float = 1e-3
    """Of AdamW, falling to zero as a half cosine. The paper's 0.3 does not train (docs/learned.md)."""
    weight_decay: float = 0.3
    """Decoupled from the gradient (AdamW), the paper's number."""
    clip: float = 1.0
    """Largest norm of a model's gradient."""
    mirror: bool = True
    """Mirror each piece at random at each use (`clients.mirrored`). Not in the paper; docs/learned.md has the gain."""
    checks: int = 20
    """Validations at equal distances over the training, as many as the paper has rounds; the best weights seen are
    kept."""

    def __post_init__(self) -> None:
        check_fields(self, LIMITS)

    def plan(self, pieces: int, draw: Generator) -> Ints:
        """(steps, batch) indices of the pieces that each optimiser step sees, without repetition within a pass."""
        batch = min(self.batch, pieces)
        if self.epoch == "step":
            return np.stack([draw.permutation(pieces)[:batch] for _ in range(self.epochs)])
        steps = -(-self.epochs * pieces // batch)
        passes = -(-steps * batch // pieces)
        return np.concatenate([draw.permutation(pieces) for _ in range(passes)])[: steps * batch].reshape(steps, batch)


def cosine(steps: int, start: float = 0.0, stop: float = 1.0) -> Floats:
    """(steps,) factors (1 + cos(pi s)) / 2 of the learning rate, s running from start to stop of the training.

    >>> cosine(2).round(3).tolist()
    [1.0, 0.5]
    """
    where = start + (stop - start) * np.arange(steps) / max(steps, 1)
    return 0.5 * (1.0 + np.cos(np.pi * where))


def generator(draw: Generator) -> torch.Generator:
    """A torch generator seeded by a keyed NumPy stream."""
    return torch.Generator().manual_seed(int(draw.integers(2**62)))


Item = TypeVar("Item")
LINE = ContextVar("line", default=0)
"""Of the terminal, for bars: processes side by side do not draw over each other."""


@contextmanager
def one_core() -> Iterator[None]:
    """One torch thread inside, the caller's number afterwards.

    The matrices of a rollout are too small to share: a second thread mostly waits, and on a busy machine it makes a
    step ten times slower. One thread also adds in one order, so weights do not depend on the machine's cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def watched(items: Iterable[Item], name: str | None, unit: str, total: int | None = None) -> Iterator[Item]:
    """The items, with a bar of that name on stderr; None: without."""
    if not isinstance(name, str | None):
        raise InputError("progress", shown(name), "must be the name of a stage", "Give None for no bar.")
    return iter(progress_bar(items, desc=name, unit=unit, total=total, disable=name is None, position=LINE.get()))
