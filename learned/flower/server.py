"""ServerApp of a federation: one of Flower's strategies, fed with screened answers, and its rounds as a checkpoint."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from coopoc import arrays
from coopoc.arrays import one_of
from coopoc.errors import InputError
from coopoc.escapes import visible
from coopoc.file_names import given_path

from ..checkpoint import Checkpoint, save
from ..federation.combine import SERVER, screen
from ..federation.history import Federation, Round
from ..nets.gain import Gain
from ..nets.stack import flatten
from ..recipes import Job, sensors, untrained
from .client import require_flower
from .job import job_of

if TYPE_CHECKING:
    from flwr.app import Context, Message
    from flwr.serverapp import Grid, ServerApp

STRATEGIES: dict[str, tuple[str, dict[str, Any]]] = {
    "mean": ("FedAvg", {}),
    "median": ("FedMedian", {}),
    "trimmed_mean": ("FedTrimmedAvg", {"beta": 0.25}),
    "krum": ("Krum", {"num_malicious_nodes": 1}),
}
"""Flower's strategy for each rule of `federate`, with the rule's defaults."""
LARGEST_LOSS = 1e12
"""m^2, the largest plausible loss: an error of 1,000 km."""
LONGEST = 200
"""Characters of a name or a reason in an answer."""


class Row(NamedTuple):
    """A round: number, weights (P,), losses m^2 and pieces by client, reasons of rejection and absence."""

    number: int
    weights: Tensor
    training_loss: dict[str, float]
    validation_loss: dict[str, float]
    pieces: dict[str, int]
    rejected: dict[str, str]

    @property
    def line(self) -> str:
        """The round in one line of text."""
        total = sum(self.pieces[name] for name in self.validation_loss)
        losses = [self.pieces[name] * loss for name, loss in self.validation_loss.items()]
        mean, missing = sum(losses) / total if total else math.nan, self.rejected.items()
        why = "".join(f"; {name}: {reason}" for name, reason in missing)
        return f"round {self.number}: validation {mean:.4f} m^2 over {len(losses)} clients{why}"


def server_app(main: Callable[[Grid, Context], None] | None = None) -> ServerApp:
    """The ServerApp of a federation.

    Args:
        main: function of grid and context; default: all rounds by the run's configuration (`job_of`; `nodes` to wait
            for, `timeout` s of a round, `out`, the checkpoint), one line per round on stdout.

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

    Raises:
        InputError: a net that is calibrated on the clients' segments, which stay with them.
    """
    given: Any = context.run_config
    job, began, rows = job_of(given), time.perf_counter(), list[Row]()
    nodes = arrays.number("nodes", given["nodes"], 1, 10**6, kind=int, allowed=">= 1", hint="Of clients, to wait for.")
    out = given_path(given["out"])
    if type(untrained(job)).calibrate is not Gain.calibrate:
        allowed = "must be a net that needs no calibration on the clients' segments"
        raise InputError("recipe", job.name, allowed, "Train it in one process, or with coopoc train --flower.")

    def keep(row: Row) -> None:
        rows.append(row)
        save(out, checkpoint(rows, job, time.perf_counter() - began))
        print(row.line, flush=True)

    rounds(grid, job, nodes, given["timeout"], keep)
    print(out, flush=True)


def rounds(grid: Grid, job: Job, nodes: int, timeout: float, keep: Callable[[Row], object]) -> None:
    """The rounds of a federation over a grid, by the Flower strategy of the recipe's rule.

    A round asks every online node and ends when all have answered, after `timeout` s at the latest.

    Args:
        grid: of Flower.
        job: recipe and setting.
        nodes: number that must be online before the first round, within `timeout` s.
        timeout: s, of a round.
        keep: called with every round once the clients have validated its weights.

    Raises:
        InputError: a rule that Flower has no strategy for.
        TimeoutError: too few nodes came online in time.
    """
    from flwr.app import Array, ArrayRecord

    (theta,) = flatten([untrained(job)])
    strategy, until = _strategy(job.recipe.aggregate, theta, keep), time.monotonic() + timeout
    while (online := len(list(grid.get_node_ids()))) < nodes:
        if time.monotonic() > until:
            state = f"only {online} came online in {timeout:g} s"
            raise TimeoutError(f"nodes = {nodes}: {state}. Start more, or wait for fewer.")
        time.sleep(0.2)
    strategy.start(grid, ArrayRecord({"theta": Array(theta.numpy())}), job.recipe.rounds, timeout)


def _strategy(aggregate: str, theta: Tensor, keep: Callable[[Row], object]) -> Any:
    """Flower's strategy of a rule, which gets screened answers only and hands each round to `keep`."""
    import flwr.serverapp.strategy as strategies

    kind, options = STRATEGIES[one_of("aggregate", aggregate, tuple(STRATEGIES))]
    base: Any = getattr(strategies, kind)

    class Screened(base):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(min_train_nodes=1, min_evaluate_nodes=1, min_available_nodes=1, **options)
            self.row, self.names = Row(0, theta, {}, {}, {}, {}), dict[int, str]()
            self.usual: float | None = None
            keep(self.row)

        def aggregate_train(self, server_round: int, replies: Iterable[Message]) -> tuple[Any, Any]:
            answers, rejected = read(replies, self.names, "training-loss")
            weights = {name: _theta(reply) for name, reply in answers.items()}
            refused, self.usual = screen(self.row.weights, weights, self.usual)
            rejected |= refused
            good = {name: reply for name, reply in answers.items() if name not in rejected}
            pieces, losses = _numbers(good, "num-examples"), _numbers(good, "training-loss")
            combined, metrics = super().aggregate_train(server_round, list(good.values()))
            now = self.row.weights
            if combined is not None:
                now = torch.from_numpy(combined["theta"].numpy().copy()).to(theta.dtype)
            self.row = Row(server_round, now, losses, {}, {n: int(k) for n, k in pieces.items()}, rejected)
            return combined, metrics

        def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> Any:
            answers, rejected = read(replies, self.names, "validation-loss")
            losses, counts = _numbers(answers, "validation-loss"), _numbers(answers, "num-examples")
            pieces = {name: int(count) for name, count in counts.items()}
            row = self.row._replace(validation_loss=losses, pieces=pieces, rejected=self.row.rejected | rejected)
            keep(row)
            return super().aggregate_evaluate(server_round, list(answers.values()))

    return Screened()


