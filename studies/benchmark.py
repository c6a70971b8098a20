"""coopoc benchmark: a score card of any method on CL-Bench's tasks, and the table of all cards."""

import json
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from coopoc import InputError, Method, paired_difference
from coopoc.arrays import seed_of
from coopoc.errors import said, unknown
from coopoc.evaluate.scores import causal, scored
from coopoc.methods.catalogue import needs_whole_fleet
from coopoc.paths import write
from coopoc.plugins import find, in_file
from coopoc.study.cell import Params, Row
from coopoc.study.numbers import three
from coopoc.study.style import NOT_CAUSAL_SUFFIX
from coopoc.workers import progress_bar, say

from .lineup import named_method, own
from .pose_drives import POSES
from .roads import CONVOYS, PUBLISHED, ROADS, convoy_row, holds, road_row, roads
from .tasks import LOGGED, TASKS, VALIDATION, Task, bound, pose_row, recording, rounded
from .worlds_card import card_file, card_head, markdown, overview, run_worlds

TASK_NAMES = [task.name for task in TASKS]
"""Of the simulated tasks."""
COMPARED_WITH = "cooperative-filter"
"""Of which others are shown to be better or worse on the same blocks of real measurements."""


def benchmark(
    methods: Annotated[Positional[tuple[str, ...]], arg(metavar="METHOD")] = (),
    /,
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/benchmark"),
    data: Annotated[Path | None, arg(metavar="FOLDER")] = None,
    validation: bool = False,
    seed: int | None = None,
    tasks: Annotated[tuple[str, ...], arg(metavar="TASK")] = (),
    worlds: int | None = None,
    jobs: int = 1,
    table: bool = False,
) -> int:
    """Run CL-Bench on methods: drawn worlds, or fixed tasks; one JSON card per method, and their table.

    Example: coopoc benchmark joint mine.py:Own --worlds 200

    Example: coopoc benchmark joint lkf-sa mine.py:Own

    Example: coopoc benchmark cooperative-filter --tasks f9k    # after coopoc data get f9k

    Example: coopoc benchmark pose-fleet --data ~/measured

    Example: coopoc benchmark --table --out benchmarks/cards

    Args:
        methods: names of coopoc list, learned gains, FILE.py:NAME; with --data also pose-fleet, ...
        out: folder of the cards.
        data: folder with the files of the tasks of real measurements (docs/benchmark.md), besides those that coopoc
            data get has fetched, or a log of your own with a truth, on which solo methods are run in the same way.
        validation: run the validation tasks or worlds, for choosing parameters; their cards cannot be submitted.
        seed: of other draws, to see whether a card holds on them; these cards cannot be submitted either. Of worlds
            the first: --seed 7 --worlds 3 are 7, 8 and 9.
        tasks: run only these tasks.
        worlds: number of worlds, of which each seed draws one, instead of tasks.
        jobs: processes that run worlds.
        table: print the table of all cards in the folder, best first.
    """
    if not methods and not (table and worlds is None):
        raise InputError("methods", "()", "must name a method", "coopoc list shows them; --table prints the cards.")
    if worlds is not None:
        if tasks or data:
            allowed = "must stand without --tasks and --data"
            raise InputError("worlds", worlds, allowed, "Run worlds and tasks one after the other.")
        return run_worlds(methods, out / "worlds", worlds, seed, validation, jobs)
    by_name = {task.name: task for task in (VALIDATION if validation else TASKS)}
    if seed is not None:
        by_name = {name: replace(task, seed=seed_of(seed)) for name, task in by_name.items()}
    every = (*by_name, *LOGGED, *roads(data), *CONVOYS)
    for name in tasks:
        if name not in every:
            raise unknown("tasks", name, every, "Leave it out for all.")
    for name in methods:
        own_tasks = runnable(name, by_name, data)
        if tasks and not set(tasks) & {*own_tasks}:
            raise InputError(f"tasks of {name}", ", ".join(tasks), f"must be of {', '.join(own_tasks)}", "Name one.")
        if data is None and not tasks and not simulated(name):
            hint = "Add --data FOLDER, or --tasks with what coopoc data get has fetched."
            raise InputError("data", None, f"must name the folder of measurements for {name}", hint)
    failed = 0
    for name in methods:
        count = len({*tasks} or (by_name if data is None else {}) or runnable(name, by_name, data))
        began, file = perf_counter(), card_file(name, out, seed, validation, count)
        made = card(name, by_name, data, tasks)
        failed += sum("failed" in row for row in made["tasks"])
        write(file, json.dumps(made, indent=1) + "\n")
        say(f"{file}, {perf_counter() - began:.1f} s")
        print(page([made]))
    if table:
        drawn_worlds, cards = (
            [json.loads(card.read_bytes()) for card in sorted(at.glob("*.json"))] for at in (out / "worlds", out)
        )
        if not cards and not drawn_worlds:
            raise InputError("out", str(out), "holds no card", "Run coopoc benchmark METHOD first.")
        print(*filter(None, (overview(drawn_worlds), page(cards))), sep="\n\n")
    return int(failed > 0)


