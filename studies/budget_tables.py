"""The tables of the study of bytes: channels, their load, schedules under a cap, and the ledger with its break-even."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.evaluate.ledger import Kind, Ledger, Way, break_even
from coopoc.evaluate.statistics import paired_difference
from coopoc.world.channel_load import BIT_RATE, CARRIER_SENSE, channel_load
from coopoc.world.v2x import ESTIMATE_AND_COV, FIX_AND_VELOCITY, Message

from . import scene, views, weights
from .scores import BYTES

if TYPE_CHECKING:
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

SHARED = (
    ("lkf-sa", "identity"),
    ("lkf-sa", "fitted"),
    ("joint", "fitted"),
    ("joint", "nominal"),
    ("split-ci", "nominal"),
    ("cooperative", "trained"),
)
SCHEDULED = (("joint", "nominal"), ("split-ci", "nominal"))
"""Which of them run under every schedule."""
CAPS = (100.0, 200.0, 400.0, 800.0)
SCHEDULES = ("nearest", "round robin", "most informative")
FREE = {"rate_hz": 0.0, "cap_bytes_per_second": 0.0, "schedule": SCHEDULES[0]}
TRAINED = ("fedokf", "recursive", "fedkalmannet")
"""Trained by federation, in the order of their bytes."""
WORDS = {"ideal": "ideal, 10 Hz", "cam": "CAM, 2.2 Hz", "bsm": "BSM, 10 Hz", "cpm": "CPM, 5 Hz"}
COUNTS: tuple[tuple[Kind, Way], ...] = (
    ("payload", "per receiver"),
    ("payload", "broadcast"),
    ("on air", "per receiver"),
    ("on air", "broadcast"),
)
CROWD = 300
"""Vehicles within earshot of each other, as in a jam (methods.md section 9.4)."""


def ways(results: Results) -> list[dict[str, Any]]:
    """The channels that were run, as selections."""
    frame = results.frame
    names = [name for name in ("channel", "max_neighbours", *FREE) if name in frame]
    return [dict(zip(names, each, strict=True)) for each, _ in frame.groupby(names, sort=False)] if names else []


def most(results: Results) -> int:
    """The largest K that was run."""
    return max((way["max_neighbours"] for way in ways(results)), default=0)


def channels(results: Results) -> Table | None:
    """RT-LE, payload and bytes on air of each method over each channel, at the largest K that was run."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    k = most(results)
    for name in scene.CHANNELS:
        for method, known in SHARED:
            where = {"channel": name, "max_neighbours": k, **FREE, "method": method, "noise_model": known}
            if k and (error := views.mean(results, where)) is not None:
                account = _account(results, where)
                sizes = [round(account.rate(kind)) for kind in ("payload", "on air")] if account else [None, None]
                body.append((WORDS[name], look(method).label, known, error, *sizes))
    header = ("Channel", "Method", "NoiseModel", "RT-LE [m]", "Payload [B/s]", "On air [B/s]")
    text = (
        f"K = {k} over channels as they are in the field: rate, latency, loss in bursts, and what a message carries "
        f"anyway. Payload is what a method adds. {scene.conditions(results.settings)}"
    )
    return Table(header, tuple(body), text, decimals=3) if body else None


def load(results: Results) -> Table | None:
    """Share of air time that each channel fills: in the drive of the study, and with many vehicles in earshot."""
    from coopoc.study.tables import Table

    if not most(results):
        return None
    drive, body = scene.fleet(results.settings["data"]), list[tuple[Any, ...]]()
    carried = {"alone": Message("none", 0), "and a fix": FIX_AND_VELOCITY, "and an estimate": ESTIMATE_AND_COV}
    for name, words in WORDS.items():
        v2x = scene.CHANNELS[name](most(results))
        for also, message in carried.items():
            size, rate = message.size(v2x.overhead), v2x.rate or 1.0 / drive.dt
            if size:
                town = 100 * channel_load(drive.position[::10], size, rate)
                crowd = 100 * float(channel_load(np.zeros((CROWD, 3)), size, rate)[0])
                body.append((words, also, size, float(np.nanmax(town)), crowd))
    header = ("Channel", "Carries", "On air [B]", "In the drive [%]", f"{CROWD} vehicles [%]")
    text = (
        f"Share of air time that messages ask for within {CARRIER_SENSE:g} m at {BIT_RATE / 1e6:g} Mb/s, the own ones "
        f"included: the highest of any vehicle and step of the drive ({len(drive.ids)} vehicles), and {CROWD} within "
        f"earshot of each other. Above 100 % the channel is saturated. The ideal channel counts payload only."
    )
    return Table(header, tuple(body), text, decimals=2)


