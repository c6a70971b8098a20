"""ClientApp: a vehicle that trains on its own drive and sends a report."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from torch import Tensor

from coopoc.errors import InputError
from coopoc.fleets import load_fleet, read_log

from ..federation.local import local_fit
from ..recipes import Job, job_clients, untrained
from ..training.clients import Client
from ..training.drives import drives_of
from ..training.fit import Judge
from ..training.machine import one_core
from .job import job_of, local
from .wire import Report, answer, asked, require_flower

if TYPE_CHECKING:
    from flwr.app import Context, Message
    from flwr.clientapp import ClientApp

Source: TypeAlias = "Callable[[Context], tuple[Client, Job]]"


def client_app(source: Source | None = None) -> ClientApp:
    """The ClientApp of one vehicle: `local_fit` on its own drive, hence the weights that `federate` would give it.

    Args:
        source: function of the context that gives the vehicle with its pieces, and the job; default: by the
            configurations of node and run.

    Raises:
        MissingLibraryError: Flower is not installed.
    """
    require_flower("a ClientApp")
    from flwr.clientapp import ClientApp

    app, found = ClientApp(), source or configured

    @app.train()
    def train(message: Message, context: Context) -> Message:
        return _replied(message, context, found, training=True)

    @app.evaluate()
    def evaluate(message: Message, context: Context) -> Message:
        return _replied(message, context, found, training=False)

    return app


def configured(context: Context) -> tuple[Client, Job]:
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
def report(client: Client, job: Job, theta: Tensor, number: int, training: bool) -> Report:
    """Validate theta (P,) on the client's own pieces and, if asked to, train on them: its half of round `number`."""
    model = untrained(job)
    validation = float(Judge([[client.validation], [client.long]], model)(theta[None]))
    base = Report(client.name, len(client.training), validation)
    if not training:
        return base
    weights, loss, failure = local_fit(model, theta, client, job.setting.seed, number, job.recipe.rounds, local(job))
    if failure:
        return replace(base, failure=failure)
    return replace(base, weights=weights, training_loss=loss)


def _replied(message: Message, context: Context, source: Source, training: bool) -> Message:
    """The reply. Only the type of an exception leaves, because its text may quote a coordinate."""
    from flwr.app import Error, Message

    try:
        client, job = source(context)
        return Message(answer(report(client, job, *asked(message.content), training)), reply_to=message)
    except Exception as error:
        traceback.print_exc(file=sys.stderr)
        reason = f"{type(error).__name__} in the client, see its own log"
        return Message(Error(code=0, reason=reason), reply_to=message)
