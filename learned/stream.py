"""Streaming of learned filters: a net's gain, or trained noise numbers, fed one step at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from coopoc.arrays import Floats
from coopoc.methods.kalman import Gaussian, SoloKalman
from coopoc.methods.stream import Stream, white

from .nets.gain_net import GainNet, Memory
from .training.machine import one_core

if TYPE_CHECKING:
    from .nets.okf import OptimisedKF

POSITIONS = ("x", "x_before", "prior_before", "gnss_before")
"""What of a net's memory is a place, m; the rest has no origin."""


class Driven(NamedTuple):
    """A net on its way: origin (3,) m of the positions in its memory (one lane), and its last gain (3, 3)."""

    origin: Floats
    memory: Memory
    gain: Floats


@dataclass(frozen=True, eq=False)
class SoloGain:
    """A net as a `Solo`. It claims no covariance, so how late a fix is changes nothing but the fix.

    The origin moves along with the estimate, so that the net's float32 is as good after a day as after a step.
    """

    model: GainNet

    def begin(self, x: Floats, late: Floats | None) -> Driven:
        """The net's first memory, at x."""
        like = next(self.model.parameters())
        return Driven(x, self.model.start(torch.zeros((1, 3), dtype=like.dtype)), np.full((3, 3), np.nan))

    def process(self, velocity: Floats, dt: float) -> Floats:
        """Nothing: the net knows no variances."""
        return np.zeros(3)

    @one_core()
    def advance(self, state: Driven, moved: Floats, process: Floats, fix: Floats, late: Floats) -> Driven:
        """`GainNet.step` with the motion as a velocity over one second; a fix of NaN only predicts."""
        kind = state.memory.x.dtype
        near, step = (torch.as_tensor(a[None], dtype=kind) for a in (fix - state.origin, moved))
        with torch.inference_mode():
            memory, gain = self.model.step(state.memory, near, step, 1.0)
            here = memory.x
            memory = memory._replace(**{name: getattr(memory, name) - here for name in POSITIONS})
        return Driven(state.origin + here[0].numpy(), memory, gain[0].numpy())

    def read(self, state: Driven) -> tuple[Floats, None]:
        """The estimate."""
        return state.origin, None


def gain_stream(model: GainNet, x0: npt.ArrayLike | None = None, history: float = 10.0) -> Stream[Driven]:
    """A net that is fed step by step; dt and velocity enter through their product only.

    Args:
        x0: (3,) m, known before the first step; None starts at the first fix. history: s, how old a fix may be.

    >>> gain_stream(GainNet(2, 1)).step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
    (array([1., 2., 0.]), None)
    """
    return Stream(SoloGain(model), x0, history)


def okf_stream(
    method: OptimisedKF, x0: npt.ArrayLike | None = None, interval: float = 0.1, history: float = 10.0
) -> Stream[Gaussian]:
    """The optimised Kalman filter that is fed step by step: x0, interval (dt of its training) and history as in
    `Kalman.start`; variance of motion dt / interval (a^2 + (b interval u)^2).

    >>> from coopoc.learned import OptimisedKF
    >>> okf_stream(OptimisedKF((1.0,) * 3, (0.0,) * 3, (1.0,) * 3)).step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)[0]
    array([1., 2., 0.])
    """

    def step(velocity: Floats) -> Floats:
        moved = np.array(method.velocity_ratio) * interval * velocity
        return np.asarray(np.square(method.process_std) + moved**2)

    return Stream(SoloKalman(white(step, interval), np.square(method.gnss_std)), x0, history)
