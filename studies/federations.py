"""Federations of the aggregation study: equal, heterogeneous, poisoned and absent clients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from coopoc.errors import InputError
from coopoc.methods.noise_model import NoiseModel
from coopoc.study.study import Params
from coopoc.world.fleet import Fleet
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import scene

if TYPE_CHECKING:
    from coopoc.learned.federation.participation import Participation
    from coopoc.learned.training.clients import Client

RULES = (
    "mean",
    "uniform",
    "fedavgm",
    "fedadam",
    "median",
    "trimmed_mean",
    "krum",
    "multi_krum",
)
CONDITIONS = {
    "iid": "equal sensors, equal amounts of data",
    "heterogeneous": "GNSS 1, 1.5, 2.5, 4 m times velocity 5, 10, 20 %, all, two thirds or one third of the pieces",
    "poisoned update": "one client sends its update times a negative factor",
    "poisoned data": "one client's reference drive lies beside the true one",
    "half absent": "half of the clients are asked, drawn anew in every round",
}
GNSS_STD, VELOCITY_RATIO, SHARES = (1.0, 1.5, 2.5, 4.0), (0.05, 0.10, 0.20), (1.0, 2 / 3, 1 / 3)


def members(p: Params) -> Fleet:
    """The vehicles that train: a number of the fleet of clients, evenly spaced."""
    fleet, count = scene.fleet(p["clients"]), int(p["members"])
    if not 2 <= count <= len(fleet.ids):
        raise InputError("members", count, f"must be 2..{len(fleet.ids)}, the vehicles of the fleet", "Take fewer.")
    return fleet.select([int(k) for k in np.arange(count) * len(fleet.ids) // count])


def noise(p: Params) -> list[Sensors]:
    """Noise of each client: the paper's training noise, or one pair of sensors after the other."""
    paper = replace(Sensors.paper_training(), velocity_reading=p["velocity_reading"])
    count = int(p["members"])
    if p["condition"] != "heterogeneous":
        return [paper] * count
    kinds = [(gnss, ratio) for ratio in VELOCITY_RATIO for gnss in GNSS_STD]
    return [replace(paper, gnss_std=(kinds[i % 12][0],) * 3, velocity_std_ratio=kinds[i % 12][1]) for i in range(count)]


def clients(p: Params, seed: int) -> tuple[Client, ...]:
    """The clients of a condition for one training seed; the one in the middle is the poisoned one."""
    from coopoc.learned.federation.participation import heterogeneous, poisoned

    count = int(p["members"])
    amounts = [SHARES[i % 3] if p["condition"] == "heterogeneous" else 1.0 for i in range(count)]
    found = list(heterogeneous(members(p), noise(p), amounts, seed=seed, piece=int(p["piece"])))
    if p["condition"] == "poisoned data":
        found[count // 2] = poisoned(found[count // 2], float(p["offset_m"]))
    return tuple(found)


def participation(p: Params) -> Participation:
    """Participation and Byzantine clients under a condition."""
    from coopoc.learned.federation.participation import Byzantine, Participation

    if p["condition"] == "poisoned update":
        return Byzantine(names=(members(p).ids[int(p["members"]) // 2],), scale=-float(p["factor"]))
    return Participation(share=0.5 if p["condition"] == "half absent" else 1.0)


def fitted(p: Params) -> NoiseModel:
    """Noise model fitted to the recordings of all clients with training seed 0."""
    fleet, acting = members(p), noise(p)
    seen = {one: observe(fleet, one, V2X(0), seed=0) for one in dict.fromkeys(acting)}
    gnss, velocity = (
        np.stack([getattr(seen[one], name)[:, :, i] for i, one in enumerate(acting)], axis=2)
        for name in ("gnss", "velocity")
    )
    return NoiseModel.fitted(replace(seen[acting[0]], gnss=gnss, velocity=velocity), fleet)


class Trained(NamedTuple):
    """A net of one training seed: the kept one, that of the last round, and the columns of its rows: kB of a client,
    rejected answers, rounds without change, seconds."""

    kept: Any
    last: Any
    costs: Mapping[str, float]


@lru_cache(maxsize=2)
def trained(condition: str, method: str, given: tuple[tuple[str, Any], ...]) -> tuple[Trained, ...]:
    """All training seeds of a method under a condition, in one rollout."""
    from coopoc.learned import GainNet

    p = {**dict(given), "condition": condition, "method": method}
    seeds = range(int(p["train_seeds"]))
    nets = [GainNet(int(p["in_mult"]), int(p["out_mult"]), seed=seed) for seed in seeds]
    groups = [clients(p, seed) for seed in seeds]
    return _pooled(p, nets, groups) if method == "centralised" else _federated(p, nets, groups)


def _federated(p: Params, nets: Sequence[Any], groups: Sequence[Sequence[Client]]) -> tuple[Trained, ...]:
    from coopoc.learned.federation.federate import Plan, federate_many

    plan = Plan(int(p["rounds"]), p["method"], int(p["local_epochs"]), participation=participation(p))
    done = federate_many(nets, groups, range(len(nets)), plan)
    return tuple(
        Trained(
            fed.model,
            fed.after(len(fed.history) - 1),
            {
                "sent_kb": sum(row.sent_bytes for row in fed.history) / len(fed.names) / 1e3,
                "received_kb": sum(row.received_bytes for row in fed.history) / len(fed.names) / 1e3,
                "rejected": sum(len(row.rejected) for row in fed.history),
                "idle_rounds": sum(row.note != "" for row in fed.history),
                "train_seconds": fed.seconds,
            },
        )
        for fed in done
    )


def _pooled(p: Params, nets: Sequence[Any], groups: Sequence[Sequence[Client]]) -> tuple[Trained, ...]:
    """Nets trained on all pieces in one place; the clients send their drives, six float32 a step, and get the net."""
    from coopoc.learned.nets.stack import flatten, unflatten
    from coopoc.learned.training.clients import Segments
    from coopoc.learned.training.fit import Task, fit_many
    from coopoc.learned.training.schedule import Schedule

    def all_(group: Sequence[Client], part: str) -> Segments:
        return Segments.join([getattr(client, part) for client in group])

    tasks = [
        Task(net, all_(g, "training"), all_(g, "validation"), seed, long=all_(g, "long"))
        for seed, (net, g) in enumerate(zip(nets, groups, strict=True))
    ]
    costs = {
        "sent_kb": 4.0 * 6 * float(members(p).present.sum(axis=0).mean()) / 1e3,
        "received_kb": 4.0 * flatten(nets[:1]).numel() / 1e3,
        "rejected": 0,
        "idle_rounds": 0,
    }
    return tuple(
        Trained(
            fit.model,
            unflatten(fit.history[-1].weights[None], fit.model)[0],
            {**costs, "train_seconds": fit.seconds},
        )
        for fit in fit_many(tasks, Schedule(epochs=int(p["steps"])))
    )
