"""federate: local training on every client, aggregation at a server or among neighbours, for some rounds."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import torch
from torch import Tensor

from coopoc.arrays import instance, listed
from coopoc.errors import InputError, shown
from coopoc.methods.options import check_options
from coopoc.plugins import find, one_of

from ..nets.gain import Gain
from ..nets.stack import flatten
from ..training.clients import Client
from ..training.machine import one_core, watched
from ..training.schedule import STEPS, Epoch, Schedule
from .aggregate import rule
from .compression import Compression
from .history import Federation, Round
from .local import Work, stacked
from .participation import Participation, Turn
from .rule import Combine, Rule
from .server import SERVER, Exchange, Group, Protection, Server, Standing
from .topology import Mesh, Topology, connected, disagreement

KINDS = {
    "aggregate": object,  # `rule` says what is none
    "schedule": Schedule,
    "participation": Participation,
    "compression": Compression,
    "topology": Topology,
}


@dataclass(frozen=True)
class Plan:
    """How nets are federated; the arguments of `federate` say what each is.

    Raises:
        InputError: less than one round or local epoch; options that exclude each other.

    >>> Plan(rounds=3).local.epochs
    5
    """

    rounds: int = 20
    aggregate: str | Rule | Combine = "mean"
    local_epochs: int = 5
    schedule: Schedule = field(default_factory=Schedule)
    epoch: Epoch = "pass"
    participation: Participation = field(default_factory=Participation)
    compression: Compression | None = None
    privacy: Protection | None = None
    topology: Topology | None = None

    def __post_init__(self) -> None:
        check_options(self, {"rounds": STEPS, "local_epochs": STEPS}, KINDS)
        one_of("epoch", self.epoch, get_args(Epoch))
        if self.topology is None:
            return
        if self.aggregate != "mean":
            hint = "Neighbours mix by Metropolis weights."
            raise InputError("aggregate", self.aggregate, 'must be "mean" with a topology', hint)
        for name in ("compression", "privacy"):
            if (given := getattr(self, name)) is not None:
                allowed = (
                    "must be None with a topology: the receiver of an update must know the weights it started from"
                )
                raise InputError(name, given, allowed, "Train with a server.")

    @property
    def rule(self) -> Rule:
        """The aggregation rule."""
        return rule(self.aggregate)

    @property
    def local(self) -> Schedule:
        """Schedule of a client's round."""
        return self.rule.local(replace(self.schedule, epochs=self.local_epochs, epoch=self.epoch))

    def step(self, team: Group) -> Server | Mesh:
        """The server or the mesh of a team; InputError for a rule that needs more clients, or that privacy does not
        cover."""
        if self.topology is not None:
            return Mesh(connected(self.topology, team.names), self.participation)
        chosen, asked = self.rule, self.participation.count(len(team.names))
        if asked < chosen.least:
            given, allowed = f"{chosen.name} with {asked} clients a round", f"takes at least {chosen.least}"
            raise InputError("aggregate", given, allowed, "Ask more clients, or take the median.")
        if self.privacy is not None:
            if not callable(getattr(self.privacy, "check", None)):
                raise InputError("privacy", shown(self.privacy), "must be a Privacy", "Give Privacy(...), or None.")
            self.privacy.check(chosen)
        return Server(chosen, self.participation, self.compression, self.privacy)


