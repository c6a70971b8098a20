"""The snapshot and the joint filter of a star of ten neighbours: compiled, NumPy, the libraries, the floor, in one run.

    OMP_NUM_THREADS=1 python benchmarks/classical.py            # two Markdown tables on stdout, about a minute

Rows of a table solve the same problems, one row after the other in every round. Times are this thread's own, medians of
rounds; the ratios are to be compared. What a library needs as input, whitened or stacked, is prepared before its clock
starts; ours are given with and without what the method does around the kernel. The floor is the flops of one solve at
this core's measured peak of double-precision products. A row counts only if its answer is that of its problem: cost
within 1e-6 relative and position within 1 mm of the reference, for the filter within 1e-9 m.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import gtsam
import numba
import numpy as np
from filterpy.kalman import KalmanFilter
from tabulate import tabulate

import coopoc as co
from coopoc.kernels.compile import SWITCH
from coopoc.kernels.snapshot import snapshots
from coopoc.kernels.star_filter import follow
from coopoc.methods.cooperative_map import LEAST_GROUND, TOLERANCE
from coopoc.methods.star import assumed_arrays, measured_arrays
from coopoc.optimize.batch import solve_batch
from coopoc.optimize.initial import converted
from coopoc.optimize.problem import Problem
from coopoc.world.inbox import inbox
from coopoc.world.spherical import spherical, to_vector, wrap
from coopoc.world.v2x import FIX_AND_VELOCITY

ROUNDS, NEIGHBOURS, STEPS, RUNS = 7, 10, 301, 10
SENSORS = co.Sensors.paper_scenario2()
KNOWN = co.Knowledge("fitted", SENSORS, process_std=(0.15, 0.05, 0.01), gnss_std=SENSORS.gnss_std)
SIZE = 3 * (NEIGHBOURS + 1)
GTSAM, FILTERPY = "GTSAM, linear Between factors, converted problem", "filterpy, KalmanFilter"


class Row(NamedTuple):
    """One way to do the job: its words, solves per call, the call, the distance from its reference, if it is right."""

    words: str
    solves: int
    call: Callable[[], Any]
    difference: float
    right: bool


def ring() -> co.Recording:
    """An ego that drives with ten neighbours around it."""
    t = np.arange(STEPS) * 0.1
    around = np.linspace(0, 2 * np.pi, NEIGHBOURS, endpoint=False)
    gap = np.linspace(12, 25, NEIGHBOURS)
    offset = np.vstack([np.zeros(3), np.stack([gap * np.cos(around), gap * np.sin(around), 0.05 * gap], axis=1)])
    path = np.stack([10 * t, 5 * np.sin(t / 5), 0 * t], axis=1)
    position = path[:, None] + offset
    velocity = np.diff(position, axis=0, prepend=2 * position[:1] - position[1:2]) / 0.1
    fleet = co.Fleet(tuple(f"v{i}" for i in range(NEIGHBOURS + 1)), t, position, velocity)
    return co.observe(fleet, SENSORS, co.V2X(max_neighbours=NEIGHBOURS), runs=RUNS, observers=[0])


def peak() -> float:
    """Double-precision flops per second of one core in a large product."""
    a = np.ones((700, 700))
    return max(2.0 * 700**3 / timed(lambda: a @ a) for _ in range(9))


def timed(call: Callable[[], Any]) -> float:
    began = time.thread_time()
    call()
    return time.thread_time() - began


def plain(call: Callable[[], Any]) -> Any:
    """The call in NumPy."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "numpy"
    try:
        return call()
    finally:
        os.environ.pop(SWITCH)
        if before is not None:
            os.environ[SWITCH] = before


