"""Federated training: some rounds of local training on the clients that are asked, and of aggregation at a server."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from time import perf_counter
from typing import NamedTuple

import torch
from torch import Tensor

from coopoc.arrays import TINY, check_fields, instance, listed
from coopoc.errors import InputError
from coopoc.plugins import find
from coopoc.world.sensors import stream

from ..nets.gain import Gain, flatten
from ..training.clients import Client
from ..training.fit import Judge, descend, pooled
from ..training.schedule import COUNT_LIMITS, Schedule, cosine, generator, one_core, watched
from .history import Federation, Round
from .rules import FLOAT32, SERVER, Answer, Combine, Rule, Standing, combine, implausible, rule


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
        check_fields(self, {"rounds": COUNT_LIMITS, "local_epochs": COUNT_LIMITS})

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


@one_core()
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
    instance("model", start, Gain, "Give GainNet(), or its name.")  # type: ignore[type-abstract]
    began, plan = perf_counter(), Plan(rounds, aggregate, local_epochs, schedule, participation)
    names = _names(clients)
    plan.check(len(names))
    judge = Judge([[client.validation for client in clients], [client.long for client in clients]], start)

    def validated(theta: Tensor) -> tuple[float, ...]:
        return tuple(judge(theta.repeat(len(names), 1)).tolist())

    standing = Standing(flatten([start])[0])
    history = [Round(0, standing.theta, (nan,) * len(names), validated(standing.theta))]
    for number in watched(range(1, plan.rounds + 1), progress, "round"):
        asked = participation.asked(seed, number, names)
        chosen = [client for client in clients if client.name in asked]
        trained = adapt(start, standing.theta, chosen, seed, number, plan.rounds, plan.local)
        answers = {
            client.name: Answer(participation.answer(client.name, standing.theta, own.weights), len(client.training))
            for client, own in zip(chosen, trained.values(), strict=True)
            if not own.failure
        }
        standing, rejected, note = combine(plan.rule, standing, answers)
        rejected = {name: own.failure for name, own in trained.items() if own.failure} | rejected
        reports = list(zip(names, validated(standing.theta), history[-1].validation_loss, strict=True))
        losses = {
            name: why for name, loss, _ in reports if name in asked and (why := implausible("validation-loss", loss))
        }
        rejected = losses | rejected
        size = FLOAT32 * len(standing.theta)
        row = Round(
            number,
            standing.theta,
            tuple(trained[name].loss if name in trained else nan for name in names),
            tuple(new if name in asked and name not in rejected else old for name, new, old in reports),
            dict.fromkeys(answers, size + FLOAT32),
            dict.fromkeys(trained, size),
            rejected,
            {name: "not asked" for name in names if name not in asked},
            note,
        )
        history.append(row)
    sizes, seconds = tuple(len(client.training) for client in clients), perf_counter() - began
    return Federation(start, tuple(history), sizes, seconds, names, [client.training for client in clients])


def _names(clients: Sequence[Client]) -> tuple[str, ...]:
    hint = "Give what learned.clients(...) returns."
    names = tuple(instance("clients", client, Client, hint).name for client in listed("clients", clients, hint))
    if not names:
        raise InputError("clients", "none", "must be at least one", hint)
    if len(set(names)) < len(names) or SERVER in names:
        raise InputError("clients", names, f"must have distinct names, none of them {SERVER!r}", "Rename the vehicles.")
    return names


class Trained(NamedTuple):
    """A client after local training: weights (P,), mean training loss m^2, and why it failed (then the loss is NaN)."""

    weights: Tensor
    loss: float
    failure: str = ""


@one_core()
def adapt(
    model: Gain, theta: Tensor, clients: Sequence[Client], seed: int, number: int, rounds: int, local: Schedule
) -> dict[str, Trained]:
    """Local training of some clients in round `number`, each from the weights theta (P,) and on its own pieces.

    A pure function of weights, data, seed and names: a client gets the same weights alone, bit for bit, for nets whose
    gradients do not depend on the other rows.

    Args:
        model: shape of the net.
        theta: (P,) received weights, not changed.
        clients: with their pieces.
        seed: of the federation.
        number: of the round.
        rounds: in all.
        local: schedule with the local epochs.

    Returns:
        By name, in the order of the clients.
    """
    pool, members = pooled([client.training for client in clients])
    weights, stopped = theta.detach().repeat(len(clients), 1), dict[int, str]()
    streams = [stream(seed, "batches", number - 1, client.name) for client in clients]
    plans = [rows[local.plan(len(rows), draw)] for rows, draw in zip(members, streams, strict=True)]
    rates = [local.learning_rate * cosine(len(plan), (number - 1) / rounds, number / rounds) for plan in plans]
    draws = [generator(draw) for draw in streams]
    losses = torch.stack([loss for _, loss in descend(weights, model, pool, plans, rates, local, draws, stopped)], 1)
    return {
        client.name: Trained(weights[r], nan, stopped[r])
        if r in stopped
        else Trained(weights[r], float(losses[r, : len(plans[r])].mean()))
        for r, client in enumerate(clients)
    }
