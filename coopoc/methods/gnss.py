"""GNSS alone: the raw fix, the floor that every filter must beat."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..world.recording import Recording, check_recording
from ..world.v2x import NO_MESSAGE, Message
from .track import Track


@dataclass(frozen=True)
class GNSS:
    """The latest fix, x_t = z_t, with the assumed GNSS covariance; where there is none, the last one is held."""

    name: str = "gnss"
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent."""
        began = time.perf_counter()
        columns = check_recording(recording).columns(egos, missing=True)
        fixes = recording.gnss[:, :, columns]
        there = np.isfinite(fixes).all(axis=-1, keepdims=True)
        newest = np.maximum.accumulate(np.where(there, np.arange(len(recording.t))[:, None, None], 0), axis=1)
        x, missing = np.take_along_axis(fixes, newest, axis=1), 100 * (1 - there.mean())
        notes = (f"holds the last fix where there is none: {missing:.0f} % of the steps",) if missing else ()
        cov = np.broadcast_to(np.diag(np.square(recording.sensors.gnss_std)), (*x.shape, 3))
        free = np.zeros((recording.runs, len(columns)))
        return Track(recording.t, tuple(columns), x, cov, free, free, time.perf_counter() - began, notes=notes)
