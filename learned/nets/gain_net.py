"""GainNet: the three-GRU KalmanNet gain for a position state with a velocity control, by steps and compiled."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from coopoc.arrays import AnyArray, number, seed_of, whole
from coopoc.errors import InputError

from ..engine import backward, forward
from ..engine.backward import Moments, Outcome, Update
from ..engine.forward import Drives, State
from ..engine.layers import CELLS, SHORTEST_LENGTH, STATE_SIZE, plan_of
from ..training.clients import Batch
from .gain import Recurrent


class GainNet(Recurrent):
    """Kalman gain from three GRUs that stand for process noise, prior covariance and innovation covariance.

    x_prior = x + dt u;  K = net(features);  x <- x_prior + K (z - x_prior).
    Features, each divided by its own Euclidean norm: fix change z - z_before, innovation z - x_prior, evolution
    x - x_before, update x - prior_before. With in_mult i and out_mult o there are 390 i + 504 o + 1818 parameters:
    (40, 5) has 19,938, the paper's "almost 20K". A fix is missing where all of it is NaN: the step only predicts, and
    the GRU states, the last fix and the last prior do not change.

    The start is a stable closed loop, K near `start_gain` times the identity; torch's own is unstable for most seeds.

    Args:
        in_mult: width of the layers that feed the GRUs.
        out_mult: width of the layer that forms the gain.
        start_gain: diagonal of the untrained gain; the last layer's random weights are then scaled by 0.1.
        seed: of the initial weights.

    References:
        Revach et al., KalmanNet, IEEE TSP 2022 (architecture 2).
        arXiv 2411.05847, section II.B.

    >>> sum(p.numel() for p in GainNet().parameters())
    19938
    """

    def __init__(self, in_mult: int = 40, out_mult: int = 5, start_gain: float = 0.1, seed: int = 0) -> None:
        super().__init__()
        hint = "The shipped nets have 5 to 40."  # the card of a checkpoint may hold anything
        self.in_mult = whole("in_mult", in_mult, 1, 1024, hint)
        self.out_mult = whole("out_mult", out_mult, 1, 1024, hint)
        start_gain = number("start_gain", start_gain, -np.inf)
        wide, both, linear = STATE_SIZE * in_mult, 2 * CELLS, nn.Linear
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(seed))
            self.update = linear(STATE_SIZE, wide)
            self.evolution = linear(STATE_SIZE, wide)
            self.observation = linear(2 * STATE_SIZE, 2 * wide)
            self.process = nn.GRUCell(wide, CELLS)
            self.prior = nn.GRUCell(CELLS + wide, CELLS)
            self.prior_to_innovation = linear(CELLS, CELLS)
            self.innovation = nn.GRUCell(CELLS + 2 * wide, CELLS)
            self.gain_hidden = linear(both, both * out_mult)
            self.gain = linear(both * out_mult, CELLS)
            self.posterior_hidden = linear(both, CELLS)
            self.posterior = linear(both, CELLS)
        self.shapes = tuple((name, tuple(parameter.shape)) for name, parameter in self.named_parameters())
        with torch.no_grad():
            self.gain.weight.mul_(0.1)
            self.gain.bias.copy_(start_gain * torch.eye(STATE_SIZE).flatten())

    def descend(self, moments: Moments, batch: Batch, update: Update) -> Outcome:
        """One optimiser step as in `Gain`; each model goes from rollout to new weights before the next one begins.

        References:
            Werbos, Proc. IEEE 1990 (backpropagation through time).
        """
        theta, plan, models = torch.from_numpy(moments.theta), plan_of(self.shapes), len(update.rows)
        drives = self._checked(theta, models, batch.gnss, batch.velocity, batch.x0, batch.dt)
        truth = _array(batch.truth, theta.dtype)
        if truth.shape != drives.gnss.shape:
            hint = "Give one position per fix."
            raise InputError("truth", f"shape {truth.shape}", f"must be {drives.gnss.shape}", hint)
        gradient, losses = np.empty((models, plan.places.shape[1]), truth.dtype), np.empty(models, truth.dtype)
        outcome = Outcome(gradient, losses, np.empty(models, np.bool_))
        backward.descend(moments, plan, drives, truth, outcome, update)
        return outcome

    def start(self, x0: Tensor) -> State:
        """Memory before the first step: estimate x0 (B, 3) m, which is also the last fix; GRU states I, 0, I."""
        unit = torch.eye(STATE_SIZE, dtype=x0.dtype).flatten().expand(len(x0), CELLS)
        return State(unit, torch.zeros_like(unit), unit, x0, x0, x0, x0)

    def step(self, memory: State, gnss: Tensor, velocity: Tensor, dt: float | Tensor) -> tuple[State, Tensor]:
        """One step: fix (B, 3) m, velocity (B, 3) m/s, dt s -> new memory (its `x` is the estimate), gain (B, 3, 3).

        The gain of a missing fix is zero. The compiled engine is tested against this text.
        """
        missing = gnss.isnan().all(1, keepdim=True)
        fix = torch.where(missing, memory.gnss_before, gnss)
        x_prior = memory.x + dt * velocity
        observed = torch.cat([_direction(fix - memory.gnss_before), _direction(fix - x_prior)], 1)
        evolved = _direction(memory.x - memory.x_before)
        updated = _direction(memory.x - memory.prior_before)

        process = self.process(self.update(updated).relu(), memory.process)
        prior = self.prior(torch.cat([process, self.evolution(evolved).relu()], 1), memory.prior)
        expected = self.prior_to_innovation(prior).relu()
        innovation = self.innovation(torch.cat([expected, self.observation(observed).relu()], 1), memory.innovation)
        gain = self.gain(self.gain_hidden(torch.cat([prior, innovation], 1)).relu())
        back = self.posterior_hidden(torch.cat([innovation, gain], 1)).relu()
        posterior = self.posterior(torch.cat([prior, back], 1)).relu()

        matrix = torch.where(missing, 0.0, gain).view(-1, STATE_SIZE, STATE_SIZE)
        x = x_prior + (matrix @ (fix - x_prior).unsqueeze(-1)).squeeze(-1)
        new = State(process, posterior, innovation, x, memory.x, x_prior, fix)
        held = memory._replace(x=x, x_before=memory.x)
        return State(*(torch.where(missing, old, now) for old, now in zip(held, new, strict=True))), matrix

    def rollout(self, theta: Tensor, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """Estimates (T, S, B, 3) m as in `Recurrent`; compiled where no gradient is wanted.

        x_t = x_{t-1} + dt u_t + K_t (z_t - x_{t-1} - dt u_t). The numbers of a model do not depend on the others.

        Raises:
            InputError: arrays that do not fit together, or theta neither float32 nor float64 in main memory.

        References:
            arXiv 2411.05847, equations 4-6.

        >>> still = torch.zeros(5, 1, 2, 3)
        >>> GainNet().rollout(torch.zeros(1, 19938), still, still, still[0], 0.1).abs().max().item()
        0.0
        """
        if torch.is_grad_enabled() and theta.requires_grad:
            return super().rollout(theta, gnss, velocity, x0, dt)
        drives = self._checked(theta, len(theta), gnss, velocity, x0, dt)
        x = np.empty_like(drives.gnss)
        forward.forward(_array(theta, theta.dtype), plan_of(self.shapes), drives, x)
        return torch.from_numpy(x)

    def _checked(self, theta: Tensor, models: int, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: Any) -> Drives:
        """The inputs of so many models as contiguous arrays of theta's dtype."""
        if theta.dtype not in (torch.float32, torch.float64) or theta.device.type != "cpu":
            actual = f"{theta.dtype} on {theta.device}"
            raise InputError("theta", actual, "must be float32 or float64 in main memory", "Use theta.cpu().float().")
        steps, lanes = gnss.shape[0], gnss.shape[2]
        wanted = {
            "theta": (theta, (len(theta), plan_of(self.shapes).places.shape[1])),
            "gnss": (gnss, (steps, models, lanes, 3)),
            "velocity": (velocity, (steps, models, lanes, 3)),
            "x0": (x0, (models, lanes, 3)),
        }
        for name, (array, shape) in wanted.items():
            if array.shape != shape:
                raise InputError(name, f"shape {tuple(array.shape)}", f"must be {shape}", "See rollout.")
        fixes, speeds, start = (_array(each, theta.dtype) for each in (gnss, velocity, x0))
        spans = np.asarray(dt, fixes.dtype)
        if spans.shape not in ((), (steps,)):
            raise InputError("dt", f"shape {spans.shape}", f"must be one number or ({steps},)", "Give s per step.")
        return Drives(fixes, speeds, start, np.broadcast_to(spans, steps).copy())


def _direction(change: Tensor) -> Tensor:
    """Changes (B, 3) m divided by their lengths, zero where there is none."""
    length = torch.linalg.vector_norm(change, dim=1, keepdim=True)
    return torch.where(length > SHORTEST_LENGTH, change / length.clamp_min(SHORTEST_LENGTH), 0.0)


def _array(tensor: Tensor, dtype: torch.dtype) -> AnyArray:
    """The same numbers as a contiguous array, without a copy where possible."""
    if tensor.dtype != dtype or not tensor.is_contiguous() or tensor.requires_grad:
        tensor = tensor.detach().to(dtype).contiguous()
    return tensor.numpy()
