"""Replay a real log through filters that are fed step by step, as a vehicle would feed them; no ROS needed.

Give a KITTI odometry sequence: the poses of an odometry (of ORB-SLAM2, say), the time stamps and the ground truth.

    python examples/replay_log.py KITTI_00_ORB.txt KITTI_00_gt_times.txt KITTI_00_gt.txt

The velocity is what the odometry measured between two stamps. KITTI's poses come without fixes, so GNSS is simulated:
ground truth and white noise. Then the log is made worse as a real receiver would: steps left out, so that dt varies;
fixes left out, ten seconds of them in a row; fixes that arrive up to half a second late. Without arguments a bundled
simulated drive is replayed instead.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

import coopoc as co
from coopoc.arrays import Floats
from coopoc.learned import load_method
from coopoc.world.sensors import stream

GNSS_STD = 2.5
"""m, per axis, of the simulated fixes."""
TUNNEL = (30.0, 40.0)
"""s without fixes, after the start of the log."""


class Log(NamedTuple):
    """Stamps (T,) s, dead-reckoned path (T, 3) m, which only its differences are used of, and truth (T, 3) m."""

    t: Floats
    path: Floats
    truth: Floats


class Tick(NamedTuple):
    """What a filter is fed: dt s, velocity (3,) m/s, fix (3,) m or None, its age s; and the truth, for the score."""

    dt: float
    velocity: Floats
    gnss: Floats | None
    age: float
    truth: Floats


def kitti(odometry: Path, times: Path, truth: Path) -> Log:
    """A KITTI sequence with its camera axes (right, down, forward) turned to forward, left, up."""
    turn = np.array([1.0, -1.0, -1.0])
    driven, true = (np.loadtxt(file)[:, [11, 3, 7]] * turn for file in (odometry, truth))  # lines of [R | t]
    return Log(np.loadtxt(times), driven, true)


def bundled(vehicle: str = "town10-24") -> Log:
    """A simulated drive with the velocity noise of the paper's training, in place of a log."""
    fleet = co.load_fleet("town10").select([vehicle])
    recording = co.observe(fleet, co.Sensors.paper_training(), co.V2X(max_neighbours=0))
    return Log(fleet.t, np.cumsum(recording.dt * recording.velocity[0, :, 0], axis=0), fleet.position[:, 0])


def ticks(log: Log, *, jitter: bool, drop: bool, late: bool) -> list[Tick]:
    """The log as it comes in: any of steps left out, fixes left out, fixes that are late."""
    draw = stream(0, "replay", 0, "log")
    lost, left_out, delay = draw.uniform(size=(3, len(log.t)))
    noise, found, before = draw.normal(0, GNSS_STD, log.truth.shape), [], 0
    for k in range(1, len(log.t)):
        if jitter and left_out[k] < 0.2:
            continue
        now, dt = log.t[k], float(log.t[k] - log.t[before])
        age = min(0.5 * float(delay[k]), float(now - log.t[0])) if late else 0.0
        at = np.array([np.interp(now - age, log.t, column) for column in log.truth.T])
        gone = drop and (lost[k] < 0.3 or TUNNEL[0] <= now - log.t[0] < TUNNEL[1])
        velocity = (log.path[k] - log.path[before]) / dt
        found.append(Tick(dt, velocity, None if gone else at + noise[k], age, log.truth[k]))
        before = k
    return found


def noise_model(assumed: co.Sensors) -> co.NoiseModel:
    """That velocity noise, and the GNSS noise as it is."""
    return co.NoiseModel.nominal(replace(assumed, gnss_std=(GNSS_STD,) * 3))


def replay(filter: Any, drive: Iterable[Tick]) -> tuple[float, float]:
    """RT-LE in m from the first fix on, and steps per second."""
    errors, began = [], time.perf_counter()
    for tick in drive:
        x, _ = filter.step(tick.gnss, tick.velocity, tick.dt, fix_age=tick.age)
        errors.append(x - tick.truth)
    seconds = time.perf_counter() - began
    square = np.square(errors).sum(axis=1)
    return float(np.sqrt(square[np.isfinite(square)].mean())), len(errors) / seconds


AXIS, SPEED = (
    co.Sensors(gnss_std=(2.5, 2.5, 2.5), velocity_floor=0.02, velocity_reading=reading) for reading in ("axis", "speed")
)
"""Velocity noise of 10 %, of each axis as in the training, or of the speed on every axis: odometry that also turns."""
FILTERS: dict[str, Callable[[], Any]] = {
    "Kalman, GNSS known, 10 % of axis": lambda: co.Kalman(noise_model(AXIS)).start(),
    "Kalman, GNSS known, 10 % of speed": lambda: co.Kalman(noise_model(SPEED)).start(),
    "OKF": lambda: load_method("okf").start(),
    "FedKalmanNet": lambda: load_method("fedkalmannet").start(),
    "cooperative, 10 % of speed": lambda: co.StarStream(co.CooperativeFilter(noise_model(SPEED)), measured=True),
}
WAYS: dict[str, dict[str, bool]] = {
    "as recorded": {"jitter": False, "drop": False, "late": False},
    "jittered dt": {"jitter": True, "drop": False, "late": False},
    "fixes lost": {"jitter": False, "drop": True, "late": False},
    "fixes late": {"jitter": False, "drop": False, "late": True},
    "all three": {"jitter": True, "drop": True, "late": True},
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print RT-LE of every filter and way, and its throughput."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("log", nargs="*", type=Path, help="odometry, stamps and truth of a KITTI sequence")
    parser.add_argument("--steps", type=int, default=None, help="replay only so many")
    given = parser.parse_args(arguments)
    if len(given.log) not in (0, 3):
        parser.error("give three files: odometry, stamps and truth; or none")
    if given.log:
        log = kitti(*given.log)
        print(f"Log: {given.log[0].name}, real odometry")
    else:
        log = bundled()
        print("No log given: the simulated vehicle town10-24 of the bundled fleet town10")
    log = Log(*(part[: given.steps] for part in log))
    print(f"{len(log.t)} stamps in {log.t[-1] - log.t[0]:.0f} s; GNSS is simulated, {GNSS_STD} m; RT-LE in m\n")
    print(f"{'':34}" + "".join(f"{way:>14}" for way in WAYS) + f"{'steps/s':>10}")
    drives = [ticks(log, **way) for way in WAYS.values()]
    with tqdm(total=len(FILTERS) * len(WAYS), desc="replay", file=sys.stderr, delay=2.0) as bar:
        for name, make in FILTERS.items():
            rows = []
            for drive in drives:
                rows.append(replay(make(), drive))
                bar.update()
            line = "".join(f"{error:14.3f}" for error, _ in rows)
            print(f"{name:34}{line}{np.median([speed for _, speed in rows]):10.0f}")


if __name__ == "__main__":
    main()
