"""The training job of a Flower run's configuration."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

from coopoc.errors import InputError, unknown

from ..recipes import Job, Recipe, Setting, recipe_of
from ..training.schedule import Schedule

PREFIX = "net-"
"""Before the name of an option of the net."""


def job_of(config: Mapping[str, Any]) -> Job:
    """The job of a run's configuration.

    Args:
        config: recipe (a name), seed, start, reading, and differences from the recipe: fields of `Recipe` and
            `Schedule` written with dashes, such as local-epochs, and options of the net, such as net-in-mult. The entry
            `change` holds such fields as words: "rounds=3 net-in-mult=2". Other entries are ignored.

    Raises:
        InputError: an unknown recipe, one that is no federation, or an unknown field in `change`.

    >>> from coopoc.learned.flower.job import job_of
    >>> job = job_of({"recipe": "fedkalmannet", "seed": 3, "change": "rounds=2 net-in-mult=5", "nodes": 4})
    >>> job.setting.seed, job.recipe.rounds, job.recipe.options
    (3, 2, (('in_mult', 5),))
    """
    name = config["recipe"]
    base = recipe_of(name)
    if base.kind != "federated":
        raise InputError("recipe", repr(name), f'is "{base.kind}", must be "federated"', "Train it without Flower.")
    settings = {key.replace("-", "_"): value for key, value in {**config, **_words(config.get("change", ""))}.items()}
    options = {key[len(PREFIX) :]: value for key, value in settings.items() if key.startswith(PREFIX.replace("-", "_"))}
    own = {} if settings.get("net", base.net) != base.net else dict(base.options)
    schedule, changed = replace(base.schedule, **_of(Schedule, settings)), tuple((own | options).items())
    recipe = replace(base, **_of(Recipe, settings), schedule=schedule, options=changed)
    return Job(name, recipe, Setting(**_of(Setting, settings)))


def _words(text: str) -> dict[str, Any]:
    """The changes of a text such as "rounds=3 aggregate=median"."""
    allowed, settings = {field.name.replace("_", "-") for kind in (Recipe, Schedule) for field in fields(kind)}, {}
    for word in text.split():
        key, _, value = word.partition("=")
        if key not in allowed and not key.startswith(PREFIX):
            raise unknown("change", key, [*sorted(allowed), f"{PREFIX}..."])
        settings[key] = value
        with suppress(json.JSONDecodeError):
            settings[key] = json.loads(value)
    return settings


def _of(kind: type[Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    return {field.name: settings[field.name] for field in fields(kind) if field.name in settings}
