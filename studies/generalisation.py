"""Whether what was learned on four drives of one town holds in other traffic, another town and other noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

FLEETS = ("town10", "town10-validation", "town04")
"""Traffic of the town where the clients drove, other traffic there, and a town with motorways."""
NOISES = {"training": (0, 0.10), "scenario 1": (1, 0.15), "scenario 2": (2, 0.15), "scenario 2, 40 %": (2, 0.40)}
"""Name -> scenario and velocity noise; the last is beyond what anything was trained at."""
METHODS = (
    ("kalman", "oracle"), ("kalman", "nominal"), ("kalman", "fitted"), ("kalman-adaptive", "nominal"),
    ("okf", "trained"), ("fedkalmannet", "trained"), ("magnitude", "trained"), ("split", "trained"),
    ("recursive", "trained"), ("cooperative", "trained"),
)  # fmt: skip


def cell(p: Params) -> list[Row]:
    """Rows of one method on one fleet under one noise."""
    return lineup.rows(p)


def at(fleet: str, noise: str) -> dict[str, Any]:
    """A fleet and a noise as a selection."""
    scenario, ratio = NOISES[noise]
    return {"data": fleet, "scenario": scenario, "velocity_ratio": ratio}


def multiple(results: Results, where: dict[str, Any]) -> float | None:
    """rms over runs of RT-LE over that of the oracle filter in the same place and noise."""
    place = {name: where[name] for name in ("data", "scenario", "velocity_ratio")}
    oracle = views.rms(results, {**place, "method": "kalman", "knowledge": "oracle"})
    mine = views.rms(results, where)
    return None if oracle is None or mine is None else mine / oracle


def _table(results: Results) -> Table | None:
    from coopoc.study.style import look

    rows = [((noise, fleet), at(fleet, noise)) for noise in NOISES for fleet in FLEETS]
    ran = [pair for pair in METHODS[1:] if views.present(results, {"method": pair[0]})]
    columns = [(look(method).label + (f", {known}" if method == "kalman" else ""),
                {"method": method, "knowledge": known}) for method, known in ran]  # fmt: skip
    return views.crossed(results, ("Noise", "Fleet"), rows, columns, multiple, _caption(results), decimals=2)


def _caption(results: Results) -> str:
    kept = results.settings
    return (
        "rms RT-LE as a multiple of the oracle Kalman filter's in the same place and noise. Trained on "
        f"{kept['clients']}; training noise 1.5 m and 10 %, scenario 1: 1.8 m with a bias, 15 %; scenario 2: 3.5 m, 15 "
        f"% unless said. {kept['runs']} runs, five egos, {kept['train_seeds']} training seeds, no neighbours."
    )


def _figure(results: Results) -> Plot | None:
    """Multiples, one panel per noise, a mark per fleet."""
    from coopoc.study.multiples import multiples

    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for method, known in METHODS[1:]:
        for noise in NOISES:
            each = [multiple(results, {**at(fleet, noise), "method": method, "knowledge": known}) for fleet in FLEETS]
            ran = [value for value in each if value is not None]
            if ran:
                found.setdefault((method, known), {})[noise] = ran
    return multiples(found, f"A mark per fleet. {_caption(results)}") if found else None


def _findings(results: Results) -> Sequence[str]:
    found = []
    for method in ("fedkalmannet", "recursive"):
        where = {"method": method, "knowledge": "trained"}
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
    key=lineup.key,
    prepare=weights.prepare,
    grid=[
        {**at(fleet, noise), "method": method, "knowledge": known}
        for fleet in FLEETS for noise in NOISES for method, known in METHODS
    ],
    settings={
        "clients": "town10-clients", "weights": "runs/weights", "velocity_reading": "axis", "start": "gnss",
        "egos": "auto", "runs": 30, "seed": 0, "train_seeds": 3,
    },
    shares=("data", "scenario", "velocity_ratio"),
    tables={"multiples": _table},
    figures={"multiples": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "All fleets are SUMO traffic with white noise; what a real odometry does to the recursive gain is in "
        "docs/streaming.md.",
    ),
    minutes=4,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("generalisation"),
)  # fmt: skip
