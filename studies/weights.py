"""coopoc train, and the weights that studies need: trained once for a setting, found by a hash of all that counts."""

import hashlib
import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from coopoc import V2X, InputError, Sensors, observe
from coopoc.arrays import whole
from coopoc.data.source import while_unchanged
from coopoc.errors import unknown
from coopoc.plugins import find, from_file, in_file
from coopoc.study.cell import Params
from coopoc.world.sensors import VelocityReading

from .scene import fleet, is_real, start

if TYPE_CHECKING:
    from coopoc import NoiseModel, Results
    from coopoc.learned.checkpoint import Checkpoint
    from coopoc.learned.training.drives import Drives

INDIVIDUAL = tuple(f"individual{client}" for client in range(1, 7))
"""Nets of single clients, one per client, at most six."""
PAPER_METHODS = ("fedkalmannet", "centralised", *INDIVIDUAL, "okf")
"""Methods that the paper trains, and the optimised Kalman filter."""
LEARNED = (*PAPER_METHODS, "fedokf")
"""Methods that are trained."""
WORST_RATIO = 1.1
"""Times the error of a Kalman filter with fitted noise, above which the command saves no weights."""


def seeds(p: Params) -> range:
    """Training seeds of a study with a trained method."""
    return range(whole("train_seeds", p["train_seeds"], 1, 1000, "Each trains a method once."))


def trainable(p: Params) -> bool:
    """False for the individual net of a client that is not there."""
    return p["method"] not in INDIVIDUAL[len(drives(p["clients"]).ids) :]


def is_trained(name: str) -> bool:
    """True for a method that is trained: by its name, or as a recipe or a net in a file, mine.py:NAME."""
    return name in LEARNED or (in_file(name) and getattr(from_file(name, "method"), "trainable", False))


def key(name: str, p: Params) -> str:
    """Hash of everything that changes the weights of a method, known before any training."""
    return hashlib.sha256("".join(_job(name, p, seed)[1] for seed in seeds(p)).encode()).hexdigest()


@while_unchanged
def drives(clients: str) -> "Drives":
    """What nets are trained on: a fleet, whose measurements are simulated, or of real data its own measurements."""
    if not is_real(clients):
        return fleet(clients)
    from coopoc.data.registry import read_log
    from coopoc.learned.training.drives import drives_of

    return drives_of(read_log(clients))


def _recipe(name: str) -> str:
    """The recipe of a method: individual2 is one of individual."""
    return "individual" if name in INDIVIDUAL else name


def _job(name: str, p: Params, seed: int) -> tuple[str, str]:
    """Label and key of the checkpoint of a method for one training seed."""
    if not is_trained(name) or not trainable({**p, "method": name}):
        raise unknown("trained method", name, LEARNED)
    from coopoc.learned.recipes import Setting, jobs_of

    data, setting = drives(p["clients"]), Setting(seed, start(p), p["velocity_reading"])
    job = jobs_of(_recipe(name), setting, data)[INDIVIDUAL.index(name) if name in INDIVIDUAL else 0]
    return job.label, job.key(data)


def prepare(cells: Iterable[Params], jobs: int = 1) -> None:
    """Train the missing weights of the cells, with progress: `jobs` checkpoints at a time."""
    wanted: dict[tuple[str, str, int], list[Params]] = {}
    for p in cells:
        if is_trained(p["method"]):
            wanted.setdefault((p["clients"], p["weights"], len(seeds(p))), []).append(p)
    for (clients, folder, count), asking in wanted.items():
        from coopoc.learned.train import train_all

        train_all(
            drives(clients),
            folder,
            seeds=range(count),
            starts=sorted({start(p) for p in asking}),
            readings=sorted({p["velocity_reading"] for p in asking}),
            recipes=list(dict.fromkeys(_recipe(p["method"]) for p in asking)),
            jobs=jobs,
        )


