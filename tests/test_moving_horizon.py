"""The moving horizon: laws of a cooperative method, closed forms, minima, the linear case, late messages."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused, textbook
from scipy import stats
from scipy.optimize import least_squares

from coopoc import (
    V2X,
    Fleet,
    JointFilter,
    Kalman,
    MovingHorizon,
    NoiseModel,
    Sensors,
    observe,
)
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.evaluate.metrics import nees_inside, rt_le
from coopoc.optimize import Problem, solve
from coopoc.world.links import spherical, wrap
from coopoc.world.recording import Recording

S2 = Sensors.paper_scenario2()
LATE = V2X(max_neighbours=4, loss=0.2, latency=0.2)


@pytest.fixture(scope="module")
def recording(crossing: Fleet) -> Recording:
    return observe(crossing, S2, V2X(max_neighbours=4), runs=3)


@pytest.mark.parametrize("v2x", [V2X(4), V2X(4, loss=0.3), V2X(4, rate=2.0)], ids=["ideal", "lossy", "slow"])
@pytest.mark.parametrize("noise_model", ["identity", "nominal"])
def test_in_a_linear_model_every_window_ends_at_the_filter(v2x: V2X, noise_model: str, crossing: Fleet) -> None:
    """The newest point is the filter's; JointFilter is held against filterpy in test_methods."""
    recording = observe(crossing.between(0, 30), S2, v2x, runs=2)
    peer = textbook(JointFilter(noise_model, exact=False))(recording, [0, 3])
    for n in (1, 5):
        track = textbook(MovingHorizon(horizon=n, noise_model=noise_model, exact=False))(recording, [0, 3])
        assert track.x == pytest.approx(peer.x, abs=1e-8)
        assert track.covariance == pytest.approx(peer.covariance, abs=1e-8)
        assert track.neighbours == pytest.approx(peer.neighbours, abs=1e-7, nan_ok=True)


def test_in_a_linear_model_the_newest_point_is_gtsams_of_the_whole_drive(crossing: Fleet) -> None:
    """Independent check: GTSAM solves all steps so far at once; the flat priors weigh 1e-6 of a fix."""
    recording = observe(crossing.between(0, 10), S2, V2X(max_neighbours=3), runs=2)
    track, known = MovingHorizon("identity", horizon=4)(recording, [0]), NoiseModel.identity()
    for run in range(2):
        problem = Problem.from_window(recording, 9, 0, 10, run, known)
        theirs, newest = solve(problem, "gtsam"), problem.separator[-1]
        assert track.x[run, 9, 0] == pytest.approx(theirs.x[newest], abs=1e-4)
        assert track.covariance[run, 9, 0] == pytest.approx(theirs.covariance[newest], abs=1e-4)


def test_the_horizon_is_at_its_minimum(formation: Fleet) -> None:
    """Independent check: scipy.optimize.least_squares on a drive that the horizon holds whole, from the truth."""
    fleet = formation.select(range(4)).between(0, 6)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    track, order = textbook(MovingHorizon(horizon=6))(recording, [0]), [0, *recording.links.neighbour[:3]]
    for run in range(2):
        moved = recording.dt * recording.velocity[run][:, order]
        std = S2.motion_std(recording.velocity, recording.dt)[run][:, order]
        seen = recording.relative[run].reshape(6, 3, 3)

        def whitened(x: np.ndarray, run=run, moved=moved, std=std, seen=seen) -> np.ndarray:
            points = x.reshape(6, 4, 3)
            fixes = (points - recording.gnss[run][:, order]) / S2.gnss_std
            motions = (np.diff(points, axis=0) - moved[1:]) / std[1:]
            gap = np.stack(spherical(*np.moveaxis(points[:, 1:] - points[:, :1], -1, 0)), axis=-1) - seen
            gap[..., 1:] = wrap(gap[..., 1:])
            return np.concatenate([r.ravel() for r in (fixes, motions, gap / S2.relative_std)])

        best = least_squares(whitened, fleet.position[:, order].ravel(), xtol=1e-12, ftol=1e-12)
        assert track.x[run, -1, 0] == pytest.approx(best.x.reshape(6, 4, 3)[-1, 0], abs=5e-4)
        cov = np.linalg.inv(best.jac.T @ best.jac)[-12:-9, -12:-9]
        assert track.covariance[run, -1, 0] == pytest.approx(cov, abs=2e-3)


def test_what_comes_after_the_horizon_is_dropped_and_counted(formation: Fleet) -> None:
    fleet = formation.select(range(3)).between(0, 20)
    recording = observe(fleet, S2, V2X(max_neighbours=2, latency=0.5), runs=2, observers=[0])
    track = MovingHorizon(horizon=4)(recording, [0])
    assert track.notes == (f"{2 * 2 * 15} fixes came later than the horizon and were dropped",)
    solo = Kalman()(recording, [0])  # without a fix of theirs neighbours say nothing of where the ego is
    assert track.x[:, 0, 0] == pytest.approx(solo.x[:, 0, 0], abs=1e-4)
    assert MovingHorizon(horizon=5)(recording, [0]).notes == ()


def test_consistent_and_on_the_bound(formation: Fleet) -> None:
    """NEES gate as in test_methods; RT-LE is not below the filtering bound of the star beyond its interval, nor far."""
    sensors = replace(S2, velocity_reading="speed")
    fleet, v2x = formation.select(range(4)).between(0, 100), V2X(max_neighbours=3)
    track = MovingHorizon(horizon=2)(observe(fleet, sensors, v2x, runs=40, seed=1, observers=[0]), [0])
    assert nees_inside(track, fleet).min() >= 0.95
    bound = bound_rt_le(posterior_bound(fleet, sensors, 0, v2x))
    square = rt_le(track, fleet)[:, 0] ** 2
    half = stats.t.ppf(0.995, 39) * square.std(ddof=1) / np.sqrt(40)
    assert square.mean() + half > bound**2
    assert square.mean() - half < 1.05 * bound**2


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda r: MovingHorizon(noise_model="guess")(r, [0]), "noise_model"),
        (lambda r: MovingHorizon()(r, ["missing"]), "egos"),
        (lambda r: MovingHorizon(horizon=0), "horizon"),
    ],
)
def test_wrong_input_says_what_to_do(recording: Recording, make, field: str) -> None:
    with refused(field):
        make(recording)
