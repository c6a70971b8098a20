"""The two ends of a round: how a client's weights leave it, and what the server makes of all that arrive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from coopoc.world.noise import stream

from .compression import Compression
from .guard import screen
from .participation import Participation, Turn
from .rule import Rule, State

SERVER = "server"
"""The server's name in the traffic of a round."""
NUMBER = 4
"""Bytes of a float32."""
NOBODY = "nobody answered: the weights stay"


class Protection(Protocol):
    """What hides a client's update before it leaves (privacy)."""

    def protect(self, updates: Tensor, names: Sequence[str], seed: int, number: int) -> Tensor:
        """Updates (C, P) as they leave the named clients in round `number`."""

    def check(self, rule: Any) -> None:
        """InputError for a rule that it cannot serve."""


class Answer(NamedTuple):
    """What the server has of a client: its weights (P,), its training pieces, and the validation loss, m^2, that the
    weights which it received had on its own pieces."""

    weights: Tensor
    size: int
    uncertainty: float


class Combined(NamedTuple):
    """Weights (P,) and state of the rule after a round, reasons of the answers that were rejected, the usual change
    (`guard.screen`), and why the weights stayed, if they did."""

    theta: Tensor
    state: State
    rejected: dict[str, str]
    usual: float | None
    note: str


def combine(
    rule: Rule, state: State, theta: Tensor, answers: Mapping[str, Answer], usual: float | None = None
) -> Combined:
    """The server's half of a round: screen the answers, then combine what is left, in the order of the names.

    Args:
        rule: how, and its state. theta: (P,) weights that the clients received. answers: by name, in any order.
        usual: what the last round gave; None at first.

    >>> from coopoc.learned.federation.aggregate import RULES
    >>> two = {"b": Answer(torch.tensor([3.0]), 1, 1.0), "a": Answer(torch.tensor([torch.nan]), 3, 1.0)}
    >>> done = combine(RULES["mean"], (), torch.tensor([2.0]), two)
    >>> done.theta.tolist(), done.rejected
    ([3.0], {'a': '1 of 1 weights are not finite'})
    """
    rejected, usual = screen(theta, {name: answer.weights for name, answer in answers.items()}, usual)
    kept = [answers[name] for name in sorted(answers) if name not in rejected]
    if not answers:
        return Combined(theta, state, rejected, usual, NOBODY)
    if len(kept) < rule.least:
        note = f"{len(kept)} answers count, {rule.name} takes at least {rule.least}: the weights stay"
        return Combined(theta, state, rejected, usual, note)
    weights = torch.stack([answer.weights for answer in kept])
    sizes, uncertainty = (torch.tensor([answer[i] for answer in kept]) for i in (1, 2))
    theta, state = rule(state, theta, weights, sizes, uncertainty)
    return Combined(theta, state, rejected, usual, "")


class Group(NamedTuple):
    """The clients of a federation: names, training pieces of each, and the seed of all draws."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    seed: int


@dataclass(frozen=True, eq=False)
class Standing:
    """What a federation remembers from round to round.

    Args:
        theta: (P,) its weights: the server's, or without one the mean of the clients'. held: (C, P) weights that each
            client starts from. state: of the rule. kept: (C, P) what compression kept back.
        usual: usual change (`guard.screen`) as the server, or without one each client, has seen it.
    """

    theta: Tensor
    held: Tensor
    state: State
    kept: Tensor
    usual: tuple[float | None, ...]


class Exchange(NamedTuple):
    """What a round moved: reasons of rejected answers, bytes by (sender, receiver), why the weights stayed."""

    rejected: dict[str, str]
    traffic: dict[tuple[str, str], int]
    note: str


@dataclass(frozen=True, eq=False)
class Server:
    """One round with a server: clients protect, compress and send; the server decodes, screens and combines."""

    rule: Rule
    participation: Participation
    compression: Compression | None
    privacy: Protection | None

    def __call__(
        self, group: Group, standing: Standing, number: int, turns: Sequence[Turn], adapted: Mapping[str, Tensor],
        reports: Sequence[float],
    ) -> tuple[Standing, Exchange]:  # fmt: skip
        """Standing after round `number` and what it moved.

        Args:
            turns: (C,) of the clients. adapted: weights (P,) of those that trained, by name. reports: (C,) m^2.
        """
        theta = standing.theta
        sent, kept, size = self._leave(group, standing, number, adapted)
        asked = [name for name, turn in zip(group.names, turns, strict=True) if turn.asked]
        up, down = self.rule.overhead(max(len(asked), self.rule.least), len(theta))
        traffic = {(SERVER, name): NUMBER * len(theta) + down for name in asked}
        traffic |= {(name, SERVER): bytes_ + NUMBER + up for name, bytes_ in size.items()}
        answers = {
            name: Answer(self.participation.answer(name, number, theta, sent[name]), pieces, loss)
            for name, pieces, loss in zip(group.names, group.sizes, reports, strict=True) if name in sent
        }  # fmt: skip
        done = combine(self.rule, standing.state, theta, answers, standing.usual[0])
        held = done.theta.expand_as(standing.held)
        after = Standing(done.theta, held, done.state, kept, (done.usual,))
        return after, Exchange(done.rejected, traffic, done.note)

    def _leave(
        self, group: Group, standing: Standing, number: int, adapted: Mapping[str, Tensor]
    ) -> tuple[dict[str, Tensor], Tensor, dict[str, int]]:
        """Weights as the server decodes them, what clients keep back, and the bytes of each answer."""
        theta, names = standing.theta, [name for name in group.names if name in adapted]
        weights, kept = dict(adapted), standing.kept
        if self.privacy is not None and names:
            updates = torch.stack([adapted[name] - theta for name in names])
            hidden = self.privacy.protect(updates, names, group.seed, number)
            weights = {name: theta + update for name, update in zip(names, hidden, strict=True)}
        if self.compression is None:
            return weights, kept, dict.fromkeys(names, NUMBER * len(theta))
        kept, size = kept.clone(), dict[str, int]()
        for name in names:
            row, draw = group.names.index(name), stream(group.seed, "compress", number, name)
            payload, kept[row] = self.compression.encode(weights[name] - theta, kept[row], draw)
            weights[name] = theta + self.compression.decode(payload, len(theta)).to(theta.dtype)
            size[name] = len(payload)
        return weights, kept, size
