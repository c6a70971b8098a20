"""Recipes: a net, its training data and its schedule; settings and the jobs that they make."""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch

from coopoc import InputError, Method, Outliers, Sensors
from coopoc.arrays import check_fields, instance
from coopoc.errors import unknown
from coopoc.paths import given_path
from coopoc.plugins import file_digest, find, in_file
from coopoc.world.sensors import VelocityReading

from .checkpoint import load
from .federation.federate import Plan
from .nets.gain import Gain
from .training.clients import Client, Start, check_pieces, clients
from .training.drives import Drives, MeasuredDrives, measured_clients
from .training.schedule import COUNT_LIMITS, Schedule

REVISION = 8
"""Raised whenever the training code changes what it makes of the same recipe."""
Kind = Literal["federated", "centralised", "individual", "okf"]
"""Of training."""
STATIC = "static"
"""Noise of recipes: the paper's."""
WEIGHTS = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Recipe:
    """One way to train, with the paper's schedule (section IV.A): 20 rounds; 1500 or 500 steps; pieces of 100, 80/20.

    Args:
        kind: "federated", "centralised", "individual" (one net per client) or "okf" (all segments at once, no batches).
        schedule: optimiser, the same for all nets.
        rounds: of a federation.
        local_epochs: of a federation, passes through the client's segments per round.
        aggregate: rule of a federation, a name or "mine.py:NAME".
        noise: of the training drives where it is simulated: "static", the paper's; or outliers by name
            (`Outliers.named`), added to the paper's.
        piece: steps of a segment.
        split: share of the segments that train.
        net: the net, an entry point in `coopoc.nets` or "mine.py:NAME".
        options: named arguments that the net is made with.

    Raises:
        InputError: an unknown kind.

    >>> Recipe("centralised", net="mine.py:Net").rounds
    20
    """

    trainable: ClassVar[bool] = True
    """Studies and commands train it first when it is named as a method."""

    kind: Kind
    schedule: Schedule = Schedule()
    rounds: int = 20
    local_epochs: int = 5
    aggregate: str = "mean"
    noise: str = STATIC
    piece: int = 100
    split: float = 0.8
    net: str = "gain_net"
    options: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, {"rounds": COUNT_LIMITS, "local_epochs": COUNT_LIMITS})
        if self.noise != STATIC:
            Outliers.named(self.noise)
        instance("options", self.options, tuple)
        check_pieces(self.piece, self.split)

    @property
    def plan(self) -> Plan:
        """Of a federation, how it trains."""
        return Plan(self.rounds, self.aggregate, self.local_epochs, self.schedule)


RECIPES = {
    "fedkalmannet": Recipe("federated"),
    "centralised": Recipe("centralised", Schedule(epochs=1500)),
    "individual": Recipe("individual", Schedule(epochs=500)),
    "okf": Recipe("okf", Schedule(epochs=300), net="okf"),
    "fedokf": Recipe("federated", Schedule(batch=12, learning_rate=0.05, weight_decay=0.0, mirror=False), net="okf"),
}


@dataclass(frozen=True)
class Setting:
    """Choices that the paper leaves open: the seed of noise, split, start and batches; the start of the filter; the
    reading of "10 % of the velocity"."""

    seed: int = 0
    start: Start = "gnss"
    reading: VelocityReading = "axis"

    def __post_init__(self) -> None:
        check_fields(self, {"seed": (0, 2**63 - 1, "in 0..2^63 - 1")})


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
        path, _, held = self.name.rpartition(":")
        name = f"{Path(path).stem}.{held}" if path else held
        return f"{name}{self.client or ''}-{self.setting.start}-{self.setting.reading}-{self.setting.seed}"

    @property
    def card(self) -> dict[str, Any]:
        """The job in the card of its checkpoint, with the noise of simulated drives."""
        noise = {"noise": asdict(sensors(self)), "client": self.client}
        return {"recipe": self.name, "settings": asdict(self.recipe) | asdict(self.setting), **noise}

    def key(self, fleet: Drives) -> str:
        """Hash of everything that changes the weights."""
        facts = {
            "recipe": asdict(self.recipe),
            "setting": asdict(self.setting),
            "client": self.client,
            "sensors": asdict(sensors(self)),
            "fleet": fleet.digest,
            "revision": REVISION,
            "torch": torch.__version__,
        }
        if files := [name for name in (self.recipe.net, self.recipe.aggregate) if in_file(name)]:
            facts["files"] = {name: file_digest(name) for name in files}
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def sensors(job: Job) -> Sensors:
    """The paper's training noise in the setting's reading, with the recipe's outliers."""
    outliers = None if job.recipe.noise == STATIC else Outliers.named(job.recipe.noise)
    return replace(Sensors.paper_training(job.setting.reading), outliers=outliers)


