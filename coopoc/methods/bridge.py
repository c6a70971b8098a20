"""Missing fixes for methods without a memory: the last fix, brought forward with the measured velocities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from ..world.recording import Recording
from .noise_model import NoiseModel


@dataclass(frozen=True, eq=False)
class BridgedNoise(NoiseModel):
    """A noise model whose fixes have been brought forward.

    Args:
        added: (R, T, N, 3) m^2, variance of the motion since the last fix.
    """

    added: Floats | None = None

    def fix_variance(self, recording: Recording) -> Floats:
        """(R, T, N, 3) m^2."""
        assert self.added is not None
        return super().fix_variance(recording) + self.added


def bridge(recording: Recording, known: NoiseModel) -> tuple[Recording, NoiseModel, tuple[str, ...]]:
    """The recording without missing fixes, z_t = z_{t-1} + dt u_t with variance r + sum of q, and a note if any was.

    Args:
        recording: whose vehicles have a fix at their first step; without one a vehicle stays at none.
        known: the noise model.
    """
    if recording.complete:
        return recording, known, ()
    gnss, missing = recording.gnss.copy(), np.isnan(recording.gnss) & np.isfinite(recording.velocity)
    process = np.broadcast_to(known.process_variance(recording), gnss.shape)
    added = np.zeros_like(gnss)
    for t in range(1, gnss.shape[1]):
        gap = missing[:, t]
        gnss[:, t] = np.where(gap, gnss[:, t - 1] + recording.dt * recording.velocity[:, t], gnss[:, t])
        added[:, t] = np.where(gap, added[:, t - 1] + process[:, t], 0.0)
    fields = {name: value for name, value in vars(known).items() if name in NoiseModel.__dataclass_fields__}
    share = 100 * missing.sum() / np.isfinite(recording.velocity).sum()
    note = f"{share:.0f} % of the fixes are missing: the last one is brought forward with the velocity"
    return replace(recording, gnss=gnss), BridgedNoise(**fields, added=added), (note,)
