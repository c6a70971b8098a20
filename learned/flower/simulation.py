"""simulate: a federation on Flower's simulation engine, every client a virtual SuperNode in a Ray process."""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopoc.errors import MissingLibraryError
from coopoc.file_names import given_path
from coopoc.workers import progress_bar

from ..checkpoint import Checkpoint, load, read_card, save
from ..recipes import Job, job_clients
from ..training.clients import Client
from ..training.drives import Drives
from .client import Source, client_app, require_flower
from .server import Row, checkpoint, rounds, server_app

if TYPE_CHECKING:
    from flwr.app import Context
    from flwr.serverapp import Grid

DAY = 24 * 3600.0
"""Seconds that a round may take in a simulation, where no client is absent."""
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "FLWR_TELEMETRY_ENABLED": "0",
    "RAY_ENABLE_AUTO_CONNECT": "0",  # or a thread that asks Ray something after the end starts it again
}


def train(job: Job, fleet: Drives, out: Path | str, progress: bool = True) -> dict[str, Checkpoint]:
    """`simulate` and write the checkpoint, or read it from `out` if the same job is there.

    Args:
        job: recipe and setting.
        fleet: drives of the clients.
        out: folder of the checkpoint.
        progress: whether to draw a bar on stderr.

    Returns:
        The checkpoint by its label, such as "fedkalmannet-gnss-axis-0".

    Raises:
        MissingLibraryError: Flower or its simulation engine is not installed.
    """
    path = given_path(out) / f"{job.label}.safetensors"
    card = read_card(path) if path.is_file() else {}
    if card.get("key") != job.key(fleet) or not str(card.get("engine")).startswith("flower"):
        save(path, simulate(job, fleet, f"train {job.name}" if progress else None))
    return {job.label: load(path)}


def simulate(job: Job, fleet: Drives, progress: str | None = None, processes: int = 2) -> Checkpoint:
    """The checkpoint of a federation on Flower's simulation engine, with the weights of `federate`, to rounding.

    Args:
        job: recipe and setting.
        fleet: drives of the clients.
        progress: name of a bar on stderr, None for no bar.
        processes: clients that train at the same time; the weights do not depend on it.

    Raises:
        MissingLibraryError: Flower or its simulation engine is not installed.
    """
    require_flower("training with --flower")
    rows, began, fleet_size = list[Row](), time.perf_counter(), len(fleet.ids)
    bar = progress_bar(total=job.recipe.rounds + 1, desc=progress, unit="round", disable=progress is None)

    def keep(row: Row) -> None:
        rows.append(row)
        bar.update()

    def lead(grid: Grid, context: Context) -> None:
        rounds(grid, job, fleet_size, DAY, keep)

    with bar:
        _simulate(lead, partial(partition, fleet=fleet, job=job), fleet_size, processes)
    made = checkpoint(rows, job, time.perf_counter() - began)
    card = {**made.card, "key": job.key(fleet), "fleet": fleet.name, "digest": fleet.digest}
    return replace(made, model=made.model.calibrate([client.training for client in job_clients(job, fleet)]), card=card)


def partition(context: Context, fleet: Drives, job: Job) -> tuple[Client, Job]:
    """The vehicle of the fleet that is this virtual node."""
    return job_clients(job, fleet)[int(context.node_config["partition-id"])], job


def _simulate(lead: Callable[[Grid, Context], None], source: Source, nodes: int, processes: int) -> None:
    with _quiet() as folder:
        try:
            import ray
            from flwr.simulation import run_simulation
        except ImportError:
            raise MissingLibraryError("ray", "training with --flower", "'coopoc[flower]'") from None
        backend: Any = {
            "init_args": {
                "num_cpus": processes,
                "include_dashboard": False,
                "logging_level": logging.ERROR,
                "log_to_driver": False,
                "_temp_dir": folder,
                "object_store_memory": 80_000_000,
            },
            "client_resources": {"num_cpus": 1.0, "num_gpus": 0.0},
        }
        try:
            run_simulation(server_app(lead), client_app(source), nodes, backend_config=backend)
        finally:
            ray.shutdown()


@contextmanager
def _quiet() -> Iterator[str]:
    """Suppress log lines and usage reports; a temporary folder for Ray's files."""
    log, before = logging.getLogger("flwr"), dict(os.environ)
    level = log.level
    log.setLevel(logging.ERROR)
    os.environ |= QUIET
    try:
        with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
            yield folder
    finally:
        log.setLevel(level)
        os.environ.clear()
        os.environ |= before
