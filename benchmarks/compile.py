"""CPU seconds of each method's first call, which compiles it once per machine: alone, each in a cache of its own.

    OMP_NUM_THREADS=1 python benchmarks/compile.py [NAME ...]     # some minutes; a Markdown table on stdout

A name is a method of `coopoc list` or one of `OTHERS`. The last row is all of them in one process and one cache, where
what they share is compiled once. Seconds are the process's own: those of the call less those of the same call again.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

from tabulate import tabulate
from unseen_graphs import joined, world

import coopoc as co
from coopoc.methods.catalogue import METHODS, needs_whole_fleet
from coopoc.optimize.graph_problems import from_graph

Call = Callable[[], object]
LIMIT = 10.0


def drive() -> co.Fleet:
    """A second of the town's traffic."""
    return co.load_fleet("town10").between(0, 12)


def method(name: str) -> Call:
    """A method of the catalogue, with neighbours and losses."""
    made = METHODS[name]("nominal")
    whole = needs_whole_fleet(name)
    v2x = co.V2X(max_neighbours=3, loss=0.1)
    seen = co.observe(drive(), co.Sensors.paper_scenario2(), v2x, runs=2, observers=None if whole else [24])
    egos = range(len(seen.ids)) if whole else [24]
    return lambda: made(seen, egos)


def pose(unit: str, **options: object) -> Call:
    """The pose filter of a unit."""
    sensors = co.Sensors(heading_std=0.05, yaw_rate_std=0.02)
    who = None if unit == "fleet" else [24]
    seen = co.observe(drive(), sensors, co.V2X(max_neighbours=3), runs=2, observers=who, frame="body")
    return lambda: co.PoseFilter(unit, **options)(seen, [24])  # type: ignore[arg-type]


def graph() -> Call:
    """A graph of robots that see and range one another and landmarks, solved with its marginals."""
    w = world(0, 2, 2, 60, 4)
    loops, ranges = w.near(20, 8.0), w.ranged(w.to_points(40), 0.3)
    problem = from_graph(
        w.graph(relative_pose=joined(w.relative(w.chain(), 0.03, 0.01), w.relative(loops, 0.03, 0.01)), ranges=ranges)
    )
    return lambda: co.solve(problem).covariance


OTHERS: dict[str, Callable[[], Call]] = {
    "pose filter, solo": lambda: pose("solo"),
    "pose filter, fleet": lambda: pose("fleet"),
    "solve of a graph": graph,
}


def spent(names: list[str]) -> float:
    """CPU seconds of first calls in this process beyond those of second ones."""
    total = 0.0
    for name in names:
        call = OTHERS[name]() if name in OTHERS else method(name)
        seconds = []
        for _ in range(2):
            begun = time.process_time()
            call()
            seconds.append(time.process_time() - begun)
        total += seconds[0] - seconds[1]
    return total


def anew(names: list[str]) -> float:
    """The same in a new process with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, __file__, "--here", *names]
        env = {**os.environ, "NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"}
        return float(subprocess.run(command, env=env, check=True, stdout=subprocess.PIPE, text=True).stdout)


def main() -> None:
    """Time what is named, or all."""
    if sys.argv[1:2] == ["--here"]:
        print(spent(sys.argv[2:]))
        return
    names = sys.argv[1:] or [*METHODS, *OTHERS]
    if unknown := set(names) - {*METHODS, *OTHERS}:
        sys.exit(f"{', '.join(sorted(unknown))}: must be among {', '.join([*METHODS, *OTHERS])}")
    rows = [(name, anew([name])) for name in names]
    rows.append(("all in one process", anew(names)))
    print(tabulate([(name, f"{s:.1f}") for name, s in rows], ["first call of", "CPU s"], "github"))
    slow = [name for name, seconds in rows[:-1] if seconds > LIMIT]
    print(f"over {LIMIT:g} s: {', '.join(slow) or 'none'}", file=sys.stderr)


if __name__ == "__main__":
    main()
