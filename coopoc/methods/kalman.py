"""The solo Kalman filter on position with measured velocity as input, vectorised over runs and vehicles."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..world.recording import Recording
from ..world.v2x import NO_MESSAGE, Message
from .knowledge import Knowledge, resolve
from .track import Track


@dataclass(frozen=True, eq=False)
class Kalman:
    """Kalman filter of x_t = x_{t-1} + dt u_t, z_t = x_t + n, with the noise that `knowledge` names.

    Args:
        knowledge: "identity", "nominal" or a Knowledge.
        x0: (R, E, 3) or (E, 3) m, a known start; None starts at the first fix.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> Kalman("nominal")(observe(fleet, Sensors(), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    knowledge: Knowledge | str = "nominal"
    x0: Floats | None = None
    name: str = "kalman"
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or x0 has another shape."""
        began = time.perf_counter()
        columns = recording.columns(egos)
        known = resolve(self.knowledge, recording)
        variance = known.process_variance(recording)
        variance = variance[:, :, columns] if variance.shape[2] > 1 else variance
        x0 = self.x0
        if x0 is not None and x0.shape[-2:] != (len(columns), 3):
            raise InputError("x0", x0.shape, f"must end in (E, 3) = ({len(columns)}, 3)", "One start per ego.")
        x, p = solo_filter(
            recording.gnss[:, :, columns], recording.velocity[:, :, columns], variance, known.gnss_variance,
            recording.dt, x0,
        )  # fmt: skip
        free = np.zeros((recording.runs, len(columns)))
        return Track(recording.t, tuple(columns), x, p[..., None] * np.eye(3), free, free, time.perf_counter() - began)


def solo_filter(
    gnss: Floats, velocity: Floats, process_variance: Floats, gnss_variance: Floats, dt: float,
    x0: Floats | None = None,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Kalman filter per axis: all covariances are diagonal, so the three axes do not couple.

    predict x += dt u, p += q; gain k = p / (p + r); x += k (z - x); p = (1 - k)^2 p + k^2 r (Joseph).

    Args:
        gnss, velocity: (R, T, N, 3), NaN where a vehicle is absent; it starts anew at its first fix.
        process_variance: broadcastable to (R, T, N, 3) m^2. gnss_variance: (3,) m^2. dt: s.
        x0: (..., N, 3) m exact position at step 0, or None for the first fix.

    Returns:
        x and p of shape (R, T, N, 3): m and m^2.
    """
    q = np.broadcast_to(process_variance, gnss.shape)
    x, p = np.empty_like(gnss), np.empty_like(gnss)
    x[:, 0] = gnss[:, 0] if x0 is None else x0
    p[:, 0] = gnss_variance if x0 is None else 0.0
    for t in range(1, gnss.shape[1]):
        prior = x[:, t - 1] + dt * velocity[:, t]
        spread = p[:, t - 1] + q[:, t]
        gain = spread / (spread + gnss_variance)
        joining = np.isnan(prior)
        x[:, t] = np.where(joining, gnss[:, t], prior + gain * (gnss[:, t] - prior))
        p[:, t] = np.where(joining, gnss_variance, (1 - gain) ** 2 * spread + gain**2 * gnss_variance)
    return x, p
