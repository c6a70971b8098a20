"""Fixed-lag smoother and moving horizon: filters in the linear case, minima in the other, late messages in time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy import stats
from scipy.optimize import least_squares, minimize

from coopoc import V2X, Fleet, InputError, JointFilter, Kalman, Method, NoiseModel, Sensors, load_fleet, observe
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.evaluate.metrics import errors, nees, nees_inside, rt_le
from coopoc.methods.catalogue import METHODS as CATALOGUE
from coopoc.methods.fixed_lag import FixedLagSmoother
from coopoc.methods.moving_horizon import MovingHorizon
from coopoc.methods.noise_model import resolve
from coopoc.methods.star import ACCELERATION_STD, assumptions, measurements
from coopoc.methods.window import points_of, steps_of
from coopoc.methods.window_problem import Arrival, arrival_of, limited, solution_of, window_problem
from coopoc.optimize.model.window import WindowStep
from coopoc.world.inbox import inbox
from coopoc.world.recording import Recording
from coopoc.world.spherical import spherical, to_vector, wrap

S2 = Sensors.paper_scenario2()
SILENT = Sensors(gnss_std=(0, 0, 0), velocity_std_ratio=0, range_std=0, azimuth_std=0, inclination_std=0)
METHODS = [
    FixedLagSmoother(lag=3),
    FixedLagSmoother(lag=3, noise_model="identity"),
    FixedLagSmoother(lag=3, smoothed=True),
    MovingHorizon(horizon=4),
    MovingHorizon(horizon=4, noise_model="identity"),
]
LATE = V2X(max_neighbours=4, loss=0.2, latency=0.2)


def label(method: FixedLagSmoother | MovingHorizon) -> str:
    return f"{method.name}-{method.noise_model}{'-smoothed' * getattr(method, 'smoothed', False)}"


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_zero_noise_gives_zero_error(method, crossing: Fleet) -> None:
    recording = observe(crossing.between(0, 40), SILENT, V2X(max_neighbours=4), assumed=S2)
    assert isinstance(method, Method)
    assert errors(method(recording, [0, 3]), crossing.between(0, 40)).max() < 1e-6


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_translating_the_world_translates_the_estimate(method, crossing: Fleet) -> None:
    shift = np.array([1000.0, -500.0, 30.0])
    fleet = crossing.between(0, 40)
    moved = replace(fleet, position=fleet.position + shift)
    here = method(observe(fleet, S2, LATE, runs=2), [0])
    there = method(observe(moved, S2, LATE, runs=2), [0])
    assert there.x - shift == pytest.approx(here.x, abs=1e-5)
    assert there.covariance == pytest.approx(here.covariance, abs=1e-5)


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_order_of_vehicles_changes_nothing(method, crossing: Fleet) -> None:
    fleet, names = crossing.between(0, 40), list(crossing.ids)
    shuffled = fleet.select([names[0], *reversed(names[1:])])
    here = method(observe(fleet, S2, LATE, runs=2), ["c0"]).x
    there = method(observe(shuffled, S2, LATE, runs=2), ["c0"]).x
    assert there == pytest.approx(here, abs=1e-6)


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_a_run_and_a_step_know_nothing_of_others(method, crossing: Fleet) -> None:
    """One run is the first of six, and a short drive the beginning of a long one where the method is causal."""
    fleet = crossing.between(0, 40)
    many = method(observe(fleet, S2, LATE, runs=6), [0]).x
    assert np.array_equal(method(observe(fleet, S2, LATE, runs=1), [0]).x, many[:1])
    short = method(observe(fleet.between(0, 25), S2, LATE, runs=6), [0]).x
    causal = 25 - 3 * getattr(method, "smoothed", False)
    assert np.array_equal(short[:, :causal], many[:, :causal])


@pytest.mark.parametrize("method", [m for m in METHODS if not getattr(m, "smoothed", False)], ids=label)
def test_zero_neighbours_is_the_solo_filter(method, crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=0), runs=3)
    solo = Kalman(method.noise_model)(recording, [0, 1])
    track = method(recording, [0, 1])
    assert track.x == pytest.approx(solo.x, abs=2e-4)  # the flat prior weighs 1e-6 of a fix
    assert (track.received_bytes == 0).all()


def test_no_message_ever_is_at_best_the_solo_filter(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=4, loss=1.0), runs=3)
    solo = rt_le(Kalman("nominal")(recording, [0]), crossing).mean()
    for method in (FixedLagSmoother(lag=3), MovingHorizon(horizon=4)):
        assert rt_le(method(recording, [0]), crossing).mean() < 1.2 * solo


def test_bytes_are_those_of_the_inbox(crossing: Fleet) -> None:
    recording = observe(crossing, S2, replace(LATE, overhead=100), runs=2)
    for method in (FixedLagSmoother(lag=1), MovingHorizon(horizon=3)):
        track, box = method(recording, [3]), inbox(recording, 3, method.message)
        assert np.array_equal(track.received_bytes[:, 0], box.received_bytes)
        assert (track.sent_bytes == box.sent_bytes).all()


@pytest.mark.parametrize("v2x", [V2X(4), V2X(4, loss=0.3), V2X(4, rate=2.0)], ids=["ideal", "lossy", "slow"])
@pytest.mark.parametrize("noise_model", ["identity", "nominal"])
def test_in_a_linear_model_every_window_ends_at_the_filter(v2x: V2X, noise_model: str, crossing: Fleet) -> None:
    """The law of performance.md 1.2 and methods.md 6.9; JointFilter is held against filterpy in test_methods."""
    recording = observe(crossing.between(0, 30), S2, v2x, runs=2)
    peer = JointFilter(noise_model, exact=False)(recording, [0, 3])
    lags = [FixedLagSmoother(lag=lag, noise_model=noise_model, exact=False) for lag in (1, 10)]
    horizons = [MovingHorizon(horizon=n, noise_model=noise_model, exact=False) for n in (1, 5)]
    for method in (*lags, *horizons):
        track = method(recording, [0, 3])
        assert track.x == pytest.approx(peer.x, abs=1e-8)
        assert track.covariance == pytest.approx(peer.covariance, abs=1e-8)
        assert track.neighbours == pytest.approx(peer.neighbours, abs=1e-7, nan_ok=True)


def test_no_lag_is_the_joint_filter(formation: Fleet) -> None:
    """Its exact step, too, and over a late channel."""
    recording = observe(formation.between(0, 60), S2, LATE, runs=3, observers=[0, 3])
    track, peer = FixedLagSmoother(lag=0)(recording, [0, 3]), JointFilter()(recording, [0, 3])
    assert track.x == pytest.approx(peer.x, abs=1e-8)
    assert track.covariance == pytest.approx(peer.covariance, abs=1e-8)


@pytest.mark.parametrize("smoothed", [False, True])
def test_fixed_lag_equals_gtsam(crossing: Fleet, smoothed: bool) -> None:
    """Independent check: gtsam.IncrementalFixedLagSmoother, newest and late points and their covariances."""
    recording = observe(crossing.between(0, 15), S2, V2X(max_neighbours=3, loss=0.2), runs=2)
    for noise_model, exact, close in (("identity", True, 1e-8), ("nominal", False, 1e-7), ("nominal", True, 0.15)):
        ours, theirs = (
            FixedLagSmoother(noise_model, lag=3, backend=backend, smoothed=smoothed, exact=exact)(recording, [0])
            for backend in ("gauss-newton", "gtsam")
        )
        assert theirs.x == pytest.approx(ours.x, abs=close)
        assert theirs.covariance == pytest.approx(ours.covariance, abs=close)
        assert theirs.neighbours == pytest.approx(ours.neighbours, abs=2 * close, nan_ok=True)
        assert "gtsam loops over the runs" in theirs.notes
        assert (ours.notes == ()) is not smoothed


def test_a_lag_of_the_whole_drive_is_filterpys_smoother(crossing: Fleet) -> None:
    """Independent check: filterpy's rts_smoother on one vehicle."""
    recording = observe(crossing.between(0, 30), S2, V2X(max_neighbours=0), runs=1)
    known = NoiseModel("fitted", S2, process_std=(0.08, 0.07, 0.01), gnss_std=(3.0, 3.5, 4.0))
    track = FixedLagSmoother(lag=40, smoothed=True, noise_model=known)(recording, [2])
    peer = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
    peer.B, peer.H = 0.1 * np.eye(3), np.eye(3)
    peer.Q, peer.R = np.diag(np.square(known.process_std)), np.diag(known.gnss_variance)
    peer.x, peer.P = recording.gnss[0, 0, 2], peer.R.copy()
    x, cov = [peer.x], [peer.P]
    for t in range(1, 30):
        peer.predict(u=recording.velocity[0, t, 2])
        peer.update(recording.gnss[0, t, 2])
        x.append(peer.x)
        cov.append(peer.P)
    # filterpy's smoother knows no control: take the known motion out of the states
    moved = np.cumsum(0.1 * recording.velocity[0, :, 2], axis=0)
    smooth, spread, _, _ = peer.rts_smoother(np.array(x) - moved, np.array(cov))
    assert track.x[0, :, 0] == pytest.approx(smooth + moved, abs=1e-4)
    assert track.covariance[0, :, 0] == pytest.approx(spread, abs=1e-4)


