"""ServerApp of a federation: one of Flower's strategies, fed with screened answers, and its rounds as a checkpoint."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from importlib.metadata import version
from math import nan
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from coopoc import InputError
from coopoc.arrays import one_of, whole
from coopoc.paths import given_path
from coopoc.text import visible

from ..checkpoint import Checkpoint, save
from ..checkpoint import read as read_checkpoint
from ..federation.history import Federation, Round
from ..federation.rules import SERVER, implausible, rule, screen, too_few
from ..nets.gain import Gain, flatten
from ..recipes import Job, untrained
from .client import job_of, require_flower

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
LONGEST_TEXT = 200
"""Characters of a name or a reason in an answer."""
MOST_PIECES = 10
"""Times the median of a round: the largest number of pieces with which a client counts. What it claims
cannot be verified."""


class Row(NamedTuple):
    """A round: number, weights (P,), losses m^2 and pieces by client, reasons of rejection, a note, and who sent."""

    number: int
    weights: Tensor
    training_loss: dict[str, float]
    validation_loss: dict[str, float]
    pieces: dict[str, int]
    rejected: dict[str, str]
    note: str = ""
    sent: Sequence[str] = ()

    @property
    def line(self) -> str:
        """The round in one line of text."""
        total = sum(self.pieces[name] for name in self.validation_loss)
        losses = [self.pieces[name] * loss for name, loss in self.validation_loss.items()]
        mean, missing = sum(losses) / total if total else nan, self.rejected.items()
        why = "".join(f"; {name}: {reason}" for name, reason in missing) + f"; {self.note}" * bool(self.note)
        return f"round {self.number}: validation {mean:.4f} m^2 over {len(losses)} clients{why}"


def server_app() -> "ServerApp":
    """The ServerApp of a federation: all rounds by the run's configuration (`job_of`; `nodes` to wait for, `timeout` s
    of a round, `out`, the checkpoint), one line per round on stdout.

    Raises:
        MissingLibraryError: Flower is not installed.
    """
    require_flower("a ServerApp")
    from flwr.serverapp import ServerApp

    app = ServerApp()
    app.main()(configured)
    return app


def configured(grid: "Grid", context: "Context") -> None:
    """All rounds by the run's configuration; the checkpoint is written after each of them, with the names of the nodes,
    which a new run with the same `out` keeps.

    Raises:
        InputError: a net that is calibrated on the clients' segments, which stay with them.
    """
    run_config: Any = context.run_config
    job, began, rows, names = job_of(run_config), time.perf_counter(), list[Row](), dict[int, str]()
    nodes = whole("nodes", run_config["nodes"], 1, 10**6, "Of clients, to wait for.")
    out = given_path(run_config["out"])
    if type(untrained(job)).calibrate is not Gain.calibrate:
        allowed = "must be a net that needs no calibration on the clients' segments"
        raise InputError("recipe", job.name, allowed, "Train it in one process: coopoc train.")

    if out.is_file():
        names |= {int(node): str(name) for node, name in read_checkpoint(out)[1].get("nodes", {}).items()}

    def keep(row: Row) -> None:
        rows.append(row)
        made = checkpoint(rows, job, time.perf_counter() - began)
        save(out, replace(made, card={**made.card, "nodes": {str(node): name for node, name in names.items()}}))
        print(row.line, flush=True)

    rounds(grid, job, nodes, run_config["timeout"], keep, names)
    print(out, flush=True)


def rounds(
    grid: "Grid", job: Job, nodes: int, timeout: float, keep: Callable[[Row], object], names: dict[int, str]
) -> None:
    """The rounds of a federation over a grid, by the Flower strategy of the recipe's rule.

    A round asks every online node and ends when all have answered, after `timeout` s at the latest.

    Args:
        grid: of Flower.
        job: recipe and setting.
        nodes: number that must be online before the first round, within `timeout` s.
        timeout: s, of a round.
        keep: called with every round once the clients have validated its weights.
        names: of nodes that are known from an earlier run; those of new nodes are added.

    Raises:
        InputError: a rule that Flower has no strategy for, or that needs more nodes.
        TimeoutError: too few nodes came online in time.
    """
    from flwr.app import Array, ArrayRecord

    (theta,) = flatten([untrained(job)])
    one_of("aggregate", job.recipe.aggregate, STRATEGIES)
    job.recipe.plan.check(nodes)
    strategy, until = _strategy(job.recipe.aggregate, theta, keep, names), time.monotonic() + timeout
    while (online := len(list(grid.get_node_ids()))) < nodes:
        if time.monotonic() > until:
            state = f"only {online} came online in {timeout:g} s"
            raise TimeoutError(f"nodes = {nodes}: {state}. Start more, or wait for fewer.")
        time.sleep(0.2)
    strategy.start(grid, ArrayRecord({"theta": Array(theta.numpy())}), job.recipe.rounds, timeout)


def _strategy(aggregate: str, theta: Tensor, keep: Callable[[Row], object], names: dict[int, str]) -> Any:
    """Flower's strategy of a rule, which gets screened answers only and hands each round to `keep`."""
    import flwr.serverapp.strategy as strategies

    kind, options = STRATEGIES[aggregate]
    base: Any = getattr(strategies, kind)

    class Screened(base):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(min_train_nodes=1, min_evaluate_nodes=1, min_available_nodes=1, **options)
            self.row = Row(0, theta, {}, {}, {}, {})
            self.usual: float | None = None
            keep(self.row)

        def aggregate_train(self, server_round: int, replies: "Iterable[Message]") -> tuple[Any, Any]:
            answers, rejected, note = read(replies, names, "training-loss")
            weights = {name: _theta(reply.content["arrays"]) for name, reply in answers.items()}
            refused, self.usual = screen(self.row.weights, weights, self.usual)
            rejected |= refused
            good = {name: reply for name, reply in answers.items() if name not in rejected}
            pieces, losses = _numbers(good, "num-examples"), _numbers(good, "training-loss")
            combined, metrics, now = None, None, self.row.weights
            if few := too_few(rule(aggregate), len(good)):
                note = f"{note}; {few}".lstrip("; ")
            else:
                combined, metrics = super().aggregate_train(server_round, list(good.values()))
            if combined is not None:
                now = _theta(combined).to(theta.dtype)
            self.row = Row(server_round, now, losses, {}, pieces, rejected, note, [*answers])
            return combined, metrics

        def aggregate_evaluate(self, server_round: int, replies: "Iterable[Message]") -> Any:
            answers, rejected, _ = read(replies, names, "validation-loss")
            losses, pieces = _numbers(answers, "validation-loss"), _numbers(answers, "num-examples")
            keep(self.row._replace(validation_loss=losses, pieces=pieces, rejected=self.row.rejected | rejected))
            return super().aggregate_evaluate(server_round, list(answers.values()))

    return Screened()


