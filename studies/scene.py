"""The scene of a cell: which fleet drives, under which sensors and channel, and who is looked at."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from coopoc.data.registry import load, recorder
from coopoc.errors import InputError
from coopoc.study.study import Params
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X


@lru_cache(maxsize=4)
def fleet(data: str) -> Fleet:
    """The fleet of a bundled name or a path."""
    return load(data)


def is_real(data: str) -> bool:
    """True for data that holds real measurements between vehicles, which nobody needs to simulate."""
    return recorder(data) is not None


@lru_cache(maxsize=4)
def labels(data: str) -> tuple[str, ...]:
    """What must be said of real data: what is simulated in it, and what uses truth."""
    real = recorder(data)
    return () if real is None else real(V2X(max_neighbours=0), runs=1, seed=0).notes


@lru_cache(maxsize=4)
def egos(data: str, wanted: str) -> tuple[str, ...]:
    """Ids of the egos: a number of vehicles evenly spaced over those present throughout, or ids joined by "+".

    >>> egos("town10", "3")
    ('town10-00', 'town10-20', 'town10-40')
    """
    drive = fleet(data)
    throughout = [i for column, i in enumerate(drive.ids) if drive.present[:, column].all()]
    if not wanted.isdigit():
        return tuple(drive.ids[drive.index(i)] for i in wanted.split("+"))
    count = int(wanted)
    if not 1 <= count <= len(throughout):
        raise InputError("egos", wanted, f"must be 1..{len(throughout)}, who is there throughout", "Take fewer.")
    return tuple(throughout[k] for k in np.arange(count) * len(throughout) // count)


def sensors(p: Params) -> Sensors:
    """What acts in scenario 1 or 2 of the paper, with the velocity noise of the cell."""
    ratio, reading = float(p["velocity_ratio"]), p["velocity_reading"]
    if p["scenario"] == 1:
        acting = Sensors.paper_scenario1()
    elif p["scenario"] == 2:
        acting = Sensors.paper_scenario2()
    else:
        raise InputError("scenario", p["scenario"], "must be 1 or 2", "See section IV.B of the paper.")
    return Sensors(**{**acting.__dict__, "velocity_std_ratio": ratio, "velocity_reading": reading})


def conditions(p: Params) -> str:
    """Noise, start and size of a cell, for captions; of real data, what is simulated in it and what uses truth."""
    size = f"{p['runs']} runs, {p['egos']} egos of {Path(p['data']).name}, {p['train_seeds']} training seeds."
    if is_real(p["data"]):
        return f"Real data: {'; '.join(labels(p['data']))}. {size}"
    acting = sensors(p)
    low, high = acting.gnss_bias
    bias = f", bias U[{low:g}, {high:g}] m per run and axis" if high else ""
    near = f", range {acting.range_std:g} m, angles 4°, radius {p['radius_m']:g} m" if "radius_m" in p else ""
    start = "first fix" if p.get("start", "gnss") == "gnss" else "true position"
    return (
        f"Scenario {p['scenario']}: GNSS {acting.gnss_std[0]:g} m per axis{bias}, velocity "
        f"{100 * acting.velocity_std_ratio:g} % (per {p['velocity_reading']}){near}, start at the {start}; {size}"
    )


def channel(p: Params) -> V2X:
    """Neighbourhood and budget of the cell; what it does not name is ideal; a cap of 0 is none."""
    cap = float(p.get("cap_bytes_per_second", 0.0))
    return V2X(
        max_neighbours=int(p.get("max_neighbours", 0)),
        radius=float(p.get("radius_m", 30.0)),
        rate=float(p.get("rate_hz", 10.0)),
        bytes_per_second=cap or float("inf"),
    )


def facts(p: Params) -> dict[str, str]:
    """What of the scene changes the numbers beyond its parameters; InputError for a scene that cannot be."""
    sensors(p), channel(p), egos(p["data"], str(p["egos"]))
    return {"fleet": fleet(p["data"]).digest}


def recording(p: Params) -> Recording:
    """What the vehicles of the cell see; the real measurements where there are any."""
    who = egos(p["data"], str(p["egos"]))
    return _recording(p["data"], sensors(p), channel(p), int(p["runs"]), int(p["seed"]), who)


@lru_cache(maxsize=2)
def _recording(data: str, acting: Sensors, v2x: V2X, runs: int, seed: int, observers: tuple[str, ...]) -> Recording:
    real = recorder(data)
    if real is not None:
        measured: Recording = real(v2x, runs=runs, seed=seed)
        return measured
    return observe(fleet(data), acting, v2x, runs=runs, seed=seed, observers=observers)
