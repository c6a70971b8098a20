"""Score cards of CL-Bench: a method's rows on the tasks, and the table of cards."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from coopoc.evaluate.scores import scored
from coopoc.evaluate.statistics import mean_interval
from coopoc.file_names import given_path
from coopoc.methods.catalogue import WHOLE_FLEET, needs_whole_fleet
from coopoc.methods.track import Method
from coopoc.one_file import file_digest, in_file
from coopoc.plugins import find, names, unknown
from coopoc.study.environment import environment
from coopoc.study.numbers import three

from .bench_tasks import VERSION, Task, bound, recording

COOPERATIVE = "cooperative"
"""The shipped net whose method cooperates."""
SMOOTHERS = frozenset({"batch-smoother"})
"""Methods that see the whole drive, for which a filtering bound is none."""


def method(name: str) -> Method:
    """A registered method under the nominal noise model, a shipped learned gain, or "mine.py:NAME".

    Args:
        name: of the method.

    Raises:
        InputError: an unknown name.
    """
    if in_file(name) or name in names("coopoc.methods"):
        made: Method = find("coopoc.methods", name)("nominal")
        return made
    from coopoc.learned import CooperativeGain, load_method
    from coopoc.learned.recipes import shipped_weights

    if name not in shipped_weights() and not given_path(name).is_file():
        raise unknown("method", name, [*names("coopoc.methods"), *shipped_weights()])
    learned = load_method(name)
    return CooperativeGain(learned.model, name) if name == COOPERATIVE else learned  # type: ignore[attr-defined]


def information(name: str, one: Method) -> str:
    """Information set whose bound a method is held against."""
    if name in SMOOTHERS:
        return ""
    if not one.cooperative:
        return "solo"
    whole = name in WHOLE_FLEET or needs_whole_fleet(name)
    return "fleet" if whole else "star"


def tried(name: str, task: Task) -> dict[str, Any]:
    """A method's row for one task: error with its interval, bound, consistency, bytes and time; or why it failed."""
    return _row(task.name, partial(_tried, name, task))


def _tried(name: str, task: Task) -> dict[str, Any]:
    row: dict[str, Any] = {"task": task.name}
    one = method(name)
    held = information(name, one)
    seen, fleet = recording(task, held in ("", "fleet"))
    one(seen.between(0, 3), [task.columns[0]])  # compiles
    found = scored(one, seen, [fleet.ids[k] for k in task.columns], fleet)
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


def measured(name: str, data: Path) -> list[dict[str, Any]]:
    """Rows of the tasks of real measurements: graphs of a backend, logs of a pose filter or of "mine.py:NAME"."""
    from . import bench_real

    rows: list[dict[str, Any]] = []
    if name in names("coopoc.backends"):
        for file in tqdm(bench_real.BEST, desc=name, unit="graph", delay=2.0):
            rows.append(_row(file, partial(bench_real.graph_row, data, file, name)))
    elif name in bench_real.POSES or in_file(name):
        for task in bench_real.LOGGED:
            made: Any = find("coopoc.methods", name)("nominal") if in_file(name) else name
            rows.append(_row(task.name, partial(bench_real.pose_row, task, data, made)))
    return rows


def _row(task: str, made: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    try:
        return made()
    except Exception as error:  # a failure is a row
        return {"task": task, "failed": f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"}


def simulated(name: str) -> bool:
    """Whether the simulated tasks are for a name: those of backends and of pose filters are real ones."""
    from .bench_real import POSES

    return name not in POSES and name not in names("coopoc.backends")


def card(name: str, tasks: Iterable[Task], data: Path | None = None) -> dict[str, Any]:
    """The card of a method: what it is, with which versions, and a row for each task.

    Args:
        name: of a method, a pose filter or a backend, or "mine.py:NAME".
        tasks: simulated ones.
        data: folder of the real measurements; None leaves these tasks out.
    """
    digest = file_digest(name, "method") if in_file(name) else ""
    with tqdm(list(tasks), desc=name, unit="task", delay=2.0) as bar:
        rows = [tried(name, task) for task in bar]
    rows += [] if data is None else measured(name, data)
    known = environment()
    versions = {one: known[one] for one in ("coopoc", "numpy", "numba", "torch") if one in known}
    return {"benchmark": VERSION, "method": name, "source": digest, "versions": versions, "tasks": rows}


def page(cards: Iterable[Mapping[str, Any]]) -> str:
    """Markdown tables of cards, of simulated tasks and of logs and graphs where there are any.

    Of simulated ones RT-LE in m and, in parentheses, over its bound, the least geometric mean first.
    """
    given = list(cards)
    return "\n\n".join(part for part in (_simulated(given), _logs(given), _graphs(given)) if part)


def _logs(cards: Sequence[Mapping[str, Any]]) -> str:
    """RT-LE, heading error and NEES of pose filters, a row per task and method."""
    rows = []
    for one, row in _rows(cards, ("robots", "uwb")):
        if "failed" in row:
            rows.append((row["task"], np.inf, {"task": row["task"], "method": one, "RT-LE [m]": "failed"}))
            continue
        mean, low, high = row["rt_le_m"]
        shown = {"task": row["task"], "method": one, "RT-LE [m]": f"{three(mean)} [{three(low)}, {three(high)}]"}
        shown |= {"heading [°]": row.get("heading_deg", ""), "NEES": row.get("nees", "")}
        shown |= {"B/s": row["received_bytes_per_second"], "us/step": row["microseconds_per_step"]}
        rows.append((row["task"], mean, shown))
    return _table([shown for *_, shown in sorted(rows, key=lambda row: row[:2])])


def _graphs(cards: Sequence[Mapping[str, Any]]) -> str:
    """Cost over the least known, status and time of backends, a row per backend."""
    shown: dict[str, dict[str, Any]] = {}
    for one, row in _rows(cards, tuple(row["task"] for card in cards for row in card["tasks"] if "over_best" in row)):
        cell = "failed" if "failed" in row else f"{row['over_best']:.4g} {row['status']}, {row['seconds']:.2g} s"
        shown.setdefault(one, {"backend": one})[row["task"]] = cell
    return _table(list(shown.values()))


def _rows(cards: Sequence[Mapping[str, Any]], tasks: Sequence[str]) -> list[tuple[str, Mapping[str, Any]]]:
    return [(card["method"], row) for card in cards for row in card["tasks"] if row["task"] in tasks]


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    from tabulate import tabulate

    return str(tabulate(rows, headers="keys", tablefmt="github", disable_numparse=True)) if rows else ""


def _simulated(cards: Sequence[Mapping[str, Any]]) -> str:
    from .bench_tasks import TASKS

    rows, known = [], {task.name for task in TASKS}
    for one in cards:
        cells = {row["task"]: row for row in one["tasks"] if row["task"] in known}
        if not cells:
            continue
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
            (mean, {"method": one["method"], "mean": three(mean) if np.isfinite(mean) else "-", **shown, **extra})
        )
    rows.sort(key=lambda row: row[0])
    return _table([row for _, row in rows])


def _cell(row: Mapping[str, Any]) -> str:
    if "failed" in row:
        return "failed"
    ratio = f" ({row['over_bound']:.2f})" if "over_bound" in row else ""
    return f"{three(row['rt_le_m'][0])}{ratio}"
