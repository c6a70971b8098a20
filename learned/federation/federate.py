"""Federated training: local training on every client and aggregation at a server, for some rounds."""

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

from coopoc.arrays import check_fields, instance, listed
from coopoc.errors import InputError, shown
from coopoc.plugins import find

from ..nets.gain import Gain
from ..nets.stack import flatten
from ..training.clients import Client
from ..training.machine import one_core, watched
from ..training.schedule import STEPS, Schedule
from .combine import FLOAT32, SERVER, Answer, Standing, combine
from .history import Federation, Round
from .local import Group, Work, stacked
from .participation import Participation
from .rules import Combine, Rule, rule


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
    schedule: Schedule = Schedule()
    participation: Participation = Participation()

    def __post_init__(self) -> None:
        check_fields(self, {"rounds": STEPS, "local_epochs": STEPS})

    @property
    def rule(self) -> Rule:
        """The aggregation rule."""
        return rule(self.aggregate)

    @property
    def local(self) -> Schedule:
        """Schedule of a client's round."""
        return replace(self.schedule, epochs=self.local_epochs, epoch="pass")

    def check(self, clients: int) -> None:
        """InputError for a rule that needs more clients than a round asks."""
        chosen, asked = self.rule, self.participation.count(clients)
        if asked < chosen.least:
            actual, allowed = f"{chosen.name} with {asked} clients a round", f"takes at least {chosen.least}"
            raise InputError("aggregate", actual, allowed, "Ask more clients, or take the median.")


def federate(
    model: str | Gain | type[Gain],
    clients: Sequence[Client],
    rounds: int = 20,
    aggregate: str | Rule | Combine = "mean",
    local_epochs: int = 5,
    seed: int = 0,
    schedule: Schedule = Schedule(),
    progress: str | None = None,
    *,
    participation: Participation = Participation(),
) -> Federation:
    """Train one net on many clients: each adapts the global weights on its own pieces, the server combines the results.

    theta_i = fit(theta_g, D_i);  theta_g = sum_i a_i theta_i. A local epoch is a pass over the client's own pieces; the
    optimiser starts anew each round and its rate falls over all rounds. Clients send weights and one validation loss.
    Implausible answers are rejected with a reason and training goes on. The federation says how many Byzantine clients
    its rule tolerates; where more are simulated, a warning does, if it tolerates any.

    Args:
        model: start, not changed: a net, a class of nets, a name in `coopoc.nets` or a path "mine.py:NAME".
        clients: with their data.
        rounds: M.
        aggregate: rule by name or path, a `Rule` or a function.
        local_epochs: E per round.
        seed: of the order of the batches.
        schedule: batch, rate, decay, clip.
        progress: name of the stage for a progress bar on stderr, None for no bar.
        participation: the clients that a round asks; default all.

    Raises:
        InputError: unknown names, a rule that needs more clients, or two clients of one name.

    References:
        arXiv 2411.05847, algorithm 1; McMahan et al., AISTATS 2017.

    >>> import torch
    >>> from coopoc.learned import clients, federate
    >>> from coopoc.world.fleet import Fleet
    >>> t = torch.arange(33) / 10
    >>> line = Fleet(("a",), t, torch.zeros(33, 1, 3), torch.zeros(33, 1, 3))
    >>> federate("gain_net", clients(line, piece=10), rounds=1, local_epochs=1).history[1].sent_bytes
    79756
    """
    chosen_net = find("coopoc.nets", model) if isinstance(model, str) else model
    start = chosen_net() if isinstance(chosen_net, type) else chosen_net
    if not isinstance(start, Gain):
        raise InputError("model", shown(start), "must be a Gain", "Give GainNet(), or its name.")
    plan = Plan(rounds, aggregate, local_epochs, schedule, participation)
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
    began, local, chosen, presence = time.perf_counter(), plan.local, plan.rule, plan.participation
    teams = [_group(group, seed) for group, seed in zip(groups, seeds, strict=True)]
    for team in teams:
        plan.check(len(team.names))
        hostile = len({*team.names} & {*getattr(presence, "names", ())})
        if 0 < (most := chosen.tolerated(presence.count(len(team.names)))) < hostile:
            text = f"{hostile} Byzantine clients of {len(team.names)}: {chosen.name} tolerates {most} a round"
            warnings.warn(text, RuntimeWarning, stacklevel=3)
    stack = stacked(models[0], groups, teams)
    standings = [Standing(theta) for theta in flatten(models)]
    reports = stack.validated([s.theta for s in standings])
    histories = [[Round(0, s.theta, (math.nan,) * len(r), r)] for s, r in zip(standings, reports, strict=True)]
    for number in watched(range(1, plan.rounds + 1), progress, "round"):
        asked = [presence.asked(team.seed, number, team.names) for team in teams]
        done = stack.adapted([s.theta for s in standings], asked, number, plan.rounds, local)
        notes = []
        for i, (team, work) in enumerate(zip(teams, done, strict=True)):
            theta, sizes = standings[i].theta, dict(zip(team.names, team.sizes, strict=True))
            answers = {
                name: Answer(presence.answer(name, theta, weights), sizes[name])
                for name, weights in work.weights.items()
            }
            standings[i], rejected, note = combine(chosen, standings[i], answers)
            notes.append((rejected, note))
        reports = stack.validated([s.theta for s in standings])
        for history, *rest in zip(histories, teams, standings, asked, done, notes, reports, strict=True):
            history.append(_row(history[-1], *rest))
    seconds = (time.perf_counter() - began) / len(groups)
    federations = []
    for history, team in zip(histories, teams, strict=True):
        most = chosen.tolerated(presence.count(len(team.names)))
        federations.append(Federation(models[0], tuple(history), team.sizes, seconds, team.names, most))
    return federations


def _group(clients: Sequence[Client], seed: int) -> Group:
    hint = "Give what learned.clients(...) returns."
    names = tuple(instance("clients", client, Client, hint).name for client in listed("clients", clients, hint))
    if not names:
        raise InputError("clients", "none", "must be at least one", hint)
    if len(set(names)) < len(names) or SERVER in names:
        raise InputError("clients", names, f"must have distinct names, none of them {SERVER!r}", "Rename the vehicles.")
    return Group(names, tuple(len(client.training) for client in clients), seed)


def _row(
    before: Round,
    team: Group,
    standing: Standing,
    asked: frozenset[str],
    work: Work,
    outcome: tuple[dict[str, str], str],
    reports: Sequence[float],
) -> Round:
    """The next row of a history; a client whose answer does not count keeps its last validation loss."""
    rejected, size = work.failed | outcome[0], FLOAT32 * len(standing.theta)
    last = [
        new if name in asked and name not in rejected else old
        for name, new, old in zip(team.names, reports, before.validation_loss, strict=True)
    ]
    return Round(
        before.number + 1,
        standing.theta,
        work.losses,
        tuple(last),
        dict.fromkeys(work.weights, size + FLOAT32),
        {name: size for name in team.names if name in asked},
        rejected,
        {name: "not asked" for name in team.names if name not in asked},
        outcome[1],
    )
