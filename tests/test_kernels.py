"""Compiled kernels against the NumPy reference, and against filterpy, SciPy and numpy.linalg."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.optimize import least_squares

from coopoc import V2X, CooperativeMAP, Fleet, JointFilter, NoiseModel, Sensors, observe
from coopoc.kernels.compiling import compile as kernels
from coopoc.world.inbox import inbox
from coopoc.world.links import spherical, to_vector, wrap
from coopoc.world.v2x import FIX_AND_VELOCITY

pytest.importorskip("numba")
S2 = Sensors.paper_scenario2()
CHANNELS = [
    V2X(max_neighbours=4),
    V2X(max_neighbours=7, loss=0.3, latency=0.2),
    V2X(max_neighbours=3, loss=1.0),
    V2X(max_neighbours=5, bytes_per_second=1000.0),
    V2X(max_neighbours=0),
]


def test_the_linear_filter_equals_filterpy(formation: Fleet) -> None:
    """Independent check over the stacked star of a formation that never changes, from its first estimate on."""
    fleet = formation.select(range(4)).between(0, 40)
    recording = observe(fleet, S2, V2X(max_neighbours=3), runs=1, observers=[0])
    known = NoiseModel("fitted", S2, process_std=(0.08, 0.07, 0.01), gnss_std=(3.0, 3.5, 4.0))
    track = JointFilter(known, exact=False)(recording, [0])
    n, order = 12, [0, *recording.links.neighbour[:3]]
    peer = KalmanFilter(dim_x=n, dim_z=n + 9, dim_u=n)
    vectors = np.kron(np.hstack([-np.ones((3, 1)), np.eye(3)]), np.eye(3))
    peer.B, peer.H = 0.1 * np.eye(n), np.vstack([np.eye(n), vectors])
    peer.Q = np.kron(np.eye(4), np.diag(np.square(known.process_std)))
    where = to_vector(recording.relative[0])
    noise = np.zeros((n + 9, n + 9))
    noise[:n, :n] = np.kron(np.eye(4), np.diag(known.gnss_variance))
    for t in range(40):
        z = np.concatenate([recording.gnss[0, t, order].ravel(), where[3 * t : 3 * t + 3].ravel()])
        if t:
            peer.predict(u=recording.velocity[0, t, order].ravel())
            ahead = peer.x[3:].reshape(3, 3) - peer.x[:3]
        else:
            ahead = where[:3]
        for k in range(3):
            at = slice(n + 3 * k, n + 3 * k + 3)
            noise[at, at] = known.relative_cov(np.array(spherical(*ahead[k])))
        if t:
            peer.update(z, R=noise)
        else:  # filterpy's own update would lose seven digits to the flat prior
            weight = peer.H.T @ np.linalg.inv(noise)
            peer.P = np.linalg.inv(np.eye(n) / 1e6 + weight @ peer.H)
            start = np.concatenate([z[:3], (z[:3] + ahead).ravel()])
            peer.x = start + peer.P @ weight @ (z - peer.H @ start)
        assert track.x[0, t, 0] == pytest.approx(peer.x[:3], abs=1e-9)
        assert track.covariance is not None
        assert track.covariance[0, t, 0] == pytest.approx(peer.P[:3, :3], rel=1e-9, abs=1e-12)


def test_the_snapshot_is_the_least_squares_solution_of_scipy(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=4), runs=2, observers=[0])
    box, track = inbox(recording, 0, FIX_AND_VELOCITY), CooperativeMAP()(recording, [0])
    assert track.covariance is not None
    x, cov = track.x[:, :, 0], track.covariance[:, :, 0]
    for run, t in ((0, 0), (1, 17), (0, 59)):
        links = box.link[box.start[t] : box.start[t + 1]]
        order = [0, *recording.links.neighbour[links]]
        fix, seen = recording.gnss[run, t, order], recording.relative[run, links]

        def residual(flat: Any, fix: Any = fix, seen: Any = seen) -> Any:
            points = flat.reshape(-1, 3)
            d, az, inc = spherical(*(points[1:] - points[0]).T)
            off = np.stack([d - seen[:, 0], wrap(az - seen[:, 1]), wrap(inc - seen[:, 2])], axis=1)
            return np.concatenate([((points - fix) / S2.gnss_std).ravel(), (off / S2.relative_std).ravel()])

        start = np.concatenate([fix[:1], fix[0] + to_vector(seen)])
        best = least_squares(residual, start.ravel(), jac="3-point", method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert x[run, t] == pytest.approx(best.x[:3], abs=1e-6)
        spread = np.linalg.inv(best.jac.T @ best.jac)[:3, :3]
        assert cov[run, t] == pytest.approx(spread, abs=1e-5)


def test_the_angle_is_atan2() -> None:
    from coopoc.kernels.stars.relative import angle

    for turn in np.concatenate([np.linspace(-3.14, 3.14, 301), [0.0, 1e-9, -1e-300, 0.2449, -0.245]]):
        assert angle(3 * math.sin(turn), 3 * math.cos(turn)) == pytest.approx(turn, rel=1e-15, abs=0)


def test_machine_code_is_stale_after_a_change_of_any_file_beside_it(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    file.write_text("one")
    before = kernels._stamp.__wrapped__(tmp_path)
    file.write_text("other")
    assert kernels._stamp.__wrapped__(tmp_path) != before


def test_importing_the_package_imports_no_numba() -> None:
    code = "import sys, coopoc; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_machine_code_of_types_that_are_gone_is_made_again(tmp_path: Path) -> None:
    """A cache from before a type was renamed cannot be read: the kernel compiles anew and is kept again."""
    (tmp_path / "own.py").write_text(
        "from coopoc.kernels.compiling.compile import compiled\n\n\n@compiled\ndef twice(x):\n    return 2.0 * x\n\n\n"
        "print(twice(4.0), sum(twice.stats.cache_hits.values()))\n"
    )

    def run() -> str:
        command = [sys.executable, tmp_path / "own.py"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
    (index,) = tmp_path.glob("__pycache__/*.nbi")
    with index.open("rb") as file:
        version = pickle.load(file)
    index.write_bytes(pickle.dumps(version) + b"cno_such_module\nThing\n.")
    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
