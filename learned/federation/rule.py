"""Rule: how a server makes one set of weights from those of its clients, with a state that it keeps between rounds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from torch import Tensor

from coopoc.errors import InputError

from ..training.schedule import Schedule

Combine = Callable[[Tensor, Tensor, Tensor], Tensor]
State = tuple[Tensor, ...]


class Rule(ABC):
    """theta, state <- rule(state, theta, weights, sizes, uncertainty): how the server combines what the clients send.

    A rule holds its parameters and nothing else; what it remembers from round to round is in its state.
    """

    @property
    def name(self) -> str:
        """What to call it in messages."""
        return repr(self)

    @property
    def least(self) -> int:
        """Fewest clients that it can combine."""
        return 1

    def overhead(self, clients: int, parameters: int) -> tuple[int, int]:
        """Bytes that each of so many clients sends and receives in a round beyond the weights themselves."""
        return 0, 0

    def start(self, theta: Tensor) -> State:
        """State before the first round, with weights theta (P,)."""
        return ()

    def local(self, schedule: Schedule) -> Schedule:
        """The clients' schedule as this rule wants it."""
        return schedule

    @abstractmethod
    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """New weights (P,) and state from the clients' weights (C, P), pieces (C,) and validation losses (C,) m^2."""


def within(field: str, value: object, good: bool, allowed: str) -> None:
    if not good:
        raise InputError(field, value, f"must be {allowed}", "The docstring of the rule names its source.")