def snapshot_rows(recording: co.Recording) -> list[Row]:
    """Each against `solve_batch` to 1e-10 m of the exact, and of the converted, problem."""
    stars = [Problem.from_snapshot(recording, t, 0, run=None, noise=KNOWN) for t in range(20)]
    exact = np.stack([solve_batch(p, tolerance=1e-10).x for p in stars], axis=1)
    linear = np.stack([solve_batch(converted(p)).x for p in stars], axis=1)
    floor = np.stack([p.linearise(exact[:, t]).cost for t, p in enumerate(stars)], axis=1)

    def judged(words: str, solves: int, call: Callable[[], Any], found: Any, wanted: Any, costs: bool = True) -> Row:
        """`found` (R, 20, n, 3) in the order of `stars`, or (R, 20, 3) of the ego."""
        full = found.ndim == 4
        away = float(np.abs(found - (wanted if full else wanted[:, :, 0])).max())
        right = away < 1e-3
        if full and costs:
            cost = np.stack([p.linearise(found[:, t]).cost for t, p in enumerate(stars)], axis=1)
            right = right and float((cost / floor - 1).max()) < 1e-6
        return Row(words, solves, call, away, right)

    box = inbox(recording, 0, FIX_AND_VELOCITY)
    measured, assumed = measured_arrays(recording, 0, box), assumed_arrays(recording, KNOWN)
    method, count = co.CooperativeMAP(knowledge=KNOWN), RUNS * STEPS
    kernel = snapshots(measured, assumed, TOLERANCE, LEAST_GROUND)
    whole = np.concatenate([kernel[0][:, :, None], kernel[2].reshape(RUNS, STEPS, NEIGHBOURS, 3)], axis=2)[:, :20]
    graphs = [gtsam_snapshot(recording, run, t) for t in range(20) for run in range(RUNS)]
    found = np.stack([gtsam_solve(g) for g in graphs]).reshape(20, RUNS, -1, 3).swapaxes(0, 1)
    def kernels() -> Any:
        return snapshots(measured, assumed, TOLERANCE, LEAST_GROUND)

    def ours() -> Any:
        return method(recording, [0])

    def gtsam_all() -> Any:
        return [gtsam_solve(g) for g in graphs]

    rows = [
        judged("compiled kernel, exact", count, kernels, whole, exact),
        judged("CooperativeMAP, compiled", count, ours, ours().x[:, :20, 0], exact),
        judged("CooperativeMAP, NumPy", count, lambda: plain(ours), plain(ours).x[:, :20, 0], exact),
        judged(GTSAM, len(graphs), gtsam_all, found, linear, costs=False),
    ]
    return [*rows, *stone_soup_snapshot(recording, graphs, exact, judged)]


def gtsam_snapshot(recording: co.Recording, run: int, t: int) -> tuple[Any, ...]:
    """Fixes, converted vectors and their square-root informations, as NumPy makes them beforehand; what was measured,
    its angles within half a turn of those between the fixes, as a filter without circular numbers needs it."""
    links = slice(t * NEIGHBOURS, (t + 1) * NEIGHBOURS)
    order = [0, *recording.links.neighbour[links]]
    relative = recording.relative[run, links]
    factor = converted(Problem.from_snapshot(recording, t, 0, run=run, noise=KNOWN)).factors[1]
    fix = recording.gnss[run, t, order]
    expected = np.stack(spherical(*(fix[1:] - fix[0]).T), axis=1)
    near = np.concatenate([relative[:, :1], expected[:, 1:] + wrap(relative - expected)[:, 1:]], axis=1)
    return fix, to_vector(relative), factor.root, relative, near


def gtsam_solve(star: tuple[Any, ...]) -> np.ndarray:
    """Graph built and solved, (n, 3)."""
    fix, vector, root = star[:3]
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))
    zero = np.zeros(3)
    for k in range(len(fix)):
        graph.add(gtsam.PriorFactorPoint3(k, fix[k], noise))
        start.insert(k, zero)
    for k in range(len(vector)):
        edge = gtsam.noiseModel.Gaussian.SqrtInformation(root[k], False)
        graph.add(gtsam.BetweenFactorPoint3(0, k + 1, vector[k], edge))
    found = graph.linearize(start).optimize()
    return np.stack([found.at(k) for k in range(len(fix))])


