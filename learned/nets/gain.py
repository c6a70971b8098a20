"""Protocol of a net for training, federation, checkpoints, streams and studies: `Gain`, and `Recurrent` for one by
steps.

A net of your own is one class in one file. Subclass `Recurrent` and write

    start(x0) -> memory              a NamedTuple; its field `x` is the estimate
    step(memory, gnss, velocity, dt) -> (memory, gain)

and everything else follows: the training loss, a rollout of many nets, the method (Recording -> Track), the stream.
Where the loss or the method differs, subclass `Gain` and write `losses(theta, batch)` and `method(name, x0)`. The truth
of a batch is NaN where there is no truth; `squared_error` and `over_time` leave these steps out.
Arguments of the constructor that are kept as attributes of the same name make the net again from a checkpoint.
"""

import copy
import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from coopoc import Method
from coopoc.arrays import Floats

from ..engine.backward import Moments, Outcome, Update, advance
from ..method import LearnedGain
from ..training.clients import Batch, Segments

Net = TypeVar("Net", bound=nn.Module)


class Gain(nn.Module, ABC):
    """A trainable filter; many nets of one shape are trained together, their flat weights as rows of theta (S, P)."""

    trainable: ClassVar[bool] = True
    """Studies and commands train it first when it is named as a method."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """The constructor's arguments that are attributes of the net: what makes a net of this shape again."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters if hasattr(self, name)}

    @abstractmethod
    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """Training loss (S, B) of every segment for S nets with weights theta (S, P), differentiable in theta."""

    @abstractmethod
    def method(self, name: str, x0: Floats | None = None) -> Method:
        """This net as a method, Recording -> Track, from the first fix or an exact start (R, E, 3) or (E, 3) m."""

    def calibrate(self, parts: Sequence[Segments]) -> "Gain":
        """The trained net, with what the loss cannot see set from the training segments of each client."""
        return self

    def descend(self, moments: Moments, batch: Batch, update: Update) -> Outcome:
        """One optimiser step in place of the rows (R,) of weights and moments, by their segments in a batch: losses are
        means over the batch."""
        with torch.enable_grad():
            leaf = torch.from_numpy(moments.theta[update.rows]).requires_grad_()
            losses = self.losses(leaf, batch).mean(1)
            (gradient,) = torch.autograd.grad(losses.sum(), leaf)
        outcome = Outcome(gradient.numpy(), losses.detach().numpy(), np.empty(len(losses), np.bool_))
        advance(moments, outcome, update)
        return outcome


class Recurrent(Gain):
    """A net that filters step by step and is trained on the squared error of its estimates."""

    positions: tuple[str, ...] = ("x", "x_before", "prior_before", "gnss_before")
    """Fields of the memory that are positions, m; a stream moves their origin along."""

    @abstractmethod
    def start(self, x0: Tensor) -> Any:
        """Memory before the first step at x0 (B, 3) m: a NamedTuple of tensors (B, ...) whose field `x` is x0."""

    @abstractmethod
    def step(self, memory: Any, gnss: Tensor, velocity: Tensor, dt: float | Tensor) -> tuple[Any, Tensor]:
        """One step: fix (B, 3) m, NaN where it is missing, velocity (B, 3) m/s, dt s -> memory, gain (B, 3, 3)."""

    def forward(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (B, T, 3) m of T steps, one `step` after the other; differentiable in everything.

        Args:
            gnss: (B, T, 3) m.
            velocity: (B, T, 3) m/s.
            x0: (B, 3) m, the start.
            dt: s, or (T,) s.
        """
        memory, estimates = self.start(x0), []
        steps = torch.as_tensor(dt, dtype=gnss.dtype).expand(gnss.shape[1])
        for fix, speed, step in zip(gnss.unbind(1), velocity.unbind(1), steps.unbind(), strict=True):
            memory, _ = self.step(memory, fix, speed, step)
            estimates.append(memory.x)
        return torch.stack(estimates, 1)

    def rollout(self, theta: Tensor, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (T, S, B, 3) m of S nets of this shape with weights theta (S, P), differentiable in theta.

        Args:
            theta: (S, P) weights.
            gnss: (T, S, B, 3) m.
            velocity: (T, S, B, 3) m/s.
            x0: (S, B, 3) m.
            dt: s, or (T,) s.
        """
        rows, parameters = [], dict(self.named_parameters())
        for s, flat in enumerate(theta):
            parts = flat.split([p.numel() for p in parameters.values()])
            weights = {name: part.view_as(p) for (name, p), part in zip(parameters.items(), parts, strict=True)}
            inputs = gnss[:, s].transpose(0, 1), velocity[:, s].transpose(0, 1), x0[s], dt
            rows.append(torch.func.functional_call(self, weights, inputs).transpose(0, 1))
        return torch.stack(rows, 1)

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) squared error of each segment, mean over time, sum over components, m^2.

        References:
            arXiv 2411.05847, equation 7.
        """
        return squared_error(self.rollout(theta, batch.gnss, batch.velocity, batch.x0, batch.dt), batch.truth)

    def method(self, name: str, x0: Floats | None = None) -> Method:
        """`LearnedGain` with this net."""
        return LearnedGain(self, name, x0)


def squared_error(x: Tensor, truth: Tensor) -> Tensor:
    """|x - truth|^2 m^2 of positions (T, ..., 3), mean over time; steps without a truth (NaN) have no part in it, and
    no gradient.

    >>> squared_error(torch.ones(2, 3), torch.tensor([[3.0, 1.0, 1.0], [torch.nan] * 3])).item()
    4.0
    """
    there = truth.isfinite()
    return over_time(torch.where(there, x - truth, 0.0).square().sum(-1), there[..., 0])


def over_time(values: Tensor, counted: Tensor) -> Tensor:
    """Mean (...) over time of the values (T, ...) that are counted (T, ...), in an order that does not depend on the
    number of rows; 0 where none is.

    >>> over_time(torch.tensor([[1.0, 2.0], [6.0, 4.0]]), torch.tensor([[True, False], [True, True]])).tolist()
    [3.5, 4.0]
    """
    rows, there = values.movedim(0, -1).contiguous(), counted.movedim(0, -1)
    if there.all():
        return rows.mean(-1)
    return torch.where(there, rows, 0.0).sum(-1) / there.sum(-1).clamp(min=1)


def flatten(models: Sequence[nn.Module]) -> Tensor:
    """(S, P) weights of S models of one shape, in the order of `parameters()`.

    >>> flatten([nn.Linear(2, 3), nn.Linear(2, 3)]).shape
    torch.Size([2, 9])
    """
    return torch.stack([nn.utils.parameters_to_vector(m.parameters()).detach() for m in models])


def unflatten(weights: Tensor, like: Net) -> Net:
    """A new model shaped as `like` with the weights (P,)."""
    model = copy.deepcopy(like).eval()
    nn.utils.vector_to_parameters(weights.detach().clone(), model.parameters())
    return model
