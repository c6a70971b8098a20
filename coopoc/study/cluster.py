"""cluster: outcomes of cells from the workers of a Dask cluster.

joblib's Dask backend waits for ever when a cell kills its workers (joblib 1.6: an error never reaches the caller), so
cells go to Dask's own client.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

from ..errors import InputError, MissingLibraryError
from .cell import Cell
from .compute import Function, Outcome, WorkerDiedError, attempt
from .provenance import environment

PATIENCE = 30.0
"""Seconds without any worker until a run gives up: one that is restarted is back by then."""


@dataclass(frozen=True)
class Cluster:
    """A Dask scheduler with workers that can load the study; their environments by address."""

    client: Any
    address: str
    environments: Mapping[str, Mapping[str, str]]

    @property
    def jobs(self) -> int:
        """Number of workers."""
        return len(self.environments)

    def compute(self, function: Function, cells: Sequence[Cell]) -> Generator[Outcome]:
        """Outcomes as they come. Cells of a worker that dies are computed by another one.

        Raises:
            WorkerDiedError: no worker is left, or a cell has killed one after the other.
        """
        done: SimpleQueue[Any] = SimpleQueue()
        run = uuid4().hex  # results of other runs are not ours, even if they have the same name
        futures = [
            self.client.submit(attempt, function, cell, key=f"{cell.name}-{run}", priority=-place, pure=False)
            for place, cell in enumerate(cells)
        ]
        for future in futures:
            future.add_done_callback(done.put)
        for _ in cells:
            future = self._patiently(lambda seconds: done.get(timeout=seconds))
            yield self._patiently(future.result)
            future.release()

    def _patiently(self, step: Callable[[float], Any]) -> Any:
        """Repeat a step that may time out: a result can be lost with its worker after it was announced."""
        while True:
            try:
                return step(PATIENCE)
            except (Empty, TimeoutError):
                if not self.client.nthreads():
                    raise _died(self.address, f"no worker is left for {PATIENCE:g} s") from None
            except Exception as error:
                raise _died(self.address, f"{type(error).__name__}: {error}") from error


@contextmanager
def connected(address: str, function: Function) -> Iterator[Cluster]:
    """The cluster at an address, such as tcp://10.0.0.1:8786.

    Raises:
        MissingLibraryError: Dask is not installed.
        InputError: no scheduler at the address, no worker, or a worker that computes on several threads, that cannot
            load the study or that has another version of coopoc.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingLibraryError("dask.distributed", "--cluster", "'coopoc[cluster]'") from None
    try:
        place = urlsplit(address)
        socket.create_connection((place.hostname, place.port), PATIENCE / 3).close()  # a Client that fails lingers on
        client = Client(address, timeout=PATIENCE / 3, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        hint = "Start one with: dask scheduler. It prints its address, such as tcp://10.0.0.1:8786."
        raise InputError("cluster", address, f"has no Dask scheduler ({error})", hint) from None
    with client:
        yield Cluster(client, address, _checked(client, address, function))


def _checked(client: Any, address: str, function: Function) -> dict[str, Mapping[str, str]]:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError:
        hint = f"Start one on each machine: dask worker {address} --nthreads 1."
        raise InputError("cluster", address, "has no worker", hint) from None
    if several := [worker for worker, threads in client.nthreads().items() if threads > 1]:
        allowed = f"has a worker of several threads, {several[0]}, but cells do not share a process"
        raise InputError("cluster", address, allowed, "Start workers with --nthreads 1, and --nworkers for more.")
    answers = client.run(_environment, function, on_error="return")
    mine = environment()["coopoc"]
    for worker, answer in answers.items():
        hint = "Install the same coopoc, and the package of the study, where the workers run."
        if isinstance(answer, BaseException):
            raise InputError("cluster", address, f"has a worker, {worker}, that cannot load the study ({answer})", hint)
        if answer["coopoc"] != mine:
            allowed = f"has a worker, {worker}, with coopoc {answer['coopoc']} instead of {mine}"
            raise InputError("cluster", address, allowed, hint)
    return dict(answers)


def _environment(function: Function) -> dict[str, str]:
    """On a worker: it has loaded `function` to come here."""
    return environment()


def _died(address: str, reason: str) -> WorkerDiedError:
    return WorkerDiedError(
        f"The cluster {address} stopped ({reason}). Finished cells are kept: repeat the command to resume."
    )
