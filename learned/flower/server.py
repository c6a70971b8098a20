"""ServerApp: the rounds of a federation over a Flower grid, with absent, late and Byzantine clients."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc import arrays
from coopoc.errors import InputError
from coopoc.file_names import given_path

from ..checkpoint import save
from ..federation.aggregate import rule
from ..federation.server import Answer, combine
from ..nets.gain import Gain
from ..nets.stack import flatten
from ..recipes import Job, untrained
from .ask import Wait, collect, wait_for_nodes
from .job import job_of
from .progress import Progress, read, write
from .rows import Row, checkpoint, line
from .wire import require_flower

if TYPE_CHECKING:
    from flwr.app import Context
    from flwr.serverapp import Grid, ServerApp


def server_app(main: Callable[[Grid, Context], None] | None = None) -> ServerApp:
    """The ServerApp of a federation.

    Args:
        main: function of grid and context; default: all rounds by the run's configuration (`job_of`; `nodes` to wait
            for, `timeout` and `patience` of `Wait`, `out`, the checkpoint), one line per round on stdout.

    Raises:
        MissingLibraryError: Flower is not installed.
    """
    require_flower("a ServerApp")
    from flwr.serverapp import ServerApp

    app = ServerApp()
    app.main()(main or configured)
    return app


def configured(grid: Grid, context: Context) -> None:
    """All rounds by the run's configuration; the checkpoint is written after each of them.

    The progress is in `out`.progress until the last round. A run that finds it there continues after its last round.

    Raises:
        InputError: a net that is calibrated on the clients' segments, which stay with them; a progress file of another
            job.
    """
    config, began, rows = context.run_config, time.perf_counter(), list[Row]()
    given: Any = config
    job, wait = job_of(config), Wait(given["timeout"], given["patience"])
    nodes = arrays.number("nodes", given["nodes"], 1, 10**6, kind=int, allowed=">= 1", hint="Of clients, to wait for.")
    out = given_path(given["out"])
    path = out.with_name(f"{out.name}.progress")
    if type(untrained(job)).calibrate is not Gain.calibrate:
        allowed = "must be a net that needs no calibration on the clients' segments"
        raise InputError("recipe", job.name, allowed, "Train it in one process, or with coopoc train --flower.")
    for row in rounds(grid, job, nodes, wait, read(path, job), partial(write, path, job)):
        rows.append(row)
        save(out, checkpoint(rows, job, time.perf_counter() - began))
        print(line(row), flush=True)
    path.unlink(missing_ok=True)
    print(out, flush=True)


def rounds(
    grid: Grid,
    job: Job,
    nodes: int,
    wait: Wait,
    progress: Progress | None = None,
    keep: Callable[[Progress], object] = lambda progress: None,
) -> Iterator[Row]:
    """`federate` over a grid: the start and the M rounds, each as soon as its weights have been validated.

    A round asks every online node. It ends when all have answered that answered the last time, or when the wait is
    over. A silent node is absent from the round; the next round asks it again and does not wait for it. Answers are
    combined in the order of the clients' names, so the order of arrival does not matter.

    Args:
        grid: of Flower.
        job: recipe and setting.
        nodes: number that must be online before the first round.
        wait: for answers.
        progress: of an earlier run of the job, which is continued.
        keep: called with the progress after each round.

    Raises:
        InputError: fewer nodes than the rule needs.
        TimeoutError: too few nodes came online in time.
        RuntimeError: no valid answer to the first question; gives the reasons.
    """
    chosen, names, silent = rule(job.recipe.aggregate), dict[int, str](), frozenset[int]()
    if nodes < chosen.least:
        raise InputError("nodes", nodes, f"must be >= {chosen.least} for {chosen.name}", "Wait for more clients.")
    (theta,) = flatten([untrained(job)])
    rows, state, usual = progress or Progress((Row(0, theta),), chosen.start(theta), None)
    yield from rows[:-1]
    first = len(rows)
    for number in range(first, job.recipe.rounds + 2):
        online = wait_for_nodes(grid, nodes if number == first else 1, wait)
        kind = "train" if number <= job.recipe.rounds else "evaluate"
        replies = collect(grid, kind, rows[-1].weights, number, online, silent, names, wait)
        if number == 1 and not replies.reports:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in {**replies.rejected, **replies.absent}.items())
            raise RuntimeError(f"no client can take part: {reasons}")
        done = rows[-1].validated(replies.reports, replies.traffic if kind == "evaluate" else {})
        yield done
        if kind == "train":
            answers = {
                name: Answer(report.weights, report.pieces, report.validation_loss)
                for name, report in replies.reports.items()
                if report.weights is not None
            }
            after = combine(chosen, state, done.weights, answers, usual)
            state, usual, silent = after.state, after.usual, replies.silent
            losses = {name: report.training_loss for name, report in replies.reports.items()}
            failed = {name: report.failure for name, report in replies.reports.items() if report.failure}
            rejected = {**failed, **replies.rejected, **after.rejected}
            trained = Row(number, after.theta, losses, {}, {}, replies.traffic, rejected, replies.absent, after.note)
            rows = (*rows[:-1], done, trained)
            keep(Progress(rows, state, usual))