class Last(NamedTuple):
    """The last window of a run over an ideal channel: its steps, arrival cost, points, and what made them."""

    steps: list[WindowStep]
    arrival: Arrival
    points: np.ndarray
    horizon: Any
    span: tuple[int, int]


def last_window(recording: Recording, known: NoiseModel, length: int, exact: bool, run: int) -> Last:
    from coopoc.kernels.windows.horizon import Settings, advance, each_group, empty

    box, steps = inbox(recording, 0, FixedLagSmoother().message), len(recording.t)
    seen, assumed = measurements(recording, 0, box), assumptions(recording, known)
    seen = seen._replace(newest=seen.newest.copy(), fresh=np.zeros_like(box.fresh))
    settings = Settings(length, exact, 10 if exact else 0, 0.03, 10.0, False)
    (runs, horizon), span = next(each_group(seen, length)), (steps - length, steps - 1)
    advance(horizon, seen, assumed, box.arrival, settings, runs, (0, steps), empty(seen))
    steps = steps_of(horizon.window, recording, box, run, span)
    points = points_of(horizon.window, run, span)
    return Last(steps, arrival_of(horizon, run, span[0]), points, horizon, span)


def whitened(x: np.ndarray, window: Last) -> np.ndarray:
    """Residuals of a window as they stand in the text books, from its steps and the arrival cost alone."""
    counts = [len(step.previous) for step in window.steps]
    points = np.split(x.reshape(-1, 3), np.cumsum(counts)[:-1])
    arrival, rows = window.arrival, []
    root = np.linalg.cholesky(arrival.information + 1e-12 * np.eye(3 * counts[0]))
    rows.append(root.T @ (points[0] - arrival.at).ravel() - np.linalg.solve(root, arrival.eta))
    for k, (step, here) in enumerate(zip(window.steps, points, strict=True)):
        rows.append((here - step.fix) / step.fix_std)
        if k:
            rows.append((here - points[k - 1][step.previous] - step.moved) / step.moved_std)
        gap = np.stack(spherical(*(here[1:] - here[0]).T), axis=-1) - step.relative
        rows.append(np.concatenate([gap[:, :1], wrap(gap[:, 1:])], axis=1) / S2.relative_std)
    return np.concatenate([r.ravel() for r in rows])


