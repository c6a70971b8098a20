"""What the paper leaves open moves the result more than the learning method does: start and reading of "10 %"."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights
from .error_cdf import CASES, LINEUP, case, meaningful

if TYPE_CHECKING:
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

CHOICES = [(start, reading) for start in ("gnss", "true") for reading in ("axis", "speed")]


def cell(p: Params) -> list[Row]:
    """Rows of one method in one case under one pair of choices."""
    return lineup.rows(p)


def _of(start: str, reading: str) -> dict[str, str]:
    return {"start": start, "velocity_reading": reading}


def _cases(results: Results, start: str, reading: str) -> list[dict[str, Any]]:
    """The cases that were run under a pair of choices, as selections."""
    found = [{**_of(start, reading), **case(*pair)} for pair in CASES]
    return [at for at in found if views.present(results, at)]


def _table(start: str, reading: str) -> Any:
    def table(results: Results) -> Table | None:
        from coopoc.study.style import look
        from coopoc.study.tables import Table

        cases, body = _cases(results, start, reading), []
        for method, known in LINEUP:
            row: list[Any] = []
            for at in cases:
                where = {**at, "method": method, "noise_model": known}
                ran = views.present(results, where)
                row += _numbers(results, where) if ran else [None] * 3
            if any(entry is not None for entry in row):
                body.append((look(method).label, known, *row))
        header = ["Method", "NoiseModel"]
        for at in cases:
            header += [f"{_name(results, at)} [m]", "Seed std [m]", "Worse than GNSS [%]"]
        digits = scene.decimals(results.settings)
        text = " ".join(scene.conditions({**results.settings, **at}) for at in cases)
        return Table(tuple(header), tuple(body), f"RT-LE. {text}", decimals=digits) if body else None

    return table


def _numbers(results: Results, where: dict[str, Any]) -> list[Any]:
    worse = 100 * results.interval("worse_than_gnss", where).mean
    return [results.interval("rt_le_m", where), views.seed_std(results, where), worse]


def _name(results: Results, at: dict[str, Any]) -> str:
    if scene.is_real(results.settings["data"]):
        return "Real data"
    return f"Sc. {at['scenario']}, {100 * at['velocity_ratio']:g} %"


def _findings(results: Results) -> Sequence[str]:
    found = [_finding(results, at) for start, reading in CHOICES for at in _cases(results, start, reading)]
    return [sentences for sentences in found if sentences]


def _finding(results: Results, at: dict[str, Any]) -> str:
    names = {
        "federated": ("fedkalmannet", "trained"),
        "centralised": ("centralised", "trained"),
        "OKF": ("okf", "trained"),
        "fitted KF": ("kalman", "fitted"),
        "oracle KF": ("kalman", "oracle"),
    }
    found = {
        words: views.mean(results, {**at, "method": method, "noise_model": known})
        for words, (method, known) in names.items()
    }
    if not views.listed(found):
        return ""
    fed, ratios = found["federated"], ""
    if fed:
        ratios = ", ".join(f"{fed / v:.2f} x {words}" for words, v in found.items() if v and words != "federated")
    shown = f"RT-LE: {views.listed(found)}"
    return f"{scene.heading({**results.settings, **at})}. {shown}" + (f"; federated is {ratios}." if ratios else ".")


STUDY = Study(
    name="open_choices",
    question="How much do the start and the reading of the velocity noise move the comparison of learned gains?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=[
        {**_of(start, reading), **case(*pair), "method": method, "noise_model": known}
        for start, reading in CHOICES
        for pair in CASES
        for method, known in LINEUP
    ],
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "egos": "auto",
        "runs": 100,
        "seed": 0,
        "train_seeds": 5,
    },
    where=meaningful,
    shares=("scenario", "velocity_ratio", "velocity_reading"),
    tables={f"{start}_{reading}": _table(start, reading) for start, reading in CHOICES},
    findings=_findings,
    limitations=("The true start is what KalmanNet's published loop assumes; no vehicle has it.",),
    minutes=30,
)
