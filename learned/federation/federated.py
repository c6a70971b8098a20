"""federate: adapt on every client, combine at a server or with neighbours, for some rounds."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from coopoc.errors import InputError

from ..nets.gain import Gain
from ..nets.stack import flatten
from ..training.clients import Client
from ..training.machine import one_core, watched
from ..training.schedule import Epoch, Schedule
from .aggregate import rule
from .compression import Compression
from .history import Federation, Round, ledger
from .local import Work, adapt, everyone, local_fit
from .participation import Participation, Turn
from .rule import Combine, Rule
from .server import SERVER, Answer, Exchange, Group, Protection, Server, Standing, combine
from .topology import Mesh, Topology, connected, disagreement

__all__ = ["Answer", "Federation", "Round", "adapt", "combine", "federate", "federate_many", "ledger", "local_fit"]


def federate(
    model: Gain,
    clients: Sequence[Client],
    rounds: int = 20,
    aggregate: str | Rule | Combine = "mean",
    local_epochs: int = 5,
    seed: int = 0,
    schedule: Schedule | None = None,
    progress: str | None = None,
    epoch: Epoch = "pass",
    *,
    participation: Participation | None = None,
    compression: Compression | None = None,
    privacy: Protection | None = None,
    topology: Topology | None = None,
) -> Federation:
    """FedKalmanNet: each round every client adapts the global net on its own pieces, and the server combines them.

    theta_i = fit(theta_g, D_i);  theta_g = sum_i a_i theta_i. A local epoch is a pass over the client's own pieces, as
    in FedAvg; the optimiser starts anew each round and its rate falls over all rounds. Only weights (and one validation
    loss per client) are sent. An answer that cannot be right is rejected with a reason and training goes on.

    Args:
        model: the start, not changed. clients: their data. rounds: M. aggregate: rule by name, a `Rule` or function.
        local_epochs: E per round. seed: of the order of the batches. schedule: batch, rate, decay, clip.
        progress: name of the stage for a progress bar on stderr, None for no bar.
        epoch: "pass" through the client's pieces, or "step", one optimiser step as KalmanNet's loop counts.
        participation: who takes part in a round; default all. compression: of what clients send. privacy: of it, too.
        topology: train without a server, each client mixing its weights with those of its neighbours; with neither
            rule, compression nor privacy.

    Raises:
        InputError: a rule that takes more clients than there are, two clients of one name, clients that the topology
            leaves apart, or options that exclude each other.

    Source: arXiv 2411.05847, algorithm 1; McMahan et al., AISTATS 2017, for E.

    >>> from coopoc.learned import GainNet, clients
    >>> from coopoc.world.fleet import Fleet
    >>> t = torch.arange(33) / 10
    >>> line = Fleet(("a",), t, torch.zeros(33, 1, 3), torch.zeros(33, 1, 3))
    >>> federate(GainNet(), clients(line, piece=10), rounds=1, local_epochs=1).history[1].sent_bytes
    79756
    """
    return federate_many(
        [model], [clients], [seed], rounds, aggregate, local_epochs, schedule, progress, epoch,
        participation=participation, compression=compression, privacy=privacy, topology=topology,
    )[0]  # fmt: skip


@one_core()
def federate_many(
    models: Sequence[Gain],
    groups: Sequence[Sequence[Client]],
    seeds: Sequence[int],
    rounds: int = 20,
    aggregate: str | Rule | Combine = "mean",
    local_epochs: int = 5,
    schedule: Schedule | None = None,
    progress: str | None = None,
    epoch: Epoch = "pass",
    *,
    participation: Participation | None = None,
    compression: Compression | None = None,
    privacy: Protection | None = None,
    topology: Topology | None = None,
) -> list[Federation]:
    """`federate` for many independent federations in one rollout."""
    for name, value in (("rounds", rounds), ("local_epochs", local_epochs)):
        if value < 1:
            raise InputError(name, value, "must be >= 1", "The paper has 20 rounds.")
    began, chosen, presence = time.perf_counter(), rule(aggregate), participation or Participation()
    local = chosen.local(replace(schedule or Schedule(), epochs=local_epochs, epoch=epoch))
    teams = [_group(group, seed) for group, seed in zip(groups, seeds, strict=True)]
    steps = [_server(team, aggregate, presence, compression, privacy) if topology is None
             else _mesh(team, aggregate, presence, compression, privacy, topology) for team in teams]  # fmt: skip
    clients = everyone(models[0], groups, teams)
    standings = [_start(theta, team, chosen) for theta, team in zip(flatten(models), teams, strict=True)]
    reports = clients.judged(standings)
    histories = [[Round(0, s.theta, (math.nan,) * len(said), said)] for s, said in zip(standings, reports, strict=True)]
    for number in watched(range(1, rounds + 1), progress, "round"):
        turns = [presence.turns(team.seed, number, team.names) for team in teams]
        local_work = clients.adapted(standings, turns, number, rounds, local)
        moved = []
        for i, (advance, team, work) in enumerate(zip(steps, teams, local_work, strict=True)):
            standings[i], exchange = advance(team, standings[i], number, turns[i], work.weights, reports[i])
            moved.append(exchange)
        reports = clients.judged(standings)
        for history, *rest in zip(histories, teams, standings, turns, local_work, moved, reports, strict=True):
            history.append(_row(history[-1], *rest))
    seconds = (time.perf_counter() - began) / len(groups)
    own = [None if topology is None else s.held for s in standings]
    return [_chosen(models[0], *rest, seconds, privacy is not None) for rest in zip(histories, teams, own, strict=True)]


def _group(clients: Sequence[Client], seed: int) -> Group:
    names = tuple(client.name for client in clients)
    if len(set(names)) < len(names) or SERVER in names:
        raise InputError("clients", names, f"must have names of their own, and none {SERVER!r}", "Rename the vehicles.")
    return Group(names, tuple(len(client.training) for client in clients), seed)


def _start(theta: Tensor, team: Group, chosen: Rule) -> Standing:
    held = theta.expand(len(team.names), -1)
    return Standing(theta, held, chosen.start(theta), torch.zeros_like(held), (None,) * len(team.names))


def _server(
    team: Group, aggregate: str | Rule | Combine, presence: Participation, compression: Compression | None,
    privacy: Protection | None,
) -> Server:  # fmt: skip
    """The server of a federation; InputError if its rule takes more clients than are asked, or has no privacy."""
    chosen, asked = rule(aggregate), presence.count(len(team.names))
    if asked < chosen.least:
        given, allowed = f"{chosen.name} with {asked} clients a round", f"takes at least {chosen.least}"
        raise InputError("aggregate", given, allowed, "Ask more clients, or take the median.")
    if privacy is not None:
        privacy.check(aggregate)
    return Server(chosen, presence, compression, privacy)


def _mesh(
    team: Group, aggregate: str | Rule | Combine, presence: Participation, compression: Compression | None,
    privacy: Protection | None, topology: Topology,
) -> Mesh:  # fmt: skip
    """The graph of a federation; InputError for what needs a server."""
    if aggregate != "mean":
        mend = "Neighbours mix by Metropolis weights."
        raise InputError("aggregate", aggregate, 'must be "mean" with a topology', mend)
    for name, given in (("compression", compression), ("privacy", privacy)):
        if given is not None:
            allowed = "must be None with a topology: an update is of use only to who knows what it starts from"
            raise InputError(name, given, allowed, "Train with a server.")
    return Mesh(connected(topology, team.names), presence)


def _row(
    before: Round, team: Group, standing: Standing, turns: Sequence[Turn], work: Work, moved: Exchange,
    reports: Sequence[float],
) -> Round:  # fmt: skip
    """The next row of a history."""
    rejected = work.broken | moved.rejected
    there = list(zip(team.names, turns, strict=True))
    counted = [turn.absent is None and name not in rejected for name, turn in there]
    said = [new if good else old for new, old, good in zip(reports, before.validation_loss, counted, strict=True)]
    return Round(
        before.number + 1, standing.theta, work.losses, tuple(said), moved.traffic, rejected,
        {name: turn.absent for name, turn in there if turn.absent is not None},
        {name: f"made {turn.share:.0%} of its local steps" for name, turn in there if 0 < turn.share < 1},
        moved.note, disagreement(standing.held),
    )  # fmt: skip


def _chosen(
    like: Gain, history: Sequence[Round], team: Group, own: Tensor | None, seconds: float, last: bool
) -> Federation:
    """The federation with the weights of its best round; under privacy of its last: losses are sent in the clear."""
    federation = Federation(like, tuple(history), team.sizes, seconds, team.names, own)
    return replace(federation, model=federation.after(len(history) - 1 if last else federation.best.number))