def recipe_of(name: str) -> Recipe:
    """The recipe of a name, an entry point in `coopoc.recipes`, or of "mine.py:NAME", a Recipe or a net.

    A net without a recipe is trained as the paper's federation is.

    Raises:
        InputError: an unknown name, or an object that is neither a Recipe nor a net.

    >>> from coopoc.learned.recipes import recipe_of
    >>> recipe_of("okf").net
    'okf'
    """
    recipe = find("coopoc.recipes", name)
    if isinstance(recipe, type) and issubclass(recipe, Gain):
        return Recipe("federated", net=name)
    if not isinstance(recipe, Recipe):
        hint = "Write RECIPE = Recipe(...), or a class that derives from Gain."
        raise InputError("recipe", repr(name), f"is a {type(recipe).__name__}, no Recipe and no net", hint)
    return recipe


def jobs_of(name: str, setting: Setting, fleet: Drives, aggregate: str | None = None) -> list[Job]:
    """The checkpoints of a recipe in a setting: one, or one per vehicle of the fleet for individual nets.

    Raises:
        InputError: an unknown recipe, or an aggregation rule for a recipe that is no federation.
    """
    recipe = recipe_of(name)
    if aggregate is not None:
        if recipe.kind != "federated":
            raise InputError("aggregate", aggregate, f"goes with federations, {name} is {recipe.kind}", "Leave it out.")
        recipe = replace(recipe, aggregate=aggregate)
    if recipe.kind != "individual":
        return [Job(name, recipe, setting)]
    return [Job(name, recipe, setting, client) for client in range(1, len(fleet.ids) + 1)]


def shipped_weights() -> dict[str, Path]:
    """Name -> file of the weights that come with the package."""
    return {path.stem: path for path in sorted(WEIGHTS.glob("*.safetensors"))}


def load_method(name_or_path: Path | str, net: str = "") -> Method:
    """The method of a checkpoint file, or of weights that come with the package by their name.

    Args:
        name_or_path: a shipped name or the path of a checkpoint.
        net: "mine.py:Net" if the net of the checkpoint is one of your own files.

    Raises:
        InputError: neither a file nor a shipped name.
    """
    shipped = shipped_weights()
    path = shipped.get(name_or_path) if isinstance(name_or_path, str) else None
    path = path or given_path(name_or_path)
    if not path.is_file():
        raise unknown("learned method", str(name_or_path), shipped, "Or give the path of a checkpoint that is there.")
    checkpoint = load(path, net)
    return checkpoint.model.method(str(checkpoint.card.get("recipe", path.stem)))


def job_clients(job: Job, fleet: Drives) -> tuple[Client, ...]:
    """The vehicles of a fleet that train a job as clients, with its noise, split and start; of measured drives with
    what they measured: then the recipe's noise has no effect."""
    recipe, setting = job.recipe, job.setting
    cut: dict[str, Any] = {"start": setting.start, "piece": recipe.piece, "split": recipe.split}
    if isinstance(fleet, MeasuredDrives):
        every = measured_clients(fleet, **cut)
    else:
        every = clients(fleet, sensors(job), seed=setting.seed, **cut)
    return every if job.client is None else (every[job.client - 1],)


def untrained(job: Job) -> Gain:
    """The net of a job before its training."""
    made: Gain = find("coopoc.nets", job.recipe.net)(**dict(job.recipe.options), seed=job.setting.seed)
    return made