def read(
    replies: "Iterable[Message]", names: dict[int, str], loss: str
) -> "tuple[dict[str, Message], dict[str, str], str]":
    """Readable answers by client name, in the order of the names, reasons of the others, and a note.

    A client is its node, which Flower knows by its key. The name that it gives is a label, and belongs to the node that
    first had it: another node with this name has its number behind it, so that none can answer in place of another.
    Claimed numbers of pieces beyond `MOST_PIECES` times their median count as that; the note names them.

    Args:
        replies: of the nodes, in any order.
        names: of the nodes, from their first answers on; a node cannot change its own.
        loss: the loss that an answer must hold.
    """
    right = {}
    rejected = {}
    for reply in sorted(replies, key=lambda reply: reply.metadata.src_node_id):
        node = reply.metadata.src_node_id
        who = names.get(node, f"node {node}")
        if reply.has_error():
            rejected[who] = visible(str(reply.error.reason)[:LONGEST_TEXT])
            continue
        try:
            content: Any = reply.content
            problem = _problem(content, loss)
        except Exception as error:  # a client may send anything
            problem = f"malformed answer ({type(error).__name__})"
        if not problem:
            name = content["client"]["name"]
            labels = name, f"{name}, node {node}"
            label = names.setdefault(node, labels[name in names.values()])
            problem = "" if label in labels else f"calls itself {name}"
        if problem:
            rejected[who] = problem
        else:
            right[label] = reply
    claimed, notes = _numbers(right, "num-examples"), []
    most = int(MOST_PIECES * median(claimed.values())) if claimed else 0
    for name, pieces in claimed.items():
        if pieces > most:
            metrics: Any = right[name].content["metrics"]
            metrics["num-examples"] = most
            notes.append(f"{name} claims {pieces} pieces and counts with {most}")
    return dict(sorted(right.items())), rejected, "; ".join(notes)


