"""The federation that a Flower run is configured to train."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

from coopoc.errors import InputError
from coopoc.world.fleet import Fleet

from ..federation.aggregate import rule
from ..nets.gain import Gain
from ..recipes import RECIPES, Job, Recipe, Setting, sensors, untrained
from ..training.clients import Client, clients
from ..training.schedule import Schedule

PREFIX = "net-"
"""Before the name of an option of the net."""


def job_of(config: Mapping[str, Any]) -> Job:
    """The job of a run's configuration.

    Args:
        config: recipe (a name), seed, start, reading, and what shall differ from the recipe: fields of `Recipe` and
            `Schedule` written with dashes, such as local-epochs, and options of the net, such as net-in-mult. The entry
            `change` holds such fields as words: "rounds=3 net-in-mult=2". Other entries are not looked at.

    Raises:
        InputError: an unknown recipe, one that is no federation, or a word in `change` that is none of these.

    >>> job = job_of({"recipe": "fedkalmannet", "seed": 3, "change": "rounds=2 net-in-mult=5", "nodes": 4})
    >>> job.setting.seed, job.recipe.rounds, job.recipe.options
    (3, 2, (('in_mult', 5),))
    """
    known = sorted(name for name, recipe in RECIPES.items() if recipe.kind == "federated")
    name = config["recipe"]
    if name not in known:
        raise InputError("recipe", repr(name), f"must be one of {known}", "Only a federation runs on Flower.")
    given = {key.replace("-", "_"): value for key, value in {**config, **_words(config.get("change", ""))}.items()}
    options = {key[len(PREFIX) :]: value for key, value in given.items() if key.startswith(PREFIX.replace("-", "_"))}
    schedule = replace(RECIPES[name].schedule, **_of(Schedule, given))
    own = tuple({**dict(RECIPES[name].options), **options}.items())
    recipe = replace(RECIPES[name], **_of(Recipe, given), schedule=schedule, options=own)
    return Job(name, recipe, Setting(**_of(Setting, given)))


def net(job: Job) -> Gain:
    """The net of a job before its training."""
    return untrained(job)


def data(job: Job, fleet: Fleet) -> tuple[Client, ...]:
    """The vehicles of a fleet as clients, with the noise, the split and the start of the job."""
    recipe, setting = job.recipe, job.setting
    return clients(fleet, sensors(setting), seed=setting.seed, noise=recipe.noise, start=setting.start,
                   piece=recipe.piece, split=recipe.split)  # fmt: skip


def local(job: Job) -> Schedule:
    """The schedule of a client's round."""
    recipe = job.recipe
    return rule(recipe.aggregate).local(replace(recipe.schedule, epochs=recipe.local_epochs, epoch=recipe.local_epoch))


def _words(text: str) -> dict[str, Any]:
    """The changes of a text such as "rounds=3 aggregate=median"."""
    allowed, found = {field.name.replace("_", "-") for kind in (Recipe, Schedule) for field in fields(kind)}, {}
    for word in text.split():
        key, _, value = word.partition("=")
        if key not in allowed and not key.startswith(PREFIX):
            raise InputError("change", word, f"must be {PREFIX}... or one of {sorted(allowed)}", "Write rounds=3.")
        found[key] = value
        with suppress(json.JSONDecodeError):
            found[key] = json.loads(value)
    return found


def _of(kind: type[Any], given: Mapping[str, Any]) -> dict[str, Any]:
    return {field.name: given[field.name] for field in fields(kind) if field.name in given}
