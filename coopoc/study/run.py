"""run: compute the cells of a study that are not finished, keep each as soon as it is, and publish the views."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

from tqdm import tqdm

from .. import plugins
from ..errors import InputError
from ..one_file import in_file
from . import store
from .cluster import Cluster, connected
from .compute import Outcome, compute, schedule
from .file_study import file_study
from .manifest import alone, held, manifest
from .publish import publish
from .results import Results
from .shard import Shard
from .study import Cell, Study


def run(
    study: Study | str,
    out: str | Path = "runs",
    jobs: int = 1,
    settings: Mapping[str, Any] | None = None,
    progress: bool = True,
    shard: str = "",
    retry_failed: bool = False,
    cluster: str = "",
) -> Results:
    """Results of a study, computed in `jobs` processes; what `out/<study.name>` already holds is not computed again.

    Workers return rows and this process alone writes, one file per cell, whole or not at all: a run that is killed
    resumes where it was. A cell that raises becomes a row with its reason. It stays one, as a pure function fails
    again, until a run is told to repeat it.

    Args:
        study: a Study, the name of one that an installed distribution registers, or "folder/mine.py:STUDY".
        out: folder of all studies. jobs: worker processes; 1 computes here. Results do not depend on it.
        settings: changes of the study's settings or axes, see `Study.override`.
        progress: show a bar on stderr.
        shard: "i/n" computes the i-th of n parts and publishes nothing, see `Shard.of`. Shards of the same settings may
            share a folder at the same time. A run without it completes and publishes what they have computed.
        retry_failed: compute failed cells once more.
        cluster: address of a Dask scheduler, whose workers compute instead of processes here. What cells share is
            still prepared here, in `jobs` processes: the workers must see its files.

    Returns:
        Results of all cells, or of those of the shard.

    Raises:
        InputError: an unknown study or setting, jobs < 1, a shard that is none, a folder that cannot be written or that
            another run holds, a cluster that cannot compute, see `cluster.connected`, or what `study.key` raises.
        MissingLibraryError: `cluster` without Dask.
        WorkerDiedError: a worker process was killed, mostly for want of memory, or no worker of a cluster is left;
            finished cells are kept.
    """
    study, cells, folder = _resolve(study, out, settings)
    if jobs < 1:
        raise InputError("jobs", jobs, "must be >= 1", "Give the number of worker processes.")
    part = _part(study, cells, shard)
    with connected(cluster, study.cell) if cluster else nullcontext() as workers:
        mine = manifest(study, cells, workers.environments.values() if workers else ())
        with held(folder, mine, shard):
            _work(study, part, folder, jobs, progress, retry_failed, workers)
            if shard:
                return Results.load(folder, {cell.name for cell in part})
            results = Results.load(folder)
            publish(study, results, folder, progress)
            return results


def plan(
    study: Study | str,
    out: str | Path = "runs",
    settings: Mapping[str, Any] | None = None,
    shard: str = "",
    retry_failed: bool = False,
) -> dict[str, Any]:
    """What `run` would do: how many cells are kept, repeated and computed, and why cells failed. Writes nothing."""
    study, cells, folder = _resolve(study, out, settings)
    part = _part(study, cells, shard)
    new, failed = _unfinished(part, folder)
    return {
        "study": study.name, "folder": str(folder), "shard": shard or None, "cells": len(part),
        "finished": len(part) - len(new) - len(failed), "failed_before": len(failed),
        "to_compute": len(new) + len(failed) * retry_failed,
        "failures": [{**cell.params, "reason": reason, "repeated": retry_failed} for cell, reason in failed],
        "settings": dict(study.settings),
    }  # fmt: skip


def _unfinished(cells: Sequence[Cell], folder: Path) -> tuple[list[Cell], list[tuple[Cell, str]]]:
    """Cells that nobody has tried yet, and those that failed, each with its reason."""
    new, failed = [], []
    for cell in cells:
        if store.load(folder, cell.name) is None:
            row = store.load_failure(folder, cell.name)
            if row is None:
                new.append(cell)
            else:
                failed.append((cell, row["reason"][0].as_py()))
    return new, failed


def _work(
    study: Study, cells: Sequence[Cell], folder: Path, jobs: int, progress: bool, retry_failed: bool,
    workers: Cluster | None,
) -> None:  # fmt: skip
    new, before = _unfinished(cells, folder)
    todo = [*new, *(cell for cell, _ in before if retry_failed)]
    if todo:
        wait = f"coopoc: {study.name}: waits for a shard that prepares what cells share"
        with alone(folder, lambda: tqdm.write(wait, file=sys.stderr) if progress else None):
            study.prepare([cell.given for cell in todo], jobs)
    todo = schedule(todo, study.shares, workers.jobs if workers else jobs)
    failed = 0 if retry_failed else len(before)
    bar = tqdm(total=len(cells), initial=len(cells) - len(todo), desc=study.name, unit="cell", smoothing=0.05,
               disable=not progress)  # fmt: skip
    outcomes = workers.compute(study.cell, todo) if workers else compute(study.cell, todo, jobs)
    with bar, closing(outcomes):
        bar.set_postfix_str(f"{failed} failed" if failed else "")
        for outcome in outcomes:
            failed += not _keep(folder, outcome)
            bar.set_postfix_str(f"{failed} failed" if failed else "", refresh=False)
            bar.update()


def _keep(folder: Path, outcome: Outcome) -> bool:
    if outcome.rows is None:
        store.save_failure(folder, outcome.cell, outcome.reason, outcome.trace, outcome.seconds)
    else:
        store.save(folder, outcome.cell, outcome.rows, outcome.seconds)
    return outcome.rows is not None


def _resolve(study: Study | str, out: str | Path, settings: Mapping[str, Any] | None) -> tuple[Study, list[Cell], Path]:
    found = _found(study) if isinstance(study, str) else study
    found = found.override(settings or {})
    return found, found.cells(), Path(out) / found.name


def _found(name: str) -> Study:
    study: Study = file_study(name) if in_file(name) else plugins.find("coopoc.studies", name)
    return study


def _part(study: Study, cells: list[Cell], shard: str) -> list[Cell]:
    return Shard.parse(shard).of(cells, study.shares) if shard else cells
