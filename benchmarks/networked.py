"""Methods of a star that filter per axis or fuse pseudo-fixes.

    OMP_NUM_THREADS=1 python benchmarks/networked.py            # a Markdown table on stdout, about a minute

Whole methods, each with its inbox and its Track, on town traffic at K = 6. Microseconds are per step and run of an ego;
the ratio is to the joint filter's in the same rounds. Right: finite estimates;
the oracles of the tests hold the numbers.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from timing import medians, report, timed

import coopoc as co
from coopoc.methods.catalogue import METHODS

ROUNDS, NEIGHBOURS, STEPS, RUNS = 3, 6, 60, 16
EGO = 0
JOBS = {
    "joint": "nominal",
    "lkf-sa": "identity",
    "lkf-sa, nominal": "nominal",
    "msmv-r": "nominal",
    "split-ci": "nominal",
    "ci": "nominal",
    "joint, gates": "nominal",
}
"""What is assumed of the noise, by the method's name and a word more; only those with gates have any."""


def measured(rounds: int = ROUNDS, steps: int = STEPS, runs: int = RUNS) -> list[dict[str, Any]]:
    """Per job microseconds and the ratio to the joint filter's."""
    fleet, calls, each, right = co.load_fleet("town10").between(0, steps), {}, {}, {}
    for name, known in JOBS.items():
        word = name.partition(",")[0]
        method = METHODS[word](known)
        if hasattr(method, "robust"):
            method = replace(method, robust="gates" in name)
        channel = co.V2X(max_neighbours=NEIGHBOURS)
        recording = co.observe(fleet, co.Sensors.paper_scenario2(), channel, runs=runs, observers=[EGO])
        calls[name] = lambda method=method, recording=recording: method(recording, [EGO])
        right[name] = bool(np.isfinite(calls[name]().x).all())
        each[name] = 1e6 / (steps * runs)
    spent = medians({name: lambda call=call: timed(call) for name, call in calls.items()}, rounds)
    us = {name: each[name] * spent[name] for name in JOBS}
    return [
        {"name": f"{name}, compiled", "us": us[name], "ratio": us[name] / us["joint"], "right": right[name]}
        for name in JOBS
    ]


if __name__ == "__main__":
    print(report(measured()))
