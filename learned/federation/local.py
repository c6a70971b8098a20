"""The clients' half of a round: local training."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from coopoc.world.sensors import stream

from ..nets.gain import Gain
from ..training.clients import Client
from ..training.fit import descend, pooled
from ..training.machine import one_core
from ..training.schedule import Schedule, cosine, generator


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
        client.name: Trained(weights[r], math.nan, stopped[r])
        if r in stopped
        else Trained(weights[r], float(losses[r, : len(plans[r])].mean()))
        for r, client in enumerate(clients)
    }
