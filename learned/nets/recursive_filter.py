"""RecursiveFilter: a trained RecursiveGain as a method, Recording -> Track with its covariance, and step by step."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.methods.stream import Stream, solo_track
from coopoc.methods.track import Track
from coopoc.world.recording import Recording
from coopoc.world.v2x import NO_MESSAGE, Message

from ..method import _divergence
from ..training.machine import one_core
from .levels import GNSS_STD, STILL
from .recursive import Memory, RecursiveGain


class Running(NamedTuple):
    """A net on its way: its memory, one lane per filter, and the shape (..., 3) of the positions."""

    memory: Memory
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SoloRecursive:
    """A net as a `Solo`, in double precision."""

    model: RecursiveGain

    def begin(self, x: Floats, late: Floats | None) -> Running:
        """Exact (late None), or as uncertain as a fix and `late` m^2 more."""
        start, shape = _lanes(x, x.shape), x.shape
        memory = self.model.start(start, torch.full((len(start),), late is None))
        if late is not None:
            more = _lanes(late, shape)
            memory = memory._replace(spread=memory.spread + more / GNSS_STD**2, variance=memory.variance + more)
        return Running(memory, shape)

    def process(self, velocity: Floats, dt: float) -> Floats:
        """Variance (3,) m^2 of an axis that stands still, which tells `advance` how long the step is."""
        return np.full(3, (dt * STILL) ** 2)

    @one_core()
    def advance(self, state: Running, moved: Floats, process: Floats, fix: Floats, late: Floats) -> Running:
        """`RecursiveGain.step`; a fix of NaN only predicts."""
        dt = float(np.sqrt(process[0])) / STILL
        step, seen, more = (_lanes(a, state.shape) for a in (moved / dt, fix, late))
        with torch.inference_mode():
            return Running(self.model.step(state.memory, seen, step, dt, more)[0], state.shape)

    def read(self, state: Running) -> tuple[Floats, Floats]:
        """Position and diagonal covariance."""
        x, variance = (a.numpy().reshape(state.shape) for a in (state.memory.x, state.memory.variance))
        return x, variance[..., None] * np.eye(3)


def _lanes(array: Floats, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(np.broadcast_to(array, shape).reshape(-1, 3).astype(np.float64))


@dataclass(frozen=True, eq=False)
class RecursiveFilter:
    """Position and covariance from own fixes and velocities with a RecursiveGain; nothing is received or sent.

    Where a fix is missing it predicts only. It trained at 10 Hz; dt is an input.

    Args:
        model: trained net. name: in tables. x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.

    Source: Mortada et al., Recursive KalmanNet, EUSIPCO 2025 (arXiv 2506.11639).

    >>> RecursiveFilter(RecursiveGain()).message.payload
    0
    """

    model: RecursiveGain
    name: str = "recursive"
    x0: Floats | None = None
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def start(self, x0: npt.ArrayLike | None = None, *, history: float = 10.0) -> Stream[Running]:
        """The filter that is fed step by step (docs/streaming.md).

        >>> x, covariance = RecursiveFilter(RecursiveGain()).start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        >>> x.tolist(), covariance.trace().item()
        ([1.0, 2.0, 0.0], 18.75)
        """
        return Stream(self._solo(), x0, history)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates and covariances of the egos; `notes` name the runs that left the fixes behind."""
        track = solo_track(self._solo(), recording, egos, self.x0)
        return replace(track, notes=tuple(_divergence(track.x, recording, list(track.egos))))

    def _solo(self) -> SoloRecursive:
        return SoloRecursive(copy.deepcopy(self.model).double())