def information(name: str, one: Method) -> str:
    """Information set whose bound a method is held against; none of a smoother, which sees the whole drive."""
    special = {"batch-smoother": "", "cooperative-filter": "past"}  # its newcomers bring what they did before
    if not one.cooperative or name in special:
        return special.get(name, "solo")
    return "fleet" if needs_whole_fleet(name) else "star"


def tried(name: str, task: Task) -> Row:
    """A method's row for one task: error with its interval, bound, consistency, bytes and time."""
    one = named_method(name)
    held = information(name, one)
    measured, fleet = recording(task, held in ("", "fleet"))
    one(measured.between(0, 3), [task.columns[0]])  # compiles
    scores = scored(one, measured, [fleet.ids[k] for k in task.columns], fleet)
    if in_file(name) and not causal(one, measured, task.columns):
        held = ""
    row: Row = {"task": task.name, "rt_le_m": rounded(scores["rt_le_m"]), "information": held}
    if held:
        least = bound(task, held)
        rms = np.sqrt(np.mean(scores["rt_le_m"] ** 2))
        row |= {"bound_m": round(least, 4), "over_bound": round(rms / least, 3)}
    if "nees_inside" in scores:
        row["nees_inside"] = round(scores["nees_inside"].mean(), 3)
    row["received_bytes_per_second"] = round(scores["bytes_per_second"].mean())
    row["microseconds_per_step"] = round(1e6 * scores["seconds"].mean() / len(fleet.t), 2)
    return row


def runnable(name: str, drawn: Mapping[str, Task], data: Path | None) -> dict[str, Callable[[], Row]]:
    """The tasks of a name, and what runs each: logs for a pose filter, simulated ones, roads and convoys for any other;
    of "mine.py:NAME" simulated ones and logs, or roads if it says `roads = True`."""
    rows: dict[str, Callable[[], Row]] = {}
    if simulated(name):
        rows = {task: partial(tried, name, one) for task, one in drawn.items()}
    if name in POSES or (in_file(name) and not _on_roads(name)):
        made = own(name) if in_file(name) else name
        return rows | {task: partial(pose_row, task, data, made) for task in LOGGED}
    method, places = named_method(name), roads(data)
    rows |= {task: partial(road_row, task, data, method) for task in places}
    if places.keys() >= ROADS.keys():
        rows |= {task: partial(convoy_row, task, data, method) for task in CONVOYS}
    return rows


def _row(task: str, made: Callable[[], Row]) -> Row:
    try:
        return made()
    except (Exception, SystemExit) as error:  # a failure is a row
        say("\n  ".join([f"failed: {task}", *traceback.format_exc().splitlines()[-5:]]))
        return {"task": task, "failed": f"{type(error).__name__}: {said(error)}"}


def simulated(name: str) -> bool:
    """Whether the simulated tasks are for a name: those of pose filters and of what says `roads` are real ones."""
    return name not in POSES and not _on_roads(name)


