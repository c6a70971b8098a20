"""ClientApp of a vehicle: it trains received weights on its own drive and answers with weights and numbers; and the job
of a run's configuration.
"""

import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, TypeAlias

import torch

from coopoc import MissingLibraryError, load_fleet, read_log
from coopoc.errors import InputError, unknown

from ..federation.federate import adapt
from ..recipes import Job, Recipe, Setting, job_clients, recipe_of, untrained
from ..training.clients import Client
from ..training.drives import drives_of
from ..training.fit import Judge
from ..training.schedule import Schedule, one_core

if TYPE_CHECKING:
    from flwr.app import Context, Message, RecordDict
    from flwr.clientapp import ClientApp

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

    >>> from coopoc.learned.flower.client import job_of
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


Source: TypeAlias = "Callable[[Context], tuple[Client, Job]]"


def require_flower(needed_for: str) -> None:
    """Import Flower with its telemetry off.

    Raises:
        MissingLibraryError: it is not installed.
    """
    os.environ.setdefault("FLWR_TELEMETRY_ENABLED", "0")
    try:
        import flwr.app  # noqa: F401
    except ImportError:
        raise MissingLibraryError("flwr", needed_for, "'coopoc[flower]'") from None


def client_app(source: "Source | None" = None) -> "ClientApp":
    """The ClientApp of one vehicle: `adapt` on its own drive, hence the weights that `federate` would give it.

    Any strategy of Flower's Message API can ask it: it reads "arrays" and "server-round", and answers with "arrays" and
    "metrics", weighted by "num-examples".

    Args:
        source: function of the context that gives the vehicle with its pieces, and the job; default: by the
            configurations of node and run.

    Raises:
        MissingLibraryError: Flower is not installed.
    """
    require_flower("a ClientApp")
    from flwr.clientapp import ClientApp

    app, data = ClientApp(), source or configured

    @app.train()
    def train(message: "Message", context: "Context") -> "Message":
        return _replied(message, context, data, training=True)

    @app.evaluate()
    def evaluate(message: "Message", context: "Context") -> "Message":
        return _replied(message, context, data, training=False)

    return app


def configured(context: "Context") -> tuple[Client, Job]:
    """The vehicle by the node's own configuration, `data` (a name or a path of a fleet, whose measurements are
    simulated) or `log` (a path of measurements with their truth), and `vehicle` (an id, not needed if the data hold one
    vehicle), and the job by the run's. Drives of other vehicles are not used.

    Raises:
        InputError: no data, or several vehicles and no `vehicle`; a log without a truth.
    """
    own = context.node_config
    if "data" not in own and "log" not in own:
        hint = "Start the SuperNode with --node-config."
        raise InputError("data", "missing", "must name a fleet or a file; or log one's measurements", hint)
    fleet = drives_of(read_log(str(own["log"])) if "log" in own else load_fleet(str(own["data"])))
    vehicle = own.get("vehicle", fleet.ids[0] if len(fleet.ids) == 1 else None)
    if vehicle is None:
        raise InputError("vehicle", "missing", f"must be one of {len(fleet.ids)} ids", "Add it to --node-config.")
    job = job_of(context.run_config)
    (client,) = job_clients(job, fleet.select([str(vehicle)]))
    return client, job


@one_core()
def answer(client: Client, job: Job, content: "RecordDict", training: bool) -> "RecordDict":
    """The client's half of a round: the loss of the received weights on its own validation pieces or, if asked to
    train, new weights and their training loss; its name, and the number of its training pieces.

    Raises:
        RuntimeError: local training failed; gives the reason.
    """
    from flwr.app import Array, ArrayRecord, ConfigRecord, MetricRecord, RecordDict

    arrays, config, model = content["arrays"], content["config"], untrained(job)
    theta = torch.from_numpy(next(iter(arrays.values())).numpy())  # type: ignore[union-attr]
    metrics = MetricRecord({"num-examples": len(client.training)})
    made = RecordDict({"metrics": metrics, "client": ConfigRecord({"name": client.name, "version": version("coopoc")})})
    if not training:
        metrics["validation-loss"] = float(Judge([[client.validation], [client.long]], model)(theta[None]))
        return made
    number: Any = config["server-round"]
    plan = job.recipe.plan
    (own,) = adapt(model, theta, [client], job.setting.seed, number, plan.rounds, plan.local).values()
    if own.failure:
        raise RuntimeError(own.failure)
    metrics["training-loss"] = own.loss
    made["arrays"] = ArrayRecord({"theta": Array(own.weights.numpy())})
    return made


def _replied(message: "Message", context: "Context", source: Source, training: bool) -> "Message":
    """The reply. Only the type of an exception leaves, because its text may quote a coordinate."""
    from flwr.app import Error, Message

    try:
        client, job = source(context)
        return Message(answer(client, job, message.content, training), reply_to=message)
    except Exception as error:
        traceback.print_exc(file=sys.stderr)
        reason = f"{type(error).__name__} in the client, see its own log"
        return Message(Error(code=0, reason=reason), reply_to=message)
