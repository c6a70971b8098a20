"""Recipes: what is trained, from which data and how; train_all makes every checkpoint that a study needs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from coopoc.errors import InputError
from coopoc.methods.track import Method
from coopoc.plugins import find
from coopoc.workers import leave_with
from coopoc.world.fleet import Fleet
from coopoc.world.sensors import Sensors, VelocityReading

from .checkpoint import Checkpoint, load, read_card, save
from .federation.federated import federate_many
from .nets.gain import Gain
from .training.clients import Client, Noise, Pieces, Start, clients
from .training.fit import Fit, Task, fit_many
from .training.machine import reporting_on
from .training.okf_fit import fit_okf_many
from .training.schedule import Epoch, Schedule

REVISION = 6
"""Raised whenever the training code changes what it makes of the same recipe."""
WEIGHTS = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Recipe:
    """One way to train, with the paper's schedule (section IV.A): 20 rounds; 1500 or 500 steps; pieces of 100, 80/20.

    Args:
        kind: "federated", "centralised", "individual" (one net per client) or "okf" (all pieces at once, no batches).
        net, options: what is trained, an entry point in `coopoc.nets`, and the named arguments that it is made with.
        schedule: optimiser, the same for all nets. rounds, local_epochs, local_epoch, aggregate: of a federation.
    """

    kind: str
    schedule: Schedule = field(default_factory=Schedule)
    rounds: int = 20
    local_epochs: int = 5
    local_epoch: Epoch = "pass"
    aggregate: str = "mean"
    noise: Noise = "static"
    piece: int = 100
    split: float = 0.8
    net: str = "gain_net"
    options: tuple[tuple[str, Any], ...] = ()


RECIPES: dict[str, Recipe] = {
    "fedkalmannet": Recipe("federated"),
    "centralised": Recipe("centralised", Schedule(epochs=1500)),
    "individual": Recipe("individual", Schedule(epochs=500)),
    "okf": Recipe("okf", Schedule(epochs=300), net="okf"),
    "fedokf": Recipe("federated", Schedule(batch=12, learning_rate=0.05, weight_decay=0.0, mirror=False), net="okf"),
    "cooperative": Recipe("federated", Schedule(batch=8, learning_rate=0.01, weight_decay=0.01), local_epochs=10,
                          noise="wide", net="noise_net"),
    "magnitude": Recipe("federated", noise="wide", options=(("magnitudes", True),)),
    "recursive": Recipe("federated", Schedule(batch=24, mirror=False), rounds=10, local_epochs=10, noise="wide",
                        piece=300, net="recursive"),
    "split": Recipe("federated", Schedule(batch=8, learning_rate=3e-3, weight_decay=0.1), local_epochs=10, noise="wide",
                    piece=300, net="split"),
}


@dataclass(frozen=True)
class Setting:
    """What the paper leaves open and a study varies: the seed of noise, split, start and batches; the start of the
    filter; the reading of "10 % of the velocity"."""

    seed: int = 0
    start: Start = "gnss"
    reading: VelocityReading = "axis"


@dataclass(frozen=True)
class Job:
    """One checkpoint to make: recipe by name, setting, and the client of an individual net (1-based, as the paper)."""

    name: str
    recipe: Recipe
    setting: Setting
    client: int | None = None

    @property
    def label(self) -> str:
        """Name of the checkpoint, such as fedkalmannet-gnss-axis-0 or individual2-gnss-axis-0."""
        return f"{self.name}{self.client or ''}-{self.setting.start}-{self.setting.reading}-{self.setting.seed}"

    def key(self, fleet: Fleet) -> str:
        """Hash of everything that changes the weights."""
        facts = {"recipe": asdict(self.recipe), "setting": asdict(self.setting), "client": self.client,
                 "sensors": asdict(sensors(self.setting)), "fleet": fleet.digest, "revision": REVISION,
                 "torch": torch.__version__}  # fmt: skip
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def sensors(setting: Setting) -> Sensors:
    """The paper's training noise in the setting's reading."""
    return replace(Sensors.paper_training(), velocity_reading=setting.reading)


def jobs_of(name: str, setting: Setting, fleet: Fleet) -> list[Job]:
    """The checkpoints of a recipe in a setting: one, or one per vehicle of the fleet for individual nets.

    Raises:
        InputError: an unknown recipe.
    """
    if name not in RECIPES:
        raise InputError("recipe", repr(name), f"must be one of {sorted(RECIPES)}", "Pick one.")
    recipe = RECIPES[name]
    if recipe.kind != "individual":
        return [Job(name, recipe, setting)]
    return [Job(name, recipe, setting, client) for client in range(1, len(fleet.ids) + 1)]


def train_all(
    fleet: Fleet,
    out: Path | str,
    *,
    seeds: Sequence[int] = range(5),
    starts: Sequence[Start] = ("gnss",),
    readings: Sequence[VelocityReading] = ("axis",),
    recipes: Sequence[str] | None = None,
    jobs: int = 1,
    progress: bool = True,
) -> dict[str, Checkpoint]:
    """Train every recipe in every setting, or read it from `out` where the same was trained before.

    All settings of a recipe are trained together, on one core; recipes side by side on `jobs` cores. A checkpoint is
    reused if its card's key, the hash of all that changes the weights, is the same; each is written whole or
    not at all.

    Args:
        fleet: the clients' drives, such as the bundled "town10-clients". out: folder of the checkpoints.
        seeds, starts, readings: the settings, every combination. recipes: names, default all of `RECIPES`.
        jobs: processes; the weights do not depend on it. progress: bars on stderr that name the stage.

    Returns:
        Checkpoints by label, such as "fedkalmannet-gnss-axis-0".

    Raises:
        InputError: an unknown recipe.
    """
    settings = [Setting(seed, start, reading) for reading in readings for start in starts for seed in seeds]
    wanted = {name: [job for setting in settings for job in jobs_of(name, setting, fleet)]
              for name in (RECIPES if recipes is None else recipes)}  # fmt: skip
    paths = {job: Path(out) / f"{job.label}.safetensors" for group in wanted.values() for job in group}
    groups = ([job for job in group if not _made(paths[job], job.key(fleet))] for group in wanted.values())
    missing = [group for group in groups if group]
    if jobs > 1 and len(missing) > 1:
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            todo = [pool.submit(_in_worker, group, fleet, Path(out), line if progress else None, os.getpid())
                    for line, group in enumerate(missing)]  # fmt: skip
            for done in todo:
                done.result()
    else:
        for group in missing:
            _train(group, fleet, Path(out), progress)
    return {job.label: load(path) for job, path in paths.items()}


def _train(group: Sequence[Job], fleet: Fleet, out: Path, progress: bool) -> None:
    """Train and save the checkpoints of one recipe."""
    for job, checkpoint in zip(group, trained(group, fleet, progress), strict=True):
        save(out / f"{job.label}.safetensors", checkpoint)


def trained(group: Sequence[Job], fleet: Fleet, progress: bool = True) -> list[Checkpoint]:
    """Checkpoints of jobs of one recipe, trained together now."""
    data = {job.setting: _data(fleet, job) for job in group}
    found = TRAINERS[group[0].recipe.kind](group, data, f"train {group[0].name}" if progress else None)
    return [replace(made, card=_card(job, fleet, data[job.setting]) | dict(made.card))
            for job, made in zip(group, found, strict=True)]  # fmt: skip


def _in_worker(group: Sequence[Job], fleet: Fleet, out: Path, line: int | None, parent: int) -> None:
    leave_with(parent)
    with reporting_on(line or 0):
        _train(group, fleet, out, line is not None)


def load_method(name_or_path: Path | str) -> Method:
    """The method of a checkpoint file, or of weights that come with the package by their name.

    Raises:
        InputError: neither a file nor a shipped name.
    """
    shipped = {path.stem: path for path in sorted(WEIGHTS.glob("*.safetensors"))}
    path = shipped.get(str(name_or_path), Path(name_or_path))
    if not path.is_file():
        allowed = f"must be a checkpoint file or one of {sorted(shipped)}"
        raise InputError("learned method", str(name_or_path), allowed, "Train one: coopoc train fedkalmannet.")
    checkpoint = load(path)
    return checkpoint.model.method(str(checkpoint.card.get("recipe", path.stem)))


Data = dict[Setting, tuple[Client, ...]]
Trainer = Callable[[Sequence[Job], Data, str | None], list[Checkpoint]]


def _made(path: Path, key: str) -> bool:
    return path.is_file() and read_card(path).get("key") == key


def _data(fleet: Fleet, job: Job) -> tuple[Client, ...]:
    recipe, setting = job.recipe, job.setting
    return clients(fleet, sensors(setting), seed=setting.seed, noise=recipe.noise, start=setting.start,
                   piece=recipe.piece, split=recipe.split)  # fmt: skip


def _card(job: Job, fleet: Fleet, data: Sequence[Client]) -> dict[str, Any]:
    used = [c for i, c in enumerate(data) if job.client in (None, i + 1)]
    return {"key": job.key(fleet), "recipe": job.name, "settings": asdict(job.recipe) | asdict(job.setting),
            "noise": asdict(sensors(job.setting)), "client": job.client, "fleet": fleet.name, "digest": fleet.digest,
            "clients": [c.name for c in used], "training_pieces": [len(c.training) for c in used],
            "validation_pieces": [len(c.validation) for c in used]}  # fmt: skip


def untrained(job: Job) -> Gain:
    """The net of a job before its training."""
    made: Gain = find("coopoc.nets", job.recipe.net)(**dict(job.recipe.options), seed=job.setting.seed)
    return made


def _joined(data: Sequence[Client], client: int | None, part: str) -> Pieces:
    return Pieces.join([getattr(c, part) for i, c in enumerate(data) if client in (None, i + 1)])


def _task(job: Job, data: Sequence[Client]) -> Task:
    training, validation, long = (_joined(data, job.client, part) for part in ("training", "validation", "long"))
    return Task(untrained(job), training, validation, job.setting.seed, str(job.client or ""), long)


def _federated(todo: Sequence[Job], data: Data, stage: str | None) -> list[Checkpoint]:
    recipe, nets = todo[0].recipe, [untrained(job) for job in todo]
    done = federate_many(
        nets, [data[j.setting] for j in todo], [j.setting.seed for j in todo], recipe.rounds, recipe.aggregate,
        recipe.local_epochs, recipe.schedule, stage, recipe.local_epoch,
    )  # fmt: skip
    found = []
    for job, federation in zip(todo, done, strict=True):
        rows = [{"round": r.number, "training_loss": r.training_loss, "validation_loss": r.validation_loss,
                 "sent_bytes": r.sent_bytes, "received_bytes": r.received_bytes, "rejected": dict(r.rejected)}
                for r in federation.history]  # fmt: skip
        weights = torch.stack([r.weights for r in federation.history])
        card = {"history": rows, "best": federation.best.number, "seconds": federation.seconds}
        model = federation.model.finished([client.training for client in data[job.setting]])
        found.append(Checkpoint(model, card, weights))
    return found


def _fitted(todo: Sequence[Job], data: Data, stage: str | None) -> list[Checkpoint]:
    fits = fit_many([_task(job, data[job.setting]) for job in todo], todo[0].recipe.schedule, stage)
    return [_of_fit(fit) for fit in fits]


def _of_fit(fit: Fit) -> Checkpoint:
    rows = [{"step": r.step, "training_loss": r.training_loss, "validation_loss": r.validation_loss}
            for r in fit.history]  # fmt: skip
    card = {"history": rows, "best": fit.best.step, "stopped": fit.stopped, "seconds": fit.seconds}
    return Checkpoint(fit.model, card, torch.stack([r.weights for r in fit.history]))


def _okf(todo: Sequence[Job], data: Data, stage: str | None) -> list[Checkpoint]:
    tasks = [(_joined(data[j.setting], None, "training"), _joined(data[j.setting], None, "validation")) for j in todo]
    fits = fit_okf_many(tasks, todo[0].recipe.schedule.epochs, progress=stage)
    return [Checkpoint(f.model, {"validation_loss": f.validation_loss, "seconds": f.seconds}) for f in fits]


TRAINERS: dict[str, Trainer] = {"federated": _federated, "centralised": _fitted, "individual": _fitted, "okf": _okf}
