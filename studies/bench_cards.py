"""Score cards of CL-Bench: a method's rows on the tasks, and the table of cards."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from coopoc.evaluate.scores import scored
from coopoc.evaluate.statistics import mean_interval
from coopoc.methods.catalogue import WHOLE_FLEET, needs_whole_fleet
from coopoc.methods.track import Method
from coopoc.one_file import in_file
from coopoc.plugins import find, names

from .bench_tasks import VERSION, Task, bound, recording

COOPERATIVE = "cooperative"
"""The shipped net whose method sends sums to its neighbours."""
SMOOTHERS = frozenset({"batch-smoother"})
"""Methods that see the whole drive, for which a filtering bound is none."""


def method(name: str, late: bool = False) -> Method:
    """A registered method under the nominal noise model, a shipped learned gain, or "mine.py:NAME".

    Args:
        name: of the method.
        late: whether messages are: then the cooperative gain sends its newest fix, for sums must come in time.
    """
    if in_file(name) or name in names("coopoc.methods"):
        made: Method = find("coopoc.methods", name)("nominal")
        return made
    from coopoc.learned import CooperativeGain, load_method

    learned = load_method(name)
    return CooperativeGain(learned.model, not late, name) if name == COOPERATIVE else learned  # type: ignore[attr-defined]


def information(name: str, one: Method) -> str:
    """Information set whose bound a method is held against."""
    if name in SMOOTHERS:
        return ""
    if not one.cooperative:
        return "solo"
    whole = name in WHOLE_FLEET or needs_whole_fleet(name)
    return "fleet" if whole else "past" if name == COOPERATIVE else "star"


def tried(name: str, task: Task) -> dict[str, Any]:
    """A method's row for one task: error with its interval, bound, consistency, bytes and time; or why it failed."""
    row: dict[str, Any] = {"task": task.name}
    try:
        one = method(name, task.v2x.latency > 0)
        held = information(name, one)
        seen, fleet = recording(task, held in ("", "fleet"))
        one(seen.between(0, 3), [task.columns[0]])  # compiles
        found = scored(one, seen, [fleet.ids[k] for k in task.columns], fleet)
    except Exception as error:  # a failure is a row
        return row | {"failed": f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"}
    level = mean_interval(found["rt_le_m"].T)
    row |= {"rt_le_m": [round(value, 4) for value in (level.mean, level.low, level.high)]}
    if held:
        least = bound(task, held)
        rms = float(np.sqrt(np.mean(found["rt_le_m"] ** 2)))
        row |= {"bound_m": round(least, 4), "information": held, "over_bound": round(rms / least, 3)}
    if "nees_inside" in found:
        row["nees_inside"] = round(float(found["nees_inside"].mean()), 3)
    row["received_bytes_per_second"] = round(float(found["bytes_per_second"].mean()))
    row["microseconds_per_step"] = round(1e6 * float(found["seconds"].mean()) / len(fleet.t), 2)
    return row


def card(name: str, tasks: Iterable[Task]) -> dict[str, Any]:
    """The card of a method: what it is, with which versions, and a row for each task."""
    digest = hashlib.sha256(Path(name.rpartition(":")[0]).read_bytes()).hexdigest() if in_file(name) else ""
    with tqdm(list(tasks), desc=name, unit="task", delay=2.0) as bar:
        rows = [tried(name, task) for task in bar]
    versions = {package: version(package) for package in ("coopoc", "numpy", "numba", "torch")}
    return {"benchmark": VERSION, "method": name, "source": digest, "versions": versions, "tasks": rows}


def page(cards: Iterable[Mapping[str, Any]]) -> str:
    """Markdown table of cards: RT-LE in m and, in parentheses, over its bound; the least geometric mean first."""
    from tabulate import tabulate

    rows = []
    for one in cards:
        cells = {row["task"]: row for row in one["tasks"]}
        shown = {name: _cell(row) for name, row in cells.items()}
        errors = [row["rt_le_m"][0] for row in cells.values() if "rt_le_m" in row]
        mean = float(np.exp(np.mean(np.log(errors)))) if len(errors) == len(cells) else np.inf
        paper = cells.get("paper", {})
        extra = {
            "NEES inside": paper.get("nees_inside", ""),
            "B/s": paper.get("received_bytes_per_second", ""),
            "us/step": paper.get("microseconds_per_step", ""),
        }
        rows.append(
            (mean, {"method": one["method"], "mean": f"{mean:.3g}" if np.isfinite(mean) else "-", **shown, **extra})
        )
    rows.sort(key=lambda row: row[0])
    return str(tabulate([row for _, row in rows], headers="keys", tablefmt="github", disable_numparse=True))


def _cell(row: Mapping[str, Any]) -> str:
    if "failed" in row:
        return "failed"
    ratio = f" ({row['over_bound']:.2f})" if "over_bound" in row else ""
    return f"{row['rt_le_m'][0]:.3g}{ratio}"
