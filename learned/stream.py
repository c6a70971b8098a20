"""GainStream: a net that filters step by step, near its own origin."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from coopoc.arrays import Floats
from coopoc.methods.motion_history import MotionHistory, three

from .training.machine import one_core


class GainStream:
    """A net, step by step: `step` takes the new measurements and returns the estimate.

    The origin of the net's positions moves along with the estimate: float32 is as accurate after a day as after a step.

    Args:
        model: the net, as `nets.gain.Recurrent`.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, model: Any, x0: npt.ArrayLike | None, history: float) -> None:
        self.history, self._model = MotionHistory(history), model
        self._x: Floats = np.full(3, np.nan) if x0 is None else three("x0", x0)
        self._memory = model.start(torch.zeros((1, 3), dtype=next(model.parameters()).dtype))

    @one_core()
    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0
    ) -> tuple[Floats, None]:
        """Position (3,) m, NaN before the first fix, as `FilterStream.step`; a net has no covariance.

        The net gets the motion as a velocity over one second; a fix of NaN only predicts.
        """
        self.history.check(gnss, velocity, dt, fix_age)
        moved = dt * np.asarray(velocity, dtype=float)
        self.history.push(dt, moved, np.zeros(3))
        fix, _ = self.history.forward(gnss, fix_age)
        if np.isnan(self._x).all():
            self._x = fix
            return fix.copy(), None
        near, motion = (torch.as_tensor(a[None], dtype=self._memory.x.dtype) for a in (fix - self._x, moved))
        with torch.inference_mode():
            memory, _ = self._model.step(self._memory, near, motion, 1.0)
            positions = [name for name in self._model.positions if name in memory._fields]
            self._memory = memory._replace(**{name: getattr(memory, name) - memory.x for name in positions})
        self._x = self._x + memory.x[0].numpy()
        return self._x.copy(), None
