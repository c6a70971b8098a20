"""Participation: the clients that a round asks; heterogeneous, poisoned and Byzantine clients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from coopoc.errors import InputError
from coopoc.methods.track import check_options
from coopoc.world.fleet import Fleet
from coopoc.world.sensors import Sensors, stream

from ..training.clients import Client, Segments, clients
from .rules import within


@dataclass(frozen=True)
class Participation:
    """Random participation, drawn for every round from the training seed.

    Args:
        share: of the clients that the server asks, at least one.

    Raises:
        InputError: a share outside (0, 1].

    References:
        McMahan et al., AISTATS 2017 (the share C).

    >>> len(Participation(share=0.5).asked(0, 1, ["a", "b"]))
    1
    """

    share: float = 1.0

    def __post_init__(self) -> None:
        check_options(self)
        within("share", self.share, 0 < self.share <= 1, "in (0, 1]", "1 asks all clients.")

    def count(self, clients: int) -> int:
        """Number of clients, of so many, that are asked in a round."""
        return max(1, round(self.share * clients))

    def asked(self, seed: int, number: int, names: Sequence[str]) -> frozenset[str]:
        """The clients that are asked in round `number`; they do not depend on the order of the names."""
        lots = {name: float(stream(seed, "asked", number, name).random()) for name in names}
        return frozenset(sorted(names, key=lots.__getitem__)[: self.count(len(names))])

    def answer(self, name: str, theta: Tensor, weights: Tensor) -> Tensor:
        """Weights that the server receives from a client that trained `weights` (P,) from theta (P,): these weights."""
        return weights


@dataclass(frozen=True)
class Byzantine(Participation):
    """Participation with Byzantine clients, which send theta + scale (theta_i - theta).

    Args:
        names: of the Byzantine clients.
        scale: of their updates; negative reverses them.

    References:
        Blanchard et al., NeurIPS 2017, section 5; Bagdasaryan et al., How to Backdoor Federated Learning, AISTATS 2020.

    >>> import torch
    >>> Byzantine(names=("a",), scale=-2.0).answer("a", torch.ones(1), torch.tensor([2.0])).tolist()
    [-1.0]
    """

    names: tuple[str, ...] = ()
    scale: float = -10.0

    def answer(self, name: str, theta: Tensor, weights: Tensor) -> Tensor:
        """Scaled if the client is Byzantine."""
        return theta + self.scale * (weights - theta) if name in self.names else weights


def poisoned(client: Client, offset: float) -> Client:
    """The client with a ground truth that is off by `offset` m on every axis."""

    def part(pieces: Segments) -> Segments:
        return replace(pieces, truth=pieces.truth + offset)

    return replace(client, training=part(client.training), validation=part(client.validation), long=part(client.long))


def heterogeneous(
    fleet: Fleet, sensors: Sequence[Sensors], shares: Sequence[float], **options: Any
) -> tuple[Client, ...]:
    """`clients` of a fleet, each with its own sensors and with a part of its training pieces.

    The noise of a vehicle is keyed by its name: it is the same as with these sensors for all.

    Args:
        fleet: drives of C vehicles.
        sensors: (C,) acting sensors.
        shares: (C,) in (0, 1], of the training pieces: the first ceil(share n) of them remain.
        options: of `clients` (seed, noise, start, piece, split).

    Raises:
        InputError: another number of sensors or shares than of vehicles, a share outside (0, 1], and as in `clients`.

    >>> import numpy as np
    >>> line = Fleet(("a", "b"), np.arange(66) / 10, np.zeros((66, 2, 3)), np.zeros((66, 2, 3)))
    >>> [len(c.training) for c in heterogeneous(line, [Sensors(), Sensors()], [1, 0.5], piece=10)]
    [4, 2]
    """
    for field, given in (("sensors", sensors), ("shares", shares)):
        if len(given) != len(fleet.ids):
            raise InputError(field, f"of {len(given)} clients", f"must be of {len(fleet.ids)}", "Give one per vehicle.")
    within("shares", list(shares), all(0 < share <= 1 for share in shares), "in (0, 1]", "1 keeps all training pieces.")
    made = {one: clients(fleet, one, **options) for one in dict.fromkeys(sensors)}
    whole = [made[one][column] for column, one in enumerate(sensors)]
    return tuple(
        replace(client, training=client.training.take(range(math.ceil(share * len(client.training)))))
        for client, share in zip(whole, shares, strict=True)
    )
