"""Gains that were learned on four drives of one town, in other traffic, another town and other noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Where, across, ran, ratio, rms, sentence
from coopoc.study.style import look

from . import lineup, scene
from .error_cdf import case
from .views import multiples, of, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

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


def at(fleet: str, noise: str) -> dict[str, Any]:
    """A fleet and a noise as a selection."""
    return {"data": fleet, **NOISES[noise]}


def multiple(results: Results, where: Where) -> float | None:
    """rms over runs of RT-LE over that of the oracle filter in the same place and noise."""
    return ratio(rms(results, where), rms(results, {**where, **of("kalman", "oracle")}))


def _each_fleet(results: Results, where: Where) -> list[float]:
    return list(ran({fleet: multiple(results, {**where, "data": fleet}) for fleet in FLEETS}).values())


TEXT = (
    "rms RT-LE as a multiple of the oracle Kalman filter's in the same place and noise. Trained on {clients}; training "
    "noise 1.5 m and 10 %, scenario 1: 1.8 m with a bias, 15 %; scenario 2: 3.5 m, 15 % unless stated. At home:"
)
HOME = {**at("town10", "scenario 2")}


FINDING = (
    "{method} in scenario 2: {home:.2f} times the oracle filter at home, {away:.2f} in the other town, {beyond:.2f} at "
    "40 % velocity noise."
)


def _findings(results: Results) -> dict[str, str]:
    places = {
        "home": HOME,
        "away": at("town04", "scenario 2"),
        "beyond": at("town10", "scenario 2, 40 %"),
    }
    texts = {}
    for method in ("fedkalmannet", "recursive"):
        each = {name: multiple(results, of(method, "trained", **place)) for name, place in places.items()}
        texts[method] = sentence(FINDING, method=method, **each)
    return texts


STUDY = lineup.study(
    "generalisation",
    "Does a gain trained on four drives generalise to other traffic, another town and other noise?",
    grid=[of(*pair, **at(fleet, noise)) for fleet in FLEETS for noise in NOISES for pair in METHODS],
    settings={**scene.WEIGHTS, **scene.SOLO, "egos": "auto", "runs": 30, "seed": 0, "train_seeds": 3},
    shares=("data", "scenario", "velocity_ratio"),
    tables={
        "multiples": selections(
            ("Noise", "Fleet"),
            [((noise, fleet), at(fleet, noise)) for noise in NOISES for fleet in FLEETS],
            across(
                multiple,
                {look(m).label + (f", {known}" if m == "kalman" else ""): of(m, known) for m, known in METHODS[1:]},
            ),
            TEXT,
            at=HOME,
        ),
    },
    figures={"multiples": multiples(METHODS[1:], NOISES, _each_fleet, "A mark per fleet.", TEXT, at=HOME)},
    findings=_findings,
    limitations=("Fleets are SUMO traffic with white noise; a real car's odometry is in docs/streaming.md.",),
    minutes=4,
    metrics={"rt_le_m": "lower"},
)
