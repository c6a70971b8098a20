"""Participation: who is asked in a round, who answers and who finishes; clients that differ, and one that lies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from torch import Tensor

from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.noise import stream
from coopoc.world.sensors import Sensors

from ..training.clients import Client, Pieces, clients


class Turn(NamedTuple):
    """What becomes of a client in a round: the share of its local steps that it makes, and why it does not answer.

    `asked` clients receive the weights; `absent` is None for those that answer.
    """

    asked: bool
    share: float
    absent: str | None


@dataclass(frozen=True)
class Participation:
    """Who takes part in a round, drawn anew for every round and client from the training seed.

    Args:
        share: of the clients that the server asks, at least one. dropout: probability that a client that was asked
            never answers. straggle: probability that one that answers has made only a part of its local steps, a
            uniformly drawn share of them and at least one.

    Raises:
        InputError: a number outside its range.

    Source: McMahan et al., AISTATS 2017 (the share C); Li et al., MLSys 2020 (partial work counts).

    >>> [turn.asked for turn in Participation(share=0.5).turns(0, 1, ["a", "b"])].count(True)
    1
    """

    share: float = 1.0
    dropout: float = 0.0
    straggle: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise InputError("share", self.share, "must be in (0, 1]", "1 asks everybody.")
        for field in ("dropout", "straggle"):
            if not 0 <= getattr(self, field) <= 1:
                raise InputError(field, getattr(self, field), "must be in [0, 1]", "0 for never.")

    def count(self, clients: int) -> int:
        """How many of so many clients are asked in a round."""
        return max(1, round(self.share * clients))

    def turns(self, seed: int, number: int, names: Sequence[str]) -> list[Turn]:
        """What becomes of every named client in round `number`, whatever the order of the names."""
        lots = {name: float(stream(seed, "asked", number, name).random()) for name in names}
        asked = set(sorted(names, key=lots.__getitem__)[: self.count(len(names))])
        return [self._turn(seed, number, name) if name in asked else Turn(False, 0.0, "not asked") for name in names]

    def _turn(self, seed: int, number: int, name: str) -> Turn:
        lots = stream(seed, "answer", number, name).random(3)
        if lots[0] < self.dropout:
            return Turn(True, 0.0, "asked, but did not answer")
        return Turn(True, float(1.0 - lots[2]) if lots[1] < self.straggle else 1.0, None)

    def answer(self, name: str, number: int, theta: Tensor, weights: Tensor) -> Tensor:
        """What the server receives from a client that made `weights` (P,) of theta (P,): an honest answer."""
        return weights


@dataclass(frozen=True)
class Poison(Participation):
    """Participation in which some clients send their update times `scale`: theta + scale (theta_i - theta).

    Args:
        who: names of the liars. scale: negative turns the update round. The rest as in `Participation`.

    Source: Blanchard et al., NeurIPS 2017, section 5 (omniscient and Gaussian attackers); Bagdasaryan et al.,
    How to Backdoor Federated Learning, AISTATS 2020 (scaled updates).

    >>> import torch
    >>> Poison(who=("a",), scale=-2.0).answer("a", 1, torch.ones(1), torch.tensor([2.0])).tolist()
    [-1.0]
    """

    who: tuple[str, ...] = ()
    scale: float = -10.0

    def answer(self, name: str, number: int, theta: Tensor, weights: Tensor) -> Tensor:
        """Scaled if the client lies."""
        return theta + self.scale * (weights - theta) if name in self.who else weights


def moved(client: Client, offset: float) -> Client:
    """The client with a truth that lies `offset` m beside the true one on every axis: poisoned data."""

    def part(pieces: Pieces) -> Pieces:
        return replace(pieces, truth=pieces.truth + offset)

    return replace(client, training=part(client.training), validation=part(client.validation), long=part(client.long))


def unlike(fleet: Fleet, sensors: Sequence[Sensors], shares: Sequence[float], **options: Any) -> tuple[Client, ...]:
    """`clients` of a fleet, each with its own sensors and with a part of its training pieces.

    The noise of a vehicle is keyed by its name: it is the same as with these sensors for all.

    Args:
        fleet: drives of C vehicles. sensors: (C,) that act. shares: (C,) in (0, 1] of the training pieces, the first
            ceil(share n) of them. options: of `clients` (seed, noise, start, piece, split).

    Raises:
        InputError: as many sensors or shares as there are not vehicles, a share outside (0, 1], and as in `clients`.

    >>> import numpy as np
    >>> line = Fleet(("a", "b"), np.arange(66) / 10, np.zeros((66, 2, 3)), np.zeros((66, 2, 3)))
    >>> [len(c.training) for c in unlike(line, [Sensors(), Sensors()], [1, 0.5], piece=10)]
    [4, 2]
    """
    for field, given in (("sensors", sensors), ("shares", shares)):
        if len(given) != len(fleet.ids):
            raise InputError(field, f"of {len(given)} clients", f"must be of {len(fleet.ids)}", "Give one per vehicle.")
    if not all(0 < share <= 1 for share in shares):
        raise InputError("shares", list(shares), "must be in (0, 1]", "1 keeps all training pieces.")
    made = {one: clients(fleet, one, **options) for one in dict.fromkeys(sensors)}
    found = []
    for column, (one, share) in enumerate(zip(sensors, shares, strict=True)):
        whole = made[one][column]
        kept = range(math.ceil(share * len(whole.training)))
        found.append(replace(whole, training=whole.training.take(kept)))
    return tuple(found)
