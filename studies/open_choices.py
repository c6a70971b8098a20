"""Choices that the paper leaves open, which move the result more than the learning method: start and reading."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Number, interval, listed, mean, present, ran, seed_means, seed_std
from coopoc.study.tables import across, crossed

from . import lineup, scene
from .error_cdf import CASES, LINEUP, case, meaningful, worse_than_gnss
from .lineup import HEAD, labelled, of

if TYPE_CHECKING:
    from coopoc.study.plot import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

CHOICES = {
    f"{start}_{reading}": {"start": start, "velocity_reading": reading}
    for start in ("gnss", "true")
    for reading in ("axis", "speed")
}
"""Pairs of choices, as selections."""
STARTS = {"gnss": "First fix", "true": "True start"}
READINGS = {"axis": "per axis", "speed": "of the speed"}


def _cases(results: Results, choice: dict[str, str]) -> dict[str, dict[str, Any]]:
    """The cases that were run under a pair of choices, as selections by their titles."""
    real = scene.is_real(results.settings["data"])
    found = {
        "Real data" if real else f"Sc. {s}, {100 * r:g} %": {**choice, **case(s, r)}
        for s, r in CASES[: 1 if real else 3]
    }
    return {title: at for title, at in found.items() if present(results, at)}


def _table(results: Results, choice: dict[str, str]) -> Table | None:
    cases = _cases(results, choice)
    columns: list[tuple[str, Number]] = []
    for title, at in cases.items():
        columns += across(interval, {f"{title} [m]": at})
        columns += across(seed_std, {"Seed std [m]": at}) + across(worse_than_gnss, {"Worse than GNSS [%]": at})
    caption = " ".join(["RT-LE.", *(scene.caption(results, **at) for at in cases.values())])
    digits = scene.decimals(results.settings)
    return crossed(results, HEAD, labelled(LINEUP), columns, caption, decimals=digits)


def _figure(results: Results) -> Plot | None:
    """Multiples of one reference under each pair of choices, a dot per training seed."""
    from coopoc.study.multiples import multiples

    at = case(2, 0.15)
    reference = mean(results, of("kalman", "oracle", **CHOICES["gnss_axis"], **at))
    if reference is None:
        return None
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for pair in LINEUP[2:]:  # fixes and unit covariances lie far beyond
        for choice in CHOICES.values():
            each = seed_means(results, of(*pair, **choice, **at))
            if each:
                title = f"{STARTS[choice['start']]}, {READINGS[choice['velocity_reading']]}"
                found.setdefault(pair, {})[title] = [value / reference for value in each]
    text = "RT-LE as a multiple of the first panel's oracle Kalman filter, a dot per training seed. First panel:"
    return multiples(found, scene.caption(results, text, **CHOICES["gnss_axis"], **at))


def _findings(results: Results) -> dict[str, str]:
    return {
        f"{name}, {title}": _finding(results, at)
        for name, choice in CHOICES.items()
        for title, at in _cases(results, choice).items()
    }


def _finding(results: Results, at: dict[str, Any]) -> str:
    names = {
        "federated": ("fedkalmannet", "trained"),
        "centralised": ("centralised", "trained"),
        "OKF": ("okf", "trained"),
        "fitted KF": ("kalman", "fitted"),
        "oracle KF": ("kalman", "oracle"),
    }
    found = ran({words: mean(results, of(*pair, **at)) for words, pair in names.items()})
    if not found:
        return ""
    fed, text = found.get("federated"), f"{scene.heading(scene.shown(results, **at))}. RT-LE: {listed(found)}"
    ratios = [f"{fed / value:.2f} x {words}" for words, value in found.items() if fed and words != "federated"]
    return text + (f"; federated is {', '.join(ratios)}." if ratios else ".")


STUDY = lineup.study(
    "open_choices",
    "How much do the start and the reading of the velocity noise change the comparison of learned gains?",
    cell=lineup.rows,
    recipe=None,
    reference=None,
    grid=[of(*pair, **choice, **case(*at)) for choice in CHOICES.values() for at in CASES for pair in LINEUP],
    settings={**scene.DRAWN, **scene.WEIGHTS, "runs": 100, "train_seeds": 5},
    where=meaningful,
    shares=("scenario", "velocity_ratio", "velocity_reading"),
    tables={name: partial(_table, choice=choice) for name, choice in CHOICES.items()},
    figures={"choices": _figure},
    findings=_findings,
    limitations=("KalmanNet's published loop starts at the true position, which no vehicle knows.",),
    minutes=30,
)
