"""Stone Soup's rows of peers.py: the snapshot by its iterated Kalman filter, the joint filter by its linear one.

Stone Soup has no measurement between two parts of a state, so a user subclasses its nonlinear model. The fixes are the
prior and the relative measurements the measurement; from there its iterated update is Gauss-Newton on the same cost,
and ends at the same minimum. One extended update does not: it is up to 19 m away."""

from collections.abc import Callable
from typing import Any

import numpy as np
from backends_star import TOLERANCE, Job, Row, as_good
from classical import KNOWN, NEIGHBOURS, RUNS, SENSORS, SIZE, STEPS, Drive, filterpy_drive, peer_drive, ring
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.updater.kalman import ExtendedKalmanUpdater, IteratedKalmanUpdater, KalmanUpdater

from coopoc.kernels.stars.joint_filter import run_filter
from coopoc.methods.egos import assumptions, measurements
from coopoc.optimize import Problem, solve
from coopoc.world.inbox import inbox
from coopoc.world.links import spherical, wrap
from coopoc.world.v2x import FIX_AND_VELOCITY

SHOWN = 20
"""Steps of the drive whose snapshots are solved."""


class RelativeMeasurements(NonLinearGaussianMeasurement):  # type: ignore[misc]
    """Ranges and angles of all neighbours from the ego, in the order of the state; angles near the `seen` (K, 3)."""

    seen: Any

    @property
    def ndim_meas(self) -> int:
        return 3 * NEIGHBOURS

    def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
        x = np.asarray(state.state_vector, dtype=float).reshape(-1, 3)
        gap = np.stack(spherical(*(x[1:] - x[0]).T), axis=1) - self.seen
        gap[:, 1:] = wrap(gap[:, 1:])
        return (self.seen + gap).reshape(-1, 1)

    def jacobian(self, state: Any, **_: Any) -> Any:
        x = np.asarray(state.state_vector, dtype=float).reshape(-1, 3)
        dx, dy, dz = (x[1:] - x[0]).T
        flat2 = dx**2 + dy**2
        flat, r2 = np.sqrt(flat2), flat2 + dz**2
        r = np.sqrt(r2)
        jacobian = np.array(
            [
                [dx / r, dy / r, dz / r],
                [-dy / flat2, dx / flat2, 0 * r],
                [dx * dz / (flat * r2), dy * dz / (flat * r2), -flat / r2],
            ]
        )
        out = np.zeros((NEIGHBOURS, 3, NEIGHBOURS + 1, 3))
        each = np.arange(NEIGHBOURS)
        out[each, :, each + 1] = np.moveaxis(jacobian, 2, 0)
        out[each, :, 0] = -np.moveaxis(jacobian, 2, 0)
        return out.reshape(3 * NEIGHBOURS, SIZE)


def snapshot() -> Job:
    """All runs at some steps of the ring."""
    recording = ring(NEIGHBOURS, STEPS, RUNS)
    stars = [Problem.from_snapshot(recording, t, 0, b, KNOWN) for t in range(SHOWN) for b in range(RUNS)]

    def ours() -> Any:
        return np.stack([solve(p, tolerance=TOLERANCE).x for p in stars])

    job = "snapshot, exact, of a drive"
    whole = [(p.factors[0].z, p.factors[1].z) for p in stars]
    rows = [Row(job, "solve", len(whole), ours)]
    for words, updater in (("iterated", IteratedKalmanUpdater), ("extended", ExtendedKalmanUpdater)):
        rows.append(Row(job, f"Stone Soup, {words} update", len(whole), updated(updater, whole), words == "iterated"))
    return Job(rows, as_good(stars))


def updated(updater: Any, stars: list[tuple[Any, Any]]) -> Callable[[], Any]:
    """Its update of the fixes (K + 1, 3) by the relative measurements (K, 3) of every star."""
    variance = np.tile(np.square(SENSORS.relative_std), NEIGHBOURS)
    model = RelativeMeasurements(ndim_state=SIZE, mapping=tuple(range(SIZE)), noise_covar=np.diag(variance))
    prior = np.diag(np.tile(KNOWN.gnss_variance, NEIGHBOURS + 1))
    options = {"tolerance": TOLERANCE} if updater is IteratedKalmanUpdater else {}
    update = updater(measurement_model=model, **options).update

    def one(fix: Any, seen: Any) -> Any:
        model.seen = seen
        given = Detection(seen.reshape(-1, 1), measurement_model=model)
        made = update(SingleHypothesis(GaussianStatePrediction(fix.reshape(-1, 1), prior), given))
        return np.asarray(made.state_vector, dtype=float).reshape(-1, 3)

    return lambda: np.stack([one(*star) for star in stars])


def joint_filter() -> Job:
    """The ego of two runs, each step a prediction and an update, against filterpy's numbers."""
    recording = ring(NEIGHBOURS, STEPS, RUNS)
    box = inbox(recording, 0, FIX_AND_VELOCITY)
    measured, assumed = measurements(recording, 0, box), assumptions(recording, KNOWN, 0, box)
    drives = [peer_drive(recording, run) for run in range(2)]
    wanted = np.stack([filterpy_drive(drive) for drive in drives])

    def right(x: Any) -> bool:
        return float(np.abs(x[:2] - wanted).max()) < 1e-9

    job = "joint filter, linear"
    return Job(
        [
            Row(job, "kernel", RUNS * STEPS, lambda: run_filter(measured, assumed, False, False, False)[0]),
            Row(job, "Stone Soup, KalmanUpdater", 2 * STEPS, lambda: np.stack([followed(d) for d in drives])),
        ],
        right,
    )


def followed(drive: Drive) -> np.ndarray:
    """(T, 3) of the ego; the prediction is one sum, which its predictors would make no faster."""
    found = np.empty((len(drive.z), 3))
    x, p = drive.x[:, None], drive.p
    found[0] = drive.x[:3]
    for t in range(1, len(found)):
        model = LinearGaussian(ndim_state=SIZE, mapping=tuple(range(SIZE)), noise_covar=drive.noise[t])
        model.matrix = lambda **_: drive.h
        prior = GaussianStatePrediction(x + drive.moved[t][:, None], p + drive.q)
        seen = Detection(drive.z[t][:, None], measurement_model=model)
        made = KalmanUpdater(measurement_model=model).update(SingleHypothesis(prior, seen))
        x, p = np.asarray(made.state_vector, dtype=float), np.asarray(made.covar, dtype=float)
        found[t] = x[:3, 0]
    return found
