"""Rivals on CL-Bench's real roads: filterpy's extended and unscented filters of the road filter's state.

coopoc benchmark benchmarks/rivals.py:EKF benchmarks/rivals.py:Gated benchmarks/rivals.py:UKF --data ~/measured

Position, heading error and scale error of the odometry, with the noise that the recording states and the road filter's
usual errors of heading and scale. `Gated` leaves out fixes beyond a Mahalanobis distance of 3.4 (99.7 % of those in the
plane), as robot_localization does by its rejection threshold (Moore, Stouch, IAS-13, 2014).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from coopoc import NoiseModel, Recording, Track
from coopoc.arrays import Floats
from coopoc.methods.road import ROAD
from coopoc.world.v2x import NO_MESSAGE, Message

LASTING = np.array([ROAD.heading, ROAD.scale])
"""rad, and share of the speed."""


def moved(x: Floats, dt: float, velocity: Floats) -> Floats:
    """State after a step: position by the turned and scaled velocity; errors fade."""
    c, s = np.cos(x[2]), np.sin(x[2])
    east, north = dt * (1 + x[3]) * np.array([c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]])
    return np.array([x[0] + east, x[1] + north, *(np.exp(-dt / ROAD.lasts) * x[2:])])


@dataclass(frozen=True)
class Rival:
    """One of the filters as a solo method in the plane; heights are those of the last fix."""

    name: str
    gate: float = np.inf
    unscented: bool = False
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of one ego in one run."""
        began, (column,) = time.perf_counter(), recording.columns(egos)
        fixes, velocity = recording.gnss[0, :, column], recording.velocity[0, :, column]
        known, dt = NoiseModel.nominal(recording.sensors), recording.dt
        q = np.broadcast_to(known.process_variance(recording), recording.gnss.shape)[0, :, column]
        fresh = (1 - np.exp(-2 * dt / ROAD.lasts)) * LASTING**2
        one = self._made(dt)
        one.x, one.R = np.array([*fixes[0, :2], 0.0, 0.0]), np.diag(known.gnss_variance[:2])
        one.P = np.diag([*known.gnss_variance[:2], *LASTING**2])
        x, cov, up = np.zeros((len(fixes), 3)), np.zeros((len(fixes), 3, 3)), fixes[0, 2]
        for t in range(len(fixes)):
            if t:
                one.Q = np.diag([*q[t, :2], *fresh])
                self._predict(one, dt, velocity[t])
                if np.isfinite(fixes[t]).all():
                    up, gap = fixes[t, 2], fixes[t, :2] - one.x[:2]
                    if gap @ np.linalg.solve(one.P[:2, :2] + one.R, gap) < self.gate**2:
                        self._update(one, fixes[t, :2])
            x[t], cov[t, :2, :2], cov[t, 2, 2] = [*one.x[:2], up], one.P[:2, :2], known.gnss_variance[2]
        none = np.zeros((1, 1))
        return Track(
            recording.t, (column,), x[None, :, None], cov[None, :, None], none, none, time.perf_counter() - began
        )

    def _made(self, dt: float) -> Any:
        if not self.unscented:
            return ExtendedKalmanFilter(4, 2)
        points = MerweScaledSigmaPoints(4, 0.1, 2.0, -1.0)
        return UnscentedKalmanFilter(4, 2, dt, lambda x: x[:2], moved, points)

    def _predict(self, one: Any, dt: float, velocity: Floats) -> None:
        if self.unscented:
            one.P = 0.5 * (one.P + one.P.T) + 1e-9 * np.eye(4)
            one.predict(velocity=velocity)
            return
        step = 1e-6
        ahead = np.array([moved(one.x + step * e, dt, velocity) - moved(one.x, dt, velocity) for e in np.eye(4)])
        one.F, one.x = ahead.T / step, moved(one.x, dt, velocity)
        one.P = one.F @ one.P @ one.F.T + one.Q

    def _update(self, one: Any, fix: Floats) -> None:
        if self.unscented:
            one.update(fix)
        else:
            one.update(fix, lambda x: np.eye(2, 4), lambda x: x[:2])


class EKF:
    """filterpy's extended Kalman filter."""

    roads = True

    def __new__(cls, noise_model: Any = "nominal") -> Any:
        """The rival."""
        return Rival("filterpy EKF")


class Gated:
    """The same with a rejection threshold."""

    roads = True

    def __new__(cls, noise_model: Any = "nominal") -> Any:
        """The rival."""
        return Rival("filterpy EKF, gated", gate=3.4)


class UKF:
    """filterpy's unscented Kalman filter."""

    roads = True

    def __new__(cls, noise_model: Any = "nominal") -> Any:
        """The rival."""
        return Rival("filterpy UKF", unscented=True)
