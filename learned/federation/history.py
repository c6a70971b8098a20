"""What a federated training leaves behind: its rounds, the net that is kept, the bytes that everybody moved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor

from coopoc.errors import InputError

from ..nets.gain import Gain
from ..nets.stack import unflatten
from .server import SERVER


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


class Bytes(NamedTuple):
    """What a client sent and received in a training, bytes."""

    sent: int
    received: int


def ledger(federation: Federation, overhead: int = 0) -> dict[str, Bytes]:
    """Bytes of every client over all rounds, as `Track.sent_bytes` and `Track.received_bytes` count decisions.

    Args:
        overhead: bytes per message on air beyond the payload, as in `V2X`.
    """
    found = dict.fromkeys(federation.names, Bytes(0, 0))
    for row in federation.history:
        for (sender, receiver), size in row.traffic.items():
            for name, moved in ((sender, Bytes(size + overhead, 0)), (receiver, Bytes(0, size + overhead))):
                if name in found:
                    found[name] = Bytes(found[name].sent + moved.sent, found[name].received + moved.received)
    return found
