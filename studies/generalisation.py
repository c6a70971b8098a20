"""Whether what was learned on four drives of one town holds in other traffic, another town, other noise, reality."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

FLEETS = ("town10", "town10-validation", "town04")
"""Traffic of the town where the clients drove, other traffic there, and a town with motorways."""
NOISES = {"training": (0, 0.10), "scenario 1": (1, 0.15), "scenario 2": (2, 0.15), "scenario 2, 40 %": (2, 0.40)}
"""Name -> scenario and velocity noise; the last is beyond what anything was trained at."""
METHODS = (
    ("kalman", "oracle"),
    ("kalman", "nominal"),
    ("kalman", "fitted"),
    ("kalman-adaptive", "nominal"),
    ("okf", "trained"),
    ("fedkalmannet", "trained"),
    ("magnitude", "trained"),
    ("split", "trained"),
    ("recursive", "trained"),
    ("cooperative", "trained"),
)


REAL = {"data": "real", "scenario": 0, "velocity_ratio": 0.10}
"""Robots that were really driven, whose noise is their own; the setting `real` says where their data are."""


def _grid() -> list[dict[str, Any]]:
    places = [at(fleet, noise) for fleet in FLEETS for noise in NOISES]
    grid = [{**place, "method": m, "noise_model": known} for place in places for m, known in METHODS]
    return grid + [{**REAL, "method": m, "noise_model": known} for m, known in METHODS if known != "oracle"]


def _meaningful(p: Params) -> bool:
    return p["data"] != "real" or bool(p["real"])


def _placed(p: Params) -> Params:
    return {**p, "data": p["real"]} if p["data"] == "real" else p


def key(p: Params) -> dict[str, str]:
    """What changes the numbers beyond the parameters."""
    return lineup.key(_placed(p))


def cell(p: Params) -> list[Row]:
    """Rows of one method on one fleet under one noise."""
    return lineup.rows(_placed(p))


def at(fleet: str, noise: str) -> dict[str, Any]:
    """A fleet and a noise as a selection."""
    scenario, ratio = NOISES[noise]
    return {"data": fleet, "scenario": scenario, "velocity_ratio": ratio}


def multiple(results: Results, where: dict[str, Any]) -> float | None:
    """rms over runs of RT-LE over that of the oracle filter in the same place and noise."""
    place = {name: where[name] for name in ("data", "scenario", "velocity_ratio")}
    oracle = views.rms(results, {**place, "method": "kalman", "noise_model": "oracle"})
    mine = views.rms(results, where)
    return None if oracle is None or mine is None else mine / oracle


def _table(results: Results) -> Table | None:
    from coopoc.study.style import look

    rows = [((noise, fleet), at(fleet, noise)) for noise in NOISES for fleet in FLEETS]
    ran = [pair for pair in METHODS[1:] if views.present(results, {"method": pair[0]})]
    columns = [
        (look(method).label + (f", {known}" if method == "kalman" else ""), {"method": method, "noise_model": known})
        for method, known in ran
    ]
    return views.crossed(results, ("Noise", "Fleet"), rows, columns, multiple, _caption(results), decimals=2)


def _caption(results: Results) -> str:
    kept = results.settings
    return (
        "rms RT-LE as a multiple of the oracle Kalman filter's in the same place and noise. Trained on "
        f"{kept['clients']}; training noise 1.5 m and 10 %, scenario 1: 1.8 m with a bias, 15 %; scenario 2: 3.5 m, 15 "
        f"% unless said. {kept['runs']} runs, five egos, {kept['train_seeds']} training seeds, no neighbours."
    )


def _real(results: Results) -> Table | None:
    """RT-LE and NEES on real data; None without them."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    base = views.mean(results, {**REAL, "method": "kalman", "noise_model": "nominal"})
    for method, known in METHODS:
        where = {**REAL, "method": method, "noise_model": known}
        error = views.mean(results, where)
        if error is not None and base is not None:
            body.append((look(method).label, known, error, error / base, views.mean(results, where, "nees")))
    header = ("Method", "NoiseModel", "RT-LE [m]", "Times the nominal KF's", "NEES")
    if not body:
        return None
    text = f"Alone, on real data. {scene.conditions({**results.settings, **_placed({**results.settings, **REAL})})}"
    return Table(header, tuple(body), text, decimals=3, best=None)


def _figure(results: Results) -> Plot | None:
    """Multiples, one panel per noise, a mark per fleet."""
    from coopoc.study.multiples import multiples

    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for method, known in METHODS[1:]:
        for noise in NOISES:
            each = [multiple(results, {**at(fleet, noise), "method": method, "noise_model": known}) for fleet in FLEETS]
            ran = [value for value in each if value is not None]
            if ran:
                found.setdefault((method, known), {})[noise] = ran
    return multiples(found, f"A mark per fleet. {_caption(results)}") if found else None


def _findings(results: Results) -> Sequence[str]:
    found = []
    for method in ("fedkalmannet", "recursive"):
        where = {"method": method, "noise_model": "trained"}
        home, away = (multiple(results, {**at(fleet, "scenario 2"), **where}) for fleet in ("town10", "town04"))
        beyond = multiple(results, {**at("town10", "scenario 2, 40 %"), **where})
        if home is not None and away is not None and beyond is not None:
            found.append(
                f"{method} in scenario 2: {home:.2f} times the oracle filter at home, {away:.2f} in the other town, "
                f"{beyond:.2f} at 40 % velocity noise."
            )
    return found


STUDY = Study(
    name="generalisation",
    question="Does what was learned on four drives hold in other traffic, another town and other noise?",
    cell=cell,
    key=key,
    prepare=weights.prepare,
    grid=_grid(),
    where=_meaningful,
    settings={
        "clients": "town10-clients",
        "weights": "runs/weights",
        "velocity_reading": "axis",
        "start": "gnss",
        "egos": "auto",
        "runs": 30,
        "seed": 0,
        "train_seeds": 3,
        "real": "",
    },
    shares=("data", "scenario", "velocity_ratio"),
    tables={"multiples": _table, "real": _real},
    figures={"multiples": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "Fleets are SUMO traffic with white noise. Real robots: --set real=FOLDER of MR.CLAM; a real car's odometry is "
        "in docs/streaming.md.",
    ),
    minutes=4,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("generalisation"),
)
