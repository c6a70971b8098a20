"""The whole fleet: batch smoother of 60 vehicles and 200 steps, neighbour search, noise, filters, in one run.

    OMP_NUM_THREADS=1 python benchmarks/fleet.py            # a Markdown table on stdout, half a minute

Vehicles drive at random through a grid of streets, blocks of 60 m, as many a block at every size. Times are those of
the process on its processors, medians of interleaved rounds; the ratios are to be compared. GTSAM gets factors whose
matrices NumPy has made beforehand. A row counts only if its answer is that of its problem: position within 1 mm and
cost within 1e-6 of the reference, links the same in the same order, the solo filter within 1e-9 m.
"""

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gtsam
import numpy as np
from filterpy.kalman import KalmanFilter
from timing import medians, report, rows_of

import coopoc as co
from coopoc.kernels.solo import FixNoise
from coopoc.methods.kalman import solo_filter
from coopoc.world import sensing
from coopoc.world.links import to_vector

VEHICLES, BLOCK = 60, 60.0
SHORT, SEARCHED = 200, ((60, 60), (1000, 4))
"""Of the common report, which should take half a minute: steps of the drive; vehicles and steps of the searches."""
SENSORS, CHANNEL = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=10)
KNOWN = co.NoiseModel.nominal(SENSORS)
ROUNDS = 3


class Row(NamedTuple):
    """One way to do the job: its words, the call, and whether its answer is that of its problem."""

    words: str
    call: Callable[[], Any]
    right: bool


def town(vehicles: int, steps: int, seed: int = 0) -> co.Fleet:
    """Vehicles that turn at random where streets cross; four or so to a crossing, whatever their number."""
    rng, across = np.random.default_rng(seed), round(np.sqrt(vehicles / 60) * 4)
    turns = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    position = np.empty((steps, vehicles, 3))
    for vehicle in range(vehicles):
        here, course = rng.integers(0, across, 2), int(rng.integers(4))
        gone = rng.uniform(0, BLOCK) + 0.1 * rng.uniform(6, 13) * np.arange(steps)
        corners = [here]
        while len(corners) * BLOCK < gone[-1] + 2 * BLOCK:
            ways = [
                c
                for c in (course, course - 1, course + 1, course + 2)
                if ((here + turns[c % 4] >= 0) & (here + turns[c % 4] < across)).all()
            ][:3]
            course = int(rng.choice(ways)) % 4
            here = here + turns[course]
            corners.append(here)
        at = BLOCK * np.arange(len(corners))
        lane = rng.uniform(-3, 3, 2)
        for c in range(2):
            position[:, vehicle, c] = np.interp(gone, at, BLOCK * np.array(corners)[:, c]) + lane[c]
        position[:, vehicle, 2] = 0.5 * np.sin(gone / 50)
    velocity = np.diff(position, axis=0, prepend=2 * position[:1] - position[1:2]) / 0.1
    return co.Fleet(tuple(f"v{i}" for i in range(vehicles)), 0.1 * np.arange(steps), position, velocity)


def timed(call: Callable[[], Any]) -> float:
    gc.collect()
    gc.disable()  # GTSAM's factors are many objects, which every collection would visit during another measurement
    began = time.process_time()
    call()
    spent = time.process_time() - began
    gc.enable()
    return spent


class Linear(NamedTuple):
    """The converted problem as GTSAM takes it: keys, vectors m and square-root informations of its factors."""

    fixes: list[Any]
    ties: list[Any]
    start: np.ndarray


def linear(recording: co.Recording) -> Linear:
    """Factors of run 0, everything but their objects."""
    steps, vehicles = recording.gnss.shape[1:3]
    links, relative = recording.links, recording.relative[0]
    vectors = to_vector(relative)
    roots = np.linalg.cholesky(np.linalg.inv(KNOWN.relative_cov(relative))).swapaxes(-1, -2)
    keys = np.arange(steps * vehicles).reshape(steps, vehicles)
    moved, std = recording.dt * recording.velocity[0], np.sqrt(KNOWN.process_variance(recording)[0])
    fixes = list(zip(keys.ravel().tolist(), recording.gnss[0].reshape(-1, 3), strict=True))
    ties = [
        (int(keys[t - 1, k]), int(keys[t, k]), moved[t, k], gtsam.noiseModel.Diagonal.Sigmas(std[t, k]))
        for t in range(1, steps)
        for k in range(vehicles)
    ]
    ties += [
        (int(a), int(b), vector, gtsam.noiseModel.Gaussian.SqrtInformation(np.asfortranarray(root), False))
        for a, b, vector, root in zip(
            keys[links.step, links.observer], keys[links.step, links.neighbour], vectors, roots, strict=True
        )
    ]
    start = solo(recording)[0]
    return Linear(fixes, ties, start)


def by_gtsam(problem: Linear) -> np.ndarray:
    """Positions (T, N, 3) of GTSAM's Levenberg-Marquardt, from the solo filters."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    of_a_fix = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))
    for key, fix in problem.fixes:
        graph.add(gtsam.PriorFactorPoint3(key, fix, of_a_fix))
    for first, second, vector, model in problem.ties:
        graph.add(gtsam.BetweenFactorPoint3(first, second, vector, model))
    for key, x in enumerate(problem.start.reshape(-1, 3)):
        values.insert(key, x)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    x = np.array([found.atPoint3(k) for k in range(len(problem.fixes))])
    return x.reshape(problem.start.shape)


def smoother_rows(recording: co.Recording) -> list[Row]:
    """Against GTSAM's linear graph, from which the curvature of ranges and angles leads a few centimetres away."""
    problem, everyone, method = linear(recording), range(VEHICLES), co.BatchSmoother(robust=False)
    away = method(recording, everyone).x[0] - by_gtsam(problem)
    right = bool(np.sqrt(np.square(away).mean()) < 0.1)
    return [
        Row("BatchSmoother, all marginals", lambda: method(recording, everyone), right),
        Row(GTSAM, lambda: by_gtsam(problem), True),
    ]