def stone_soup() -> Any:
    """Stone Soup's parts; None where it is not installed."""
    try:
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.prediction import GaussianStatePrediction
        from stonesoup.updater.kalman import ExtendedKalmanUpdater, KalmanUpdater
    except ImportError:
        return None
    return (LinearGaussian, NonLinearGaussianMeasurement, Detection, SingleHypothesis, GaussianStatePrediction,
            ExtendedKalmanUpdater, KalmanUpdater)  # fmt: skip


def stone_soup_snapshot(recording: co.Recording, graphs: list[Any], exact: Any, judged: Any) -> list[Row]:
    """Its extended filter's update of the fixes by ranges and angles: one step, so not the same answer."""
    parts = stone_soup()
    if parts is None:
        return []
    _, nonlinear, detection, hypothesis, prediction, extended, _ = parts

    class Star(nonlinear):  # type: ignore[misc, valid-type]
        @property
        def ndim_meas(self) -> int:
            return 3 * NEIGHBOURS

        def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
            x = np.asarray(state.state_vector, dtype=float).reshape(-1, 3)
            seen = spherical(*(x[1:] - x[0]).T)
            return np.stack(seen, axis=1).reshape(-1, 1)

        def jacobian(self, state: Any, **_: Any) -> Any:
            x = np.asarray(state.state_vector, dtype=float).reshape(-1, 3)
            dx, dy, dz = (x[1:] - x[0]).T
            flat2 = dx**2 + dy**2
            flat, r2 = np.sqrt(flat2), flat2 + dz**2
            r = np.sqrt(r2)
            slope = np.array([[dx / r, dy / r, dz / r], [-dy / flat2, dx / flat2, 0 * r],
                              [dx * dz / (flat * r2), dy * dz / (flat * r2), -flat / r2]])  # fmt: skip
            out = np.zeros((NEIGHBOURS, 3, NEIGHBOURS + 1, 3))
            each = np.arange(NEIGHBOURS)
            out[each, :, each + 1] = np.moveaxis(slope, 2, 0)
            out[each, :, 0] = -np.moveaxis(slope, 2, 0)
            return out.reshape(3 * NEIGHBOURS, SIZE)

    std = np.tile(SENSORS.relative_std, NEIGHBOURS)
    model = Star(ndim_state=SIZE, mapping=tuple(range(SIZE)), noise_covar=np.diag(std**2))
    updater = extended(measurement_model=model)
    prior_cov = np.diag(np.tile(KNOWN.gnss_variance, NEIGHBOURS + 1))

    def solve(star: tuple[Any, ...]) -> np.ndarray:
        prior = prediction(star[0].reshape(-1, 1), prior_cov)
        seen = detection(star[4].reshape(-1, 1), measurement_model=model)
        return np.asarray(updater.update(hypothesis(prior, seen)).state_vector, dtype=float).reshape(-1, 3)

    found = np.stack([solve(g) for g in graphs]).reshape(20, RUNS, -1, 3).swapaxes(0, 1)
    return [judged("Stone Soup, extended update", len(graphs), lambda: [solve(g) for g in graphs], found, exact)]


