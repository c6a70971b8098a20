"""Rivals on CL-Bench's real roads: filters and a smoother of other libraries.

coopoc benchmark benchmarks/rivals.py:EKF benchmarks/rivals.py:FixedLag --data ~/measured

The state is position, heading error and scale error of the odometry, with the noise that the recording states.
`Gated` leaves out fixes beyond a Mahalanobis distance of 3.4 (99.7 % of those in the plane), as robot_localization
does by its rejection threshold (Moore, Stouch, IAS-13, 2014). `FixedLag` is GTSAM's incremental smoother of the last
30 s (Kaess et al., IJRR 31(2), 2012) with Geman and McClure's kernel.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, NamedTuple

import gtsam
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from coopoc import NoiseModel, Recording, Track
from coopoc.arrays import Floats
from coopoc.world.v2x import NO_MESSAGE, Message


class Known(NamedTuple):
    """Numbers of a rival: factors of the stated deviations of fixes and motion; standard deviations from which a fix is
    left out; deviations of heading rad and scale, and s for which they last."""

    fix: float = 1.0
    motion: float = 1.0
    gate: float = np.inf
    heading: float = 0.1
    scale: float = 0.03
    lasts: float = 300.0


WHITE = Known()
LAG, KERNEL = 30.0, 3.0
"""s of the smoother; whitened residual at which Geman and McClure's weight is a quarter."""


def moved(x: Floats, dt: float, velocity: Floats, lasts: float) -> Floats:
    """State after a step: position by the turned and scaled velocity; errors fade."""
    c, s = np.cos(x[2]), np.sin(x[2])
    east, north = dt * (1 + x[3]) * np.array([c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]])
    return np.array([x[0] + east, x[1] + north, *(np.exp(-dt / lasts) * x[2:])])


def slope(x: Floats, dt: float, velocity: Floats, lasts: float) -> Floats:
    """(4, 4) Jacobian of `moved`."""
    east, north = moved(x, dt, velocity, lasts)[:2] - x[:2]
    out = np.diag([1.0, 1.0, *2 * [np.exp(-dt / lasts)]])
    out[:2, 2:] = [[-north, east / (1 + x[3])], [east, north / (1 + x[3])]]
    return out


class Extended(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's: `ahead` predicts, `see` updates."""

    def __init__(self, x: Floats, cov: Floats, fix: Floats, dt: float, known: Known) -> None:
        super().__init__(4, 2)
        self.x, self.P, self.R, self.dt, self.known = x, cov, fix, dt, known

    def ahead(self, velocity: Floats, q: Floats) -> None:
        """Over a step with the process noise q (4, 4)."""
        self.F = slope(self.x, self.dt, velocity, self.known.lasts)
        self.x, self.P = moved(self.x, self.dt, velocity, self.known.lasts), self.F @ self.P @ self.F.T + q

    def see(self, fix: Floats) -> None:
        """A fix (2,)."""
        self.update(fix, lambda x: np.eye(2, 4), lambda x: x[:2])


class Unscented(UnscentedKalmanFilter):  # type: ignore[misc]
    """filterpy's."""

    def __init__(self, x: Floats, cov: Floats, fix: Floats, dt: float, known: Known) -> None:
        points = MerweScaledSigmaPoints(4, 0.1, 2.0, -1.0)
        super().__init__(4, 2, dt, lambda x: x[:2], moved, points)
        self.x, self.P, self.R, self.known = x, cov, fix, known

    def ahead(self, velocity: Floats, q: Floats) -> None:
        """Over a step."""
        self.P, self.Q = 0.5 * (self.P + self.P.T) + 1e-9 * np.eye(4), q
        self.predict(velocity=velocity, lasts=self.known.lasts)

    def see(self, fix: Floats) -> None:
        """A fix."""
        self.update(fix)


def flat(state: Any) -> Floats:
    """(4,) of Stone Soup's state."""
    return np.asarray(state.state_vector, dtype=float)[:, 0]


class Soup:
    """Stone Soup's extended predictor and updater."""

    def __init__(self, x: Floats, cov: Floats, fix: Floats, dt: float, known: Known) -> None:
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.base import TransitionModel
        from stonesoup.predictor.kalman import ExtendedKalmanPredictor
        from stonesoup.types.state import GaussianState
        from stonesoup.updater.kalman import ExtendedKalmanUpdater

        class Motion(TransitionModel):  # type: ignore[misc]
            """That of all rivals."""

            ndim_state, velocity, q = 4, np.zeros(3), np.zeros((4, 4))
            rvs = pdf = None

            def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
                return moved(flat(state), dt, self.velocity, known.lasts)[:, None]

            def jacobian(self, state: Any, **_: Any) -> Floats:
                return slope(flat(state), dt, self.velocity, known.lasts)

            def covar(self, **_: Any) -> Floats:
                return self.q

        self.motion, self.t = Motion(), datetime(2026, 1, 1)
        self.model = LinearGaussian(ndim_state=4, mapping=(0, 1), noise_covar=fix)
        self.step, self.R = timedelta(seconds=dt), fix
        self.predictor, self.updater = ExtendedKalmanPredictor(self.motion), ExtendedKalmanUpdater(self.model)
        self.state: Any = GaussianState(x[:, None], cov, self.t)

    def ahead(self, velocity: Floats, q: Floats) -> None:
        """Over a step."""
        self.motion.velocity, self.motion.q, self.t = velocity, q, self.t + self.step
        self.state = self.predictor.predict(self.state, timestamp=self.t)

    def see(self, fix: Floats) -> None:
        """A fix."""
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis

        seen = Detection(fix[:, None], timestamp=self.t, measurement_model=self.model)
        self.state = self.updater.update(SingleHypothesis(self.state, seen))

    @property
    def x(self) -> Floats:
        """(4,)."""
        return flat(self.state)

    @property
    def P(self) -> Floats:
        """(4, 4)."""
        return np.asarray(self.state.covar, dtype=float)


class Smoother(Extended):
    """GTSAM's incremental fixed-lag smoother: a node at each fix, odometry summed up between."""

    def __init__(self, x: Floats, cov: Floats, fix: Floats, dt: float, known: Known) -> None:
        super().__init__(x, cov, fix, dt, known)
        often = gtsam.ISAM2Params()
        often.relinearizeSkip = 1
        self.smoother, self.node, self.t, self.began = gtsam.IncrementalFixedLagSmoother(LAG, often), 0, 0.0, 0.0
        kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(known.gate)
        self.robust = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(fix))
        self.path, self.q = np.zeros(3), np.zeros((4, 4))
        first = gtsam.NonlinearFactorGraph()
        first.addPriorVector(0, x, gtsam.noiseModel.Gaussian.Covariance(cov))
        self._add(first)

    def ahead(self, velocity: Floats, q: Floats) -> None:
        """Over a step: the filter's prediction, and the sums of the odometry and its noise."""
        super().ahead(velocity, q)
        self.path, self.q, self.t = self.path + self.dt * velocity, self.q + q, self.t + self.dt

    def see(self, fix: Floats) -> None:
        """A node with the odometry since the last one and a robust fix."""
        span, path, lasts = self.t - self.began, self.path / (self.t - self.began), self.known.lasts
        keys = [self.node, self.node + 1]

        def odometry(factor: Any, values: Any, jacobians: Any) -> Floats:
            before, after = map(values.atVector, keys)
            if jacobians is not None:
                jacobians[0], jacobians[1] = -slope(before, span, path, lasts), np.eye(4)
            return np.asarray(after - moved(before, span, path, lasts))

        def place(factor: Any, values: Any, jacobians: Any) -> Floats:
            if jacobians is not None:
                jacobians[0] = np.eye(2, 4)
            return np.asarray(values.atVector(keys[1])[:2] - fix)

        more = gtsam.NonlinearFactorGraph()
        more.add(gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(self.q), keys, odometry))
        more.add(gtsam.CustomFactor(self.robust, keys[1:], place))
        self.node, self.began, self.path, self.q = self.node + 1, self.t, np.zeros(3), np.zeros((4, 4))
        self._add(more)
        self.x = self.smoother.calculateEstimateVector(self.node)
        self.P = self.smoother.getISAM2().marginalCovariance(self.node)

    def _add(self, factors: Any) -> None:
        values = gtsam.Values()
        values.insert(self.node, self.x)
        self.smoother.update(factors, values, {self.node: self.t})


