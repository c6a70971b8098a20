"""LearnedGain: a trained GainNet as a method, Recording -> Track."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import AnyArray, Floats
from coopoc.errors import InputError
from coopoc.methods.track import Track
from coopoc.world.recording import Recording
from coopoc.world.v2x import NO_MESSAGE, Message

from .machine import one_core
from .net import SIZE, GainNet
from .rollout import Step, steps
from .stack import flatten, layers


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """What the paper calls the net's covariance estimates, by name; none of them is a covariance.

    A GRU state is a running mix of tanh values and so stays in [-1, 1] whatever the noise; it need not be symmetric or
    positive. `posterior` is K times the assumed GNSS covariance, which equals the posterior covariance only if K is the
    optimal gain. All (R, T, E, 3, 3), the first step NaN.
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

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates of the egos, all runs at once; `notes` name the runs that left the fixes behind."""
        began, columns = time.perf_counter(), recording.columns(egos)
        x = self._scan(recording, columns, lambda step: step.x)
        origin = recording.gnss[:, :1, columns]
        x[:, 0] = self._x0(recording, columns)
        estimates = np.concatenate([x[:, :1], x[:, 1:] + origin], axis=1)
        silent = np.zeros((recording.runs, len(columns)))
        seconds = time.perf_counter() - began
        notes = tuple(_divergence(estimates, recording, columns))
        return Track(recording.t, tuple(columns), estimates, None, silent, silent, seconds, notes=notes)

    def diagnostics(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Diagnostics:
        """Gain, GRU states and K times the GNSS covariance at every step, with the caveat of `Diagnostics`."""
        columns = recording.columns(egos)

        def picture(step: Step) -> Tensor:
            return torch.stack([step.gain, step.process.after, step.prior.after, step.innovation.after], dim=2)

        found = self._scan(recording, columns, picture)
        gain, process, prior, innovation = np.moveaxis(found.reshape(*found.shape[:-1], SIZE, SIZE), 3, 0)
        posterior = gain * np.square(np.array(recording.sensors.gnss_std))
        return Diagnostics(gain, process, prior, innovation, posterior)

    def _x0(self, recording: Recording, columns: list[int]) -> Floats:
        """(R, E, 3) m, where the filter starts."""
        fixes: Floats = recording.gnss[:, 0, columns]
        if self.x0 is None:
            return fixes
        if np.shape(self.x0) not in (fixes.shape, fixes.shape[1:]):
            allowed = f"must be (R, E, 3) = {fixes.shape} or (E, 3)"
            raise InputError("x0", f"shape {np.shape(self.x0)}", allowed, "Give one position per ego.")
        return np.broadcast_to(self.x0, fixes.shape)

    @one_core()
    def _scan(self, recording: Recording, columns: list[int], pick: Callable[[Step], Tensor]) -> AnyArray:
        """(R, T, E, ...) of what `pick` takes from each step, relative to the first fix; step 0 is NaN."""
        origin = recording.gnss[:, :1, columns]

        def lanes(array: Floats) -> Tensor:
            flat = np.moveaxis(array, 1, 0).reshape(len(array[0]), 1, -1, SIZE)
            return torch.from_numpy(np.ascontiguousarray(flat, dtype=np.float32))

        gnss = lanes(recording.gnss[:, 1:, columns] - origin)
        velocity = lanes(recording.velocity[:, 1:, columns])
        x0 = lanes(self._x0(recording, columns)[:, None] - origin)[0]
        net = layers(flatten([self.model]), self.model)
        with torch.inference_mode():
            picked = [pick(s)[0].numpy() for s in steps(net, gnss, velocity, x0, recording.dt)]
        rows = np.stack([np.full_like(picked[0], np.nan), *picked]).astype(np.float64)
        return np.moveaxis(rows.reshape(len(rows), recording.runs, len(columns), *rows.shape[2:]), 0, 1)


DIVERGED = 10.0
"""Standard deviations (norm of the assumed GNSS std) between estimate and fix beyond which a run counts as lost."""


def _divergence(x: Floats, recording: Recording, columns: list[int]) -> list[str]:
    """A note if an estimate is ever farther from its fix than `DIVERGED` standard deviations."""
    limit = DIVERGED * float(np.linalg.norm(recording.sensors.gnss_std))
    gap = np.linalg.norm(x - recording.gnss[:, :, columns], axis=-1)
    lost = int((gap > limit).any(axis=1).sum())
    total = gap.shape[0] * gap.shape[2]
    return [f"diverged in {lost} of {total} runs (over {limit:.0f} m from the fix)"] if lost else []
