"""The tables of the study of bytes: channels, their load, schedules under a cap, and the ledger with its break-even."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.evaluate.ledger import Kind, Ledger, Way, break_even
from coopoc.evaluate.scores import BYTES
from coopoc.study.numbers import Number, Where, difference, interval, mean, present
from coopoc.study.pivot import across, crossed
from coopoc.study.style import look
from coopoc.study.tables import Table
from coopoc.world.v2x import (
    BIT_RATE,
    CARRIER_SENSE,
    CHANNELS,
    ESTIMATE_AND_COV,
    FIX_AND_VELOCITY,
    Message,
    channel_load,
)

from . import scene, weights
from .lineup import of

if TYPE_CHECKING:
    from coopoc.study.results import Results

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
SCHEDULES = ("nearest", "round robin")
FREE = {"rate_hz": 0.0, "cap_bytes_per_second": 0.0, "schedule": SCHEDULES[0]}
AXES = ("channel", "max_neighbours", *FREE)
"""Parameters of a channel."""
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
"""Vehicles within the range of each other, as in a jam: 350 B each at 10 Hz are 8.4 Mb/s, and the channel has 6."""


def way(channel: str, k: int, **limits: Any) -> dict[str, Any]:
    """A channel as parameters or as a selection; its own rate, no cap and the nearest first, but for the limits."""
    return {"channel": channel, "max_neighbours": k, **FREE, **limits}


def under(cap: float, schedule: str, method: str, known: str) -> dict[str, Any]:
    """The selection of a method under a cap and a schedule."""
    return of(method, known, **way("ideal", 10, cap_bytes_per_second=cap, schedule=schedule))


def _most(results: Results) -> int:
    """The largest K that was run."""
    return int(max(results.frame["max_neighbours"], default=0)) if set(AXES) <= set(results.frame) else 0


def _methods(results: Results) -> list[dict[str, Any]]:
    """Each method over each channel at the largest K that was run, as selections."""
    k = _most(results)
    return [of(*pair, **way(name, k)) for name in CHANNELS for pair in SHARED if k]


def _labels(where: Where) -> tuple[str, str]:
    return WORDS[where["channel"]], look(where["method"]).label


def channels(results: Results) -> Table | None:
    """RT-LE, payload and bytes on air of each method over each channel, at the largest K that was run."""
    rows = [((*_labels(where), where["noise_model"]), where) for where in _methods(results)]
    columns: list[tuple[str, Number]] = [
        ("RT-LE [m]", mean),
        ("Payload [B/s]", _rate),
        ("On air [B/s]", partial(_rate, kind="on air")),
    ]
    text = (
        f"K = {_most(results)} over field channels (CAM, BSM, CPM): rate, latency, bursts of loss, and what a "
        "message carries anyway. Payload is what a method adds."
    )
    head = ("Channel", "Method", "Noise model")
    return crossed(results, head, rows, columns, scene.caption(results, text), decimals=3)


def load(results: Results) -> Table | None:
    """Share of air time that each channel fills: in the drive of the study, and with many vehicles in range."""
    k, drive, body = _most(results), scene.fleet(results.settings["data"]), list[tuple[Any, ...]]()
    carried = {"alone": Message("none", 0), "and a fix": FIX_AND_VELOCITY, "and an estimate": ESTIMATE_AND_COV}
    for name, words in WORDS.items() if k else ():
        v2x = CHANNELS[name](k)
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
    return Table(header, tuple(body), text) if body else None


def schedules(results: Results) -> Table | None:
    """RT-LE under each cap by the neighbours that come first, and the paired differences."""
    rows = [
        ((int(cap), look(pair[0]).label), under(cap, SCHEDULES[0], *pair))
        for cap in CAPS
        for pair in SCHEDULED
        if _other_schedule(results, cap, *pair)
    ]

    def less(results: Results, where: Where) -> Any:
        return difference(results, where, {**where, "schedule": SCHEDULES[0]})

    differences = {f"{each} - {SCHEDULES[0]}": {"schedule": each} for each in SCHEDULES[1:]}
    columns = across(interval, {each: {"schedule": each} for each in SCHEDULES}) + across(less, differences)
    text = (
        "RT-LE [m] when an ego receives no more than the cap, by schedule; differences are paired, with 95 % "
        f"intervals. K = {_most(results)} at 10 Hz."
    )
    options: dict[str, Any] = {"best": "min", "unranked": tuple(differences), "decimals": 3}
    return crossed(results, ("Cap [B/s]", "Method"), rows, columns, scene.caption(results, text), **options)


def _other_schedule(results: Results, cap: float, *pair: str) -> bool:
    """True if the nearest first and another schedule were run."""
    first, *others = (present(results, under(cap, each, *pair)) for each in SCHEDULES)
    return first is not None and any(others)


def _account(results: Results, where: Where) -> Ledger | None:
    """The ledger of one second of the drive; None where the method was not run."""
    kept = present(results, where)
    if kept is None:
        return None
    egos = sorted(results.select(kept)["ego"].unique())
    found = {counted: results.values(name, kept).T for name, counted in BYTES.items()}
    moved = np.zeros((2, 2, 2, *next(iter(found.values())).shape))
    for (kind, way), rate in found.items():
        moved[int(way == "per receiver"), 1, int(kind == "on air")] = rate
    return Ledger(tuple(egos), np.ones(len(egos)), moved[0], moved[1])


def _rate(results: Results, where: Where, kind: Kind = "payload") -> int | None:
    account = _account(results, where)
    return None if account is None else round(account.rate(kind))


def _trainings(results: Results) -> dict[str, Ledger]:
    """The ledgers of the trainings that the study has run, by label."""
    ran = [name for name in TRAINED if present(results, {"method": name})]
    return {look(name).label: weights.ledger(results.settings, name) for name in ran}


def even(results: Results) -> Table | None:
    """Driving time after which online cooperation has moved as many bytes as a training, per method and channel."""

    def time(total: Ledger) -> Number:
        def column(results: Results, where: Where) -> str | None:
            account = _account(results, where)
            return None if account is None else duration(break_even(total, account))

        return column

    ran = _trainings(results)
    once = [(f"{name}, {total.per_vehicle('training') / 1e3:,.0f} kB", time(total)) for name, total in ran.items()]
    honest = [where for where in _methods(results) if ran and where["noise_model"] in ("nominal", "trained")]
    text = (
        f"Driving time after which online cooperation (K = {_most(results)}) has moved as many bytes as each training "
        "moved per vehicle, once: payload, per receiver."
    )
    columns = [("Payload [B/s]", _rate), *once]
    rows = [(_labels(where), where) for where in honest]
    return crossed(results, ("Channel", "Online"), rows, columns, scene.caption(results, text))


def ledger(results: Results) -> Table | None:
    """The same for the joint filter as payload and on air, sent once and per receiver."""
    ran, k, (method, known) = _trainings(results), _most(results), SCHEDULED[0]
    body: list[tuple[Any, ...]] = []
    for channel, make in CHANNELS.items() if ran and k else ():
        account = _account(results, of(method, known, **way(channel, k)))
        for kind, each in COUNTS if account is not None else ():
            if account is not None and (kind == "payload" or make(k).overhead):
                times = (duration(break_even(total, account, kind, each)) for total in ran.values())
                body.append((WORDS[channel], f"{kind}, {each}", round(account.rate(kind, each)), *times))
    for kind, each in COUNTS[:2] if body else ():
        once = (f"{total.per_vehicle('training', kind, each) / 1e3:,.0f} kB" for total in ran.values())
        body.append(("a training, once", f"{kind}, {each}", None, *once))
    text = (
        f"The ledger per vehicle: {look(method).label.lower()}, {known}, K = {k}, and the driving time after which it "
        f"has moved as many bytes as a training. Broadcast: what is sent, each message once, a server's included; per "
        f"receiver: a copy for each that receives it. Nothing is added to the payload of a training, which goes by "
        f"another network."
    )
    header = ("Channel", "Counted", "Online [B/s]", *ran)
    return Table(header, tuple(body), scene.caption(results, text)) if body else None


def duration(seconds: float) -> str:
    """Seconds in a unit that suits them.

    >>> duration(0.3), duration(5), duration(600), duration(7300), duration(float("inf"))
    ('< 1 s', '5 s', '10 min', '2.0 h', 'never')
    """
    if seconds < 60:
        return f"{seconds:.0f} s" if seconds >= 1 else "< 1 s"
    if not np.isfinite(seconds):
        return "never"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