def filter_rows(recording: co.Recording) -> list[Row]:
    """The linear filter against filterpy's, run by run, and what the exact one costs more."""
    box = inbox(recording, 0, FIX_AND_VELOCITY)
    measured, assumed = measured_arrays(recording, 0, box), assumed_arrays(recording, KNOWN)
    linear, exact = co.JointFilter(KNOWN, exact=False), co.JointFilter(KNOWN)
    drives = [peer_drive(recording, run) for run in range(2)]
    peer = np.stack([filterpy_drive(d) for d in drives])
    best = plain(lambda: exact(recording, [0])).x[:, :, 0]

    def judged(words: str, call: Callable[[], Any], found: Any, wanted: Any, solves: int = RUNS * STEPS) -> Row:
        away = float(np.abs(found[: len(wanted)] - wanted).max())
        return Row(words, solves, call, away, away < 1e-9)

    def kernel(refine: bool) -> Any:
        return follow(measured, assumed, refine)[0]

    def all_steps(method: co.JointFilter) -> Any:
        return method(recording, [0]).x[:, :, 0]

    rows = [
        judged("compiled kernel, linear", lambda: kernel(False), kernel(False), peer),
        judged("compiled kernel, exact", lambda: kernel(True), kernel(True), best),
        judged("JointFilter(exact=False), compiled", lambda: all_steps(linear), all_steps(linear), peer),
        judged("JointFilter(), compiled", lambda: all_steps(exact), all_steps(exact), best),
        judged("JointFilter(exact=False), NumPy", lambda: plain(lambda: all_steps(linear)),
               plain(lambda: all_steps(linear)), peer),
        judged("JointFilter(), NumPy", lambda: plain(lambda: all_steps(exact)), best, best),
        judged(FILTERPY, lambda: [filterpy_drive(d) for d in drives], peer, peer, 2 * STEPS),
    ]  # fmt: skip
    if stone_soup() is not None:
        found = np.stack([stone_soup_drive(d) for d in drives])
        rows.append(judged("Stone Soup, KalmanUpdater", lambda: [stone_soup_drive(d) for d in drives], found, peer,
                           2 * STEPS))  # fmt: skip
    return rows


class Drive(NamedTuple):
    """One run as a library takes it: state and covariance after step 0, and of each step moves (T, n), measurements
    (T, m) and their noise (T, m, m)."""

    x: np.ndarray
    p: np.ndarray
    moved: np.ndarray
    z: np.ndarray
    noise: np.ndarray
    h: np.ndarray
    q: np.ndarray


def peer_drive(recording: co.Recording, run: int) -> Drive:
    """Stacked matrices in the order of columns; noise at the predicted geometry, found by a NumPy filter beforehand."""
    n, m = SIZE, SIZE + 3 * NEIGHBOURS
    h = np.vstack([np.eye(n), np.kron(np.hstack([-np.ones((NEIGHBOURS, 1)), np.eye(NEIGHBOURS)]), np.eye(3))])
    q = np.kron(np.eye(NEIGHBOURS + 1), np.diag(np.square(KNOWN.process_std)))
    z, noise = np.zeros((STEPS, m)), np.zeros((STEPS, m, m))
    moved = 0.1 * recording.velocity[run].reshape(STEPS, n)
    x, information = np.zeros(n), np.eye(n) / 1e6
    for t in range(STEPS):
        links = slice(t * NEIGHBOURS, (t + 1) * NEIGHBOURS)
        order = np.argsort(recording.links.neighbour[links])
        vector = to_vector(recording.relative[run, links][order])
        z[t] = np.concatenate([recording.gnss[run, t].ravel(), vector.ravel()])
        x = x + moved[t] if t else np.concatenate([z[0, :3], (z[0, :3] + vector).ravel()])
        if t:
            information = np.linalg.inv(np.linalg.inv(information) + q)
        seen = np.stack(spherical(*(x[3:].reshape(-1, 3) - x[:3]).T), axis=1)
        noise[t, :n, :n] = np.diag(np.tile(KNOWN.gnss_variance, NEIGHBOURS + 1))
        for k, cov in enumerate(KNOWN.relative_cov(seen)):
            noise[t, n + 3 * k : n + 3 * k + 3, n + 3 * k : n + 3 * k + 3] = cov
        weight = h.T @ np.linalg.inv(noise[t])
        information = information + weight @ h
        x = x + np.linalg.solve(information, weight @ (z[t] - h @ x))
        if t == 0:
            first = x, np.linalg.inv(information)
    return Drive(*first, moved, z, noise, h, q)


def filterpy_drive(drive: Drive) -> np.ndarray:
    """(T, 3) of the ego."""
    peer = KalmanFilter(dim_x=SIZE, dim_z=len(drive.h), dim_u=SIZE)
    peer.B, peer.H, peer.Q, peer.x, peer.P = np.eye(SIZE), drive.h, drive.q, drive.x, drive.p
    found = np.empty((STEPS, 3))
    found[0] = drive.x[:3]
    for t in range(1, STEPS):
        peer.predict(u=drive.moved[t])
        peer.update(drive.z[t], R=drive.noise[t])
        found[t] = peer.x[:3]
    return found


