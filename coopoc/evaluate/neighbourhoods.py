"""The bytes of one neighbourhood: a star, where one vehicle receives, or a clique, where all do."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats
from ..world.inbox import inbox
from ..world.recording import Recording
from ..world.v2x import Message
from .ledger import Ledger, of_drive


def star(recording: Recording, ego: int | str, message: Message) -> Ledger:
    """The ledger of one star in which all neighbours broadcast and only the ego receives, after loss and cap.

    Args:
        recording: the links of the ego.
        ego: column or id.
        message: a broadcast of one size.

    Raises:
        InputError: an ego that is unknown or no observer; another kind of message, see `world.inbox`.

    >>> from coopoc import Fleet, Sensors, observe
    >>> place = np.zeros((2, 3, 3)) + [[[0, 0, 0], [9, 0, 0], [0, 9, 0]]]
    >>> seen = observe(Fleet(("a", "b", "c"), [0, 0.1], place, 0 * place), Sensors())
    >>> star(seen, "a", Message("fix", 8)).of("online", way="broadcast").tolist()  # 32 B in each of two steps
    [[0.0, 64.0, 64.0]]
    """
    column = _column(recording, ego)
    received = np.zeros((recording.runs, len(recording.ids)))
    received[:, column] = inbox(recording, column, message).received_bytes
    link = recording.links.of(column)
    step, neighbour = recording.links.step[link], recording.links.neighbour[link]
    senders = neighbour[recording.broadcasts[step, neighbour]]
    size = message.size(recording.v2x.overhead)
    sent = size * np.bincount(senders, minlength=len(recording.ids)).astype(float)
    return _around(recording, column, sent, received, message)


def clique(recording: Recording, ego: int | str, message: Message) -> Ledger:
    """The ledger of one neighbourhood in which each member sends to every other, over a channel that loses nothing.

    A broadcast of m members costs m messages and m (m - 1) receptions a step; one message to each neighbour costs
    m (m - 1) of both.

    Args:
        recording: the links of the ego.
        ego: column or id.
        message: a broadcast or one for each neighbour; as long as the neighbourhood only without overhead.

    Raises:
        InputError: an ego that is unknown or no observer.

    >>> from coopoc import Fleet, Sensors, observe
    >>> place = np.zeros((2, 3, 3)) + [[[0, 0, 0], [9, 0, 0], [0, 9, 0]]]
    >>> seen = observe(Fleet(("a", "b", "c"), [0, 0.1], place, 0 * place), Sensors())
    >>> clique(seen, "a", Message("fix", 8)).of("online").tolist()
    [[128.0, 128.0, 128.0]]
    """
    column, overhead = _column(recording, ego), recording.v2x.overhead
    link = recording.links.of(column)
    there = np.zeros((len(recording.t), len(recording.ids)), dtype=bool)
    there[recording.links.step[link], recording.links.neighbour[link]] = True
    there[:, column] = there.any(axis=1)
    others = np.maximum(there.sum(axis=1, keepdims=True) - 1, 0)
    sending = there & recording.broadcasts
    size = np.where(sending, message.size(overhead, others), 0)
    received = np.where(there, size.sum(axis=1, keepdims=True) - size, 0).sum(axis=0, dtype=float)
    sent = (size * (others if message.unicast else 1)).sum(axis=0, dtype=float)
    return _around(recording, column, sent, received[None], message)


def _around(recording: Recording, ego: int, sent: Floats, received: Floats, message: Message) -> Ledger:
    """Ledger of the bytes that serve one ego's drive."""
    seconds = np.zeros(len(recording.ids))
    seconds[ego] = len(recording.t) * recording.dt
    return of_drive(recording.ids, seconds, sent[None], received, message, recording.v2x.overhead)


def _column(recording: Recording, ego: int | str) -> int:
    return recording.columns([ego], missing=True)[0]
