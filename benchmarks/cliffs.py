"""What each method costs when the input is not the plain case: gaps, absences, one run, drift, smoothing, a stream.

    OMP_NUM_THREADS=1 python benchmarks/cliffs.py            # a Markdown table on stdout, about two minutes

Whole methods with their inbox and Track, on town traffic at K = 6, ten runs. A row is its time per step, run and
estimated vehicle; its ratio, to that of the plain case in the same rounds, is not to exceed 1.5; of a stream, to
filterpy's step of the same state. One run alone leaves the other lanes of a kernel empty and pays for Python's part of
a call itself. Right means finite estimates for every ego at every step.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from timing import medians, report, timed

import coopoc as co
from coopoc.methods.catalogue import METHODS
from coopoc.methods.cooperative_filter import CooperativeFilter

ROUNDS, NEIGHBOURS, STEPS, RUNS, EGO = 5, 6, 60, 10, 0
GAPS = (
    "kalman",
    "lkf-sa",
    "lkf-sa-edge",
    "msmv-r",
    "joint",
    "cooperative-filter",
    "ci",
    "split-ci",
)
"""Methods that are tried with missing fixes and with vehicles that come and go."""
NOISE = co.Sensors.paper_scenario2()


class Case(NamedTuple):
    """One row: its name, the name of the row that it is compared with, the call, and the estimates that it makes."""

    name: str
    plain: str
    call: Callable[[], Any]
    count: int


def missing(recording: co.Recording, share: float = 0.1) -> co.Recording:
    """The recording without a share of its fixes; the first ones stay."""
    gnss = recording.gnss.copy()
    gone = np.random.default_rng(0).uniform(size=gnss.shape[:3]) < share
    gone[:, 0] = False
    gnss[gone] = np.nan
    return replace(recording, gnss=gnss)


def absent(fleet: co.Fleet) -> co.Fleet:
    """The fleet whose every third vehicle but the ego is away for a third of the drive."""
    position, velocity = fleet.position.copy(), fleet.velocity.copy()
    third = len(fleet.t) // 3
    for array in (position, velocity):
        array[third : 2 * third, 1::3] = np.nan
    return replace(fleet, position=position, velocity=velocity)


def seen(fleet: co.Fleet, noise: co.Sensors, runs: int = RUNS, **channel: Any) -> co.Recording:
    """What the ego measures."""
    v2x = co.V2X(max_neighbours=NEIGHBOURS, **channel)
    return co.observe(fleet, noise, v2x, runs=runs, observers=[EGO])


def method_cases() -> Iterator[Case]:
    """Each method plain, with missing fixes, with absences, over a late and lossy channel and in one run alone."""
    fleet = co.load_fleet("town10").between(0, STEPS)

    def case(name: str, plain: str, method: Any, recording: co.Recording) -> Case:
        members = 1 + len(recording.links.of(EGO)) / STEPS
        return Case(name, plain, lambda: method(recording, [EGO]).x, round(STEPS * len(recording.gnss) * members))

    for name in GAPS:
        method, recording = METHODS[name]("nominal"), seen(fleet, NOISE)
        yield case(f"{name}, plain", f"{name}, plain", method, recording)
        yield case(f"{name}, missing fixes", f"{name}, plain", method, missing(recording))
        yield case(f"{name}, absences", f"{name}, plain", method, seen(absent(fleet), NOISE))
        late = seen(fleet, NOISE, latency=0.2, loss=0.3)
        yield case(f"{name}, late and lost", f"{name}, plain", method, late)
        yield case(f"{name}, one run", f"{name}, plain", method, seen(fleet, NOISE, runs=1))
    drifting = replace(NOISE, gnss_drift_std=2.0, gnss_common_std=1.0)
    name, measured_by = "cooperative-filter, time-correlated errors", seen(fleet, drifting)
    yield case(name, "joint, plain", CooperativeFilter(), measured_by)


def stream_cases() -> Iterator[Case]:
    """A stream's step beside filterpy's of the same state: solo, and a star of ten."""
    z, u, steps = np.zeros(3), np.array([9.0, 1.0, 0.0]), 200
    known = co.NoiseModel.nominal(NOISE)
    for n, name in ((1, "kalman stream"), (11, "cooperative stream, ten neighbours")):
        peer = KalmanFilter(dim_x=3 * n, dim_z=6 * n - 3, dim_u=3 * n)
        peer.R, peer.B, peer.P = np.eye(6 * n - 3), 0.1 * np.eye(3 * n), np.eye(3 * n)
        edges = np.hstack([-np.tile(np.eye(3), (n - 1, 1)), np.eye(3 * n - 3)])
        peer.H = np.vstack([np.eye(3 * n), edges.reshape(3 * n - 3, 3 * n)])

        def theirs(peer: Any = peer, n: int = n) -> Any:
            for _ in range(steps):
                peer.predict(u=np.tile(u, n))
                peer.update(np.zeros(6 * n - 3))
            return peer.x

        other = co.StarStream(co.CooperativeFilter(known))
        other.step(z, u, 0.1)
        around = [[15.0, 0.6 * k, np.pi / 2] for k in range(n - 1)]
        relative = [co.RelativeMeasurement(f"v{k}", seen, *other.broadcast) for k, seen in enumerate(around)]
        more = {} if n == 1 else {"neighbours": relative}
        yield Case(f"filterpy, {3 * n} numbers", f"filterpy, {3 * n} numbers", theirs, steps)
        for robust in (False, True) if n == 1 else (True,):
            stream = co.Kalman(known, robust=robust).start() if n == 1 else co.StarStream(co.CooperativeFilter(known))

            def ours(stream: Any = stream, more: Any = more) -> Any:
                return [stream.step(z, u, 0.1, **more)[0] for _ in range(steps)][-1]

            yield Case(name + ", gates" * robust, f"filterpy, {3 * n} numbers", ours, steps)


def measured(rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Rows: microseconds per estimate, and the ratio to the plain case."""
    cases = [*method_cases(), *stream_cases()]
    right = {case.name: bool(np.isfinite(case.call()).all()) for case in cases}
    spent = medians({case.name: (lambda case=case: timed(case.call) / case.count) for case in cases}, rounds)
    return [
        {
            "name": case.name,
            "us": 1e6 * spent[case.name],
            "ratio": spent[case.name] / spent[case.plain],
            "right": right[case.name],
        }
        for case in cases
    ]


if __name__ == "__main__":
    print(report(measured()))