def stone_soup_drive(drive: Drive) -> np.ndarray:
    """(T, 3) of the ego; the prediction is one sum, which its predictors would make no faster."""
    model_of, _, detection, hypothesis, prediction, _, kalman = stone_soup()
    found = np.empty((STEPS, 3))
    x, p = drive.x[:, None], drive.p
    found[0] = drive.x[:3]
    shown = drive.h
    for t in range(1, STEPS):
        model = model_of(ndim_state=SIZE, mapping=tuple(range(SIZE)), noise_covar=drive.noise[t])
        model.matrix = lambda **_: shown
        prior = prediction(x + drive.moved[t][:, None], p + drive.q)
        seen = detection(drive.z[t][:, None], measurement_model=model)
        made = kalman(measurement_model=model).update(hypothesis(prior, seen))
        x, p = np.asarray(made.state_vector, dtype=float), np.asarray(made.covar, dtype=float)
        found[t] = x[:3, 0]
    return found


def seconds(rows: list[Row]) -> dict[str, float]:
    """Per solve, medians of interleaved rounds."""
    spent: dict[str, list[float]] = {row.words: [] for row in rows}
    for _ in range(ROUNDS):
        for row in rows:
            spent[row.words].append(timed(row.call) / row.solves)
    return {words: float(np.median(times)) for words, times in spent.items()}


def parts() -> list[tuple[str, str, list[Row]]]:
    """The two jobs, each with the row that it is compared to."""
    recording = ring()
    return [("snapshot", GTSAM, snapshot_rows(recording)), ("joint filter", FILTERPY, filter_rows(recording))]


def measured(found: list[tuple[str, str, list[Row]]] | None = None) -> list[dict[str, Any]]:
    """Per row its name, microseconds, the ratio to the peer's time, and whether its answer is right: None where it is
    another one by construction."""
    out: list[dict[str, Any]] = []
    for job, peer, rows in parts() if found is None else found:
        medians = seconds(rows)
        for row in rows:
            right = None if row.words.startswith("Stone Soup, extended") else row.right
            spent = medians[row.words]
            ratio = spent / medians[peer]
            out.append({"name": f"{job}: {row.words}", "us": 1e6 * spent, "ratio": ratio, "right": right})
    return out


def table(rows: list[Row], peer: str, floor: float) -> str:
    """Medians of interleaved rounds, and ratios to a peer and to the floor (s per solve)."""
    medians = seconds(rows)
    lines = [[row.words, 1e6 * medians[row.words], medians[peer] / medians[row.words], medians[row.words] / floor,
              row.difference, "yes" if row.right else "NO"] for row in rows]  # fmt: skip
    if stone_soup() is None:
        lines.append(["Stone Soup: not installed", None, None, None, None, ""])
    lines.append(["floor: flops at the measured peak", 1e6 * floor, medians[peer] / floor, 1.0, None, ""])
    header = ["", "us", f"x {peer.split(',')[0]}", "x floor", "difference m", "same answer"]
    return tabulate(lines, header, tablefmt="github", floatfmt=("", ".3g", ".3g", ".3g", ".1e", ""))


def main() -> None:
    """Print the tables."""
    recording, speed = ring(), peak()
    print(f"{NEIGHBOURS} neighbours, {STEPS} steps, {RUNS} runs, one thread; products at {speed / 1e9:.0f} GFLOP/s; "
          f"numba {numba.__version__}, gtsam {version('gtsam')}.\n")  # fmt: skip
    print("Snapshot, per solve:\n")
    print(table(snapshot_rows(recording), GTSAM, 6300 / speed), "\n")
    print("Joint filter, per step:\n")
    print(table(filter_rows(recording), FILTERPY, (4 * SIZE**3 / 3) / speed))


if __name__ == "__main__":
    main()
