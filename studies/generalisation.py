"""Gains that were learned on four drives of one town, in other traffic, another town, other noise and on robots."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Number, Where, mean, present, ran, ratio, rms, sentence
from coopoc.study.pivot import across, crossed
from coopoc.study.study import Params, Row
from coopoc.study.style import look

from . import lineup, scene
from .error_cdf import case
from .lineup import HEAD, labelled, of

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

FLEETS = ("town10", "town10-validation", "town04")
"""Traffic of the town where the clients drove, other traffic there, and a town with motorways."""
NOISES = {
    "training": case(0, 0.10),
    "scenario 1": case(1, 0.15),
    "scenario 2": case(2, 0.15),
    "scenario 2, 40 %": case(2, 0.40),
}
"""Cases as selections; the last is beyond the noise of every training."""
METHODS = (
    ("kalman", "oracle"),
    ("kalman", "nominal"),
    ("kalman", "fitted"),
    ("kalman-adaptive", "nominal"),
    *((name, "trained") for name in ("okf", "fedkalmannet", "split", "recursive", "cooperative")),
)
REAL = {"data": "real", **case(0, 0.10)}
"""Robots that were really driven, whose noise is their own; the setting `real` says where their data are."""


def _grid() -> list[dict[str, Any]]:
    places = [at(fleet, noise) for fleet in FLEETS for noise in NOISES]
    return [of(*pair, **place) for place in (*places, REAL) for pair in METHODS if place != REAL or pair[1] != "oracle"]


def _meaningful(p: Params) -> bool:
    return p["data"] != "real" or bool(p["real"])


def _placed(p: Params) -> Params:
    return {**p, "data": p["real"]} if p["data"] == "real" else p


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers beyond the parameters."""
    return lineup.key(_placed(p))


def cell(p: Params) -> list[Row]:
    """Rows of one method on one fleet under one noise."""
    return lineup.rows(_placed(p))


def at(fleet: str, noise: str) -> dict[str, Any]:
    """A fleet and a noise as a selection."""
    return {"data": fleet, **NOISES[noise]}


def multiple(results: Results, where: Where) -> float | None:
    """rms over runs of RT-LE over that of the oracle filter in the same place and noise."""
    place = {name: where[name] for name in ("data", "scenario", "velocity_ratio")}
    return ratio(rms(results, where), rms(results, of("kalman", "oracle", **place)))


def _table(results: Results) -> Table | None:
    rows = [((noise, fleet), at(fleet, noise)) for noise in NOISES for fleet in FLEETS]
    names = {
        look(method).label + (f", {known}" if method == "kalman" else ""): of(method, known)
        for method, known in METHODS[1:]
        if present(results, {"method": method})
    }
    return crossed(results, ("Noise", "Fleet"), rows, across(multiple, names), _caption(results))


def _caption(results: Results) -> str:
    kept = results.settings
    return (
        "rms RT-LE as a multiple of the oracle Kalman filter's in the same place and noise. Trained on "
        f"{kept['clients']}; training noise 1.5 m and 10 %, scenario 1: 1.8 m with a bias, 15 %; scenario 2: 3.5 m, 15 "
        f"% unless stated. {kept['runs']} runs, five egos, {kept['train_seeds']} training seeds, no neighbours."
    )


def _real(results: Results) -> Table | None:
    """RT-LE and NEES on real data; None without them."""
    base = mean(results, of("kalman", "nominal", **REAL))
    if base is None:
        return None
    columns: list[tuple[str, Number]] = [
        ("RT-LE [m]", mean),
        ("Times the nominal KF's", lambda results, where: ratio(mean(results, where), base)),
        ("NEES", partial(mean, value="nees")),
    ]
    text = scene.caption(results, "Alone, on real data.", **_placed({**results.settings, **REAL}))
    return crossed(results, HEAD, labelled(METHODS, **REAL), columns, text, decimals=3)


def _figure(results: Results) -> Plot | None:
    """Multiples, one panel per noise, a mark per fleet."""
    from coopoc.study.multiples import multiples

    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for pair in METHODS[1:]:
        for noise in NOISES:
            each = ran({fleet: multiple(results, of(*pair, **at(fleet, noise))) for fleet in FLEETS})
            if each:
                found.setdefault(pair, {})[noise] = list(each.values())
    return multiples(found, f"A mark per fleet. {_caption(results)}") if found else None


FINDING = (
    "{method} in scenario 2: {home:.2f} times the oracle filter at home, {away:.2f} in the other town, {beyond:.2f} at "
    "40 % velocity noise."
)


def _findings(results: Results) -> dict[str, str]:
    return {
        method: sentence(
            FINDING,
            method=method,
            home=multiple(results, of(method, "trained", **at("town10", "scenario 2"))),
            away=multiple(results, of(method, "trained", **at("town04", "scenario 2"))),
            beyond=multiple(results, of(method, "trained", **at("town10", "scenario 2, 40 %"))),
        )
        for method in ("fedkalmannet", "recursive")
    }


STUDY = lineup.study(
    "generalisation",
    "Does a gain trained on four drives generalise to other traffic, another town and other noise?",
    cell=cell,
    key=key,
    grid=_grid(),
    where=_meaningful,
    settings={**scene.WEIGHTS, **scene.SOLO, "egos": "auto", "runs": 30, "seed": 0, "train_seeds": 3, "real": ""},
    shares=("data", "scenario", "velocity_ratio"),
    tables={"multiples": _table, "real": _real},
    figures={"multiples": _figure},
    findings=_findings,
    limitations=(
        "Fleets are SUMO traffic with white noise. Real robots: --set real=FOLDER of MR.CLAM; a real car's odometry is "
        "in docs/streaming.md.",
    ),
    minutes=4,
    metrics={"rt_le_m": "lower"},
)
