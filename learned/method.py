"""LearnedGain: a trained GainNet as a method, Recording -> Track."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.methods.stream import Stream
from coopoc.methods.track import Track
from coopoc.world.recording import Recording
from coopoc.world.v2x import NO_MESSAGE, Message

from .nets.gain_net import SIZE, GainNet
from .stream import Driven, gain_stream
from .training.machine import one_core


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """What the paper calls the net's covariance estimates, by name; none of them is a covariance.

    A GRU state is a running mix of tanh values and so stays in [-1, 1] whatever the noise; it need not be symmetric or
    positive. `posterior` is K times the assumed GNSS covariance, which equals the posterior covariance only if K is the
    optimal gain. All (R, T, E, 3, 3), the first step NaN; where a fix is missing the gain is zero and the states stay.
    """

    gain: Floats
    process: Floats
    prior: Floats
    innovation: Floats
    posterior: Floats


@dataclass(frozen=True, eq=False)
class LearnedGain:
    """Position from own fixes and velocities with the gain of a net; nothing is received or sent while driving.

    x_prior = x + dt u;  x <- x_prior + K (z - x_prior). It claims no covariance. Estimates are made relative to the
    start, so that float32 costs no accuracy far from the origin.

    Args:
        model: trained net. name: in tables. x0: (R, E, 3) or (E, 3) m, a known start as in KalmanNet's
            published loop; None starts at the first fix.

    Source: arXiv 2411.05847, equations 4-6 and section II.B.

    >>> LearnedGain(GainNet()).message.payload
    0
    """

    model: GainNet
    name: str = "fedkalmannet"
    x0: Floats | None = None
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def start(self, x0: npt.ArrayLike | None = None, *, history: float = 10.0) -> Stream[Driven]:
        """The net that is fed step by step (docs/streaming.md)."""
        return gain_stream(self.model, x0, history)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates of the egos, all runs at once; `notes` name the runs that left the fixes behind."""
        began, columns = time.perf_counter(), recording.columns(egos, missing=True)
        x0, origin = self._x0(recording, columns), recording.gnss[:, :1, columns]
        with one_core(), torch.inference_mode():
            moved = self.model(*self._lanes(recording, columns), recording.dt).numpy().astype(np.float64)
        moved = np.moveaxis(moved.reshape(recording.runs, len(columns), -1, SIZE), 2, 1)
        estimates = np.concatenate([x0[:, None], moved + origin], axis=1)
        silent = np.zeros((recording.runs, len(columns)))
        seconds = time.perf_counter() - began
        notes = tuple(_divergence(estimates, recording, columns))
        return Track(recording.t, tuple(columns), estimates, None, silent, silent, seconds, notes=notes)

    def diagnostics(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Diagnostics:
        """Gain, GRU states and K times the GNSS covariance at every step, with the caveat of `Diagnostics`."""
        columns = recording.columns(egos, missing=True)
        gnss, velocity, x0 = self._lanes(recording, columns)
        states: list[tuple[Tensor, ...]] = [(torch.full((len(x0), SIZE**2), torch.nan),) * 4]
        with one_core(), torch.inference_mode(), _heard(self.model) as heard:
            memory = self.model.start(x0)
            for fix, speed in zip(gnss.unbind(1), velocity.unbind(1), strict=True):
                memory, gain = self.model.step(memory, fix, speed, recording.dt)
                missing = fix.isnan().all(1, keepdim=True)
                kept = [torch.where(missing, old, new) for old, new in zip(states[-1][1:], heard, strict=True)]
                states.append((gain.flatten(1), *kept))
        found = torch.stack([torch.stack(step) for step in states]).double().numpy()
        found = found.reshape(len(states), 4, recording.runs, len(columns), SIZE, SIZE).transpose(1, 2, 0, 3, 4, 5)
        posterior = found[0] * np.square(np.array(recording.sensors.gnss_std))
        return Diagnostics(found[0], found[1], found[2], found[3], posterior)

    def _lanes(self, recording: Recording, columns: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Fixes and velocities (R E, T - 1, 3) and starts (R E, 3) for the net, relative to the first fix."""
        origin = recording.gnss[:, :1, columns]

        def lanes(array: Floats) -> Tensor:
            flat = np.moveaxis(array, 1, 2).reshape(-1, array.shape[1], SIZE)
            return torch.from_numpy(np.ascontiguousarray(flat, dtype=np.float32))

        gnss, velocity = recording.gnss[:, 1:, columns] - origin, recording.velocity[:, 1:, columns]
        return lanes(gnss), lanes(velocity), lanes(self._x0(recording, columns)[:, None] - origin)[:, 0]

    def _x0(self, recording: Recording, columns: list[int]) -> Floats:
        """(R, E, 3) m, where the filter starts."""
        fixes: Floats = recording.gnss[:, 0, columns]
        if self.x0 is None:
            return fixes
        if np.shape(self.x0) not in (fixes.shape, fixes.shape[1:]):
            allowed = f"must be (R, E, 3) = {fixes.shape} or (E, 3)"
            raise InputError("x0", f"shape {np.shape(self.x0)}", allowed, "Give one position per ego.")
        return np.broadcast_to(self.x0, fixes.shape)


@contextmanager
def _heard(model: GainNet) -> Iterator[list[Tensor]]:
    """What the GRUs of process, prior and innovation gave at the last step, kept up to date inside."""
    heard = [torch.empty(0)] * 3
    hooks = [cell.register_forward_hook(lambda _, __, state, at=at: heard.__setitem__(at, state))
             for at, cell in enumerate((model.process, model.prior, model.innovation))]  # fmt: skip
    try:
        yield heard
    finally:
        for hook in hooks:
            hook.remove()


DIVERGED = 10.0
"""Standard deviations (norm of the assumed GNSS std) between estimate and fix beyond which a run counts as lost."""


def _divergence(x: Floats, recording: Recording, columns: list[int]) -> list[str]:
    """A note if an estimate is ever farther from its fix than `DIVERGED` standard deviations."""
    limit = DIVERGED * float(np.linalg.norm(recording.sensors.gnss_std))
    gap = np.linalg.norm(x - recording.gnss[:, :, columns], axis=-1)
    lost = int((gap > limit).any(axis=1).sum())
    total = gap.shape[0] * gap.shape[2]
    return [f"diverged in {lost} of {total} runs (over {limit:.0f} m from the fix)"] if lost else []