def _on_roads(name: str) -> bool:
    return in_file(name) and getattr(find("coopoc.methods", name), "roads", False)


def card(name: str, drawn: Mapping[str, Task], data: Path | None = None, tasks: Sequence[str] = ()) -> Row:
    """The card of a method: what it is, with which versions, and a row for each task.

    Args:
        name: of a method or a pose filter, or "mine.py:NAME".
        drawn: simulated tasks by name.
        data: folder of the real measurements, or None.
        tasks: those that are run; by default all that there are for the name, without data the simulated ones.
    """
    chosen = {}
    for task, run in runnable(name, drawn, data).items():
        if data and not tasks and task in PUBLISHED and not holds(data, task):
            say(f"{task} is left out: no {PUBLISHED[task][0]} below {data}")
        elif task in tasks or (not tasks and (data or task in drawn)):
            chosen[task] = run
    bar = progress_bar(chosen.items(), name, unit="task", delay=2.0)
    return {**card_head(name), "tasks": [_row(task, run) for task, run in bar]}


def page(cards: Sequence[Params]) -> str:
    """Markdown tables of cards, of simulated tasks and of logs where there are any.

    Of simulated ones RT-LE in m and, in parentheses, over its bound, the least geometric mean over all tasks first.
    """
    ordered = (sorted(rows, key=itemgetter(0)) for rows in (_simulated(cards), _logs(cards)) if rows)
    return "\n\n".join(markdown([row for _, row in rows]) for rows in ordered)


def _logs(cards: Sequence[Params]) -> list[tuple[Any, Row]]:
    """RT-LE, heading error and NEES of pose filters, a row per task and method."""
    each = [(card["method"], row) for card in cards for row in card["tasks"] if row["task"] not in TASK_NAMES]
    usual = {row["task"]: row for one, row in each if one == COMPARED_WITH}
    rows = []
    for one, row in each:
        shown = {"task": row["task"], "method": one, "RT-LE [m]": "failed"}
        if "failed" not in row:
            shown["RT-LE [m]"] = "{} [{}, {}]".format(*map(three, row["rt_le_m"]))
            blocks, rival = row.get("blocks_m", ()), usual.get(row["task"], {}).get("blocks_m", "-")
            if one != COMPARED_WITH and len(blocks) == len(rival):
                shown[f"less {COMPARED_WITH} [m]"] = str(paired_difference(np.array(blocks), np.array(rival)))
            shown |= {"heading [°]": row.get("heading_deg", ""), "NEES": row.get("nees", "")}
            shown |= {"B/s": row["received_bytes_per_second"], "us/step": row["microseconds_per_step"]}
        rows.append(((row["task"], row.get("rt_le_m", [np.inf])[0]), shown))
    return rows


def _simulated(cards: Sequence[Params]) -> list[tuple[Any, Row]]:
    rows = []
    for one in cards:
        cells = {row["task"]: row for row in one["tasks"] if row["task"] in TASK_NAMES}
        if not cells:
            continue
        errors = [row["rt_le_m"][0] for row in cells.values() if "rt_le_m" in row]
        mean = float(np.exp(np.mean(np.log(errors)))) if len(errors) == len(TASK_NAMES) else np.inf
        paper = cells.get("paper", {})
        shown = {"method": one["method"], "mean": three(mean) if np.isfinite(mean) else "-"}
        shown |= {task: _cell(cells[task]) if task in cells else "" for task in TASK_NAMES}
        shown |= {"NEES inside": paper.get("nees_inside", ""), "B/s": paper.get("received_bytes_per_second", "")}
        rows.append((mean, shown | {"us/step": paper.get("microseconds_per_step", "")}))
    return rows


def _cell(row: Params) -> str:
    if "failed" in row:
        return "failed"
    ratio = f" ({row['over_bound']:.2f})" if "over_bound" in row else NOT_CAUSAL_SUFFIX * (row.get("information") == "")
    return f"{three(row['rt_le_m'][0])}{ratio}"
