"""ServerApp: the rounds of a federation over a Flower grid, whoever is absent, late or broken."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from coopoc.errors import InputError

from ..checkpoint import save
from ..federation.aggregate import rule
from ..federation.server import Answer, combine
from ..nets.gain import Gain
from ..nets.stack import flatten
from ..recipes import Job
from .ask import Wait, gather, hear
from .job import job_of, net
from .rows import Row, checkpoint, line
from .wire import require_flower

if TYPE_CHECKING:
    from flwr.app import Context
    from flwr.serverapp import Grid, ServerApp


def server_app(main: Callable[[Grid, Context], None] | None = None) -> ServerApp:
    """The ServerApp of a federation.

    Args:
        main: what it does with the grid; default: all rounds by the run's configuration (`job_of`; `nodes` to wait for,
            `timeout` and `patience` of `Wait`, `out`, the checkpoint), one line per round on stdout.

    Raises:
        MissingLibraryError: Flower is not installed.
    """
    require_flower("a ServerApp")
    from flwr.serverapp import ServerApp

    app = ServerApp()
    app.main()(main or configured)
    return app


def configured(grid: Grid, context: Context) -> None:
    """All rounds by the run's configuration, then the checkpoint.

    Raises:
        InputError: a net that would have to be finished on the clients' pieces, which stay with them.
    """
    config, began, rows = context.run_config, time.perf_counter(), list[Row]()
    job, wait = job_of(config), Wait(float(config["timeout"]), float(config["patience"]))
    if type(net(job)).finished is not Gain.finished:
        allowed = "must be a net that is whole without a look at the clients' pieces"
        raise InputError("recipe", job.name, allowed, "Train it in one process, or with coopoc train --flower.")
    for row in rounds(grid, job, int(config["nodes"]), wait):
        rows.append(row)
        print(line(row), flush=True)
    print(save(str(config["out"]), checkpoint(rows, job, time.perf_counter() - began)), flush=True)


def rounds(grid: Grid, job: Job, nodes: int, wait: Wait) -> Iterator[Row]:
    """`federate` over a grid: the start and the M rounds, each as soon as its weights have been judged.

    A round asks every node that is online. It ends when all have answered that answered the last time, or when the wait
    is over. Who stays silent is absent from the round; it is asked again in the next, which does not wait for it.
    Answers are combined in the order of the clients' names, so the order of arrival does not matter.

    Args:
        grid: Flower's. job: recipe and setting. nodes: how many must be online before the first round.

    Raises:
        InputError: fewer nodes than the rule takes.
        TimeoutError: that many nodes did not come in time.
        RuntimeError: nobody answered the first question as it should; says what came instead.
    """
    chosen, names, silent = rule(job.recipe.aggregate), dict[int, str](), frozenset[int]()
    if nodes < chosen.least:
        raise InputError("nodes", nodes, f"must be >= {chosen.least} for {chosen.name}", "Wait for more clients.")
    (theta,) = flatten([net(job)])
    state, usual, done = chosen.start(theta), None, Row(0, theta)
    for number in range(1, job.recipe.rounds + 2):
        online = gather(grid, nodes if number == 1 else 1, wait)
        kind = "train" if number <= job.recipe.rounds else "evaluate"
        heard = hear(grid, kind, theta, number, online, silent, names, wait)
        if number == 1 and not heard.reports:
            why = "; ".join(f"{name}: {reason}" for name, reason in {**heard.rejected, **heard.absent}.items())
            raise RuntimeError(f"no client can take part: {why}")
        yield done.judged(heard.reports, heard.traffic if kind == "evaluate" else {})
        answers = {name: Answer(told.weights, told.pieces, told.validation_loss)
                   for name, told in heard.reports.items() if told.weights is not None}  # fmt: skip
        after = combine(chosen, state, theta, answers, usual)
        theta, state, usual, silent = after.theta, after.state, after.usual, heard.silent
        losses = {name: told.training_loss for name, told in heard.reports.items()}
        broke = {name: told.broke for name, told in heard.reports.items() if told.broke}
        rejected = {**broke, **heard.rejected, **after.rejected}
        done = Row(number, theta, losses, {}, {}, heard.traffic, rejected, heard.absent, after.note)
