"""What the paper leaves open moves the result more than the learning method does: start and reading of "10 %"."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, weights
from .error_cdf import CASES, CLASSIC, key, seed_spread

if TYPE_CHECKING:
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

CHOICES = [(start, reading) for start in ("gnss", "true") for reading in ("axis", "speed")]


def cell(p: Params) -> list[Row]:
    """Rows of one method in one case under one pair of choices."""
    return lineup.rows(p)


def _where(start: str, reading: str, scenario: int, ratio: float) -> dict[str, Any]:
    return {"start": start, "velocity_reading": reading, "scenario": scenario, "velocity_ratio": ratio}


def _table(start: str, reading: str) -> Any:
    def table(results: Results) -> Table:
        from coopoc.study.style import look
        from coopoc.study.tables import Table

        body = []
        for method, known in (*CLASSIC, *((name, "trained") for name in weights.LEARNED)):
            row: list[Any] = [look(method).label, known]
            for scenario, ratio in CASES:
                where = {**_where(start, reading, scenario, ratio), "method": method, "knowledge": known}
                row += [results.interval("rt_le_m", where), seed_spread(results, where)]
            body.append((*row, 100 * results.interval("worse_than_gnss", where).mean))
        header = ["Method", "Knowledge"]
        for scenario, ratio in CASES:
            header += [f"Sc. {scenario}, {100 * ratio:g} % [m]", "Seed std [m]"]
        where_from = "first fix" if start == "gnss" else "true position"
        p = results.settings
        caption = (
            f"RT-LE, start at the {where_from}, velocity noise read per {reading}; {p['runs']} paired runs, "
            f"{p['egos']} egos of {p['data']}, {p['train_seeds']} training seeds. Last column: of the last case."
        )
        return Table((*header, "Worse [%]"), tuple(body), caption, best=None)

    return table


def _findings(results: Results) -> Sequence[str]:
    found = []
    for start, reading in CHOICES:
        text = []
        for scenario, ratio in CASES:
            where = _where(start, reading, scenario, ratio)

            def mean(method: str, known: str = "trained", at: dict[str, Any] = where) -> float:
                return results.interval("rt_le_m", {**at, "method": method, "knowledge": known}).mean

            fed, centralised, oracle = mean("fedkalmannet"), mean("centralised"), mean("kalman", "oracle")
            text.append(
                f"scenario {scenario} at {100 * ratio:g} %: federated {fed:.3f} m = {fed / oracle:.2f} x oracle, "
                f"{100 * (fed / centralised - 1):+.1f} % of centralised, fitted KF {mean('kalman', 'fitted'):.3f} m"
            )
        found.append(f"Start {start}, per {reading}: " + "; ".join(text) + ".")
    return found


STUDY = Study(
    name="open_choices",
    question="How much do the start and the reading of the velocity noise move the comparison of learned gains?",
    cell=cell,
    key=key,
    prepare=weights.prepare,
    grid=[
        {**_where(start, reading, scenario, ratio), "method": method, "knowledge": known}
        for start, reading in CHOICES for scenario, ratio in CASES
        for method, known in (*CLASSIC, *((name, "trained") for name in weights.LEARNED))
    ],
    settings={
        "data": "town10", "clients": "town10-clients", "weights": "runs/weights", "egos": "5", "runs": 100, "seed": 0,
        "train_seeds": 5,
    },
    shares=("scenario", "velocity_ratio", "velocity_reading"),
    tables={f"{start}_{reading}": _table(start, reading) for start, reading in CHOICES},
    findings=_findings,
    limitations=("The true start is what KalmanNet's published loop assumes; no vehicle has it.",),
    minutes=30,
)  # fmt: skip
