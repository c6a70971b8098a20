"""Schedule: how a net is optimised; plans of batches; the optimiser of many models at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError
from coopoc.kernels.compile import numba_is_there

Epoch = Literal["step", "pass"]


@dataclass(frozen=True)
class Schedule:
    """Optimiser settings, the same for every recipe so that only the data and its distribution differ."""

    epochs: int = 1500
    """The paper's 1500 (centralised) and 500 (individual)."""
    epoch: Epoch = "step"
    """"step": one optimiser step on one random batch, as KalmanNet's published loop counts. "pass": all the data."""
    batch: int = 2
    """Pieces per step. The paper's 1 is as accurate and takes half as long again (docs/learned.md)."""
    learning_rate: float = 1e-3
    """Of AdamW, falling to zero as a half cosine. The paper's 0.3 does not train (docs/learned.md)."""
    weight_decay: float = 0.3
    """Decoupled from the gradient (AdamW), the paper's number."""
    l2: float = 0.0
    """gamma of the paper's gamma ||theta||^2 in the loss; weaker than the decoupled decay under static noise."""
    proximal: float = 0.0
    """mu of FedProx's mu / 2 ||theta - theta_start||^2 in the loss: how far training may leave where it started."""
    clip: float = 1.0
    """Largest norm of a model's gradient."""
    mirror: bool = True
    """Mirror each piece at random at each use (`clients.mirrored`). Not in the paper; docs/learned.md has the gain."""
    checks: int = 20
    """Validations spread over the training, as many as the paper has rounds; the best weights seen are kept."""

    def __post_init__(self) -> None:
        for field in ("epochs", "batch", "learning_rate", "clip", "checks"):
            if not getattr(self, field) > 0:
                raise InputError(field, getattr(self, field), "must be > 0", f"Give Schedule({field}=...).")
        for field in ("weight_decay", "l2", "proximal"):
            if not getattr(self, field) >= 0:
                raise InputError(field, getattr(self, field), "must be >= 0", "Use 0 for none.")
        if self.epoch not in ("step", "pass"):
            raise InputError("epoch", repr(self.epoch), 'must be "step" or "pass"', "Pick one.")

    def plan(self, pieces: int, draw: np.random.Generator) -> Ints:
        """(steps, batch) indices of the pieces that each optimiser step sees, without repetition within a pass."""
        steps = self.epochs if self.epoch == "step" else -(-self.epochs * pieces // self.batch)
        if self.epoch == "step" and self.batch <= pieces:
            return np.stack([draw.permutation(pieces)[: self.batch] for _ in range(steps)])
        passes = -(-steps * self.batch // pieces)
        order = np.concatenate([draw.permutation(pieces) for _ in range(passes)])
        return order[: steps * self.batch].reshape(steps, self.batch)


class Moving(NamedTuple):
    """What training changes, S models in rows (S, P): weights, where these began, mean gradient, mean square."""

    theta: Tensor
    began: Tensor
    first: Tensor
    second: Tensor


def cosine(steps: int, start: float = 0.0, stop: float = 1.0) -> Floats:
    """(steps,) factors (1 + cos(pi s)) / 2 of the learning rate, s running from start to stop of the training.

    >>> cosine(2).round(3).tolist()
    [1.0, 0.5]
    """
    where = start + (stop - start) * np.arange(steps) / max(steps, 1)
    factors: Floats = 0.5 * (1.0 + np.cos(np.pi * where))
    return factors


def clip(gradient: Tensor, limit: float) -> Tensor:
    """Gradients (S, P), each scaled to a norm of at most `limit`.

    >>> clip(torch.tensor([[3.0, 4.0]]), 1.0).norm().round(decimals=3).item()
    1.0
    """
    norm = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    return gradient * torch.clamp(limit / (norm + 1e-6), max=1.0)


def adamw(
    theta: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: Tensor, decay: float
) -> None:
    """One AdamW step in place for S models: theta, gradient and moments (S, P), step >= 1, rate (S, 1).

    Row by row the same as `torch.optim.AdamW` (beta 0.9, 0.999); stacked, because rows may end at different steps.

    Source: Loshchilov and Hutter, ICLR 2019, algorithm 2.
    """
    theta.mul_(1.0 - rate * decay)
    first.lerp_(gradient, 0.1)
    second.lerp_(gradient.square(), 0.001)
    size = (second / (1.0 - 0.999**step)).sqrt_().add_(1e-8)
    theta.addcdiv_(first * (-rate / (1.0 - 0.9**step)), size)


def advance(
    theta: Tensor, gradient: Tensor, began: Tensor, first: Tensor, second: Tensor, losses: Tensor,
    rows: Sequence[int], step: int, rates: Sequence[float], schedule: Schedule,
) -> Tensor:  # fmt: skip
    """One optimiser step in place for `rows` of theta and moments (S, P); whether each could be taken, (R,) booleans.

    The gradient of the penalties gamma ||theta||^2 + mu / 2 ||theta - began||^2 is added, the sum clipped, and AdamW
    moves the weights; a row whose loss or gradient is not finite stays as it is. Compiled where numba is installed.

    Args:
        gradient, losses: (R, P) and (R,) of the rows. began: (S, P), where training started. step: >= 1.
    """
    if engine := _compiled():
        finite = np.empty(len(rows), np.bool_)
        engine.advance(*(a.numpy() for a in (theta, gradient, began, first, second, losses)), np.array(rows), step,
                       np.array(rates), float(schedule.weight_decay), float(schedule.l2), float(schedule.proximal),
                       float(schedule.clip), finite)  # fmt: skip
        return torch.from_numpy(finite)
    good = losses.isfinite() & gradient.isfinite().all(1)
    at = torch.tensor(rows)[good]
    mine, m, v = theta[at], first[at], second[at]
    rate = torch.tensor(rates, dtype=theta.dtype)[good, None]
    pulled = gradient[good] + 2 * schedule.l2 * mine + schedule.proximal * (mine - began[at])
    adamw(mine, clip(pulled, schedule.clip), m, v, step, rate, schedule.weight_decay)
    theta[at], first[at], second[at] = mine, m, v
    return good


def _compiled() -> ModuleType | None:
    """The compiled step; None where numba is missing."""
    if not numba_is_there("AdamW runs in torch, several times slower than compiled"):
        return None
    from ..engine import optimiser

    return optimiser


def generator(draw: np.random.Generator) -> torch.Generator:
    """A torch generator seeded by a keyed NumPy stream."""
    made = torch.Generator()
    made.manual_seed(int(draw.integers(2**62)))
    return made
