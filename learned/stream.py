"""A net that filters step by step, as a `Solo`: one step at a time, near its own origin."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from coopoc.arrays import Floats

from .training.machine import one_core


class StepByStep(Protocol):
    """Protocol of a net for `LearnedGain`; `nets.gain.Recurrent` satisfies it."""

    positions: tuple[str, ...]

    def start(self, x0: Tensor) -> Any:
        """The memory before the first step at x0 (B, 3) m: a NamedTuple whose field `x` is the estimate."""

    def step(self, memory: Any, gnss: Tensor, velocity: Tensor, dt: float | Tensor) -> tuple[Any, Tensor]:
        """The memory after a step, and the gain (B, 3, 3)."""

    def parameters(self) -> Iterator[nn.Parameter]:
        """The weights."""

    def __call__(self, gnss: Tensor, velocity: Tensor, x0: Tensor, dt: float | Tensor) -> Tensor:
        """The estimates (B, T, 3) m."""


class GainState(NamedTuple):
    """The state of a streamed net: origin (3,) m of its memory's positions, memory (one lane), last gain (3, 3)."""

    origin: Floats
    memory: Any
    gain: Floats


@dataclass(frozen=True, eq=False)
class SoloGain:
    """A net as a `Solo`. It has no covariance, so the age of a fix changes nothing but the fix.

    The origin moves along with the estimate: the net's float32 is as accurate after a day as after a step.
    """

    model: StepByStep

    def begin(self, x: Floats, late: Floats | None) -> GainState:
        """The net's first memory, at x."""
        like = next(iter(self.model.parameters()))
        return GainState(x, self.model.start(torch.zeros((1, 3), dtype=like.dtype)), np.full((3, 3), np.nan))

    def process(self, velocity: Floats, dt: float) -> Floats:
        """Zeros: the net has no process noise."""
        return np.zeros(3)

    @one_core()
    def advance(self, state: GainState, moved: Floats, process: Floats, fix: Floats, late: Floats) -> GainState:
        """`step` with the motion as a velocity over one second; a fix of NaN only predicts."""
        kind = state.memory.x.dtype
        near, step = (torch.as_tensor(a[None], dtype=kind) for a in (fix - state.origin, moved))
        with torch.inference_mode():
            memory, gain = self.model.step(state.memory, near, step, 1.0)
            here = memory.x
            positions = [name for name in self.model.positions if name in memory._fields]
            memory = memory._replace(**{name: getattr(memory, name) - here for name in positions})
        return GainState(state.origin + here[0].numpy(), memory, gain[0].numpy())

    def read(self, state: GainState) -> tuple[Floats, None]:
        """The estimate."""
        return state.origin, None
