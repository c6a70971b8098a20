"""run: compute the cells of a study that are not finished, keep each as soon as it is, and publish the views."""

from __future__ import annotations

import itertools
import os
import time
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from .. import plugins
from ..errors import InputError
from ..workers import leave_with
from . import store
from .environment import environment
from .publish import publish
from .results import Results
from .study import Cell, Params, Row, Study


def run(
    study: Study | str,
    out: str | Path = "runs",
    jobs: int = 1,
    settings: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Results:
    """Results of a study, computed in `jobs` processes; what `out/<study.name>` already holds is not computed again.

    Workers return rows and this process alone writes, one file per cell, whole or not at all: a run that is killed
    resumes where it was. A cell that raises becomes a row with its reason, and is tried again by the next run.

    Args:
        study: a Study, or the name of one that an installed distribution registers.
        out: folder of all studies. jobs: worker processes; 1 computes here. Results do not depend on it.
        settings: changes of the study's settings or axes, see `Study.override`.
        progress: show a bar on stderr.

    Raises:
        InputError: an unknown study or setting, jobs < 1, a folder that cannot be written or that another run holds,
            or what `study.key` raises.
        WorkerDiedError: a worker process was killed, mostly for want of memory; finished cells are kept.
    """
    study, cells, folder = _resolve(study, out, settings)
    if jobs < 1:
        raise InputError("jobs", jobs, "must be >= 1", "Give the number of worker processes.")
    with store.held(folder):
        return _run(study, cells, folder, jobs, progress)


def _run(study: Study, cells: Sequence[Cell], folder: Path, jobs: int, progress: bool) -> Results:
    store.prepare(folder, _manifest(study, cells))
    todo = [cell for cell in cells if store.load(folder, cell.name) is None]
    if todo:
        study.prepare([cell.given for cell in todo], jobs)
    bar = tqdm(total=len(cells), initial=len(cells) - len(todo), desc=study.name, unit="cell", disable=not progress)
    with bar, closing(_compute(study.cell, schedule(todo, study.shares, jobs), jobs)) as outcomes:
        failed = 0
        for outcome in outcomes:
            failed += not _keep(folder, outcome)
            bar.set_postfix_str(f"{failed} failed" if failed else "", refresh=False)
            bar.update()
    results = Results.load(folder)
    publish(study, results, folder, progress)
    return results


def plan(study: Study | str, out: str | Path = "runs", settings: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What `run` would do: number of cells, finished, failed before, and still to compute. Writes nothing."""
    study, cells, folder = _resolve(study, out, settings)
    finished = [c for c in cells if store.load(folder, c.name) is not None]
    failed = [c for c in cells if c not in finished and store.load_failure(folder, c.name) is not None]
    return {
        "study": study.name, "folder": str(folder), "cells": len(cells), "finished": len(finished),
        "failed_before": len(failed), "to_compute": len(cells) - len(finished), "settings": dict(study.settings),
    }  # fmt: skip


def schedule(cells: Sequence[Cell], shares: Sequence[str], jobs: int) -> list[Cell]:
    """Cells in an order in which those that share a recording follow each other within one of `jobs` lanes.

    Groups are dealt to the lanes in turn and the lanes are interleaved, so that each worker mostly meets one group
    at a time. A worker that drifts into another lane computes that recording once more, nothing else changes. The last
    groups come first: grids mostly grow towards their end, and a long cell at the end would leave other workers idle.
    """
    groups: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells:
        groups.setdefault(tuple(cell.given.get(name) for name in shares), []).append(cell)
    ordered = list(groups.values())[::-1]
    lanes = [list(itertools.chain.from_iterable(ordered[lane::jobs])) for lane in range(jobs)]
    return [cell for step in itertools.zip_longest(*lanes) for cell in step if cell is not None]


class WorkerDiedError(ChildProcessError):
    """A worker process was killed from outside; finished cells are kept and the next run resumes."""


@dataclass(frozen=True)
class Outcome:
    """What a worker returns: rows, or the reason why there are none."""

    cell: Cell
    rows: list[Row]
    reason: str
    trace: str
    seconds: float


def attempt(function: Callable[[Params], list[Row]], cell: Cell) -> Outcome:
    """Compute one cell on one thread; whatever it raises becomes its reason."""
    start = time.perf_counter()
    try:
        with threadpool_limits(limits=1):
            rows = [dict(row) for row in function(cell.given)]
        _check(rows, cell)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        return Outcome(cell, [], reason, traceback.format_exc(), time.perf_counter() - start)
    return Outcome(cell, rows, "", "", time.perf_counter() - start)


def _check(rows: Sequence[Row], cell: Cell) -> None:
    if not rows:
        raise InputError("rows", "none", "a cell must return at least one row", "Return one dict per run and ego.")
    taken = {name for row in rows for name in row} & {*cell.params, *store.OWN_COLUMNS}
    if taken:
        raise InputError("rows", sorted(taken), "must not repeat a parameter", "The engine adds those columns.")
    store.to_table(rows)


def _compute(function: Callable[[Params], list[Row]], cells: Sequence[Cell], jobs: int) -> Generator[Outcome]:
    if jobs == 1 or len(cells) < 2:
        yield from (attempt(function, cell) for cell in cells)
        return
    os.environ.setdefault("TQDM_DISABLE", "1")  # workers read it when they import tqdm: one bar, ours, is enough
    with parallel_config(backend="loky", inner_max_num_threads=1):
        workers = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1, max_nbytes=None)
        try:
            yield from workers(delayed(_in_worker)(function, cell, os.getpid()) for cell in cells)
        except BrokenProcessPool as error:
            raise WorkerDiedError(
                "A worker process was killed, mostly for want of memory. Finished cells are kept: "
                "repeat the command to resume, with fewer --jobs."
            ) from error


def _in_worker(function: Callable[[Params], list[Row]], cell: Cell, parent: int) -> Outcome:
    leave_with(parent)
    return attempt(function, cell)


def _keep(folder: Path, outcome: Outcome) -> bool:
    if outcome.reason:
        store.save_failure(folder, outcome.cell, outcome.reason, outcome.trace, outcome.seconds)
    else:
        store.save(folder, outcome.cell, outcome.rows, outcome.seconds)
    return not outcome.reason


def _resolve(study: Study | str, out: str | Path, settings: Mapping[str, Any] | None) -> tuple[Study, list[Cell], Path]:
    found: Study = plugins.find("coopoc.studies", study) if isinstance(study, str) else study
    found = found.override(settings or {})
    return found, found.cells(), Path(out) / found.name


def _manifest(study: Study, cells: Sequence[Cell]) -> dict[str, Any]:
    return {
        "study": study.name, "question": study.question, "axes": list(study.axes), "settings": dict(study.settings),
        "cells": [{"name": cell.name, "params": dict(cell.params)} for cell in cells], "environment": environment(),
    }  # fmt: skip
