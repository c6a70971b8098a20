"""Questions to the nodes of a Flower grid: how long a round waits, and validation of the answers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from coopoc.methods.options import check_options

from ..federation.server import SERVER
from .wire import MalformedAnswerError, Report, question, reason, reported, size

if TYPE_CHECKING:
    from flwr.app import Message, RecordDict
    from flwr.serverapp import Grid

POLL = 0.2
"""Seconds between two queries for answers."""


@dataclass(frozen=True)
class Wait:
    """Time that a round waits for answers.

    Args:
        timeout: s, at most.
        patience: once most clients have answered, the round ends after this many times the latest answer's time;
            infinite for no end before the timeout.
        pause: function that waits some seconds; an exception from it ends the rounds.
    """

    timeout: float = 600.0
    patience: float = 10.0
    pause: Callable[[float], object] = time.sleep

    def __post_init__(self) -> None:
        check_options(self, {"timeout": (0.0, 1e9, ">= 0 s"), "patience": (1.0, math.inf, ">= 1")})

    def until(self, arrived: Sequence[float], needed: int) -> float:
        """Seconds after the question at which the round ends, given those at which answers arrived.

        >>> Wait(60.0, 3.0).until([2.0, 5.0], needed=3), Wait(60.0, 3.0).until([2.0], needed=3)
        (15.0, 60.0)
        """
        return min(self.timeout, self.patience * max(arrived)) if 2 * len(arrived) > needed else self.timeout


class Replies(NamedTuple):
    """Answers to a question by client name: reports, reasons of rejection, reasons of absence; nodes without an answer;
    bytes of the readable messages' records by (sender, receiver)."""

    reports: Mapping[str, Report]
    rejected: Mapping[str, str]
    absent: Mapping[str, str]
    silent: frozenset[int]
    traffic: Mapping[tuple[str, str], int]


def collect(
    grid: Grid,
    kind: str,
    theta: Tensor,
    number: int,
    nodes: Sequence[int],
    silent: frozenset[int],
    names: dict[int, str],
    wait: Wait,
) -> Replies:
    """Ask the nodes with theta (P,) and read their answers; new nodes are added to `names`."""
    names |= {node.node_id: node.name for node in grid.get_nodes() if node.name}
    content = question(theta, number)
    replies, lasted = ask(grid, kind, content, number, nodes, silent, wait)
    failed = {node: reason(reply.error.reason) for node, reply in replies.items() if reply.has_error()}
    answers = {node: reply.content for node, reply in sorted(replies.items()) if node not in failed}
    reports, rejected, received = read(answers, names)
    missing = frozenset(nodes) - replies.keys()
    absent = dict.fromkeys(names.keys() - set(nodes), "not online") | failed
    absent |= dict.fromkeys(missing, f"no answer in {lasted:.0f} s")
    traffic = {(SERVER, _name(names, node)): size(content) for node in nodes}
    traffic |= {(name, SERVER): count for name, count in received.items()}
    return Replies(reports, rejected, {_name(names, node): absent[node] for node in sorted(absent)}, missing, traffic)


def ask(
    grid: Grid,
    kind: str,
    content: RecordDict,
    number: int,
    nodes: Sequence[int],
    silent: frozenset[int],
    wait: Wait,
) -> tuple[dict[int, Message], float]:
    """The replies to one question by node, and the seconds they took; silent nodes are waited for only if all are."""
    from flwr.app import Message

    began = time.monotonic()
    messages = [Message(content, node, kind, ttl=wait.timeout, group_id=str(number)) for node in nodes]
    grid.push_messages(messages)
    missing = {message.metadata.message_id: message.metadata.dst_node_id for message in messages}
    needed, replies, arrived = set(nodes) - silent or set(nodes), dict[int, Message](), list[float]()
    while needed - replies.keys() and time.monotonic() - began < wait.until(arrived, len(needed)):
        wait.pause(POLL)
        for reply in grid.pull_messages(list(missing)):
            node = missing.pop(reply.metadata.reply_to_message_id, None)
            if node is not None:  # neither a replay nor an answer to another question
                replies[node] = reply
                arrived.append(time.monotonic() - began)
    return replies, time.monotonic() - began


def read(
    answers: Mapping[int, RecordDict], names: dict[int, str]
) -> tuple[dict[str, Report], dict[str, str], dict[str, int]]:
    """Reports by client name, reasons of rejected answers, and bytes of the readable ones.

    Args:
        answers: by node.
        names: of the nodes, as registered or as first reported; a node cannot change its own.
    """
    reports, rejected, received = dict[str, Report](), dict[str, str](), dict[str, int]()
    for node, content in answers.items():
        try:
            report, count = reported(content), size(content)
        except MalformedAnswerError as error:
            rejected[_name(names, node)] = f"malformed answer: {error}"
            continue
        except Exception as error:  # a client may send anything
            rejected[_name(names, node)] = f"malformed answer ({type(error).__name__})"
            continue
        if names.get(node, report.name) != report.name or report.name in (SERVER, *reports):
            rejected[f"node {node}"] = f"claims the name {report.name} of another node"
            continue
        names[node], reports[report.name], received[report.name] = report.name, report, count
    return reports, rejected, received


def wait_for_nodes(grid: Grid, nodes: int, wait: Wait) -> list[int]:
    """The nodes that are online, in a fixed order, as soon as there are enough."""
    until = time.monotonic() + wait.timeout
    while len(online := sorted(grid.get_node_ids())) < nodes:
        if time.monotonic() > until:
            found = f"only {len(online)} came online in {wait.timeout:g} s"
            raise TimeoutError(f"nodes = {nodes}: {found}. Start more, or wait for fewer.")
        wait.pause(POLL)
    return online


def _name(names: Mapping[int, str], node: int) -> str:
    return names.get(node, f"node {node}")
