"""compute: outcomes of cells as they come, here or in worker processes; their order."""

import itertools
import os
import sys
import time
import traceback
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeAlias

import pyarrow as pa
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import process_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError
from threadpoolctl import threadpool_limits

from ..arrays import listed, named
from ..errors import InputError
from ..text import uncontrolled
from ..workers import leave_with
from . import store
from .cell import Cell, Params, Row
from .store import Outcome

Function: TypeAlias = Callable[[Params], list[Row]]
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
    start, rows, reason, trace = time.perf_counter(), None, "", ""
    try:
        with threadpool_limits(limits=1):
            rows = _checked(function(cell.settings), cell)
    except (Exception, SystemExit) as error:
        reason, trace = map(uncontrolled, (f"{type(error).__name__}: {error}", traceback.format_exc()))
    return Outcome(cell, rows, reason, trace, time.perf_counter() - start)


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
