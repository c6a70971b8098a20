"""The server's half of a round: decoding, screening and aggregation of the clients' answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from coopoc.errors import InputError
from coopoc.world.sensors import stream

from .compression import Compression
from .guard import screen
from .participation import Participation, Turn
from .rule import Rule, State

SERVER = "server"
"""The server's name in the traffic of a round."""
FLOAT32 = 4
"""Bytes of a float32."""
NO_ANSWER = "no client answered: weights unchanged"


class Protection(Protocol):
    """A transformation of updates before they leave their clients (privacy)."""

    def protect(self, updates: Tensor, names: Sequence[str], seed: int, number: int) -> Tensor:
        """Updates (C, P) as they leave the named clients in round `number`."""

    def check(self, rule: Rule) -> None:
        """InputError for a rule that the protection does not cover."""


class Answer(NamedTuple):
    """A client's answer: its weights (P,), its training pieces, and the validation loss, m^2, of the weights that it
    received, on its own pieces."""

    weights: Tensor
    size: int
    uncertainty: float


class Combined(NamedTuple):
    """Weights (P,) and state of the rule after a round, reasons of rejected answers, the usual change
    (`guard.screen`), and the reason why the weights are unchanged, if they are."""

    theta: Tensor
    state: State
    rejected: dict[str, str]
    usual: float | None
    note: str


def combine(
    rule: Rule, state: State, theta: Tensor, answers: Mapping[str, Answer], usual: float | None = None
) -> Combined:
    """The server's half of a round: screen the answers, then combine the accepted ones, in the order of the names.

    Weights and state are unchanged if too few answers are accepted, or if the result is not finite.

    Args:
        rule: aggregation rule.
        state: of the rule.
        theta: (P,) weights that the clients received.
        answers: by name, in any order.
        usual: of the previous round's result; None at first.

    Raises:
        InputError: a rule whose result has another shape than theta.

    >>> from coopoc.learned.federation.means import FedProx
    >>> two = {"b": Answer(torch.tensor([3.0]), 1, 1.0), "a": Answer(torch.tensor([torch.nan]), 3, 1.0)}
    >>> done = combine(FedProx(), (), torch.tensor([2.0]), two)
    >>> done.theta.tolist(), done.rejected
    ([3.0], {'a': '1 of 1 weights are not finite'})
    """
    rejected, usual = screen(theta, {name: answer.weights for name, answer in answers.items()}, usual)
    while accepted := [name for name in sorted(answers) if name not in rejected]:
        weights = torch.stack([answers[name].weights for name in accepted])
        sizes, uncertainty = (torch.tensor([answers[name][i] for name in accepted]) for i in (1, 2))
        unfit = rule.unfit(theta, weights, sizes)
        if not unfit:
            break
        rejected |= {accepted[row]: reason for row, reason in unfit.items()}
    if not answers:
        return Combined(theta, state, rejected, usual, NO_ANSWER)
    if len(accepted) < max(rule.least, 1):
        note = f"{len(accepted)} answers accepted, {rule.name} takes at least {rule.least}: weights unchanged"
        return Combined(theta, state, rejected, usual, note)
    found, after = rule(state, theta, weights, sizes, uncertainty)
    if found.shape != theta.shape:
        allowed = f"must have the shape {tuple(theta.shape)} of the net's weights"
        raise InputError("aggregate", f"{rule.name} -> {tuple(found.shape)}", allowed, "Combine over the clients only.")
    if not all(bool(part.isfinite().all()) for part in (found, *after)):
        note = f"{rule.name} gives weights that are not finite: weights unchanged"
        return Combined(theta, state, rejected, usual, note)
    return Combined(found.to(theta.dtype), after, rejected, usual, "")


class Group(NamedTuple):
    """The clients of a federation: names, training pieces of each, and the seed of all draws."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    seed: int


@dataclass(frozen=True, eq=False)
class Standing:
    """The state of a federation between two rounds.

    Args:
        theta: (P,) weights of the server, or without one the mean of the clients'.
        held: (C, P) weights from which each client starts.
        state: of the rule.
        residual: (C, P) part of earlier updates that compression has not sent yet.
        usual: usual change (`guard.screen`) at the server, or without one at each client.
    """

    theta: Tensor
    held: Tensor
    state: State
    residual: Tensor
    usual: tuple[float | None, ...]


class Exchange(NamedTuple):
    """Reasons of rejected answers, bytes by (sender, receiver), and why the weights are unchanged, of one round."""

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
        self,
        group: Group,
        standing: Standing,
        number: int,
        turns: Sequence[Turn],
        adapted: Mapping[str, Tensor],
        reports: Sequence[float],
    ) -> tuple[Standing, Exchange]:
        """Standing after round `number`, and its exchange.

        Args:
            group: the clients.
            standing: before the round.
            number: of the round.
            turns: (C,) participation of the clients.
            adapted: weights (P,) after local training, by name.
            reports: (C,) m^2, validation losses.
        """
        theta = standing.theta
        sent, residual, size = self._encoded(group, standing, number, adapted)
        asked = [name for name, turn in zip(group.names, turns, strict=True) if turn.asked]
        up, down = self.rule.overhead(max(len(asked), self.rule.least), len(theta))
        traffic = {(SERVER, name): FLOAT32 * len(theta) + down for name in asked}
        traffic |= {(name, SERVER): bytes_ + FLOAT32 + up for name, bytes_ in size.items()}
        answers = {
            name: Answer(self.participation.answer(name, number, theta, sent[name]), pieces, loss)
            for name, pieces, loss in zip(group.names, group.sizes, reports, strict=True)
            if name in sent
        }
        done = combine(self.rule, standing.state, theta, answers, standing.usual[0])
        held = done.theta.expand_as(standing.held)
        after = Standing(done.theta, held, done.state, residual, (done.usual,))
        return after, Exchange(done.rejected, traffic, done.note)

    def _encoded(
        self, group: Group, standing: Standing, number: int, adapted: Mapping[str, Tensor]
    ) -> tuple[dict[str, Tensor], Tensor, dict[str, int]]:
        """Weights as the server decodes them, residuals of the clients, and the bytes of each answer."""
        theta, names = standing.theta, [name for name in group.names if name in adapted]
        weights, residual = dict(adapted), standing.residual
        if self.privacy is not None and names:
            updates = torch.stack([adapted[name] - theta for name in names])
            protected = self.privacy.protect(updates, names, group.seed, number)
            weights = {name: theta + update for name, update in zip(names, protected, strict=True)}
        if self.compression is None:
            return weights, residual, dict.fromkeys(names, FLOAT32 * len(theta))
        residual, size = residual.clone(), dict[str, int]()
        for name in names:
            row, draw = group.names.index(name), stream(group.seed, "compress", number, name)
            payload, residual[row] = self.compression.encode(weights[name] - theta, residual[row], draw)
            weights[name] = theta + self.compression.decode(payload, len(theta)).to(theta.dtype)
            size[name] = len(payload)
        return weights, residual, size