def federate(
    model: str | Gain | type[Gain],
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
    """Train one net on many clients: each adapts the global weights on its own pieces, the server combines the results.

    theta_i = fit(theta_g, D_i);  theta_g = sum_i a_i theta_i. A local epoch is a pass over the client's own pieces; the
    optimiser starts anew each round and its rate falls over all rounds. Clients send weights and one validation loss.
    Implausible answers are rejected with a reason and training goes on.

    Args:
        model: start, not changed: a net, a class of nets, a name in `coopoc.nets` or a path "mine.py:NAME".
        clients: with their data.
        rounds: M.
        aggregate: rule by name or path, a `Rule` or a function.
        local_epochs: E per round.
        seed: of the order of the batches.
        schedule: batch, rate, decay, clip.
        progress: name of the stage for a progress bar on stderr, None for no bar.
        epoch: "pass" over the client's pieces, or "step", one optimiser step as in KalmanNet's published loop.
        participation: sampling, drop-outs, stragglers; default all clients in all rounds.
        compression: of the clients' updates.
        privacy: protection of the clients' updates.
        topology: train without a server, each client mixing its weights with those of its neighbours; excludes rules,
            compression and privacy.

    Raises:
        InputError: unknown names, a rule that needs more clients, two clients of one name, a graph that is not
            connected, or options that exclude each other.

    References:
        arXiv 2411.05847, algorithm 1; McMahan et al., AISTATS 2017.

    >>> from coopoc.learned import clients, federate
    >>> from coopoc.world.fleet import Fleet
    >>> t = torch.arange(33) / 10
    >>> line = Fleet(("a",), t, torch.zeros(33, 1, 3), torch.zeros(33, 1, 3))
    >>> federate("gain_net", clients(line, piece=10), rounds=1, local_epochs=1).history[1].sent_bytes
    79756
    """
    found = find("coopoc.nets", model) if isinstance(model, str) else model
    start = found() if isinstance(found, type) else found
    if not isinstance(start, Gain):
        raise InputError("model", shown(start), "must be a Gain", "Give GainNet(), or its name.")
    optimiser = Schedule() if schedule is None else schedule
    presence = Participation() if participation is None else participation
    protection = compression, privacy, topology
    plan = Plan(rounds, aggregate, local_epochs, optimiser, epoch, presence, *protection)
    return federate_many([start], [clients], [seed], plan, progress)[0]


@one_core()
def federate_many(
    models: Sequence[Gain],
    groups: Sequence[Sequence[Client]],
    seeds: Sequence[int],
    plan: Plan,
    progress: str | None = None,
) -> list[Federation]:
    """`federate` for many independent federations in one rollout."""
    began, local, presence, meshed = time.perf_counter(), plan.local, plan.participation, plan.topology is not None
    teams = [_group(group, seed) for group, seed in zip(groups, seeds, strict=True)]
    steps = [plan.step(team) for team in teams]
    stack = stacked(models[0], groups, teams)
    standings = [_start(theta, team, plan.rule) for theta, team in zip(flatten(models), teams, strict=True)]
    reports = stack.validated(standings)
    histories = [[Round(0, s.theta, (math.nan,) * len(r), r)] for s, r in zip(standings, reports, strict=True)]
    for number in watched(range(1, plan.rounds + 1), progress, "round"):
        turns = [presence.turns(team.seed, number, team.names) for team in teams]
        local_work = stack.adapted(standings, turns, number, plan.rounds, local)
        exchanges = []
        for i, (step, team, work) in enumerate(zip(steps, teams, local_work, strict=True)):
            standings[i], exchange = step(team, standings[i], number, turns[i], work.weights, reports[i])
            exchanges.append(exchange)
        reports = stack.validated(standings)
        for history, *rest in zip(histories, teams, standings, turns, local_work, exchanges, reports, strict=True):
            history.append(_row(history[-1], *rest))
    seconds = (time.perf_counter() - began) / len(groups)
    own = [s.held if meshed else None for s in standings]
    return [
        _selected(models[0], *rest, seconds, plan.privacy is not None)
        for rest in zip(histories, teams, own, strict=True)
    ]


def _group(clients: Sequence[Client], seed: int) -> Group:
    hint = "Give what learned.clients(...) returns."
    names = tuple(instance("clients", client, Client, hint).name for client in listed("clients", clients, hint))
    if not names:
        raise InputError("clients", "none", "must be at least one", hint)
    if len(set(names)) < len(names) or SERVER in names:
        raise InputError("clients", names, f"must have distinct names, none of them {SERVER!r}", "Rename the vehicles.")
    return Group(names, tuple(len(client.training) for client in clients), seed)


def _start(theta: Tensor, team: Group, chosen: Rule) -> Standing:
    held = theta.expand(len(team.names), -1)
    return Standing(theta, held, chosen.start(theta), torch.zeros_like(held), (None,) * len(team.names))


def _row(
    before: Round,
    team: Group,
    standing: Standing,
    turns: Sequence[Turn],
    work: Work,
    exchange: Exchange,
    reports: Sequence[float],
) -> Round:
    """The next row of a history."""
    rejected = work.failed | exchange.rejected
    named = list(zip(team.names, turns, strict=True))
    counted = [turn.absent is None and name not in rejected for name, turn in named]
    last = [new if good else old for new, old, good in zip(reports, before.validation_loss, counted, strict=True)]
    return Round(
        before.number + 1,
        standing.theta,
        work.losses,
        tuple(last),
        exchange.traffic,
        rejected,
        {name: turn.absent for name, turn in named if turn.absent is not None},
        {name: f"made {turn.share:.0%} of its local steps" for name, turn in named if 0 < turn.share < 1},
        exchange.note,
        disagreement(standing.held),
    )


def _selected(
    like: Gain, history: Sequence[Round], team: Group, own: Tensor | None, seconds: float, last: bool
) -> Federation:
    """The federation with its best round's weights; under privacy its last round's, as losses are sent in the clear."""
    federation = Federation(like, tuple(history), team.sizes, seconds, team.names, own)
    return replace(federation, model=federation.after(len(history) - 1 if last else federation.best.number))
