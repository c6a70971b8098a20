"""federate: adapt on every client, combine at a server, for some rounds."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from coopoc.arrays import Ints
from coopoc.errors import InputError
from coopoc.world.noise import stream

from .aggregate import Aggregate, rule
from .clients import Client, Pieces
from .gain import Gain
from .machine import one_core, watched
from .schedule import Epoch, Schedule, cosine, generator
from .stack import flatten, unflatten
from .train import Judge, descend, pooled


@dataclass(frozen=True, eq=False)
class Round:
    """A communication round: global weights (P,), losses of each client (C,) m^2, bytes over all clients.

    `validation_loss` is the score of `Judge`: the validation loss, or that of the long pieces if it is larger.
    A client's `training_loss` is NaN and `rejected` names a reason if its local training broke; it then did not count.
    """

    number: int
    weights: Tensor
    training_loss: tuple[float, ...]
    validation_loss: tuple[float, ...]
    sent_bytes: int
    received_bytes: int
    rejected: dict[str, str]


@dataclass(frozen=True, eq=False)
class Federation:
    """A federated net: the global weights that validated best, every round, the shape of the net, seconds."""

    model: Gain
    history: tuple[Round, ...]
    sizes: tuple[int, ...]
    seconds: float

    @property
    def best(self) -> Round:
        """The round whose weights are kept: the least validation loss, clients weighted by their sizes."""
        return min(self.history, key=self.validation_loss)

    def validation_loss(self, row: Round) -> float:
        """Validation loss of a round over all clients, m^2; infinite if it is not finite."""
        total = sum(n * loss for n, loss in zip(self.sizes, row.validation_loss, strict=True)) / sum(self.sizes)
        return total if math.isfinite(total) else math.inf

    def after(self, number: int) -> Gain:
        """The global net after round `number`, 0 being the start."""
        if not 0 <= number < len(self.history):
            raise InputError("round", number, f"must be in 0..{len(self.history) - 1}", "See history.")
        return unflatten(self.history[number].weights[None], self.model)[0]


def federate(
    model: Gain,
    clients: Sequence[Client],
    rounds: int = 20,
    aggregate: str | Aggregate = "mean",
    local_epochs: int = 5,
    seed: int = 0,
    schedule: Schedule | None = None,
    progress: str | None = None,
    epoch: Epoch = "pass",
) -> Federation:
    """FedKalmanNet: each round every client adapts the global net on its own pieces, and the server combines them.

    theta_i = fit(theta_g, D_i);  theta_g = sum_i a_i theta_i. A local epoch is a pass over the client's own pieces, as
    in FedAvg; the optimiser starts anew each round and its rate falls over all rounds. Only weights (and one validation
    loss per client) are sent.

    Args:
        model: the start, not changed. clients: their data. rounds: M. aggregate: rule by name or function.
        local_epochs: E per round. seed: of the order of the batches. schedule: batch, rate, decay, clip.
        progress: name of the stage for a progress bar on stderr, None for no bar.
        epoch: "pass" through the client's pieces, or "step", one optimiser step as KalmanNet's loop counts.

    Source: arXiv 2411.05847, algorithm 1; McMahan et al., AISTATS 2017, for E.

    >>> from coopoc.learned import GainNet, clients
    >>> from coopoc.world.fleet import Fleet
    >>> t = torch.arange(33) / 10
    >>> line = Fleet(("a",), t, torch.zeros(33, 1, 3), torch.zeros(33, 1, 3))
    >>> federate(GainNet(), clients(line, piece=10), rounds=1, local_epochs=1).history[1].sent_bytes
    79756
    """
    return federate_many([model], [clients], [seed], rounds, aggregate, local_epochs, schedule, progress, epoch)[0]


@one_core()
def federate_many(
    models: Sequence[Gain],
    groups: Sequence[Sequence[Client]],
    seeds: Sequence[int],
    rounds: int = 20,
    aggregate: str | Aggregate = "mean",
    local_epochs: int = 5,
    schedule: Schedule | None = None,
    progress: str | None = None,
    epoch: Epoch = "pass",
) -> list[Federation]:
    """`federate` for many independent federations in one rollout."""
    for name, value in (("rounds", rounds), ("local_epochs", local_epochs)):
        if value < 1:
            raise InputError(name, value, "must be >= 1", "The paper has 20 rounds.")
    began, combine = time.perf_counter(), rule(aggregate)
    local = replace(schedule or Schedule(), epochs=local_epochs, epoch=epoch)
    everyone = [client for group in groups for client in group]
    keys = [(seed, c.name) for seed, group in zip(seeds, groups, strict=True) for c in group]
    pool, members = pooled([c.training for c in everyone])
    judge = Judge([[c.validation for c in everyone], [c.long for c in everyone]], models[0])
    sizes = [torch.tensor([len(c.training) for c in group]) for group in groups]
    theta = flatten(models)
    copies = torch.tensor([len(group) for group in groups])
    history = [_rows(0, theta, judge(theta.repeat_interleave(copies, 0)), None, {}, groups)]
    for number in watched(range(1, rounds + 1), progress, "round"):
        adapted = theta.repeat_interleave(copies, 0)
        losses, stopped = adapt(adapted, models[0], pool, members, keys, number, rounds, local)
        alive = torch.tensor([i not in stopped for i in range(len(everyone))]).split(copies.tolist())
        parts = zip(theta, adapted.split(copies.tolist()), sizes, alive, strict=True)
        theta = torch.stack([combine(w[ok], n[ok]) if ok.any() else old for old, w, n, ok in parts])
        history.append(_rows(number, theta, judge(theta.repeat_interleave(copies, 0)), losses, stopped, groups))
    seconds = (time.perf_counter() - began) / len(groups)
    return [_chosen(h, n, models[0], seconds) for h, n in zip(zip(*history, strict=True), sizes, strict=True)]


def adapt(
    theta: Tensor,
    like: Gain,
    pool: Pieces,
    members: Sequence[Ints],
    keys: Sequence[tuple[int, str]],
    number: int,
    rounds: int,
    local: Schedule,
) -> tuple[Tensor, dict[int, str]]:
    """Local training of every client in round `number`, in place: a pure function of weights, data and (seed, client).

    Args:
        theta: (S, P). pool, members: the clients' pieces. keys: (seed, client name) of each row.

    Returns:
        Mean training loss (S,) m^2 and the reasons of the rows that broke.
    """
    streams = [stream(seed, "batches", number - 1, name) for seed, name in keys]
    plans = [rows[local.plan(len(rows), draw)] for rows, draw in zip(members, streams, strict=True)]
    span = (number - 1) / rounds, number / rounds
    rates = [local.learning_rate * cosine(len(plan), *span) for plan in plans]
    draws, stopped = [generator(draw) for draw in streams], dict[int, str]()
    losses = [loss for _, loss in descend(theta, like, pool, plans, rates, local, draws, stopped)]
    return torch.stack(losses).nanmean(0), stopped


def _rows(
    number: int,
    theta: Tensor,
    validation: Tensor,
    training: Tensor | None,
    stopped: dict[int, str],
    groups: Sequence[Sequence[Client]],
) -> list[Round]:
    """The round's row of each federation; bytes are float32 weights up and down and one float32 loss up."""
    rows, at = [], 0
    for weights, group in zip(theta, groups, strict=True):
        span = range(at, at + len(group))
        losses = [math.nan if training is None else float(training[i]) for i in span]
        rejected = {group[i - at].name: stopped[i] for i in span if i in stopped}
        down = 4 * len(weights) * len(group) if number else 0
        up = down + 4 * len(group) if number else 0
        rows.append(Round(number, weights.clone(), tuple(losses), tuple(validation[at : span.stop].tolist()), up, down,
                          rejected))  # fmt: skip
        at = span.stop
    return rows


def _chosen(history: Sequence[Round], sizes: Tensor, like: Gain, seconds: float) -> Federation:
    """The federation with the weights of its best round."""
    federation = Federation(like, tuple(history), tuple(sizes.tolist()), seconds)
    return replace(federation, model=federation.after(federation.best.number))
