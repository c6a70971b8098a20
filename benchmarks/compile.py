"""CPU seconds until the first answer of each method, solve and stream: everything that a user waits for.

    OMP_NUM_THREADS=1 python benchmarks/compile.py [NAME ...]        # some minutes; a Markdown table on stdout

Each name runs in a process of its own, from its start to its answer, twice: with an empty cache of machine code, and
again with what the first run has kept. The difference is compiled once per machine.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate
from unseen_graphs import joined, world

import coopoc as co
from coopoc.methods.catalogue import METHODS, needs_whole_fleet
from coopoc.optimize.graph_problems import from_graph

Call = Callable[[], object]
S = co.Sensors.paper_scenario2()
BODY = co.Sensors(heading_std=0.05, yaw_rate_std=0.02)
GATED = ("kalman", "joint", "cooperative-filter", "batch-smoother", "pose filter, fleet", "solve of a graph")
"""Rows of the gate."""


def drive() -> co.Fleet:
    """A second of the town's traffic."""
    return co.load_fleet("town10").between(0, 12)


def method(name: str) -> None:
    """A method of the catalogue, with neighbours and messages that are late or lost."""
    made, whole, v2x = (
        METHODS[name]("nominal"),
        needs_whole_fleet(name),
        co.V2X(max_neighbours=3, loss=0.1, latency=0.2),
    )
    seen = co.observe(drive(), S, v2x, runs=2, observers=None if whole else [24])
    track = made(seen, range(len(seen.ids)) if whole else [24])
    if track.covariance is not None:
        co.nees(track, drive())


def pose(unit: str) -> None:
    """The pose filter of a unit."""
    who = None if unit == "fleet" else [24]
    seen = co.observe(drive(), BODY, co.V2X(max_neighbours=3), runs=2, observers=who, frame="body")
    co.PoseFilter(unit)(seen, [24])  # type: ignore[arg-type]


def graph() -> None:
    """A graph of robots that see and range one another and landmarks, from its records to the marginals."""
    w = world(0, 2, 2, 60, 4)
    loops, ranges = w.near(20, 8.0), w.ranged(w.to_points(40), 0.3)
    poses = joined(w.relative(w.chain(), 0.03, 0.01), w.relative(loops, 0.03, 0.01))
    np.asarray(co.solve(from_graph(w.graph(relative_pose=poses, ranges=ranges))).covariance)


def log() -> None:
    """Fixes alone, whose velocity a log does not hold."""
    with tempfile.TemporaryDirectory() as folder:
        rows = "".join(f"{k},a,{9 * k},0\n" for k in range(9))
        (Path(folder) / "fixes.csv").write_text(f"t,vehicle,x,y\n{rows}")
        co.read_log(Path(folder) / "fixes.csv")


def streams() -> None:
    """Filters step by step: alone, with a neighbour, and poses."""
    noise = co.NoiseModel.nominal(S)
    alone = co.Kalman(noise).start(history=1.0)
    for k in range(3):
        alone.step([0.9 * k, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, fix_age=0.1 * (k == 2))
    ego, other = (co.StarStream(co.CooperativeFilter(noise)) for _ in range(2))
    for k in range(3):
        other.step([12.0 + k, 1.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        seen = co.RelativeMeasurement("b", [11.8, 0.1, 1.57], *other.broadcast, age=0.1)
        ego.step([0.9 * k, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, neighbours=[seen])
    robot = co.PoseFilter("solo", assumed=BODY).start(dt=0.1)
    mast = co.LandmarkMeasurement([20.1, 0.4, 1.4], position=[18.0, 9.0, 3.0])
    robot.step(co.OwnMeasurement([9.0, 0.0, 0.0], 0.02, gnss=[0.4, 0.2, 0.0], heading=0.1), [mast])


def training() -> None:
    """An epoch of each net's training, and the answer of a net."""
    from coopoc.learned import GainNet, NoiseParameters, Schedule, clients, fit, load_method

    own = clients(co.load_fleet("town10-clients").between(0, 120), piece=20)[0]
    for net in (GainNet(), NoiseParameters()):
        fit(net, own.training, own.validation, Schedule(epochs=1))
    load_method("fedkalmannet")(co.observe(drive(), S, co.V2X(max_neighbours=0), runs=2, observers=[24]), [24])


CALLS: dict[str, Call] = {
    **{name: lambda name=name: method(name) for name in METHODS},  # type: ignore[misc]
    **{f"pose filter, {unit}": lambda unit=unit: pose(unit) for unit in ("solo", "fleet")},  # type: ignore[misc]
    "solve of a graph": graph,
    "streams": streams,
    "a log": log,
    "a net": training,
}


def spent(name: str, folder: str) -> float:
    """CPU seconds of a process that makes one call with the machine code of a folder."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    env = {**os.environ, "NUMBA_CACHE_DIR": folder, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, __file__, "--here", name], env=env, check=True, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def first_and_again(name: str) -> tuple[float, float]:
    """CPU seconds until the answer with an empty cache, and with what that run has kept."""
    with tempfile.TemporaryDirectory() as folder:
        return spent(name, folder), spent(name, folder)


def measured() -> list[dict[str, Any]]:
    """Rows of the gate: first answers over that of the solo filter again, most of which is loading libraries; a call
    that fails ends the run."""
    seconds = {name: first_and_again(name) for name in GATED}
    unit = seconds["kalman"][1]
    return [
        {"name": f"compiled: {name}, first answer", "us": 1e6 * first, "ratio": first / unit, "right": True}
        for name, (first, _) in seconds.items()
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Time what is named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", choices=[*CALLS, []], metavar="NAME")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.here:
        CALLS[given.names[0]]()
    else:
        rows = [(name, *(f"{s:.1f}" for s in first_and_again(name))) for name in given.names or CALLS]
        print(tabulate(rows, ["CPU s until the first answer of", "first call", "again"], "github"))


if __name__ == "__main__":
    main()