def schedules(results: Results) -> Table | None:
    """RT-LE under each cap when different neighbours are heard first, and what that changes, paired."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    for cap in CAPS:
        for method, known in SCHEDULED:
            found = [views.present(results, under(cap, each, method, known)) for each in SCHEDULES]
            if found[0] is None or all(where is None for where in found[1:]):
                continue
            base = results.values("rt_le_m", found[0])
            errors = [None if where is None else results.interval("rt_le_m", where) for where in found]
            gaps = [
                None if where is None else paired_difference(results.values("rt_le_m", where), base)
                for where in found[1:]
            ]
            body.append((int(cap), look(method).label, *errors, *gaps))
    differences = tuple(f"{each} - {SCHEDULES[0]}" for each in SCHEDULES[1:])
    header = ("Cap [B/s]", "Method", *SCHEDULES, *differences)
    text = (
        f"RT-LE [m] when an ego hears no more than the cap, by whom it hears first; differences are paired, with 95 % "
        f"intervals. K = {most(results)} at 10 Hz. {scene.conditions(results.settings)}"
    )
    return Table(header, tuple(body), text, best="min", unranked=differences, decimals=3) if body else None


def under(cap: float, schedule: str, method: str, known: str) -> dict[str, Any]:
    """The selection of a method under a cap and a schedule."""
    limited = {**FREE, "cap_bytes_per_second": cap, "schedule": schedule}
    return {"channel": "ideal", "max_neighbours": 10, **limited, "method": method, "noise_model": known}


def _account(results: Results, where: dict[str, Any]) -> Ledger | None:
    """The ledger of one second of the drive; None where the method was not run."""
    kept = views.present(results, where)
    if kept is None:
        return None
    egos = sorted(results.select(kept)["ego"].unique())
    found = {counted: results.values(name, kept).T for name, counted in BYTES.items()}
    moved = np.zeros((2, 2, 2, *next(iter(found.values())).shape))
    for (kind, way), rate in found.items():
        moved[int(way == "per receiver"), 1, int(kind == "on air")] = rate
    return Ledger(tuple(egos), np.ones(len(egos)), moved[0], moved[1])


def even(results: Results) -> Table | None:
    """Driving time after which deciding together has moved as many bytes as a training, per method and channel."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    ran, k = _trainings(results), most(results)
    body: list[tuple[Any, ...]] = []
    for channel in scene.CHANNELS:
        for method, known in SHARED:
            where = {"channel": channel, "max_neighbours": k, **FREE, "method": method, "noise_model": known}
            account = _account(results, where) if k and ran and known in ("nominal", "trained") else None
            if account is not None:
                times = [spoken(break_even(total, account)) for total in ran.values()]
                body.append((WORDS[channel], look(method).label, round(account.rate()), *times))
    once = (f"{look(name).label}, {total.per_vehicle('training') / 1e3:,.0f} kB" for name, total in ran.items())
    header = ("Channel", "Deciding", "Payload [B/s]", *once)
    text = (
        f"Driving time after which deciding together (K = {k}) has moved as many bytes as each training moved per "
        f"vehicle, once: payload, per receiver. {scene.conditions(results.settings)}"
    )
    return Table(header, tuple(body), text) if body else None


def ledger(results: Results) -> Table | None:
    """The same for the joint filter as payload and on air, sent once and per receiver."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    ran, k = _trainings(results), most(results)
    if not ran or not k:
        return None
    method, known = SCHEDULED[0]
    body: list[tuple[Any, ...]] = []
    for channel in scene.CHANNELS:
        where = {"channel": channel, "max_neighbours": k, **FREE, "method": method, "noise_model": known}
        account = _account(results, where)
        for kind, way in COUNTS if account is not None else ():
            if account is not None and not (kind == "on air" and not scene.CHANNELS[channel](k).overhead):
                even_ = (spoken(break_even(total, account, kind, way)) for total in ran.values())
                body.append((WORDS[channel], f"{kind}, {way}", round(account.rate(kind, way)), *even_))
    for kind, way in COUNTS[:2] if body else ():
        once = (f"{total.per_vehicle('training', kind, way) / 1e3:,.0f} kB" for total in ran.values())
        body.append(("a training, once", f"{kind}, {way}", None, *once))
    header = ("Channel", "Counted", "Deciding [B/s]", *(look(name).label for name in ran))
    text = (
        f"The ledger per vehicle: {look(method).label.lower()}, {known}, K = {k}, and the driving time after which it "
        f"has moved as many bytes as a training. Broadcast: what is sent, each message once, a server's included; per "
        f"receiver: a copy for each that hears it. Nothing is added to the payload of a training, which goes by "
        f"another network. {scene.conditions(results.settings)}"
    )
    return Table(header, tuple(body), text) if body else None


def _trainings(results: Results) -> dict[str, Ledger]:
    """The ledgers of the trainings that the study has run."""
    ran = [name for name in TRAINED if views.present(results, {"method": name})]
    return {name: weights.ledger(results.settings, name) for name in ran}


def spoken(seconds: float) -> str:
    """Seconds as one reads them.

    >>> spoken(0.3), spoken(5), spoken(600), spoken(7300), spoken(float("inf"))
    ('< 1 s', '5 s', '10 min', '2.0 h', 'never')
    """
    if seconds < 60:
        return f"{seconds:.0f} s" if seconds >= 1 else "< 1 s"
    if not np.isfinite(seconds):
        return "never"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
