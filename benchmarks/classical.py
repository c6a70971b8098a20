"""The joint filter of a star of ten neighbours: compiled, NumPy and the libraries, in one run.

    OMP_NUM_THREADS=1 python benchmarks/classical.py            # a Markdown table on stdout, about a minute

Rows solve the same problems, one row after the other in every round. Times are this thread's own, medians of
rounds; the ratios are to be compared. What a library needs as input, whitened or stacked, is prepared before its clock
starts; ours are given with and without what the method does around the kernel. A row counts only if its answer is that
of its problem, within 1e-9 m.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from timing import medians, report, rows_of, timed

import coopoc as co
from coopoc.kernels.stars.joint_filter import run_filter
from coopoc.methods.egos import assumptions, measurements
from coopoc.world.inbox import inbox
from coopoc.world.links import spherical, to_vector
from coopoc.world.v2x import FIX_AND_VELOCITY

ROUNDS, NEIGHBOURS, STEPS, RUNS = 7, 10, 301, 10
SENSORS = co.Sensors.paper_scenario2()
KNOWN = co.NoiseModel("fitted", SENSORS, process_std=(0.15, 0.05, 0.01), gnss_std=SENSORS.gnss_std)
SIZE = 3 * (NEIGHBOURS + 1)
FILTERPY = "filterpy, KalmanFilter"


class Row(NamedTuple):
    """One way to do the job: its words, solves per call, the call, and whether its answer is that of its problem."""

    words: str
    solves: int
    call: Callable[[], Any]
    right: bool


def ring(neighbours: int, steps: int, runs: int, sensors: co.Sensors = SENSORS, frame: str = "world") -> co.Recording:
    """An ego that drives with neighbours around it."""
    t = np.arange(steps) * 0.1
    around = np.linspace(0, 2 * np.pi, neighbours, endpoint=False)
    gap = np.linspace(12, 25, neighbours)
    offset = np.vstack([np.zeros(3), np.stack([gap * np.cos(around), gap * np.sin(around), 0.05 * gap], axis=1)])
    path = np.stack([10 * t, 5 * np.sin(t / 5), 0 * t], axis=1)
    position = path[:, None] + offset
    velocity = np.diff(position, axis=0, prepend=2 * position[:1] - position[1:2]) / 0.1
    fleet = co.Fleet(tuple(f"v{i}" for i in range(neighbours + 1)), t, position, velocity)
    v2x = co.V2X(max_neighbours=neighbours)
    return co.observe(fleet, sensors, v2x, runs=runs, observers=[0], frame=frame)


def filter_rows(recording: co.Recording) -> list[Row]:
    """The linear filter against filterpy's, run by run, and what the exact one costs more."""
    box = inbox(recording, 0, FIX_AND_VELOCITY)
    measured, assumed = measurements(recording, 0, box), assumptions(recording, KNOWN, 0, box)
    linear, exact = (co.JointFilter(KNOWN, exact=wish, robust=False) for wish in (False, True))  # as filterpy's
    drives = [peer_drive(recording, run) for run in range(2)]
    peer = np.stack([filterpy_drive(d) for d in drives])
    best = exact(recording, [0]).x[:, :, 0]

    def judged(words: str, call: Callable[[], Any], found: Any, wanted: Any, solves: int = RUNS * STEPS) -> Row:
        away = float(np.abs(found[: len(wanted)] - wanted).max())
        return Row(words, solves, call, away < 1e-9)

    def kernel(refine: bool) -> Any:
        return run_filter(measured, assumed, refine, False, False)[0]

    def all_steps(method: co.JointFilter) -> Any:
        return method(recording, [0]).x[:, :, 0]

    return [
        judged("compiled kernel, linear", lambda: kernel(False), kernel(False), peer),
        judged("compiled kernel, exact", lambda: kernel(True), kernel(True), best),
        judged("JointFilter(exact=False), compiled", lambda: all_steps(linear), all_steps(linear), peer),
        judged("JointFilter(), compiled", lambda: all_steps(exact), all_steps(exact), best),
        judged(FILTERPY, lambda: [filterpy_drive(d) for d in drives], peer, peer, 2 * STEPS),
    ]


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


def seconds(rows: list[Row]) -> dict[str, float]:
    """Per solve, medians of interleaved rounds."""
    return medians({row.words: lambda row=row: timed(row.call) / row.solves for row in rows}, ROUNDS)


def parts() -> list[tuple[str, str, list[Row]]]:
    """The two jobs, each with the row that it is compared to."""
    recording = ring(NEIGHBOURS, STEPS, RUNS)
    return [("joint filter", FILTERPY, filter_rows(recording))]


def measured() -> list[dict[str, Any]]:
    """Per row its name, microseconds, the ratio to the peer's time, and whether its answer is right."""
    out: list[dict[str, Any]] = []
    for job, peer, rows in parts():
        out += rows_of(f"{job}: ", seconds(rows), peer, {row.words: row.right for row in rows})
    return out


if __name__ == "__main__":
    print(report(measured()))
