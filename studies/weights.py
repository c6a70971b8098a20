"""The weights that a study needs: trained once for a setting, found again by everything that changes them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopoc.errors import InputError
from coopoc.methods.knowledge import Knowledge
from coopoc.plugins import unknown
from coopoc.study.study import Params
from coopoc.world.sensing import observe
from coopoc.world.sensors import VelocityReading
from coopoc.world.v2x import V2X

from .scene import Start, fleet, start

if TYPE_CHECKING:
    from coopoc.evaluate.ledger import Ledger
    from coopoc.learned.checkpoint import Checkpoint
    from coopoc.study.results import Results

INDIVIDUAL = tuple(f"individual{client}" for client in range(1, 7))
"""Nets of single clients, of as many as there are, at most six."""
PAPER = ("fedkalmannet", "centralised", *INDIVIDUAL, "okf")
"""What the paper trains, and the fair floor."""
LEARNED = (*PAPER, "fedokf", "magnitude", "split", "recursive", "cooperative")
"""Methods that are trained."""


def seeds(p: Params) -> range:
    """Training seeds of a study."""
    return range(int(p["train_seeds"]))


def trainable(p: Params) -> bool:
    """False for the individual net of a client that is not there."""
    return p["method"] not in INDIVIDUAL[len(fleet(p["clients"]).ids) :]


def label(name: str, p: Params, seed: int) -> str:
    """Name of a checkpoint, such as fedkalmannet-gnss-axis-0."""
    return f"{name}-{start(p)}-{p['velocity_reading']}-{seed}"


def key(name: str, p: Params) -> str:
    """Hash of everything that changes the weights of a method, known before any training."""
    return hashlib.sha256("".join(_key(name, p, seed) for seed in seeds(p)).encode()).hexdigest()


def _key(name: str, p: Params, seed: int) -> str:
    keys = _keys(p["clients"], start(p), p["velocity_reading"], int(p["train_seeds"]))
    if label(name, p, seed) not in keys:
        raise unknown("trained method", name, LEARNED)
    return keys[label(name, p, seed)]


@lru_cache
def _keys(clients: str, begin: Start, reading: VelocityReading, count: int) -> Mapping[str, str]:
    from coopoc.learned.recipes import RECIPES, Setting, jobs_of

    drives = fleet(clients)
    settings = [Setting(seed, begin, reading) for seed in range(count)]
    return {
        job.label: job.key(drives) for setting in settings for name in RECIPES for job in jobs_of(name, setting, drives)
    }


def prepare(cells: Iterable[Params], jobs: int = 1) -> None:
    """Train what the cells need and is not there yet, with progress: `jobs` recipes at a time."""
    from coopoc.learned.recipes import RECIPES, train_all

    wanted: dict[tuple[str, str, int], list[Params]] = {}
    for p in cells:
        if p["method"] in LEARNED:
            wanted.setdefault((p["clients"], p["weights"], len(seeds(p))), []).append(p)
    for (clients, folder, count), asking in wanted.items():
        named = {p["method"].rstrip("0123456789") for p in asking}
        train_all(
            fleet(clients), folder, seeds=range(count), starts=sorted({start(p) for p in asking}),
            readings=sorted({p["velocity_reading"] for p in asking}), recipes=[r for r in RECIPES if r in named],
            jobs=jobs,
        )  # fmt: skip


@lru_cache(maxsize=64)
def _checkpoint(path: Path, key: str) -> Checkpoint:
    from coopoc.learned.checkpoint import load

    found = load(path)
    if found.card.get("key") != key:
        raise InputError("weights", path, "were trained otherwise", "Train again, or use another folder.")
    return found


def checkpoint(name: str, p: Params, seed: int) -> Checkpoint:
    """The trained checkpoint of a method for one training seed.

    Raises:
        InputError: it is not there, or it is of another training than these parameters ask for.
    """
    return _checkpoint(Path(p["weights"]) / f"{label(name, p, seed)}.safetensors", _key(name, p, seed))


@lru_cache
def _fitted(clients: str, reading: VelocityReading) -> Knowledge:
    from coopoc.learned.recipes import Setting, sensors

    drives = fleet(clients)
    acting = sensors(Setting(reading=reading))
    return Knowledge.fitted(observe(drives, acting, V2X(max_neighbours=0), seed=0), drives)


def trained(results: Results) -> list[str]:
    """The trained methods that a study has run."""
    ran = set(results.frame["method"].unique()) if "method" in results.frame else set()
    return [name for name in LEARNED if name in ran]


def ledger(p: Params, name: str) -> Ledger:
    """The bytes of a training, from the card of the first seed."""
    from coopoc.learned.federation.history import card_ledger

    return card_ledger(checkpoint(name, p, 0).card, fleet(p["clients"]))


def training_bytes(p: Params, names: Sequence[str]) -> dict[str, float]:
    """Payload bytes that one vehicle sends and receives in training, on average over the clients."""
    return {name: ledger(p, name).per_vehicle("training") for name in names}


def described(results: Results) -> Mapping[str, str]:
    """What the report says about the training of the methods that were run, from the cards of the first seed."""
    cards = {name: checkpoint(name, results.settings, 0).card for name in trained(results)}
    nets = [card for name, card in cards.items() if name in PAPER and card["kind"] == "gain_net"]
    told = {"nets": _nets(nets[0], len(seeds(results.settings)))} if nets else {}
    for name, card in cards.items():
        plan = card["settings"]
        text = f"{plan['schedule']['epochs']} optimiser steps"
        if plan["kind"] == "federated":
            text = f"{plan['rounds']} rounds of {plan['local_epochs']} passes through each client's pieces"
        seconds, clients = f"{card['seconds']:.0f} s per net", ", ".join(card["clients"])
        own = "" if name in PAPER else f"; {_own(card)}"
        told[name] = f"{text}{own}; clients {clients}; {seconds}; key {card['key'][:12]}"
    return told


def _own(card: Mapping[str, Any]) -> str:
    """How a net that the paper does not have was trained otherwise than the paper's."""
    plan, how = card["settings"], card["settings"]["schedule"]
    pieces = "mirrored" if how["mirror"] else "as they are"
    return (
        f"{card['parameters']} parameters, AdamW at {how['learning_rate']:g}, decoupled decay {how['weight_decay']:g}, "
        f"batch {how['batch']}, pieces of {plan['piece']} steps {pieces}, {plan['noise']} noise"
    )


def _nets(card: Mapping[str, Any], count: int) -> str:
    """What the paper's nets have in common, from the card of one."""
    plan, how = card["settings"], card["settings"]["schedule"]
    pieces = "mirrored at random" if how["mirror"] else "as they are"
    which = f"seeds 0 to {count - 1}" if count > 1 else "seed 0"
    return (
        f"{card['parameters']} parameters, AdamW at {how['learning_rate']:g} falling as a half cosine, decoupled decay "
        f"{how['weight_decay']:g}, batch {how['batch']}, gradient norm at most {how['clip']:g}, pieces of "
        f"{plan['piece']} steps {pieces}, {plan['noise']} noise, {100 * plan['split']:.0f} % for training, best "
        f"weights of {how['checks']} validations; training {which}"
    )


def fitted(p: Params) -> Knowledge:
    """Noise fitted on the recording that the nets of training seed 0 saw."""
    return _fitted(p["clients"], p["velocity_reading"])
