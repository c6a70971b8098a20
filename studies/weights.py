"""The weights that a study needs: trained once for a setting, found again by everything that changes them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from coopoc.methods.knowledge import Knowledge
from coopoc.study.study import Params
from coopoc.world.sensing import observe
from coopoc.world.v2x import V2X

from .scene import fleet

if TYPE_CHECKING:
    from coopoc.learned.checkpoint import Checkpoint
    from coopoc.study.results import Results

LEARNED = ("fedkalmannet", "centralised", "individual1", "individual2", "individual3", "individual4", "okf")
"""Methods that are trained, the individual nets one per client."""


def seeds(p: Params) -> range:
    """Training seeds of a study."""
    return range(int(p["train_seeds"]))


def label(name: str, p: Params, seed: int) -> str:
    """Name of a checkpoint, such as fedkalmannet-gnss-axis-0."""
    return f"{name}-{p['start']}-{p['velocity_reading']}-{seed}"


def key(name: str, p: Params) -> str:
    """Hash of everything that changes the weights of a method, known before any training."""
    keys = _keys(p["clients"], p["start"], p["velocity_reading"], int(p["train_seeds"]))
    return hashlib.sha256("".join(keys[label(name, p, seed)] for seed in seeds(p)).encode()).hexdigest()


@lru_cache
def _keys(clients: str, start: str, reading: str, count: int) -> Mapping[str, str]:
    from coopoc.learned.recipes import RECIPES, Setting, jobs

    drives = fleet(clients)
    settings = [Setting(seed, start, reading) for seed in range(count)]  # type: ignore[arg-type]
    return {
        job.label: job.key(drives) for setting in settings for name in RECIPES for job in jobs(name, setting, drives)
    }


def prepare(cells: Iterable[Params]) -> None:
    """Train what the cells need and is not there yet: in this process, one setting after another, with progress."""
    from coopoc.learned.recipes import train_all

    wanted: dict[tuple[str, str, int], tuple[set[str], set[str]]] = {}
    for p in cells:
        if p.get("method") in LEARNED:
            starts, readings = wanted.setdefault((p["clients"], p["weights"], int(p["train_seeds"])), (set(), set()))
            starts.add(p["start"])
            readings.add(p["velocity_reading"])
    for (clients, folder, count), (starts, readings) in wanted.items():
        train_all(fleet(clients), folder, seeds=range(count), starts=sorted(starts), readings=sorted(readings))  # type: ignore[arg-type]


@lru_cache(maxsize=64)
def _checkpoint(path: Path) -> Checkpoint:
    from coopoc.learned.checkpoint import load

    return load(path)


def checkpoint(name: str, p: Params, seed: int) -> Checkpoint:
    """The trained checkpoint of a method for one training seed."""
    return _checkpoint(Path(p["weights"]) / f"{label(name, p, seed)}.safetensors")


@lru_cache
def _fitted(clients: str, reading: str) -> Knowledge:
    from coopoc.learned.recipes import Setting, sensors

    drives = fleet(clients)
    acting = sensors(Setting(reading=reading))  # type: ignore[arg-type]
    return Knowledge.fitted(observe(drives, acting, V2X(max_neighbours=0), seed=0), drives)


def training_bytes(p: Params) -> dict[str, float]:
    """Bytes that one vehicle sends and receives in training, on average over the clients.

    A federation moves the weights both ways in every round. A centralised net needs the raw drives, six float32 per
    step (noisy fixes and velocities; the reference drive comes on top), and sends the net back once.
    """
    card = checkpoint("fedkalmannet", p, 0).card
    drives = fleet(p["clients"])
    upload = 4 * 6 * float(drives.present.sum(axis=0).mean())
    rounds = card["history"][1:]
    moved = sum(row["sent_bytes"] + row["received_bytes"] for row in rounds) / len(card["clients"])
    return {
        "fedkalmannet": float(moved),
        "centralised": upload + 4 * card["parameters"],
        "okf": upload + 4 * checkpoint("okf", p, 0).card["parameters"],
    }


def described(results: Results) -> Mapping[str, str]:
    """What the report says about the training, from the cards of the first seed."""
    p = results.settings
    cards = {name: checkpoint(name, p, 0).card for name in LEARNED}
    plan = cards["fedkalmannet"]["settings"]
    how = plan["schedule"]
    pieces = "mirrored at random" if how["mirror"] else "as they are"
    told = {
        "nets": f"{cards['fedkalmannet']['parameters']} parameters, AdamW at {how['learning_rate']:g} falling as a "
        f"half cosine, decoupled decay {how['weight_decay']:g}, batch {how['batch']}, gradient norm at most "
        f"{how['clip']:g}, pieces of {plan['piece']} steps {pieces}, {plan['noise']} noise, "
        f"{100 * plan['split']:.0f} % for training, best weights of {how['checks']} validations; training seeds 0 to "
        f"{int(p['train_seeds']) - 1}",
        "fedkalmannet": f"{plan['rounds']} rounds of {plan['local_epochs']} passes through each client's pieces",
    }
    for name in LEARNED[1:]:
        told[name] = f"{cards[name]['settings']['schedule']['epochs']} optimiser steps"
    return {
        name: f"{text}; clients {', '.join(cards[name]['clients'])}; {cards[name]['seconds']:.0f} s per net; "
        f"key {cards[name]['key'][:12]}" if name in cards else text
        for name, text in told.items()
    }  # fmt: skip


def fitted(p: Params) -> Knowledge:
    """Noise fitted on the recording that the nets of training seed 0 saw."""
    return _fitted(p["clients"], p["velocity_reading"])
