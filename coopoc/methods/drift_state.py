"""The state of a star whose fixes have time-correlated errors: positions, each receiver's drift, the common drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from ..world.sensors import Sensors
from .star import FORGOTTEN, rows


@dataclass(frozen=True)
class Drift:
    """Gauss-Markov errors of the fixes in the state of n members: positions (3n), drifts (3n), common (3).

    e_t = keep e_{t-1} + w_t with var e = own or common m^2 per axis. What has no variance is not in the state.

    Args:
        own: m^2 per axis, of each receiver.
        common: m^2 per axis, of all receivers.
        keep: correlation of two errors one step apart.

    >>> Drift.of(Sensors(gnss_drift_std=1.0), 0.1).size(4)
    24
    """

    own: float
    common: float
    keep: float

    @classmethod
    def of(cls, sensors: Sensors, dt: float) -> Drift:
        """Of sensors at an interval of dt s."""
        keep = float(np.exp(-dt / sensors.gnss_drift_time))
        return cls(sensors.gnss_drift_std**2, sensors.gnss_common_std**2, keep)

    def size(self, n: int) -> int:
        """Length of the state of n members."""
        return 3 * n * (1 + (self.own > 0)) + 3 * (self.common > 0)

    def fix_matrix(self, n: int) -> Floats:
        """(3n, size) of the fixes: z = x + drift + common + white noise."""
        unit = np.eye(3 * n)
        parts = [unit, *([unit] if self.own else []), *([np.tile(np.eye(3), (n, 1))] if self.common else [])]
        return np.concatenate(parts, axis=1)

    def carry(self, covariance: Floats, previous: Ints, process: Floats) -> Floats:
        """Covariance one step later, (..., size, size) m^2: nothing is known of the position of a new member.

        Args:
            covariance: (..., size, size) of the members before.
            previous: (n,) their places there, -1 for a new member.
            process: (..., n, 3) m^2 of the motion.
        """
        n, before = len(previous), self._members(covariance.shape[-1])
        stays = np.flatnonzero(previous >= 0)
        here, there = rows(stays), rows(previous[stays])
        if self.own:
            here, there = (np.concatenate([at, at + 3 * m]) for at, m in ((here, n), (there, before)))
        if self.common:
            here, there = (np.append(at, self.size(m) - 3 + np.arange(3)) for at, m in ((here, n), (there, before)))
        new, diagonal = self._fresh(n, stays, process, covariance.shape[:-2]), np.arange(self.size(n))
        shrink = np.where(here < 3 * n, 1.0, self.keep)
        out = np.zeros((*new.shape, new.shape[-1]))
        out[..., diagonal, diagonal] = new
        if before:
            out[..., here[:, None], here] += shrink[:, None] * shrink * covariance[..., there[:, None], there]
        return out

    def moved(self, state: Floats, previous: Ints) -> Floats:
        """(..., size) of the drifts one step later and zeros for the positions and new members."""
        n, before = len(previous), self._members(state.shape[-1])
        out = np.zeros((*state.shape[:-1], self.size(n)))
        stays = np.flatnonzero(previous >= 0)
        if self.own and before:
            out[..., 3 * n + rows(stays)] = self.keep * state[..., 3 * before + rows(previous[stays])]
        if self.common and before:
            out[..., -3:] = self.keep * state[..., -3:]
        return out

    def _fresh(self, n: int, stays: Ints, process: Floats, lead: tuple[int, ...]) -> Floats:
        """Variance (..., size) that a step adds, or that a joining member starts with."""
        position = np.full((*lead, n, 3), FORGOTTEN)
        position[..., stays, :] = process[..., stays, :]
        drift = np.full((n, 3), float(self.own))
        drift[stays] *= 1.0 - self.keep**2
        parts = [position.reshape(*lead, 3 * n)]
        parts += [np.broadcast_to(drift.ravel(), (*lead, 3 * n))] if self.own else []
        started = len(stays) > 0
        common = self.common * (1.0 - self.keep**2 if started else 1.0)
        parts += [np.broadcast_to(common, (*lead, 3))] if self.common else []
        return np.concatenate(parts, axis=-1)

    def _members(self, size: int) -> int:
        return max(0, (size - 3 * (self.common > 0)) // (3 * (1 + (self.own > 0))))


def drifting(sensors: Sensors) -> bool:
    """Whether fixes have time-correlated errors."""
    return sensors.gnss_drift_std > 0 or sensors.gnss_common_std > 0


def require_white(sensors: Sensors, what: str) -> None:
    """InputError where fixes have time-correlated errors and `what` takes them as white."""
    if drifting(sensors):
        found = (sensors.gnss_drift_std, sensors.gnss_common_std)
        hint = "Set them to 0, or take the filtering one."
        raise InputError("gnss_drift_std, gnss_common_std", found, f"must be 0 for {what}", hint)
