"""Gain: what training, federation and checkpoints need of a net that filters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from coopoc.arrays import Floats, Ints
from coopoc.methods.track import Method

from ..training.clients import Batch, Pieces
from ..training.schedule import Moving, Schedule, advance


class Gain(nn.Module, ABC):
    """A net that filters fixes and velocities; many of one shape are trained together as rows of theta (S, P).

    Whoever writes another net gives its losses as a differentiable function of flat weights and has `fit`, `federate`,
    every aggregation rule, checkpoints and studies at once.
    """

    @property
    @abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """Arguments that make a net of this shape again."""

    @abstractmethod
    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """Training loss (S, B) of every piece for S nets with weights theta (S, P), differentiable in theta."""

    @abstractmethod
    def method(self, name: str, x0: Floats | None = None) -> Method:
        """This net as a method, Recording -> Track, from the first fix or a known start (R, E, 3) or (E, 3) m."""

    def finished(self, parts: Sequence[Pieces]) -> Gain:
        """The net after its training, with what the loss could not see set from the training pieces of each client."""
        return self

    def loss_and_gradient(self, theta: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Loss (S,), the mean over the batch, and its gradient (S, P) at theta (S, P)."""
        with torch.enable_grad():
            given = theta.detach().requires_grad_()
            means = self.losses(given, batch).mean(1)
            (gradient,) = torch.autograd.grad(means.sum(), given)
        return means.detach(), gradient

    def descend(
        self, moving: Moving, rows: Ints, batch: Batch, step: int, rates: Floats, schedule: Schedule
    ) -> tuple[Tensor, Tensor]:
        """One optimiser step (`schedule.advance`) in place: losses (R,) of the rows, and whether each could be taken.

        Args:
            moving: weights and moments (S, P). rows, rates: (R,). batch: what these R models see. step: >= 1.
        """
        losses, gradient = self.loss_and_gradient(moving.theta[rows], batch)
        taken = advance(moving.theta, gradient, *moving[1:], losses, rows.tolist(), step, rates.tolist(), schedule)
        return losses, taken


def over_time(losses: Tensor) -> Tensor:
    """Mean (S, B) of losses (T, S, B), added in an order that does not depend on how many rows stand side by side."""
    return losses.movedim(0, -1).contiguous().mean(-1)
