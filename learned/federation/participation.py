"""Participation: the clients that a round asks."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from coopoc.arrays import TINY, check_fields
from coopoc.world.sensors import stream


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
        check_fields(self, {"share": (TINY, 1, "in (0, 1], 1 for all clients")})

    def count(self, clients: int) -> int:
        """Number of clients, of so many, that are asked in a round."""
        return max(1, round(self.share * clients))

    def asked(self, seed: int, number: int, names: Sequence[str]) -> frozenset[str]:
        """The clients that are asked in round `number`; they do not depend on the order of the names."""
        lots = {name: float(stream(seed, "asked", number, name).random()) for name in names}
        return frozenset(sorted(names, key=lots.__getitem__)[: self.count(len(names))])

    def answer(self, name: str, theta: Tensor, weights: Tensor) -> Tensor:
        """Weights that the server receives from a client that trained `weights` (P,) from theta (P,): these weights,
        unless a class of yours simulates an attack, as `examples/aggregation.py` does."""
        return weights
