"""run_study: compute the cells of a study that are not finished, here or in worker processes, write each at once, and
publish the views.
"""

import itertools
import os
import sys
import traceback
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import Any
from urllib.parse import quote

import pyarrow as pa
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import process_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError
from threadpoolctl import threadpool_limits

from ..arrays import instance, listed, named, whole
from ..errors import InputError
from ..formats.trajectories import write_tum
from ..paths import given_path
from ..text import uncontrolled
from ..workers import leave_with, progress_bar
from ..world.fleet import Fleet
from ..world.recording import Recording
from ..world.storage import digest, save_recording
from . import store
from .cell import Cell, Params, Row
from .provenance import environment
from .publish import publish
from .results import Results
from .store import Manifest, Outcome, locked
from .study import Study, find_study

Function = Callable[[Params], list[Row]]
OF_WORKERS = {
    "TQDM_DISABLE": "1",  # read when tqdm is imported: one bar, ours, is enough
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1:glibc.malloc.mmap_threshold=268435456:"
    "glibc.malloc.trim_threshold=536870912",  # keep freed memory, in large pages: else a fifth of a cell is page faults
}
"""Defaults of the environment of worker processes."""


class WorkerDiedError(ChildProcessError):
    """A worker process was killed from outside; finished cells are kept and the next run resumes."""


def schedule(cells: Sequence[Cell], shares: Sequence[str], jobs: int) -> list[Cell]:
    """Cells in an order in which those that agree on the parameters `shares`, and so share a recording, follow each
    other within one of `jobs` lanes.

    Groups are dealt to the lanes in turn and the lanes are interleaved, so that each worker mostly meets one group
    at a time. A worker that drifts into another lane computes that recording once more, nothing else changes. The last
    groups come first: grids mostly grow towards their end, and a long cell at the end would leave other workers idle.
    """
    shared: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells:
        shared.setdefault(tuple(cell.settings.get(name) for name in shares), []).append(cell)
    ordered = [*shared.values()][::-1]
    lanes = [list(itertools.chain.from_iterable(ordered[lane::jobs])) for lane in range(jobs)]
    return [cell for step in itertools.zip_longest(*lanes) for cell in step if cell is not None]


def attempt(function: Function, cell: Cell) -> Outcome:
    """Compute one cell on one thread; an exception becomes its reason.

    >>> done = attempt(lambda p: [{"x": 1}], Cell({}, {}, "a"))
    >>> done.reason, 0.0 <= done.seconds < 60.0
    ('', True)
    """
    start, rows, reason, trace = perf_counter(), None, "", ""
    try:
        with threadpool_limits(limits=1):
            rows = _checked(function(cell.settings), cell)
    except (Exception, SystemExit) as error:
        reason, trace = map(uncontrolled, (f"{type(error).__name__}: {error}", traceback.format_exc()))
    return Outcome(cell, rows, reason, trace, perf_counter() - start)


def compute(function: Function, cells: Sequence[Cell], jobs: int) -> Generator[Outcome]:
    """Outcomes as they come: here for one job, else from worker processes; WorkerDiedError if one was killed."""
    if (jobs := min(jobs, len(cells))) < 2:  # loky starts all of its workers
        yield from (attempt(function, cell) for cell in cells)
        return
    for name, value in OF_WORKERS.items():
        os.environ.setdefault(name, value)
    places = {"initializer": _import_from, "initargs": (tuple(sys.path),)}  # of others no worker is taken over
    with parallel_config(backend="loky", inner_max_num_threads=1, **places):
        workers = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1, max_nbytes=None)
        try:
            yield from workers(delayed(_in_worker)(function, cell, os.getpid()) for cell in cells)
        except TerminatedWorkerError as error:
            raise WorkerDiedError(
                "A worker process was killed, mostly for want of memory. Finished cells are kept: "
                "repeat the command to resume, with fewer --jobs."
            ) from error


def _import_from(places: tuple[str, ...]) -> None:
    """Import modules from where the process that started this one does."""
    sys.path[:] = places


def _in_worker(function: Function, cell: Cell, parent: int) -> Outcome:
    leave_with(parent)
    process_executor._MAX_MEMORY_LEAK_SIZE = sys.maxsize
    # loky would end a worker that has grown by 300 MB; that is no leak here, but a recording that the next cell shares
    return attempt(function, cell)


def _checked(rows: Sequence[Row], cell: Cell) -> pa.Table:
    hint = "Return a list of one dict per run and ego."
    table = store.to_table([named("rows", row, hint) for row in listed("rows", rows, hint)])
    if not len(table):
        raise InputError("rows", "none", "a cell must return at least one row", hint)
    taken = {*table.column_names} & {*cell.params, *store.OWN_COLUMNS}
    if taken:
        raise InputError("rows", sorted(taken), "must not repeat a parameter", "The engine adds those columns.")
    return table


