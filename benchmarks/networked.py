"""Methods of a star that filter per axis, fuse pseudo-fixes or solve a window, rounds of messages, a whole fleet.

    OMP_NUM_THREADS=1 python benchmarks/networked.py            # a Markdown table on stdout, about a minute

Whole methods, compiled beside NumPy, each with its inbox and its Track, on town traffic at K = 6. Microseconds are per
step and run of an ego, or of a vehicle where all take part. Right is the NumPy reference's answer to 1e-9 m.
"""

from __future__ import annotations

import os
from functools import partial
from typing import Any

import numpy as np
from classical import timed
from tabulate import tabulate

import coopoc as co
from coopoc.kernels.compile import SWITCH
from coopoc.methods.catalogue import METHODS, WHOLE_FLEET

ROUNDS, NEIGHBOURS, STEPS, RUNS = 3, 6, 60, 16
EGO = 0
JOBS = {"lkf-sa": "identity", "lkf-sa, nominal": "nominal", "msmv-r": "nominal", "cooperative-map-5": "nominal",
        "split-ci": "nominal", "ci": "nominal", "gbp": "nominal", "admm": "nominal", "central-filter": "nominal",
        "central-filter, identity": "identity"}  # fmt: skip
"""What is assumed of the noise, by the method's name and a word more."""


def by(kernels: str, method: Any, recording: co.Recording) -> Any:
    """Track of the ego with these kernels."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = kernels
    try:
        return method(recording, [EGO])
    finally:
        os.environ.pop(SWITCH)
        if before is not None:
            os.environ[SWITCH] = before


def measured(rounds: int = ROUNDS, steps: int = STEPS, runs: int = RUNS) -> list[dict[str, Any]]:
    """Per job NumPy and compiled: microseconds and their ratio to NumPy's."""
    fleet, out = co.load("town10").between(0, steps), []
    for name, known in JOBS.items():
        word = name.partition(",")[0]
        everyone, method = word in WHOLE_FLEET, METHODS[word](known)
        channel, observers = co.V2X(max_neighbours=NEIGHBOURS), None if everyone else [EGO]
        recording = co.observe(fleet, co.Sensors.paper_scenario2(), channel, runs=runs, observers=observers)
        calls = {kernels: partial(by, kernels, method, recording) for kernels in ("numpy", "numba")}
        wanted, found = calls["numpy"]().x, calls["numba"]().x
        spent = {kernels: float(np.median([timed(call) for _ in range(rounds)])) for kernels, call in calls.items()}
        each = 1e6 / (steps * runs * (len(fleet.ids) if everyone else 1))
        out += [{"name": f"{name}, {words}", "us": each * spent[kernels], "ratio": spent[kernels] / spent["numpy"],
                 "right": bool(np.abs(found - wanted).max() < 1e-9)}
                for kernels, words in (("numpy", "NumPy"), ("numba", "compiled"))]  # fmt: skip
    return out


def main() -> None:
    """Print the table."""
    lines = [[row["name"], row["us"], row["ratio"], "yes" if row["right"] else "NO"] for row in measured()]
    print(tabulate(lines, ["", "us", "x NumPy", "right"], tablefmt="github", floatfmt=("", ".4g", ".3g", "")))


if __name__ == "__main__":
    main()
