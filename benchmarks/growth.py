"""What does not grow: the time of an import, and a method's time per vehicle and step in a larger fleet.

OMP_NUM_THREADS=1 python benchmarks/growth.py            # a Markdown table on stdout, about half a minute
"""

import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np
from timing import medians, report, rows_of, timed

import coopoc as co
from coopoc.methods.catalogue import METHODS

ROUNDS, STEPS, NEIGHBOURS = 5, 20, 6
FLEETS = {60: (6, 10), 500: (20, 25)}
"""Vehicles: rows and columns of the grid that they drive in."""
METHOD_NAMES = ("joint",)
SPACING = 14.0
"""m"""
IMPORT_SECONDS = 0.3


def grid(rows: int, columns: int, steps: int = STEPS) -> co.Fleet:
    """A block of vehicles that drives on together."""
    t = np.arange(steps) * 0.1
    i, j = np.divmod(np.arange(rows * columns), columns)
    start = SPACING * np.stack([i, j, 0.05 * ((i + j) % 3)], axis=1)
    velocity = np.broadcast_to([10.0, 0.0, 0.0], (steps, len(start), 3))
    return co.Fleet(tuple(f"v{k}" for k in range(len(start))), t, start + t[:, None, None] * velocity[:1], velocity)


def methods(fleets: dict[int, tuple[int, int]] = FLEETS, rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Per method and fleet the microseconds per vehicle-step and their ratio to the smallest fleet's.

    Right is an error below that of the fixes.
    """
    sensors, v2x = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=NEIGHBOURS)
    drives = [grid(*shape) for shape in fleets.values()]
    recordings = [co.observe(fleet, sensors, v2x) for fleet in drives]
    out: list[dict[str, Any]] = []
    for name in METHOD_NAMES:
        method = METHODS[name]("nominal")
        calls = [partial(method, recording, range(len(recording.ids))) for recording in recordings]
        right = []
        for call, fleet, recording in zip(calls, drives, recordings, strict=True):
            fixes = np.linalg.norm(recording.gnss - fleet.position, axis=-1).mean()
            right.append(bool(np.mean(co.rt_le(call(), fleet)) < fixes))
        names = [f"{name}, {count} vehicles" for count in fleets]
        spent = medians(
            {
                each: lambda call=call, n=len(fleet.ids): timed(call) / (n * STEPS)
                for each, call, fleet in zip(names, calls, drives, strict=True)
            },
            rounds,
        )
        out += rows_of("", spent, names[0], dict(zip(names, right, strict=True)))
    return out


def printed(code: str) -> str:
    """What a fresh process prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def imports() -> list[dict[str, Any]]:
    """Microseconds of `import coopoc` in a fresh process and their ratio to `import numpy`; right is below 0.3 s."""
    code = "import time; a = time.process_time(); import {}; print(time.process_time() - a)"
    numpy, ours = (
        float(np.median([float(printed(code.format(name))) for _ in range(ROUNDS)])) for name in ("numpy", "coopoc")
    )
    return [{"name": "import coopoc", "us": 1e6 * ours, "ratio": ours / numpy, "right": ours < IMPORT_SECONDS}]


def measured() -> list[dict[str, Any]]:
    """All rows."""
    return [*imports(), *methods()]


if __name__ == "__main__":
    print(report(measured()))
