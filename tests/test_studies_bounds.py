"""No mark of any study lies below the bound of its own condition and information set beyond its interval.

The committed reference numbers hold every study's marks: mean, standard deviation from run to run, number of runs.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

FILES = sorted((Path(__file__).resolve().parents[1] / "studies" / "reference").glob("*.json"))


def conditions(file: Path) -> Iterator[tuple[dict[str, Any], dict[tuple[str, str], dict[str, Any]]]]:
    """Every condition of a study with the marks of its methods and bounds."""
    found: dict[str, dict[tuple[str, str], dict[str, Any]]] = defaultdict(dict)
    for number in json.loads(file.read_text())["numbers"]:
        where = dict(number["where"])
        pair = (where.pop("method"), where.pop("noise_model", ""))
        if number["metric"] == "rt_le_m":
            found[json.dumps(where, sort_keys=True)][pair] = number
    for where, marks in found.items():
        yield json.loads(where), marks


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_mark_lies_below_its_bound(file: Path) -> None:
    for where, marks in conditions(file):
        bounds = {known: mark["value"] for (method, known), mark in marks.items() if method == "bound"}
        for (method, known), mark in marks.items():
            if method == "bound" or not bounds:
                continue
            own = max(bounds.values())
            error = mark["run_std"] / mark["runs"] ** 0.5
            assert mark["value"] + 3.0 * error > own, (where, method, known, mark["value"], own)


def test_most_studies_show_a_bound() -> None:
    shown = {file.stem for file in FILES for _, marks in conditions(file) if any(m == "bound" for m, _ in marks)}
    assert {"budget", "cooperative_gain", "correlated_gnss", "neighbours", "learned_gains", "heading_error"} <= shown
