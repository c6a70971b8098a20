"""Rule: how a server combines its clients' weights, with a state that is carried from round to round."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from torch import Tensor

from coopoc.errors import InputError

from ..training.schedule import Schedule

Combine = Callable[[Tensor, Tensor, Tensor], Tensor]
State = tuple[Tensor, ...]


class Rule:
    """theta, state <- rule(state, theta, weights, sizes, uncertainty).

    A rule holds its parameters and nothing else; what it carries from round to round is in its state. A stateless rule
    overrides `combine`, one with a state `start` and `__call__`.
    """

    @property
    def name(self) -> str:
        """Name in messages."""
        return repr(self)

    @property
    def least(self) -> int:
        """Smallest number of clients that it can combine."""
        return 1

    @property
    def mean_by(self) -> Literal["sizes", "uniform"] | None:
        """Weighting of the clients' mean if the rule depends on nothing else, which secure aggregation needs."""
        return None

    def overhead(self, clients: int, parameters: int) -> tuple[int, int]:
        """Bytes that each of so many clients sends and receives in a round beyond the weights themselves."""
        return 0, 0

    def start(self, theta: Tensor) -> State:
        """State before the first round, with weights theta (P,)."""
        return ()

    def local(self, schedule: Schedule) -> Schedule:
        """The clients' schedule under this rule."""
        return schedule

    def unfit(self, theta: Tensor, weights: Tensor, sizes: Tensor) -> Mapping[int, str]:
        """Reasons, by row of the weights (C, P), of those that the rule cannot take."""
        return {}

    def combine(self, weights: Tensor, sizes: Tensor, uncertainty: Tensor) -> Tensor:
        """New weights (P,) from those of the clients (C, P), their pieces (C,) and validation losses (C,) m^2."""
        raise NotImplementedError(f"{type(self).__name__} defines neither combine nor __call__")

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """New weights (P,) and state; arguments as of `combine`, theta (P,) being what the clients received."""
        return self.combine(weights, sizes, uncertainty), state


def within(field: str, value: object, good: bool, allowed: str, hint: str = "The docstring cites its source.") -> None:
    """InputError for a parameter outside its range."""
    if not good:
        raise InputError(field, value, f"must be {allowed}", hint)