def read(replies: Iterable[Message], names: dict[int, str], loss: str) -> tuple[dict[str, Message], dict[str, str]]:
    """Readable answers by client name, in the order of the names, and reasons of the others.

    Args:
        replies: of the nodes, in any order.
        names: of the nodes, as first reported; a node cannot change its own.
        loss: the loss that an answer must hold.
    """
    right: dict[str, Message] = {}
    rejected: dict[str, str] = {}
    for reply in sorted(replies, key=lambda reply: reply.metadata.src_node_id):
        node = reply.metadata.src_node_id
        who = names.get(node, f"node {node}")
        if reply.has_error():
            rejected[who] = visible(str(reply.error.reason)[:LONGEST])
            continue
        try:
            content: Any = reply.content
            name, problem = content["client"]["name"], _problem(content, loss)
        except Exception as error:  # a client may send anything
            rejected[who] = f"malformed answer ({type(error).__name__})"
            continue
        if problem or names.get(node, name) != name or name in (SERVER, *right):
            rejected[who] = problem or f"claims the name {name} of another node"
            continue
        names[node], right[name] = name, reply
    return dict(sorted(right.items())), rejected


def _problem(content: Any, loss: str) -> str:
    """Why an answer cannot be used, "" if it can."""
    name, pieces, value, theirs = (
        content["client"]["name"],
        content["metrics"]["num-examples"],
        float(content["metrics"][loss]),
        content["client"]["version"],
    )
    if {*content["metrics"]} != {"num-examples", loss} or len(content.metric_records) + len(content.array_records) > 2:
        return "other records than were asked for"
    if not (0 < len(name) <= LONGEST and name.isprintable()):
        return f"a name that is not 1 to {LONGEST} printable characters"
    if not (isinstance(pieces, int) and 1 <= pieces < 2**31):
        return "a number of pieces that is not in 1..2^31 - 1"
    if not 0 <= value <= LARGEST_LOSS:
        return f"a {loss} of {value:g} m^2, must be in [0, {LARGEST_LOSS:g}]"
    if theirs != version("coopoc"):
        return f"made by another version of coopoc, the server has {version('coopoc')}: install the same"
    if loss == "training-loss" and content["arrays"]["theta"].numpy().dtype != "float32":
        return f"weights in {content['arrays']['theta'].numpy().dtype}, must be float32"
    return ""


def _numbers(answers: dict[str, Message], name: str) -> dict[str, float]:
    """A metric by client."""
    return {client: float(reply.content["metrics"][name]) for client, reply in answers.items()}  # type: ignore[arg-type]


def _theta(reply: Message) -> Tensor:
    arrays: Any = reply.content["arrays"]
    return torch.from_numpy(arrays["theta"].numpy().copy())


def federation(rows: Sequence[Row], job: Job, seconds: float) -> Federation:
    """The rounds as `federate` gives them: clients in the order of their names, and the last report of each."""
    sizes = {name: count for row in rows for name, count in row.pieces.items()}
    names, last, history = sorted(sizes), dict.fromkeys(sizes, math.nan), list[Round]()
    for row in rows:
        last |= row.validation_loss
        size, absent = 4 * len(row.weights), [n for n in names if n not in row.training_loss and n not in row.rejected]
        history.append(
            Round(
                row.number,
                row.weights,
                tuple(row.training_loss.get(name, math.nan) for name in names),
                tuple(last[name] for name in names),
                dict.fromkeys(row.training_loss, size + 4),
                dict.fromkeys(row.training_loss, size),
                row.rejected,
                dict.fromkeys(absent, "no answer") if row.number else {},
            )
        )
    made = Federation(untrained(job), tuple(history), tuple(sizes[name] for name in names), seconds, tuple(names))
    return replace(made, model=made.after(made.best.number)) if names else made


def checkpoint(rows: Sequence[Row], job: Job, seconds: float) -> Checkpoint:
    """The selected weights, those of every round, and a card that names Flower as the engine."""
    made = federation(rows, job, seconds)
    card: dict[str, Any] = {
        "recipe": job.name,
        "settings": asdict(job.recipe) | asdict(job.setting),
        "noise": asdict(sensors(job)),
        "client": None,
        "clients": list(made.names),
        "training_pieces": list(made.sizes),
        "history": [row.card for row in made.history],
        "best": made.best.number if made.names else 0,
        "seconds": seconds,
        "engine": f"flower {version('flwr')}",
    }
    return Checkpoint(made.model, card, torch.stack([row.weights for row in made.history]))
