"""The record of a federated training: its rounds, the selected net, and the traffic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import Any

import numpy as np
import torch
from torch import Tensor

from coopoc import Ledger
from coopoc.arrays import Floats, instance, whole
from coopoc.evaluate.ledger import of_training
from coopoc.text import short_repr

from ..nets.gain import Gain, unflatten
from ..training.clients import Segments
from .rules import LARGEST_LOSS, SERVER

AGREEMENT = 0.1
"""Excess of a round's median loss over the least one up to which the round may be selected."""


CARD = ("training_loss", "validation_loss", "sent_bytes", "received_bytes", "rejected", "absent", "note")
"""Fields of a round in the card of a checkpoint."""


@dataclass(frozen=True, eq=False)
class Round:
    """A communication round.

    Args:
        number: of the round, 0 for the start.
        weights: (P,) of the server.
        training_loss: (C,) m^2, of each client, NaN where its training did not complete.
        validation_loss: (C,) m^2, last report of each client: `Judge` of `weights` after this round where its answer
            was accepted, of an earlier round otherwise.
        sent: payload bytes by client.
        received: payload bytes by client.
        rejected: reasons of rejected answers, by client.
        absent: reasons of absence, by client.
        note: reason why the weights are unchanged, if they are.
    """

    number: int
    weights: Tensor
    training_loss: tuple[float, ...]
    validation_loss: tuple[float, ...]
    sent: Mapping[str, int] = field(default_factory=dict)
    received: Mapping[str, int] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    note: str = ""

    __repr__ = short_repr

    @property
    def sent_bytes(self) -> int:
        """Bytes that all clients sent."""
        return sum(self.sent.values())

    @property
    def received_bytes(self) -> int:
        """Bytes that all clients received."""
        return sum(self.received.values())

    @property
    def card(self) -> dict[str, Any]:
        """The round in the card of a checkpoint."""
        return {"round": self.number} | {name: getattr(self, name) for name in CARD}


@dataclass(frozen=True, eq=False)
class Federation:
    """A federated net.

    Args:
        like: net of its shape.
        history: rounds, the start first.
        sizes: (C,) training pieces of each client.
        seconds: of training.
        names: (C,) of the clients.
        parts: (C,) training pieces, by which a net is calibrated.
    """

    like: Gain
    history: tuple[Round, ...]
    sizes: tuple[int, ...]
    seconds: float
    names: tuple[str, ...] = ()
    parts: Sequence[Segments] = ()

    __repr__ = short_repr

    @cached_property
    def model(self) -> Gain:
        """Net of the best round."""
        return self.after(self.best.number)

    @property
    def card(self) -> dict[str, Any]:
        """The rounds in the card of a checkpoint."""
        return {"history": [row.card for row in self.history], "best": self.best.number, "seconds": self.seconds}

    @property
    def weights(self) -> Tensor:
        """(rounds + 1, P) of the server."""
        return torch.stack([row.weights for row in self.history])

    @property
    def best(self) -> Round:
        """The selected round: the least `validation_loss` among the rounds on which most clients agree.

        These are the rounds whose median loss over the clients exceeds the least such median by at most `AGREEMENT`
        times its size (a likelihood's loss may be negative), so that no minority of false reports can select a round
        that the other clients find poor. One or two reports have no majority: then all rounds compete. Without any
        client it is the start.
        """
        return self.history[selected([row.card for row in self.history], self.sizes, self.names)]

    def validation_loss(self, row: Round) -> float:
        """Mean of the clients' last reports, weighted by size, m^2; infinite if it is not finite.

        Clients of which no answer was ever accepted do not count.
        """
        losses, sizes = reports([past.card for past in self.history], self.sizes, self.names)
        return float(np.average(losses[self.history.index(row)], weights=sizes))

    def after(self, rounds: int) -> Gain:
        """The global net after so many rounds, 0 being the start, calibrated."""
        rounds = whole("rounds", rounds, 0, len(self.history) - 1, "See history.")
        return unflatten(self.history[rounds].weights, self.like).calibrate(self.parts)


def reports(
    rows: Sequence[Mapping[str, Any]], sizes: Sequence[int], names: Sequence[str]
) -> tuple[Floats, Sequence[int]]:
    """Losses (rows, C), infinite if implausible, and sizes of the clients that count, of the rows of a card's history:
    of those of which an answer was ever accepted, of all if there are none."""
    missing = [{*row.get("rejected", ()), *row.get("absent", ())} for row in rows[1:]]
    accepted = [i for i, name in enumerate(names) if any(name not in some for some in missing)] or range(len(sizes))
    losses = np.array([np.broadcast_to(row["validation_loss"], len(sizes)) for row in rows], float)[:, accepted]
    return np.where(abs(losses) <= LARGEST_LOSS, losses, inf), [sizes[i] for i in accepted]


def selected(rows: Sequence[Mapping[str, Any]], sizes: Sequence[int], names: Sequence[str]) -> int:
    """Row of a card's history whose weights are kept, as `Federation.best`; of a fit the one with the least loss."""
    losses, counted = reports(rows, sizes, names)
    if not counted:
        return 0
    typical = np.median(losses, axis=1)
    most = min(typical) + AGREEMENT * abs(min(typical)) if len(counted) > 2 else inf
    agreed = np.flatnonzero(typical <= most)
    return int(agreed[np.average(losses[agreed], axis=1, weights=counted).argmin()])


def ledger(federation: Federation, overhead: int = 0) -> Ledger:
    """Bytes of every client and of the server over all rounds; the server broadcasts its weights once a round.

    Args:
        federation: with its traffic.
        overhead: bytes per message on air beyond the payload, as in `V2X`.
    """
    rounds = instance("federation", federation, Federation, "Give what federate(...) returns.").history
    names = [*federation.names, SERVER]
    moved, messages = np.zeros((2, 2, len(names)))
    for column, name in enumerate(federation.names):
        for way, totals in enumerate(([row.sent for row in rounds], [row.received for row in rounds])):
            sizes = [row[name] for row in totals if name in row]
            moved[way, column], messages[way, column] = sum(sizes), len(sizes)
    downloads = [max(row.received.values()) for row in rounds if row.received]
    moved[:, -1], messages[:, -1] = (sum(downloads), moved[0].sum()), (len(downloads), messages[0].sum())
    return of_training(names, moved[0], moved[1], [SERVER], messages, overhead)
