"""Reference values: the committed numbers of a study, their tolerances, and the command that checks results by them."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from ..errors import InputError
from ..evaluate.statistics import Interval
from ..paths import given_path, write
from ..plugins import names
from ..workers import say
from . import store
from .cell import Params
from .results import SEED, Results, ego_by_run, lacking, whole
from .study import find_study
from .style import label, words
from .tables import Entry, Table

PAIRED_TOLERANCE, TRAINED_TOLERANCE = 0.01, 0.05
"""Share of a number by which it may move: draws are paired, but libraries differ in their last digits, and nets are
trained by them."""
SIGMA = 2.0
"""Standard errors by which means over other numbers of runs may differ in addition."""


def _finite(value: Any) -> float:
    """A number that can be compared."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is no finite number")
    return float(value)


NUMBER_READERS: Mapping[str, Any] = {
    "where": dict,
    "metric": str,
    "value": _finite,
    "runs": lambda runs: max(int(runs), 1),
    "run_std": _finite,
    "tolerance": _finite,
}
"""Field of a number -> how it is read."""
FREE_SETTINGS = ("runs", "weights", "backend", "metric")
"""Settings that may differ from those of the reference."""


@dataclass(frozen=True)
class Number:
    """A mean over egos, runs and training seeds.

    Args:
        where: parameter -> value.
        metric: name of the number.
        value: the mean.
        runs: number of runs.
        run_std: standard deviation of a run's mean.
        tolerance: share of the value by which it may move.
    """

    where: Params
    metric: str
    value: float
    runs: int
    run_std: float
    tolerance: float

    @property
    def key(self) -> tuple[str, str]:
        """Identifies the number in another set."""
        return json.dumps(dict(self.where), sort_keys=True, default=str), self.metric


class Change(NamedTuple):
    """A reference number and the same number now.

    Attributes:
        was: the reference.
        now: its value now.
        difference: now less the reference, with what its tolerance and the noise of other runs allow.
        better: "lower" or "higher" if that is better, or the value that is best.
    """

    was: Number
    now: float
    difference: Interval
    better: str | float

    @property
    def verdict(self) -> str:
        """within noise, better or worse.

        >>> was = Number({}, "rt_le_m", 1.0, 3, 0.0, 0.01)
        >>> Change(was, 1.2, Interval(0.2, 0.19, 0.21, 3), "lower").verdict
        'worse'
        """
        if math.isnan(self.now):  # a run of an ego has lost its number
            return "worse"
        if self.difference.low <= 0 <= self.difference.high:
            return "within noise"
        if isinstance(self.better, str):
            return "better" if (self.difference.mean > 0) == (self.better == "higher") else "worse"
        return "better" if abs(self.now - self.better) < abs(self.was.value - self.better) else "worse"


@dataclass(frozen=True)
class Reference:
    """The numbers of a study under its settings."""

    study: str
    settings: Params
    numbers: tuple[Number, ...]

    def save(self, path: str | Path) -> None:
        """Write as JSON, one line per number."""
        lines = ",\n".join("  " + json.dumps(vars(number), default=float) for number in self.numbers)
        head = json.dumps({"study": self.study, "settings": dict(self.settings)}, indent=1, default=list)[:-2]
        write(given_path(path), f'{head},\n "numbers": [\n{lines}\n ]\n}}\n')

    @classmethod
    def load(cls, path: str | Path) -> "Reference":
        """Read what `save` wrote; InputError without such a file, or for a damaged one."""
        path, hint = given_path(path), "Write them with coopoc reference --write."
        document = store.content(path, {"study": str, "settings": dict, "numbers": list}, hint)
        try:
            numbers = tuple(
                Number(**{name: NUMBER_READERS[name](each[name]) for name in NUMBER_READERS})
                for each in document["numbers"]
            )
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise InputError("file", str(path), f"is damaged ({error})", hint) from None
        return cls(document["study"], document["settings"], numbers)


def measure(results: Results, metrics: Iterable[str]) -> Reference:
    """The means of the metrics at every point of the grid that has finished."""
    numbers = []
    for point, rows in results.groups(results.axes) if len(results.frame) else ():
        where = {name: plain(value) for name, value in zip(results.axes, point, strict=True)}
        tolerance = TRAINED_TOLERANCE if SEED in rows and rows[SEED].notna().any() else PAIRED_TOLERANCE
        for metric in metrics:
            if metric not in rows:
                continue
            grid = ego_by_run(rows, metric)
            each = whole(grid).to_numpy()
            if lacking(grid):
                numbers.append(Number(where, metric, math.nan, 1, 0.0, tolerance))
            elif each.size:
                runs = each.shape[1]
                std = each.mean(axis=0).std(ddof=1) if runs > 1 else 0.0
                mean, std = (float(f"{value:.6g}") for value in (each.mean(), std))  # more depends on the machine
                numbers.append(Number(where, metric, mean, runs, std, tolerance))
    return Reference(results.study, {k: plain(v) for k, v in results.settings.items()}, tuple(numbers))