def _problem(content: Any, loss: str) -> str:
    """Why an answer cannot be used, "" if it can: it holds what was asked for, and nothing else."""
    asked = {"metrics": {"num-examples", loss}, "client": {"name", "version"}}
    asked |= {"arrays": {"theta"}} if loss == "training-loss" else {}
    if {record: {*content[record]} for record in content} != asked:
        return "other records than were asked for"
    name, theirs = (content["client"][key] for key in ("name", "version"))
    pieces, value = content["metrics"]["num-examples"], float(content["metrics"][loss])
    if not (0 < len(name) <= LONGEST_TEXT and name.isprintable() and name != SERVER):
        return f"a name that is not 1 to {LONGEST_TEXT} printable characters, or the server's"
    if not (isinstance(pieces, int) and 1 <= pieces < 2**31):
        return "a number of pieces that is not in 1..2^31 - 1"
    if why := implausible(loss, value):
        return why
    if theirs != version("coopoc"):
        return f"made by another version of coopoc, the server has {version('coopoc')}: install the same"
    if loss == "training-loss" and (kind := content["arrays"]["theta"].numpy().dtype) != "float32":
        return f"weights in {kind}, must be float32"
    return ""


def _numbers(answers: "dict[str, Message]", name: str) -> dict[str, Any]:
    """A metric by client."""
    return {client: reply.content["metrics"][name] for client, reply in answers.items()}


def _theta(arrays: Any) -> Tensor:
    return torch.from_numpy(arrays["theta"].numpy().copy())


def federation(rows: Sequence[Row], job: Job, seconds: float) -> Federation:
    """The rounds as `federate` gives them: clients in the order of their names, and the last report of each."""
    sizes = {name: count for row in rows for name, count in row.pieces.items()}
    names, last, history = sorted(sizes), dict.fromkeys(sizes, nan), []
    for row in rows:
        last |= row.validation_loss
        size, absent = 4 * len(row.weights), [n for n in names if n not in row.training_loss and n not in row.rejected]
        history.append(
            Round(
                row.number,
                row.weights,
                tuple(row.training_loss.get(name, nan) for name in names),
                tuple(last[name] for name in names),
                dict.fromkeys(row.sent, size + 4),
                dict.fromkeys(row.sent, 2 * size),  # to train, and to validate
                row.rejected,
                dict.fromkeys(absent, "no answer") if row.number else {},
                row.note,
            )
        )
    return Federation(untrained(job), tuple(history), tuple(sizes[name] for name in names), seconds, tuple(names))


def checkpoint(rows: Sequence[Row], job: Job, seconds: float) -> Checkpoint:
    """The selected weights, those of every round, and a card that names Flower as the engine."""
    made = federation(rows, job, seconds)
    who = {"clients": list(made.names), "training_pieces": list(made.sizes), "engine": f"flower {version('flwr')}"}
    return Checkpoint(made.model, job.card | made.card | who, made.weights)
