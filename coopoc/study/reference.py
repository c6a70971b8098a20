"""Reference numbers: what a study gave when it was committed, how far that may move, and which way is worse."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from . import store
from .results import SEED, Results, ego_by_run
from .tables import Table

TOLERANCE, TRAINED = 0.01, 0.05
"""Share of a number by which it may move: draws are paired, but libraries differ in their last digits, and nets are
trained by them."""
SIGMA = 2.0
"""Standard errors by which means over other numbers of runs may differ beside that."""
FREE = ("runs", "weights", "backend")
"""Settings that a run may change and still be held against the reference."""
Direction = str | float
"""Of a metric: "lower" or "higher" is better, or the number that it should have."""


@dataclass(frozen=True)
class Number:
    """A mean over egos, runs and training seeds, and the standard deviation of a run's."""

    where: Mapping[str, Any]
    metric: str
    value: float
    runs: int
    run_std: float
    tolerance: float
    better: Direction


@dataclass(frozen=True)
class Reference:
    """The numbers of a study under its settings."""

    study: str
    settings: Mapping[str, Any]
    numbers: tuple[Number, ...]

    def save(self, path: str | Path) -> None:
        """Write as JSON, one line per number."""
        lines = ",\n".join("  " + json.dumps(vars(number), default=float) for number in self.numbers)
        head = json.dumps({"study": self.study, "settings": dict(self.settings)}, indent=1, default=list)[:-2]
        store.write(Path(path), f'{head},\n "numbers": [\n{lines}\n ]\n}}\n')

    @classmethod
    def load(cls, path: str | Path) -> Reference:
        """What `save` wrote; InputError if there is none, or if it is damaged."""
        given = store.content(Path(path), "holds no reference numbers", "Write them with coopoc reference --write.")
        return cls(given["study"], given["settings"], tuple(Number(**number) for number in given["numbers"]))


def measure(results: Results, metrics: Mapping[str, Direction]) -> Reference:
    """The means of the metrics at every point of the grid that has finished.

    Args:
        metrics: name -> "lower", "higher" or the number that is best.

    Raises:
        InputError: a direction that is none of these.
    """
    for name, better in metrics.items():
        if not (better in ("lower", "higher") or isinstance(better, float)):
            raise InputError("metrics", f"{name}: {better!r}", "must be 'lower', 'higher' or a number", "Say which.")
    found = []
    for point, rows in results.groups(results.axes) if len(results.frame) else ():
        where = {name: _plain(value) for name, value in zip(results.axes, point, strict=True)}
        trained = SEED in rows and rows[SEED].notna().any()
        for metric, better in metrics.items():
            each = ego_by_run(rows, metric)[0] if metric in rows and rows[metric].notna().any() else np.empty((0, 0))
            if each.size:
                runs = each.shape[1]
                std = float(each.mean(axis=0).std(ddof=1)) if runs > 1 else 0.0
                tolerance = TRAINED if trained else TOLERANCE
                found.append(Number(where, metric, _short(each.mean()), runs, _short(std), tolerance, better))
    return Reference(results.study, {k: _plain(v) for k, v in results.settings.items()}, tuple(found))


def differing(results: Results, reference: Reference) -> list[str]:
    """Settings under which the results cannot be held against the reference."""
    mine = {name: _plain(value) for name, value in results.settings.items()}
    names = {*mine, *reference.settings} - set(FREE)
    return sorted(name for name in names if mine.get(name) != reference.settings.get(name))


@dataclass(frozen=True)
class Held:
    """A number, what it was, how far it may move, and what that makes of it: as before, better, worse or moved."""

    was: Number
    now: Number
    allowed: float
    verdict: str


def hold(results: Results, reference: Reference) -> list[Held]:
    """The numbers that results and reference share.

    InputError if their settings differ: then they are numbers of different things.
    """
    if others := differing(results, reference):
        allowed = f"is not the reference's in {', '.join(others)}"
        mend = f"Run it with its own settings; {', '.join(FREE)} may differ."
        raise InputError("settings", results.study, allowed, mend)
    before = {_key(number): number for number in reference.numbers}
    now = measure(results, {number.metric: number.better for number in reference.numbers}).numbers
    return [_held(before[_key(number)], number) for number in now if _key(number) in before]


def _held(was: Number, now: Number) -> Held:
    spread = 0.0 if was.runs == now.runs else SIGMA * was.run_std * np.sqrt(1 / was.runs + 1 / now.runs)
    allowed = float(was.tolerance * abs(was.value) + spread)
    if abs(now.value - was.value) <= allowed:
        return Held(was, now, allowed, "as before")
    if isinstance(was.better, float):
        nearer = abs(now.value - was.better) < abs(was.value - was.better)
    else:
        nearer = (now.value < was.value) == (was.better == "lower")
    return Held(was, now, allowed, "better" if nearer else "worse")


def summary(found: Sequence[Held]) -> str:
    """One sentence: how many hold, and how many have moved which way."""
    moved = [f"{count} {word}" for word in ("worse", "better") if (count := sum(h.verdict == word for h in found))]
    kept = sum(h.verdict == "as before" for h in found)
    return f"{kept} of {len(found)} reference numbers hold" + (f"; {', '.join(moved)}." if moved else ".")


def table(found: Sequence[Held], everything: bool = False) -> Table | None:
    """The numbers that have moved, or all; None if there are none."""
    shown = [h for h in found if everything or h.verdict != "as before"]
    names = tuple(dict.fromkeys(name for h in shown for name in h.was.where))
    rows = tuple(
        (*(_text(h.was.where.get(name)) for name in names), h.was.metric, h.was.value, h.now.value, h.allowed,
         h.verdict)
        for h in shown
    )
    header = (*names, "Metric", "Reference", "Now", "May move by", "Verdict")
    text = f"{summary(found)} May move: a share of each, and where runs differ {SIGMA:g} standard errors."
    return Table(header, rows, text, decimals=4) if rows else None


def _key(number: Number) -> tuple[str, str]:
    return json.dumps(dict(number.where), sort_keys=True, default=str), number.metric


def _plain(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and np.isnan(value):
        return None
    return list(value) if isinstance(value, tuple) else value


def _short(value: float) -> float:
    """Six digits: more would only say which machine it was."""
    return float(f"{value:.6g}")


def _text(value: Any) -> str | None:
    return None if value is None else f"{value:g}" if isinstance(value, float) else str(value)
