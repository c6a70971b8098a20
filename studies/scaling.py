"""Cost per vehicle as the fleet grows: 60 to 1,980 vehicles, the town's traffic beside itself."""

from __future__ import annotations

import time
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coopoc.plugins import find
from coopoc.study.provenance import revision
from coopoc.study.numbers import mean, ran
from coopoc.study.study import Params, Row, Study
from coopoc.study.style import look
from coopoc.study.tables import Table
from coopoc.world.fleet import Fleet
from coopoc.world.sensing import observe

from . import scene

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

COPIES = (1, 2, 4, 8, 16, 33)
APART = 5_000.0
"""m between copies: no vehicle is in the range of another copy."""
EGOS = 60
"""Vehicles that per-ego methods serve, at every size of the fleet."""
PER_EGO = ("kalman", "joint", "split-ci", "lkf-sa")
DISTRIBUTED = ("gbp", "admm", "central-filter")
"""Methods that serve all vehicles at once."""
METHODS = (*PER_EGO, *DISTRIBUTED)


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


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers beyond the parameters."""
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


def costs(results: Results, method: str) -> dict[int, float | None]:
    """Number of vehicles -> microseconds per vehicle served, step and run."""
    each = len(scene.fleet(results.settings["data"]).ids)
    return {each * copies: mean(results, {"method": method, "copies": copies}, "us") for copies in COPIES}


def _growth(results: Results, method: str) -> float | None:
    """Cost in the largest fleet over that in the smallest."""
    found = list(ran(costs(results, method)).values())
    return found[-1] / found[0] if found else None


def _table(results: Results) -> Table | None:
    found = {method: costs(results, method) for method in ("observe", *METHODS)}
    sizes = sorted({size for each in found.values() for size in ran(each)})
    body = [
        ("Observing" if m == "observe" else look(m).label, *(each[size] for size in sizes), _growth(results, m))
        for m, each in found.items()
        if ran(each)
    ]
    header = ("Method", *(f"{size:,} vehicles" for size in sizes), "Largest / smallest")
    return Table(header, tuple(body), _caption(results)) if body else None


def _caption(results: Results) -> str:
    kept = results.settings
    return (
        f"CPU microseconds per vehicle served, step and run, best of {kept['repeats']} calls; "
        f"{Path(kept['data']).name}'s traffic beside itself, {kept['steps']} steps, K = {kept['max_neighbours']}, "
        f"{kept['runs']} runs."
    )


def _figure(results: Results) -> Plot | None:
    from coopoc.study.lines import Line, draw
    from coopoc.study.plot import Plot, canvas, legend, plain_log

    with canvas(1, 1, width=5.6, height=3.6) as (figure, panel):
        drawn = draw(panel, [Line({"method": method}, costs(results, method)) for method in METHODS])
        if not drawn:
            return None
        plain_log(panel.xaxis)
        plain_log(panel.yaxis)
        panel.set(xlabel="Vehicles", ylabel="µs per vehicle, step and run")
        legend(panel, drawn)
    return Plot(figure, _caption(results))


def _findings(results: Results) -> dict[str, str]:
    found = {m: _growth(results, m) for m in METHODS if len(ran(costs(results, m))) > 1}
    if not (growth := ran(found)):
        return {}
    name = max(growth, key=lambda method: growth[method])
    verdict = "grows by less than 1.5 times" if growth[name] <= 1.5 else "grows by MORE than 1.5 times"
    return {
        "growth": f"Cost per vehicle and step {verdict} from the smallest to the largest fleet: most for {name}, "
        f"{growth[name]:.2f} times."
    }


STUDY = Study(
    "scaling",
    "How does the time per vehicle grow with the fleet?",
    cell=cell,
    key=key,
    grid={"copies": COPIES, "method": ("observe", *METHODS)},
    settings={**scene.TOWN, "max_neighbours": 6, "steps": 60, "repeats": 3, "runs": 4, "train_seeds": 0},
    shares=("copies",),
    tables={"cost": _table},
    figures={"cost": _figure},
    findings=_findings,
    limitations=(
        "Copies of one town: every vehicle has the same neighbours at every size.",
        "CPU times are of this machine under its other load.",
    ),
    minutes=5,
)
