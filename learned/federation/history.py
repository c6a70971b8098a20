"""What a federated training leaves behind: its rounds, the net that is kept, the bytes that everybody moved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from coopoc.errors import InputError
from coopoc.evaluate.ledger import Ledger, of_training
from coopoc.world.fleet import Fleet

from ..nets.gain import Gain
from ..nets.stack import unflatten
from .server import NUMBER, SERVER


@dataclass(frozen=True, eq=False)
class Round:
    """A communication round.

    Args:
        weights: (P,) of the server, or without one the mean of the clients' weights.
        training_loss: (C,) m^2 of each client, NaN where it did not train to the end.
        validation_loss: (C,) m^2, what each client last reported: `Judge` of `weights` after this round for those whose
            answer counted, of an earlier round for the others.
        traffic: bytes by (sender, receiver), payload only. rejected, absent, stragglers: reasons by name.
        note: why the weights stayed as they were, if they did.
        disagreement: largest distance between the weights of two clients; 0 with a server.
    """

    number: int
    weights: Tensor
    training_loss: tuple[float, ...]
    validation_loss: tuple[float, ...]
    traffic: Mapping[tuple[str, str], int] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    stragglers: Mapping[str, str] = field(default_factory=dict)
    note: str = ""
    disagreement: float = 0.0

    @property
    def sent_bytes(self) -> int:
        """Bytes that all clients sent."""
        return sum(size for (sender, _), size in self.traffic.items() if sender != SERVER)

    @property
    def received_bytes(self) -> int:
        """Bytes that all clients received."""
        return sum(size for (_, receiver), size in self.traffic.items() if receiver != SERVER)


@dataclass(frozen=True, eq=False)
class Federation:
    """A federated net: the global weights that validated best, every round, the clients, seconds.

    Without a server `model` is the mean of the clients' nets after the best round, and `own` (C, P) is what each client
    holds in the end; with one `own` is None.
    """

    model: Gain
    history: tuple[Round, ...]
    sizes: tuple[int, ...]
    seconds: float
    names: tuple[str, ...] = ()
    own: Tensor | None = None

    @property
    def best(self) -> Round:
        """The round whose weights are kept: the least validation loss, clients weighted by their sizes."""
        return min(self.history, key=self.validation_loss)

    def validation_loss(self, row: Round) -> float:
        """Validation loss of a round over all clients that were ever heard, m^2; infinite if it is not finite."""
        out = [{*past.rejected, *past.absent} for past in self.history[1:]]
        heard = [i for i, name in enumerate(self.names) if not out or any(name not in missing for missing in out)]
        reports = [(self.sizes[i], row.validation_loss[i]) for i in heard or range(len(self.sizes))]
        total = sum(n * loss for n, loss in reports) / sum(n for n, _ in reports)
        return total if math.isfinite(total) else math.inf

    def after(self, number: int) -> Gain:
        """The global net after round `number`, 0 being the start."""
        if not 0 <= number < len(self.history):
            raise InputError("round", number, f"must be in 0..{len(self.history) - 1}", "See history.")
        return unflatten(self.history[number].weights[None], self.model)[0]


def ledger(federation: Federation, overhead: int = 0) -> Ledger:
    """Bytes of every client, and of the server if there is one, over all rounds.

    What a sender tells several receivers in a round it sends once, the longest; each of them receives its copy.

    Args:
        overhead: bytes per message on air beyond the payload, as in `V2X`.
    """
    ends = {name for row in federation.history for pair in row.traffic for name in pair}
    names = [*federation.names, *sorted(ends - set(federation.names))]
    moved, messages = np.zeros((2, 2, len(names)))
    for row in federation.history:
        once: dict[str, int] = {}
        for (sender, receiver), size in row.traffic.items():
            once[sender] = max(size, once.get(sender, 0))
            moved[1, names.index(receiver)] += size
            messages[1, names.index(receiver)] += 1
        for sender, size in once.items():
            moved[0, names.index(sender)] += size
            messages[0, names.index(sender)] += 1
    servers = [name for name in names if name == SERVER]
    return of_training(names, moved[0], moved[1], servers, messages, overhead)


def card_ledger(card: Mapping[str, Any], drives: Fleet) -> Ledger:
    """The same of trained weights, from their card: payload, on average over the clients.

    A federation moves the weights both ways in every round; its server may broadcast its own. What is trained in one
    place needs the raw drives, six float32 per step (noisy fixes and velocities; the reference drive comes on top), and
    sends the weights back once.

    Args:
        card: of a `Checkpoint`. drives: of the clients.
    """
    if card["settings"]["kind"] == "federated":
        names, rounds = card["clients"], card["history"][1:]
        up, down = (np.full(len(names), sum(row[way] for row in rounds) / len(names))
                    for way in ("sent_bytes", "received_bytes"))  # fmt: skip
    else:
        names, up = drives.ids, NUMBER * 6.0 * drives.present.sum(axis=0)
        down = np.full(len(names), float(NUMBER * card["parameters"]))
    return of_training([*names, SERVER], [*up, down[0]], [*down, up.sum()], [SERVER])