def test_the_window_is_at_its_minimum(formation: Fleet) -> None:
    """Independent check: scipy.optimize.least_squares on the whole window with its arrival cost, from the truth."""
    fleet = formation.select(range(4)).between(0, 12)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=2, observers=[0])
    track, known = MovingHorizon(horizon=4)(recording, [0]), resolve("nominal", recording)
    order = [0, *recording.links.neighbour[:3]]
    start = fleet.position[7:12, order].ravel()
    for run in range(2):
        window = last_window(recording, known, 5, True, run)
        found = least_squares(whitened, start, args=(window,), xtol=1e-12, ftol=1e-12)
        assert track.x[run, -1, 0] == pytest.approx(found.x.reshape(5, 4, 3)[-1, 0], abs=5e-4)
        cov = np.linalg.inv(found.jac.T @ found.jac)[-12:-9, -12:-9]
        assert track.covariance[run, -1, 0] == pytest.approx(cov, abs=2e-3)


def test_late_messages_stand_at_their_true_time(formation: Fleet) -> None:
    """Independent check: numpy.linalg.lstsq over all steps, rows written out from the arrivals of the messages."""
    fleet = formation.select(range(4)).between(0, 9)
    recording = observe(fleet, S2, V2X(max_neighbours=3, latency=0.2, loss=0.3), runs=3, observers=[0])
    track, dt, now = MovingHorizon(horizon=12, noise_model="identity")(recording, [0]), recording.dt, 8
    for run in range(3):
        rows, right = [], []
        place = {(v, s): 4 * s + v for s in range(now + 1) for v in range(4)}

        def row(std: float, value: np.ndarray, *terms: tuple[int, float], rows=rows, right=right) -> None:
            rows.append(np.zeros(4 * (now + 1)))
            for column, sign in terms:
                rows[-1][column] = sign / std
            right.append(value / std)

        links = recording.links
        arrived = {
            (int(n), int(s)): 0 <= a <= now
            for n, s, a in zip(links.neighbour, links.step, recording.arrival[run], strict=True)
        }
        arrived |= {(0, s): True for s in range(now + 1)}
        for s in range(now + 1):
            for link in np.flatnonzero(links.step == s):
                vector = to_vector(recording.relative[run, link])
                row(1.0, vector, (place[int(links.neighbour[link]), s], 1), (place[0, s], -1))
            for v in range(4):
                if arrived[v, s]:
                    row(1.0, recording.gnss[run, s, v], (place[v, s], 1))
                sent = [k for k in range(s + 1) if arrived[v, k]]
                if s and sent:
                    age = s - sent[-1]
                    error = np.sqrt((2 * age + 1) * (1 + (dt**2 * age * ACCELERATION_STD) ** 2))
                    row(error, dt * recording.velocity[run, sent[-1], v], (place[v, s], 1), (place[v, s - 1], -1))
        x = np.linalg.lstsq(np.array(rows), np.array(right))[0]
        assert track.x[run, now, 0] == pytest.approx(x[place[0, now]], abs=1e-4)  # flat priors weigh 1e-6