def check(results: Results, reference: Reference, metrics: Mapping[str, str | float]) -> list[Change]:
    """Changes of the results (B) from the reference (A), of the numbers that both have.

    Args:
        results: of the study.
        reference: its committed numbers.
        metrics: name -> what is `better`.

    Raises:
        InputError: their settings differ, so that the numbers mean different things.
    """
    measured = measure(results, metrics)
    a, b = reference.settings, measured.settings
    if others := sorted(name for name in {*a, *b} - {*FREE_SETTINGS} if a.get(name) != b.get(name)):
        differs = f"is not the reference's in {', '.join(others)}"
        hint = f"Run it with its own settings; {', '.join(FREE_SETTINGS)} may differ."
        raise InputError("settings", results.study, differs, hint)
    before, changes = {number.key: number for number in reference.numbers}, []
    for now in measured.numbers:
        if was := before.get(now.key):
            noise = 0.0 if was.runs == now.runs else SIGMA * was.run_std * np.sqrt(1 / was.runs + 1 / now.runs)
            moved, allowed = now.value - was.value, float(was.tolerance * abs(was.value) + noise)
            difference = Interval(moved, moved - allowed, moved + allowed, now.runs)
            changes.append(Change(was, now.value, difference, metrics[now.metric]))
    return changes


def table(changes: Sequence[Change], everything: bool = False, missing: int = 0) -> Table:
    """The numbers that have moved, or all; the caption says how many hold, and how many do not.

    Args:
        changes: of `check`.
        everything: show the numbers that hold, too.
        missing: number of reference numbers without a value.

    >>> table([], missing=4).caption
    '0 of 4 reference numbers hold; 4 without a value.'
    """
    counts = Counter(change.verdict for change in changes) + Counter({"without a value": missing})
    moved = [f"; {counts[word]} {word}" for word in ("worse", "better", "without a value") if counts[word]]
    text = f"{counts['within noise']} of {counts.total()} reference numbers hold{''.join(moved)}."
    shown = [change for change in changes if everything or change.verdict != "within noise"]
    names = [*dict.fromkeys(name for change in shown for name in change.was.where), "metric"]
    header = (*map(words, names), "Reference", "Now", "Now - Reference", "Change")
    rows: list[tuple[Entry, ...]] = []
    for change in shown:
        at = {"metric": change.was.metric, **change.was.where}
        labels = (label(name, at.get(name)) for name in names)
        rows.append((*labels, change.was.value, change.now, change.difference, change.verdict))
    return Table(header, tuple(rows), text, decimals=4)


def reference(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")],
    /,
    study: Annotated[str, arg(metavar="NAME")] = "",
    file: Annotated[Path | None, arg(metavar="FILE")] = None,
    write: bool = False,
    all: bool = False,
) -> int:
    """Check the results of a study against its committed reference values; the status is 1 if one is worse, cells
    failed, or no number has a value.

    Example: coopoc reference runs/budget

    Example: coopoc reference runs/mine --study mine.py:STUDY

    Args:
        folder: folder of the study.
        study: the study, FILE.py:NAME, if it is not an installed one.
        file: file of the reference values, instead of the study's own.
        write: write the reference values from these results.
        all: show every value, not only those that moved.
    """
    results = Results.load(folder)
    if not study and results.study not in names("coopoc.studies"):
        hint = f"If it is a file of your own, name it: coopoc reference {folder} --study FILE.py:NAME."
        raise InputError("study", repr(results.study), "is not installed", hint)
    of = find_study(study or results.study)
    if of.name != results.study:
        raise InputError("study", repr(of.name), f"must be {results.study}, as in the folder", "Name that study.")
    file = file or (Path(of.reference) if of.reference else None)
    if file is None or not of.metrics:
        raise InputError("study", of.name, "has no reference numbers", "Name its metrics, and give --file.")
    if write:
        made = measure(results, of.metrics)
        made = replace(made, numbers=tuple(number for number in made.numbers if number.value == number.value))
        made.save(file)
        say(f"{len(made.numbers)} numbers are in {file}")
        return 0
    known = Reference.load(file)
    changes = check(results, known, of.metrics)
    shown = table(changes, all, len(known.numbers) - len(changes))
    print(shown.to_markdown() if shown.rows else shown.caption)
    return int(not changes or results.failed > 0 or any(change.verdict == "worse" for change in changes))


def plain(value: Any) -> Any:
    """A parameter as JSON has it: Python's own number, None for NaN, a list for a tuple."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if value != value else list(value) if isinstance(value, tuple) else value
