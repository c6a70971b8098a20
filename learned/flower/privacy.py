"""Flower's secure aggregation (SecAgg+) around the same local training: the server sees the clients' mean only."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from coopoc.errors import InputError

from ..nets.stack import flatten
from ..privacy.differential import Privacy
from ..privacy.secure import SecureAggregation
from ..recipes import Job, untrained
from .client import Source, configured, report
from .wire import require_flower

if TYPE_CHECKING:
    from flwr.app import Context
    from flwr.clientapp import ClientApp
    from flwr.serverapp import Grid, ServerApp

CLIP = 8.0
"""Largest weight that SecAgg+'s fixed point holds."""


def secure_client_app(source: Source | None = None, privacy: Privacy | None = None) -> ClientApp:
    """The ClientApp of one vehicle under SecAgg+: masked weights and the number of its pieces leave it, nothing else.

    A client whose training fails answers with an error and is a drop-out, which the protocol tolerates.

    Args:
        source: as in `client_app`.
        privacy: clip and noise under the mask; all clients then weigh the same, and the number of pieces is not sent.
            Its noise must come from a cryptographic generator (`keyed=False`), and `clients` must be given.

    Raises:
        MissingLibraryError: Flower is not installed.
        InputError: keyed noise, or a privacy without its number of clients.
    """
    require_flower("secure aggregation on Flower")
    if privacy is not None and privacy.keyed:
        allowed = "must be False in a deployment: keyed noise follows from seed and names and can be subtracted"
        raise InputError("keyed", True, allowed, "Take Privacy(..., keyed=False).")
    if privacy is not None and privacy.clients is None:
        hint = "Give Privacy(clients=...): a node does not know the others."
        raise InputError("clients", None, "must be given on a node", hint)
    from flwr.client import NumPyClient
    from flwr.client.mod import secaggplus_mod
    from flwr.clientapp import ClientApp

    class Vehicle(NumPyClient):
        def __init__(self, context: Context) -> None:
            self.fleet, self.job = (source or configured)(context)

        def fit(self, parameters: list[Any], config: dict[str, Any]) -> tuple[list[Any], int, dict[str, Any]]:
            theta, number = torch.from_numpy(parameters[0]).float(), int(config["server-round"])
            made = report(self.fleet, self.job, theta, number, True)
            if made.weights is None:
                raise RuntimeError("local training failed")
            weights, count = made.weights, made.pieces
            if privacy is not None:
                update = privacy.protect((weights - theta)[None], [made.name], self.job.setting.seed, number)
                weights = theta + update[0]
            equal = privacy is not None or SecureAggregation(self.job.recipe.aggregate).mean_by == "uniform"
            return [weights.double().numpy()], 1 if equal else count, {}  # in float32 Flower would round at CLIP

    return ClientApp(client_fn=lambda context: Vehicle(context).to_client(), mods=[secaggplus_mod])


def secure_server_app(
    job: Job, clients: int, found: Callable[[int, Tensor], object], largest: int = 1, threshold: int | None = None
) -> ServerApp:
    """The ServerApp of a federation under SecAgg+; the mean of each round goes through the rule of the recipe.

    Args:
        job: recipe, whose rule must need the mean only, and setting.
        clients: C that must be online.
        found: called with the number of every round and the weights (P,) after it.
        largest: pieces of the largest client, 1 if all weigh the same; sets the resolution of the fixed point.
        threshold: clients that a round needs, default 2 C // 3 + 1 and less than C, as Flower requires.

    Raises:
        InputError: fewer than three clients, or a rule that needs the weights of single clients.
        MissingLibraryError: Flower is not installed.

    References:
        Bell et al., Secure single-server aggregation with (poly)logarithmic overhead, CCS 2020.
    """
    require_flower("secure aggregation on Flower")
    if clients < 3:
        raise InputError(
            "clients", clients, "must be >= 3 for SecAgg+", "In a sum of two either knows the other's update."
        )
    from flwr.serverapp import ServerApp

    app, rule = ServerApp(), SecureAggregation(job.recipe.aggregate)

    @app.main()
    def main(grid: Grid, context: Context) -> None:
        from flwr.server import LegacyContext, ServerConfig
        from flwr.server.workflow import DefaultWorkflow, SecAggPlusWorkflow

        least = threshold or min(2 * clients // 3 + 1, clients - 1)
        bits = 31 - (clients - 1).bit_length()  # the sum of all clients stays below the modulus of 2^32
        masked = SecAggPlusWorkflow(
            num_shares=clients,
            reconstruction_threshold=least,
            max_weight=float(largest),
            clipping_range=CLIP,
            quantization_range=2**bits,
        )
        legacy = LegacyContext(context, ServerConfig(job.recipe.rounds), _strategy(job, rule, clients, found))
        DefaultWorkflow(fit_workflow=masked)(grid, legacy)

    return app


def _strategy(job: Job, rule: SecureAggregation, clients: int, found: Callable[[int, Tensor], object]) -> Any:
    """The Flower strategy that passes the mean of each round to the server's rule."""
    from flwr.common import ndarrays_to_parameters, parameters_to_ndarrays
    from flwr.server.strategy import FedAvg

    class Mean(FedAvg):
        def __init__(self) -> None:
            (self.theta,) = flatten([untrained(job)])
            self.state = rule.start(self.theta)
            super().__init__(
                fraction_evaluate=0.0,
                min_fit_clients=clients,
                min_available_clients=clients,
                initial_parameters=ndarrays_to_parameters([self.theta.numpy()]),
                on_fit_config_fn=lambda number: {"server-round": number},
            )

        def aggregate_fit(self, server_round: int, results: Any, failures: Any) -> Any:
            mean = torch.from_numpy(parameters_to_ndarrays(results[0][1].parameters)[0]).to(self.theta.dtype)
            one = torch.ones(1)  # the workflow has put the mean in the place of every client's weights
            self.theta, self.state = rule.server(self.state, self.theta, mean[None], one, one)
            found(server_round, self.theta)
            return ndarrays_to_parameters([self.theta.numpy()]), {}

    return Mean()
