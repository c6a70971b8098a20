"""LearnedGain: a trained net as a method, Recording -> Track, and GainStream: one that filters step by step."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from coopoc.arrays import Bools, Floats, check_fields
from coopoc.errors import InputError, shown
from coopoc.kernels.compiling.waiting import clock
from coopoc.methods.kalman import solo_track
from coopoc.methods.motion_history import MotionHistory, three
from coopoc.methods.track import Alone, Track, in_stretches, start_of
from coopoc.text import short_repr
from coopoc.world.recording import Recording, Vehicles, check_recording

from .training.schedule import one_core


class GainStream:
    """A net, step by step: `step` takes the new measurements and returns the estimate.

    The origin of the net's positions moves along with the estimate: float32 is as accurate after a day as after a step.

    Args:
        model: the net, as `nets.gain.Recurrent`.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, model: Any, x0: ArrayLike | None, history: float) -> None:
        self.history, self._model = MotionHistory(history), model
        self._x: Floats = np.full(3, np.nan) if x0 is None else three("x0", x0)
        self._start, self._moves = self._x, np.zeros(3, bool)
        self._memory = model.start(torch.zeros((1, 3), dtype=next(model.parameters()).dtype))

    @one_core()
    def step(self, gnss: ArrayLike | None, velocity: ArrayLike, dt: float, fix_age: float = 0.0) -> tuple[Floats, None]:
        """Position (3,) m, NaN before the first fix, as `FilterStream.step`; a net has no covariance.

        A fix of NaN only predicts.
        """
        self.history.check(gnss, velocity, dt, fix_age)
        moved = dt * np.asarray(velocity, float)
        self.history.push(dt, moved, np.zeros(3))
        fix, _ = self.history.forward(gnss, fix_age)
        if np.isnan(self._x).all():
            self._x = self._start = fix
            return fix.copy(), None
        given = fix - self._x, np.array(velocity, float)
        near, speed = (torch.as_tensor(a[None], dtype=self._memory.x.dtype) for a in given)
        with torch.inference_mode():
            memory, _ = self._model.step(self._memory, near, speed, float(dt))
            positions = [name for name in self._model.positions if name in memory._fields]
            self._memory = memory._replace(**{name: getattr(memory, name) - memory.x for name in positions})
        self._x = self._x + memory.x[0].numpy()
        self._moves |= moves(fix - self._start, moved)
        return np.where(self._moves, self._x, self._start), None


@dataclass(frozen=True, eq=False)
class LearnedGain(Alone):
    """Position from own fixes and velocities with the gain of a net; no messages are exchanged.

    x_prior = x + dt u;  x <- x_prior + K (z - x_prior). The track has no covariance. Estimates are relative to the
    first fix, so that float32 costs no accuracy far from the origin.

    Args:
        model: trained net, as `nets.gain.Recurrent`.
        name: label in tables.
        x0: (R, E, 3) or (E, 3) m, an exact start as in KalmanNet's published loop; None starts at the first fix.

    References:
        arXiv 2411.05847, equations 4-6 and section II.B.

    >>> from coopoc.learned import GainNet
    >>> LearnedGain(GainNet()).message.payload
    0
    """

    model: Callable[..., Any]
    name: str = "fedkalmannet"
    x0: Floats | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self)
        if not callable(self.model) or not callable(getattr(self.model, "start", None)):
            raise InputError("model", shown(self.model), "must be a net with start and step", "Give GainNet().")

    def start(self, x0: ArrayLike | None = None, *, history: float = 10.0) -> GainStream:
        """The net as a stream, one step at a time (docs/streaming.md).

        Args:
            x0: (3,) m, the exact start; None starts at the first fix.
            history: s, the oldest fix that is accepted.

        >>> from coopoc.learned import GainNet
        >>> LearnedGain(GainNet(2, 1)).start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        (array([1., 2., 0.]), None)
        """
        return GainStream(self.model, x0, history)

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Estimates of the egos, all runs at once; `notes` say where fixes contradict them."""
        began, columns = clock(), check_recording(recording).columns(egos, self.x0 is None)
        fixes, speeds = recording.gnss[:, :, columns], recording.velocity[:, :, columns]
        origin = start_of(self.x0, fixes[:, 0])[:, None]
        off, speeds = fixes[:, 1:] - origin, speeds[:, 1:]
        model: Any = self.model
        with one_core(), torch.inference_mode():
            theta = nn.utils.parameters_to_vector(model.parameters())[None]
            moved = model.rollout(theta, _lanes(off), _lanes(speeds), _lanes(0.0 * origin)[0], recording.dt).numpy()
        moved = np.moveaxis(moved.reshape(-1, recording.runs, len(columns), 3), 0, 1)
        moved = np.where(np.logical_or.accumulate(moves(off, speeds), axis=1), moved, 0.0)
        estimates = np.hstack([origin, origin + moved])
        unused = ("the net does not use the standard deviations that fixes state",) * bool(recording.fix_factor.size)
        return solo_track(recording, columns, estimates, None, began, unused)


def moves(off: Floats, speeds: Floats) -> Bools:
    """Where a fix is off the start, or the odometry moves. Until then the start is held: a net has no height for a
    drive in one plane."""
    return np.asarray((abs(off) > 0.0) | (speeds != 0.0))


def _lanes(array: Floats) -> Tensor:
    """(T, 1, R E, 3) for the net of (R, T, E, 3)."""
    lanes = np.moveaxis(array, 1, 0).reshape(array.shape[1], 1, -1, 3)
    return torch.from_numpy(np.ascontiguousarray(lanes, np.float32))