@dataclass(frozen=True)
class Rival:
    """One of them as a solo method in the plane; heights are those of the last fix."""

    name: str
    engine: type[Any]
    known: Known = WHITE
    cooperative: bool = False
    message: Message = NO_MESSAGE

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of one ego in one run."""
        began, (column,), known = time.perf_counter(), recording.columns(egos), self.known
        fixes, velocity = recording.gnss[0, :, column], recording.velocity[0, :, column]
        stated, dt = NoiseModel.nominal(recording.sensors), recording.dt
        q = np.broadcast_to(stated.process_variance(recording), recording.gnss.shape)[0, :, column, :2]
        lasting, r = np.square([known.heading, known.scale]), known.fix**2 * stated.gnss_variance
        fresh = (1 - np.exp(-2 * dt / known.lasts)) * lasting
        start = np.array([*fixes[0, :2], 0.0, 0.0]), np.diag([*r[:2], *lasting])
        one = self.engine(*start, np.diag(r[:2]), dt, known)
        gate = np.inf if self.engine is Smoother else known.gate
        x, cov, up = np.zeros((len(fixes), 3)), np.zeros((len(fixes), 3, 3)), fixes[0, 2]
        for t in range(len(fixes)):
            if t:
                one.ahead(velocity[t], np.diag([*known.motion**2 * q[t], *fresh]))
                if np.isfinite(fixes[t]).all():
                    up, gap = fixes[t, 2], fixes[t, :2] - one.x[:2]
                    if gap @ np.linalg.solve(one.P[:2, :2] + one.R, gap) < gate**2:
                        one.see(fixes[t, :2])
            x[t], cov[t, :2, :2], cov[t, 2, 2] = [*one.x[:2], up], one.P[:2, :2], r[2]
        none = np.zeros((1, 1))
        return Track(
            recording.t, (column,), x[None, :, None], cov[None, :, None], none, none, time.perf_counter() - began
        )


@dataclass(frozen=True)
class Entry:
    """What `coopoc benchmark` calls with a noise model to get a method, for tasks of real roads alone."""

    method: Any
    roads = True

    def __call__(self, noise_model: Any = "nominal") -> Any:
        """The rival."""
        return self.method


EKF = Entry(Rival("filterpy EKF", Extended))
Gated = Entry(Rival("filterpy EKF, gated", Extended, Known(gate=3.4)))
UKF = Entry(Rival("filterpy UKF", Unscented))
StoneSoup = Entry(Rival("Stone Soup EKF", Soup))
FixedLag = Entry(Rival("GTSAM fixed-lag", Smoother, Known(gate=KERNEL)))
