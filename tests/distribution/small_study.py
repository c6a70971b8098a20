"""A third party's study, as it would be installed: one circle of traffic, two filters, a row of neighbours."""

import os
import signal
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.evaluate.metrics import max_error, rt_le
from coopoc.methods.kalman import GNSS, Kalman
from coopoc.methods.star_filters import JointFilter
from coopoc.study.cell import Params, Row
from coopoc.study.results import Results
from coopoc.study.study import Study
from coopoc.study.tables import Table, pivot
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

METHODS: dict[str, Any] = {"gnss": GNSS, "kalman": Kalman, "joint": JointFilter}


def circle() -> Fleet:
    """Five vehicles on a circle of 20 m radius."""
    t = 0.1 * np.arange(40)
    angle = 0.4 * t[:, None] + 2 * np.pi * np.arange(5) / 5
    x = 20 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    u = np.concatenate([np.diff(x, axis=0), np.zeros((1, 5, 3))]) / 0.1
    return Fleet(tuple("abcde"), t, x, np.roll(u, 1, axis=0), name="circle")


@lru_cache(maxsize=2)
def recording(max_neighbours: int, runs: int, seed: int) -> Recording:
    """The circle as its vehicles see it."""
    return observe(circle(), Sensors.paper_scenario2(), V2X(max_neighbours, radius=50.0), runs=runs, seed=seed)


def cell(p: Params) -> list[Row]:
    """Rows of one method at one number of neighbours; `trouble` makes a cell fail while the file it names exists."""
    time.sleep(p["pause"])
    troubled = p["method"] == "kalman" and p["max_neighbours"] == 1 and Path(p["trouble"]).is_file()
    if troubled and Path(p["trouble"]).read_text() == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if troubled:
        raise {"exit": SystemExit}.get(Path(p["trouble"]).read_text(), FloatingPointError)(
            "the filter diverged at step 3"
        )
    began = time.perf_counter()
    track = METHODS[p["method"]]()(recording(p["max_neighbours"], p["runs"], p["seed"]), egos=p["egos"])
    error, worst = rt_le(track, circle()), max_error(track, circle())
    return [
        {
            "run": r,
            "ego": circle().ids[ego],
            "rt_le_m": error[r, e],
            "max_error_m": worst[r, e],
            "bytes_per_second": track.received_bytes[r, e] / 4.0,
            "seconds": time.perf_counter() - began,
        }
        for e, ego in enumerate(p["egos"])
        for r in range(p["runs"])
    ]


def key(p: Params) -> dict[str, Any]:
    """The fleet, and a check of the neighbours before any work."""
    V2X(p["max_neighbours"])
    return {"fleet": circle().digest}


def table(results: Results) -> Table:
    """RT-LE against neighbours."""
    return pivot(results, "max_neighbours", "method", "rt_le_m", caption="RT-LE [m] at a GNSS noise of 3.5 m.")


def figure(results: Results) -> Any:
    """RT-LE against neighbours."""
    from coopoc.study import figures

    return figures.sweep(results, "max_neighbours")


STUDY = Study(
    name="small",
    question="What is a neighbour worth on a circle?",
    cell=cell,
    key=key,
    grid={"max_neighbours": (0, 1, 2), "method": tuple(METHODS)},
    settings={"runs": 4, "seed": 0, "egos": (0, 2), "pause": 0.0, "trouble": "no such file", "data": "circle"},
    shares=("max_neighbours",),
    tables={"rt_le": table},
    figures={"rt_le": figure},
    findings=lambda r: [f"KF: {r.interval('rt_le_m', method='kalman', max_neighbours=0)} m."],
    recipe=lambda r: {"training": "none: nothing here learns"},
    limitations=("No vehicle drives in circles.",),
)


def greet(name: str = "you") -> int:
    """Greet somebody.

    Example: coopoc greet --name you

    Args:
        name: who is greeted.
    """
    print(f"hello {name}")
    return 0


KIN = {"greet": greet}