def seconds(rows: Sequence[Row]) -> dict[str, float]:
    """Per call, medians of interleaved rounds."""
    return medians({row.words: lambda row=row: timed(row.call) for row in rows}, ROUNDS)


GTSAM, FILTERPY = "GTSAM Levenberg-Marquardt, converted problem, no marginals", "filterpy, KalmanFilter"


def by_pairs(fleet: co.Fleet, most: int, radius: float, least: float) -> np.ndarray:
    """Links (L, 3) from every distance, N x N of them at each step."""
    found = []
    for t, position in enumerate(fleet.position):
        gap = np.linalg.norm(position - position[:, None], axis=2)
        np.fill_diagonal(gap, np.inf)
        gap[~((gap <= radius) & (gap >= least))] = np.inf
        order = np.argsort(gap, axis=1, kind="stable")[:, :most]
        observer, rank = np.nonzero(np.isfinite(np.take_along_axis(gap, order, axis=1)))
        found.append(np.column_stack([np.full(len(observer), t), observer, order[observer, rank]]))
    return np.concatenate(found)


def search_rows(sizes: Sequence[tuple[int, int]]) -> list[dict[str, Any]]:
    """Neighbour search of whole fleets: microseconds per vehicle and step, their ratio to a table of all pairs."""
    out, args = [], (CHANNEL.max_neighbours, CHANNEL.radius, SENSORS.min_range)
    for vehicles, steps in sizes:
        fleet, everyone = town(vehicles, steps), range(vehicles)
        found = sensing.find_links(fleet, everyone, CHANNEL, SENSORS.min_range)
        same = np.array_equal(by_pairs(fleet, *args), np.column_stack([found.step, found.observer, found.neighbour]))
        spent = [
            (
                timed(lambda f=fleet, e=everyone: sensing.find_links(f, e, CHANNEL, SENSORS.min_range)),
                timed(lambda f=fleet: by_pairs(f, *args)),
            )
            for _ in range(ROUNDS)
        ]
        ours, table_of_all = np.median(spent, axis=0)
        out.append(
            {
                "name": f"neighbours, {vehicles} vehicles",
                "us": 1e6 * float(ours) / (vehicles * steps),
                "ratio": float(ours / table_of_all),
                "right": same,
            }
        )
    return out


def parts() -> list[tuple[str, str, list[Row]]]:
    """The jobs of a short drive, each with the row that it is compared to."""
    recording = co.observe(town(VEHICLES, SHORT), SENSORS, CHANNEL)
    return [
        ("smoother", GTSAM, smoother_rows(recording)),
        ("solo", FILTERPY, solo_rows(recording)),
    ]


def measured() -> list[dict[str, Any]]:
    """Per row its name, microseconds per vehicle and step, the ratio to the peer's time, and whether it is right."""
    out = []
    for job, peer, rows in parts():
        spent = {words: each / (VEHICLES * SHORT) for words, each in seconds(rows).items()}
        out += rows_of(f"{job}: ", spent, peer, {row.words: row.right for row in rows})
    return [*out, *search_rows(SEARCHED)]


def solo(recording: co.Recording) -> np.ndarray:
    """Positions of all vehicles by the solo filter's kernel."""
    return solo_filter(recording, range(len(recording.ids)), KNOWN, FixNoise(KNOWN.gnss_variance))[0]


def solo_rows(recording: co.Recording) -> list[Row]:
    """All vehicles; filterpy's is one vehicle's time times their number."""
    variance, vehicles = KNOWN.process_variance(recording), len(recording.ids)

    def peer(vehicle: int) -> np.ndarray:
        filter_ = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
        filter_.x, filter_.P = recording.gnss[0, 0, vehicle].copy(), np.diag(KNOWN.gnss_variance)
        filter_.B, filter_.H, filter_.R = 0.1 * np.eye(3), np.eye(3), np.diag(KNOWN.gnss_variance)
        found = [filter_.x]
        for t in range(1, len(recording.t)):
            filter_.predict(u=recording.velocity[0, t, vehicle], Q=np.diag(variance[0, t, vehicle]))
            filter_.update(recording.gnss[0, t, vehicle])
            found.append(filter_.x)
        return np.array(found)

    wanted = np.stack([peer(k) for k in range(vehicles)], axis=1)

    def row(words: str, call: Callable[[], Any], found: np.ndarray) -> Row:
        away = float(np.abs(found - wanted).max())
        return Row(words, call, away < 1e-9)

    return [
        row(
            "Kalman, compiled",
            lambda: co.Kalman(robust=False)(recording, range(vehicles)),
            co.Kalman(robust=False)(recording, range(vehicles)).x[0],
        ),
        Row(FILTERPY, lambda: [peer(k) for k in range(vehicles)], True),
        Row(
            "floor: a copy of what is read and written",
            lambda: [a.copy() for a in (recording.gnss, recording.velocity, variance, recording.gnss, variance)],
            True,
        ),
    ]


if __name__ == "__main__":
    print(report(measured()))