def test_a_late_message_is_worth_more_in_its_place() -> None:
    """In traffic that brakes, at 1 s of latency: fixes that are brought forward make a filter over-confident."""
    fleet = load_fleet("town10").between(300, 400)
    recording = observe(fleet, S2, V2X(max_neighbours=4, latency=1.0), runs=5, observers=[12])
    late, forward = MovingHorizon(horizon=10)(recording, [12]), JointFilter()(recording, [12])
    assert late.notes == ()
    assert rt_le(late, fleet).mean() < 0.92 * rt_le(forward, fleet).mean()
    assert nees(late, fleet).mean() < 3.6 < 5.0 < nees(forward, fleet).mean()


def test_what_comes_after_the_horizon_is_dropped_and_counted(formation: Fleet) -> None:
    fleet = formation.select(range(3)).between(0, 20)
    recording = observe(fleet, S2, V2X(max_neighbours=2, latency=0.5), runs=2, observers=[0])
    track = MovingHorizon(horizon=4)(recording, [0])
    assert track.notes == (f"{2 * 2 * 15} fixes came later than the horizon and were dropped",)
    solo = Kalman()(recording, [0])  # without a fix of theirs neighbours say nothing of where the ego is
    assert track.x[:, 0, 0] == pytest.approx(solo.x[:, 0, 0], abs=1e-4)
    assert MovingHorizon(horizon=5)(recording, [0]).notes == ()


@pytest.mark.parametrize("method", [FixedLagSmoother(lag=2), MovingHorizon(horizon=2)], ids=label)
def test_consistent_and_on_the_bound(method, formation: Fleet) -> None:
    """NEES gate as in test_methods; RT-LE is not below the filtering bound of the star beyond its interval, nor far."""
    sensors = replace(S2, velocity_reading="speed")
    fleet, v2x = formation.select(range(4)).between(0, 100), V2X(max_neighbours=3)
    track = method(observe(fleet, sensors, v2x, runs=40, seed=1, observers=[0]), [0])
    assert nees_inside(track, fleet).min() >= 0.95
    bound = bound_rt_le(posterior_bound(fleet, sensors, 0, v2x))
    square = rt_le(track, fleet)[:, 0] ** 2
    half = stats.t.ppf(0.995, 39) * square.std(ddof=1) / np.sqrt(40)
    assert square.mean() + half > bound**2
    assert square.mean() - half < 1.05 * bound**2


