"""coopoc benchmark: a score card of any method on CL-Bench's tasks, and the table of all cards."""

from __future__ import annotations

import json
import re
import sys
import time
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from coopoc.errors import InputError


def benchmark(
    methods: Annotated[Positional[tuple[str, ...]], arg(metavar="METHOD")] = (),
    /,
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/benchmark"),
    data: Annotated[Path | None, arg(metavar="FOLDER")] = None,
    validation: bool = False,
    tasks: Annotated[tuple[str, ...], arg(metavar="TASK")] = (),
    table: bool = False,
) -> int:
    """Run CL-Bench on methods: fixed tasks, seeds, egos and scores; one JSON card per method, and their table.

    Example: coopoc benchmark joint lkf-sa mine.py:Own

    Example: coopoc benchmark pose-fleet gauss-newton --data ~/measured

    Example: coopoc benchmark --table --out benchmarks/cards

    Args:
        methods: names of coopoc list, learned gains, FILE.py:NAME; with --data also pose-fleet, ... and backends.
        out: folder of the cards.
        data: folder with MR.CLAM set 6 and PyFG files, for the tasks of real measurements (docs/benchmark.md).
        validation: run the validation tasks, for choosing parameters; their cards cannot be submitted.
        tasks: run only these tasks.
        table: print the table of all cards in the folder, best first.
    """
    from .bench_cards import card, method, page, simulated
    from .bench_tasks import TASKS, VALIDATION

    known = {task.name: task for task in (VALIDATION if validation else TASKS)}
    for name in tasks:
        if name not in known:
            raise InputError("tasks", repr(name), f"must be of {', '.join(known)}", "Leave it out for all.")
    if not methods and not table:
        raise InputError("methods", "()", "must name a method", "coopoc list shows them; --table prints the cards.")
    for name in methods:
        if data is None and not simulated(name):
            raise InputError("data", None, f"must name the folder of measurements for {name}", "Add --data FOLDER.")
        if simulated(name):
            method(name)
    failed = 0
    for name in methods:
        began = time.perf_counter()
        made = card(name, [known[task] for task in tasks or known] if simulated(name) else [], data)
        failed += sum("failed" in row for row in made["tasks"])
        folder = out / "validation" if validation else out
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{re.sub(r'[^A-Za-z0-9-]+', '_', name).strip('_')}.json"
        file.write_text(json.dumps(made, indent=1) + "\n")
        print(f"coopoc: {file}, {time.perf_counter() - began:.1f} s", file=sys.stderr)
        print(page([made]))
    if table:
        cards = [json.loads(file.read_text()) for file in sorted(out.glob("*.json"))]
        if not cards:
            raise InputError("out", str(out), "holds no card", "Run coopoc benchmark METHOD first.")
        print(page(cards))
    return int(failed > 0)