def run_study(
    study: Study | str,
    out: str | Path = "runs",
    jobs: int = 1,
    settings: Params | None = None,
    progress: bool = True,
    retry_failed: bool = False,
) -> Results:
    """Compute the results of a study in `jobs` processes; finished cells in `out/<study.name>` are not computed again.

    Workers return rows and this process alone writes, one file per cell, whole or not at all: a run that is killed
    resumes. A cell that raises becomes a row with its reason and is computed again only with `retry_failed`: a cell is
    a pure function, and fails again.

    Args:
        study: a Study, the name of one that an installed distribution registers, or "folder/mine.py:STUDY".
        out: folder of all studies.
        jobs: worker processes; 1 computes here. Results do not depend on it.
        settings: changes of the study's settings or axes, see `Study.override`. A Recording, a Log of `read_log`, or
            (Recording, Fleet of its truth) is stored in `out/data` and its path taken.
        progress: show a bar on stderr.
        retry_failed: compute failed cells once more.

    Returns:
        Results of all cells.

    Raises:
        InputError: an unknown study or setting, jobs < 1, a folder that cannot be written or that
            another run uses or from which finished cells vanish, or an error of `study.key`.
        WorkerDiedError: a worker process was killed, mostly for want of memory; finished cells are kept.
    """
    study, cells, folder = _resolve(study, out, settings)
    whole("jobs", jobs, 1, 10**4, "Give the number of worker processes.")
    params = {cell.name: dict(cell.params) for cell in cells}
    manifest = Manifest(study.name, study.question, study.axes, dict(study.settings), params, environment())
    with locked(folder, manifest):
        _work(study, cells, folder, jobs, progress, retry_failed)
        results = Results.load(folder)
        if results.pending:
            lost = f"lost {results.pending} of {len(cells)} cells while it ran: something else removed or changed them"
            raise InputError("out", str(folder), lost, "Repeat the command: it computes what is missing.")
        publish(study, results, folder, progress)
        return results


def write_tracks(study: Study | str, out: str | Path, settings: Params) -> Path:
    """Estimate again what the cells of a study estimated, and write a TUM file for each ego and run of each cell.

    Args:
        study: as in `run_study`.
        out: folder of all studies.
        settings: changes of the study's settings or axes.

    Returns:
        The folder of the files, whose names begin with the parameters of the cell, as in a URL.

    Raises:
        InputError: a study whose cells have no estimates.
    """
    study, cells, folder = _resolve(study, out, settings)
    tracks, folder = study.tracks_of(), folder / "tracks"
    folder.mkdir(parents=True, exist_ok=True)
    for cell in cells:
        if store.load(folder.parent, cell.name) is not None:
            for name, *path in tracks(cell.settings):
                words = [quote(str(value), safe="") for value in (*cell.params.values(), name)]
                write_tum(folder / f"{','.join(words)}.tum", *path)
    return folder


def plan(
    study: Study | str, out: str | Path = "runs", settings: Params | None = None, retry_failed: bool = False
) -> dict[str, Any]:
    """Number of cells that `run_study` would keep, repeat and compute, and the reasons of failures; nothing is written.

    Args:
        study: as in `run_study`.
        out: folder of all studies.
        settings: changes of the study's settings or axes.
        retry_failed: count failed cells among those to compute.
    """
    study, cells, folder = _resolve(study, out, settings)
    new, failed = _unfinished(cells, folder)
    return {
        "study": study.name,
        "folder": str(folder),
        "cells": len(cells),
        "finished": len(cells) - len(new) - len(failed),
        "failed_before": len(failed),
        "to_compute": len(new) + len(failed) * retry_failed,
        "failures": [{**cell.params, "reason": reason, "repeated": retry_failed} for cell, reason in failed],
        "settings": dict(study.settings),
    }


def _unfinished(cells: Sequence[Cell], folder: Path) -> tuple[list[Cell], list[tuple[Cell, str]]]:
    """Cells that were not computed yet, and failed ones, each with its reason."""
    new, failed = [], []
    for cell in cells:
        if store.load(folder, cell.name) is None:
            row = store.load(folder, cell.name, store.FAILED)
            if row is None:
                new.append(cell)
            else:
                failed.append((cell, row["reason"][0].as_py()))
    return new, failed


def _work(study: Study, cells: Sequence[Cell], folder: Path, jobs: int, progress: bool, retry_failed: bool) -> None:
    new, before = _unfinished(cells, folder)
    todo = [*new, *(cell for cell, _ in before if retry_failed)]
    if todo:
        study.prepare([cell.settings for cell in todo], jobs)
    todo = schedule(todo, study.shares, jobs)
    failed = 0 if retry_failed else len(before)
    outcomes = compute(study.cell, todo, jobs)
    count = len(cells)
    with (
        progress_bar(
            total=count, initial=count - len(todo), desc=study.name, unit="cell", smoothing=0.05, disable=not progress
        ) as bar,
        closing(outcomes),
    ):
        bar.set_postfix_str(f"{failed} failed" if failed else "")  # shows the bar where stderr is no terminal, too
        for outcome in outcomes:
            store.save(folder, outcome)
            failed += outcome.rows is None
            bar.set_postfix_str(f"{failed} failed" if failed else "", refresh=False)
            bar.update()


def _resolve(study: Study | str, out: str | Path, settings: Params | None) -> tuple[Study, list[Cell], Path]:
    """The study under its settings, its cells, and its folder."""
    resolved = find_study(study) if isinstance(study, str) else instance("study", study, Study)
    changes = named("settings", settings or {}, "Give settings={name: value}.")
    changed = resolved.override({name: _as_path(name, value, out) for name, value in changes.items()})
    return changed, changed.cells(), given_path(out) / changed.name


def _as_path(name: str, value: Any, out: str | Path) -> Any:
    """The value of a setting; of a Recording, a Log, or a pair (Recording, Fleet of its truth) a path in `out/data`."""
    if isinstance(value, Fleet):
        hint = "Give the path of its file, or mine.py:NAME of a function that makes it."
        raise InputError(name, repr(value), "must be a name or a path, or a Recording", hint)
    match value:
        case Recording() as recording:
            truth = None
        case (Recording() as recording, truth):
            pass
        case object(recording=Recording() as recording, truth=truth):
            pass
        case _:
            return value
    file = given_path(out) / "data" / f"{digest(recording)[:12]}{truth.digest[:8] if truth is not None else ''}.npz"
    if not file.exists():
        save_recording(recording, file, truth)
    return str(file)