def test_smoothing_is_held_to_the_smoothing_bound(formation: Fleet) -> None:
    sensors = replace(S2, velocity_reading="speed")
    fleet, v2x = formation.select(range(4)).between(0, 60), V2X(max_neighbours=3)
    recording = observe(fleet, sensors, v2x, runs=20, observers=[0])
    scores = [
        np.sqrt((rt_le(FixedLagSmoother(lag=lag, smoothed=True)(recording, [0]), fleet) ** 2).mean())
        for lag in (0, 3, 10)
    ]
    assert (
        scores[0] > scores[1] > scores[2] > 0.9 * bound_rt_le(posterior_bound(fleet, sensors, 0, v2x, smoothing=True))
    )


@pytest.mark.parametrize("backend", ["osqp", "casadi", "gtsam"])
def test_backends_solve_the_same_windows(crossing: Fleet, backend: str) -> None:
    recording = observe(crossing.between(0, 12), S2, V2X(max_neighbours=3, latency=0.2), runs=1)
    for noise_model, exact, close in (("nominal", False, 1e-6), ("nominal", True, 2e-3)):
        ours, theirs = (
            MovingHorizon(horizon=4, backend=b, noise_model=noise_model, exact=exact)(recording, [0])
            for b in ("gauss-newton", backend)
        )
        assert theirs.x == pytest.approx(ours.x, abs=close)
        assert theirs.covariance == pytest.approx(ours.covariance, abs=1e-9)
        assert theirs.notes == (f"{backend} loops over the runs",)


@pytest.mark.parametrize("backend", ["osqp", "casadi"])
def test_a_road_is_solved_with_the_whole_arrival_cost(crossing: Fleet, backend: str) -> None:
    """Independent check: the dense KKT system of the linear window with its arrival cost and every height 0.3 m."""
    recording = observe(crossing.between(0, 14), S2, V2X(max_neighbours=4), runs=1)
    known = resolve("nominal", recording)
    window = last_window(recording, known, 4, False, 0)
    problem = window_problem(window.horizon, window.steps, known, False, 0, window.span)
    problem, x = limited(problem, recording.dt, 0.3, None), window.points
    solution = solution_of(problem, window.arrival, x, backend)
    r, jacobian = problem.whiten(x)
    hessian, gradient, m = (jacobian.T @ jacobian).toarray(), jacobian.T @ r, window.arrival.at.size
    hessian[:m, :m] += window.arrival.information
    gradient[:m] += window.arrival.information @ (x.ravel()[:m] - window.arrival.at.ravel())
    gradient[:m] -= window.arrival.eta
    assert np.abs(gradient).max() < 1e-6  # the elimination's own answer
    flat = np.eye(x.size)[2::3]
    kkt = np.block([[hessian, flat.T], [flat, np.zeros((len(flat),) * 2)]])
    step = np.linalg.solve(kkt, np.concatenate([-gradient, 0.3 - x[:, 2]]))[: x.size]
    assert solution is not None
    assert np.abs(step).max() > 0.3
    assert solution.x == pytest.approx(x + step.reshape(-1, 3), abs=1e-4)


