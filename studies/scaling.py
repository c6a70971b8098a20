"""What a vehicle costs as the fleet grows: 60 to 1,980 vehicles, the town's traffic beside itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.plugins import find
from coopoc.study.environment import revision
from coopoc.study.study import Params, Row, Study
from coopoc.world.fleet import Fleet
from coopoc.world.sensing import observe

from . import scene, views

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

COPIES = (1, 2, 4, 8, 16, 33)
APART = 5_000.0
"""m between copies: nobody sees across."""
EGOS = 60
"""Vehicles that per-ego methods serve, at every size of the fleet."""
PER_EGO = ("kalman", "joint", "split-ci", "lkf-sa")
DISTRIBUTED = ("gbp", "admm", "central-filter")
"""Methods that serve all vehicles at once."""


@lru_cache(maxsize=1)
def copied(data: str, copies: int, steps: int) -> Fleet:
    """The first steps of a drive, `copies` times side by side.

    >>> len(copied("town10", 2, 5).ids)
    120
    """
    drive = scene.fleet(data).between(0, steps)
    shifts = np.arange(copies)[:, None] * np.array([APART, 0.0, 0.0])
    ids = tuple(f"{k}-{name}" for k in range(copies) for name in drive.ids)
    position = np.concatenate([drive.position + shift for shift in shifts], axis=1)
    return Fleet(ids, drive.t, position, np.tile(drive.velocity, (1, copies, 1)))


def _grid() -> list[dict[str, Any]]:
    return [{"copies": copies, "method": m} for copies in COPIES for m in ("observe", *PER_EGO, *DISTRIBUTED)]


def key(p: Params) -> dict[str, str]:
    """What changes the numbers beyond the parameters."""
    return {"code": revision(*scene.CODE), "fleet": scene.fleet(p["data"]).digest}


def cell(p: Params) -> list[Row]:
    """Microseconds per vehicle, step and run, of observing the fleet or of a method; the best of three calls."""
    drive, v2x = copied(p["data"], int(p["copies"]), int(p["steps"])), scene.channel(p)
    size = {"vehicles": len(drive.ids), "run": 0, "ego": "all"}
    began = time.process_time()
    seen = observe(drive, scene.sensors(p), v2x, runs=int(p["runs"]), seed=int(p["seed"]))
    took = time.process_time() - began
    scale = 1e6 / len(drive.t) / seen.runs
    if p["method"] == "observe":
        return [{**size, "us": scale * took / len(drive.ids), "seconds": took}]
    egos = list(range(len(drive.ids))) if p["method"] in DISTRIBUTED else _spread(len(drive.ids))
    method, spent = find("coopoc.methods", p["method"])("nominal"), []
    for _ in range(int(p["repeats"])):
        began = time.process_time()
        method(seen, egos)
        spent.append(time.process_time() - began)
    return [{**size, "us": scale * min(spent) / len(egos), "seconds": min(spent)}]


def _spread(vehicles: int) -> list[int]:
    """The egos: as many at every size, from all copies."""
    return (np.arange(EGOS) * vehicles // EGOS).tolist()


def _us(results: Results, method: str, copies: int) -> float | None:
    return views.mean(results, {"method": method, "copies": copies}, "us")


def _table(results: Results) -> Table | None:
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    sizes = [copies for copies in COPIES if views.present(results, {"copies": copies}, "us")]
    each = len(scene.fleet(results.settings["data"]).ids)
    body = []
    for method in ("observe", *PER_EGO, *DISTRIBUTED):
        found = [_us(results, method, copies) for copies in sizes]
        ran = [value for value in found if value is not None]
        if ran:
            name = "Observing" if method == "observe" else look(method).label
            body.append((name, *found, ran[-1] / ran[0]))
    header = ("Method", *(f"{each * copies:,} vehicles" for copies in sizes), "Largest / smallest")
    return Table(header, tuple(body), _caption(results), decimals=2) if body else None


def _caption(results: Results) -> str:
    kept = results.settings
    return (
        f"CPU microseconds per vehicle served, step and run, best of {kept['repeats']} calls; "
        f"{Path(kept['data']).name}'s traffic beside itself, {kept['steps']} steps, K = {kept['max_neighbours']}, "
        f"{kept['runs']} runs."
    )


def _figure(results: Results) -> Plot | None:
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    each, drawn = len(scene.fleet(results.settings["data"]).ids), []
    with canvas(1, 1, width=5.6, height=3.6) as (figure, panel):
        for method in (*PER_EGO, *DISTRIBUTED):
            found = {each * copies: _us(results, method, copies) for copies in COPIES}
            ran = {size: value for size, value in found.items() if value is not None}
            if ran:
                panel.plot(list(ran), list(ran.values()), **strokes({"method": method}))
                drawn.append({"method": method})
        if not drawn:
            return None
        plain_log(panel.xaxis)
        plain_log(panel.yaxis)
        panel.set(xlabel="Vehicles", ylabel="µs per vehicle, step and run")
        legend(panel, drawn)
    return Plot(figure, _caption(results))


def _findings(results: Results) -> Sequence[str]:
    worst = {}
    for method in (*PER_EGO, *DISTRIBUTED):
        ran = [value for copies in COPIES if (value := _us(results, method, copies)) is not None]
        if len(ran) > 1:
            worst[method] = ran[-1] / ran[0]
    if not worst:
        return []
    name = max(worst, key=lambda method: worst[method])
    verdict = "grows by less than 1.5 times" if worst[name] <= 1.5 else "grows by MORE than 1.5 times"
    return [
        f"Cost per vehicle and step {verdict} from the smallest to the largest fleet: most for {name}, "
        f"{worst[name]:.2f} times."
    ]


STUDY = Study(
    name="scaling",
    question="What does a vehicle cost as the fleet grows?",
    cell=cell,
    key=key,
    grid=_grid(),
    settings={
        "data": "town10",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "max_neighbours": 6,
        "steps": 60,
        "repeats": 3,
        "runs": 4,
        "seed": 0,
        "egos": "auto",
        "train_seeds": 0,
    },
    shares=("copies",),
    tables={"cost": _table},
    figures={"cost": _figure},
    findings=_findings,
    limitations=(
        "Copies of one town: every vehicle has the same neighbours at every size.",
        "CPU time of this machine, beside whatever else it did.",
    ),
    minutes=5,
)