@lru_cache(maxsize=64)
def _checkpoint(path: Path, key: str, net: str) -> "Checkpoint":
    from coopoc.learned.checkpoint import load

    checkpoint = load(path, net)
    if checkpoint.card.get("key") != key:
        raise InputError("weights", path, "were trained otherwise", "Train again, or use another folder.")
    return checkpoint


def checkpoint(name: str, p: Params, seed: int) -> "Checkpoint":
    """The trained checkpoint of a method for one training seed.

    Raises:
        InputError: it is not there, or it is of another training than these parameters ask for.
    """
    net = ""
    if in_file(name):
        from coopoc.learned.recipes import recipe_of

        net = recipe_of(name).net
    label, key = _job(name, p, seed)
    return _checkpoint(Path(p["weights"]) / f"{label}.safetensors", key, net if in_file(net) else "")


@while_unchanged
def fitted(clients: str, reading: VelocityReading) -> "NoiseModel":
    """Noise fitted on the recording that the nets of training seed 0 saw, or on the measurements of real data."""
    from coopoc import NoiseModel

    if is_real(clients):
        from coopoc.data.registry import read_log

        return NoiseModel.fitted(read_log(clients).recording, fleet(clients))
    acting, moving = Sensors.paper_training(reading), fleet(clients)
    return NoiseModel.fitted(observe(moving, acting, V2X(max_neighbours=0), seed=0), moving)


def described(results: "Results") -> Mapping[str, str]:
    """Descriptions of the training of the methods that were run, from the cards of the first seed."""
    texts, ran = {}, dict.fromkeys(results.frame.get("method", ()))
    for name in dict.fromkeys((*LEARNED, *ran)):
        if name not in ran or not is_trained(name):
            continue
        card = checkpoint(name, results.settings, 0).card
        plan, how = card["settings"], card["settings"]["schedule"]
        steps = f"{how['epochs']} optimiser steps"
        if plan["kind"] == "federated":
            steps = f"{plan['rounds']} rounds of {plan['local_epochs']} passes through each client's pieces"
        texts[name] = (
            f"{steps}; {card['parameters']} parameters, AdamW at {how['learning_rate']:g}, {plan['noise']} noise; "
            f"{len(seeds(results.settings))} training seeds; clients {', '.join(card['clients'])}; "
            f"key {card['key'][:12]}"
        )
    return texts


def train(
    recipe: Annotated[Positional[str], arg(metavar="RECIPE")],
    /,
    data: Annotated[str, arg(metavar="NAME_OR_PATH")] = "town10-clients",
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/weights"),
    seed: int = 0,
    aggregate: Annotated[str | None, arg(metavar="RULE")] = None,
    worse: bool = False,
) -> None:
    """Train a recipe, or find its checkpoint if the same was trained before.

    Example: coopoc train fedkalmannet --seed 0

    Example: coopoc train okf --data "mylog?until=300" --out runs/mylog

    Args:
        recipe: a name such as fedkalmannet (see coopoc list), or FILE.py:NAME of a recipe or a net.
        data: fleet of the clients or a log with its truth, a name or a path; "mylog?until=300" takes 300 s.
        out: folder of the checkpoints.
        seed: seed of noise, split, start and batches.
        aggregate: aggregation rule, a name or FILE.py:NAME, instead of the recipe's.
        worse: save also what errs more than a tenth more than a Kalman filter with fitted noise.
    """
    find("coopoc.recipes", recipe)  # before torch is loaded
    from coopoc.learned.train import train_all

    worst = math.inf if worse else WORST_RATIO
    made = train_all(drives(data), out, seeds=[seed], recipes=[recipe], aggregate=aggregate, worst=worst)
    for label, checkpoint in made.items():
        card = checkpoint.card
        print(f"{out / label}.safetensors  {card['parameters']} parameters")
        if errors := card.get("validation_m"):
            print("  errs {:.3g} m on pieces that validate, a Kalman filter with fitted noise {:.3g} m".format(*errors))