def test_a_top_speed_is_scipys_constrained_minimum(formation: Fleet) -> None:
    """Independent check: scipy's SLSQP on the whole (first) window of a vehicle that may do 9.8 m/s and does 10."""
    fleet = formation.select(range(2)).between(0, 3)
    recording = observe(fleet, S2, V2X(max_neighbours=1), runs=1, observers=[0], seed=3)
    track = MovingHorizon(horizon=2, backend="casadi", top_speed=9.8)(recording, [0])
    window = last_window(recording, resolve("nominal", recording), 3, True, 0)
    start = window.points

    def room(x: np.ndarray) -> np.ndarray:
        step = np.diff(x.reshape(3, 2, 3), axis=0) / recording.dt
        return (9.8**2 - np.square(step).sum(axis=-1)).ravel()

    found = minimize(
        lambda x: 0.5 * np.square(whitened(x, window)).sum(),
        start.ravel(),
        method="SLSQP",
        constraints={"type": "ineq", "fun": room},
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert room(start.ravel()).min() < 0
    assert track.x[0, -1, 0] == pytest.approx(found.x.reshape(3, 2, 3)[-1, 0], abs=5e-3)


def hill(x, y, m):
    return 0.05 * x + 2.0 * m.sqrt(1.0 + 0.01 * y * y)


def test_constraints_hold_and_help(formation: Fleet) -> None:
    fleet = formation.select(range(3)).between(0, 12)
    recording = observe(fleet, S2, V2X(max_neighbours=2), runs=1, observers=[0])
    free = MovingHorizon(horizon=3)(recording, [0])
    for backend in ("osqp", "casadi"):
        band = MovingHorizon(horizon=3, backend=backend, road=(-1.5, 1.5))(recording, [0])
        level = MovingHorizon(horizon=3, backend=backend, road=0.0)(recording, [0])
        assert np.abs(band.x[..., 2]).max() <= 1.5 + 1e-6
        assert np.abs(level.x[..., 2]).max() < 1e-6
        assert rt_le(level, fleet).mean() < rt_le(band, fleet).mean() < rt_le(free, fleet).mean()
        kept = np.abs(band.x - free.x).max(axis=-1) < 1e-9  # windows that keep the band as they are
        assert kept.any()
        assert not kept.all()
        assert level.notes == (f"{backend} loops over the runs",)
    height = hill(*np.moveaxis(fleet.position[..., :2], -1, 0), np)
    raised = replace(fleet, position=fleet.position + height[..., None] * [0, 0, 1])
    drive = observe(raised, S2, V2X(max_neighbours=2), runs=1, observers=[0])
    track = MovingHorizon(horizon=3, backend="casadi", road=hill, top_speed=15.0)(drive, [0])
    x, y, z = np.moveaxis(track.x, -1, 0)
    assert z == pytest.approx(hill(x, y, np), abs=1e-6)
    assert rt_le(track, raised).mean() < rt_le(MovingHorizon(horizon=3)(drive, [0]), raised).mean()


def test_a_top_speed_is_no_trouble_to_who_stands() -> None:
    """The speed has no derivative at zero; a standing vehicle's windows are solved all the same."""
    position = np.tile([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], (10, 1, 1))
    fleet = Fleet(("a", "b"), np.arange(10) * 0.1, position, 0 * position)
    track = MovingHorizon(horizon=4, backend="casadi", road=0.0, top_speed=20.0)(
        observe(fleet, S2, V2X(max_neighbours=1)), [0]
    )
    assert track.notes == ("casadi loops over the runs",)
    assert np.abs(track.x[..., 2]).max() < 1e-6


def test_the_catalogue_has_them() -> None:
    assert CATALOGUE["fixed-lag"]("nominal").name == "fixed-lag"
    assert CATALOGUE["mhe"]("identity").name == "mhe"


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: FixedLagSmoother(lag=-1), "lag"),
        (lambda: FixedLagSmoother(lag=2, backend="osqp"), "backend"),
        (lambda: MovingHorizon(horizon=0), "horizon"),
        (lambda: MovingHorizon(horizon=5, backend="ipopt"), "backend"),
        (lambda: MovingHorizon(horizon=5, road=0.0), "backend"),
        (lambda: MovingHorizon(horizon=5, backend="osqp", road=hill), "backend"),
        (lambda: MovingHorizon(horizon=5, backend="osqp", top_speed=20.0), "backend"),
        (lambda: MovingHorizon(horizon=5, backend="casadi", top_speed=0.0), "top_speed"),
        (lambda: MovingHorizon(horizon=5, backend="casadi", road=(1.0, 0.0)), "road"),
        (lambda: MovingHorizon(horizon=5, backend="osqp", road=np.nan), "road"),
    ],
)
def test_wrong_input_says_what_to_do(make, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()
