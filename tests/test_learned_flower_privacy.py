"""Flower's own SecAgg+ around our local training, messages handed over in this process: the means are `federate`'s."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from functools import partial
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from coopoc import Fleet, InputError

pytest.importorskip("flwr")

from flwr.app import Context, Error, Message, RecordDict
from flwr.clientapp import ClientApp
from flwr.common.secure_aggregation.secaggplus_constants import Key
from flwr.common.secure_aggregation.secaggplus_utils import pseudo_rand_gen
from flwr.serverapp import Grid, ServerApp
from flwr.supercore.task_identity import TaskIdentity

from coopoc.learned import clients, federate
from coopoc.learned.flower.job import job_of
from coopoc.learned.flower.privacy import secure_client_app, secure_server_app
from coopoc.learned.flower.simulation import partition
from coopoc.learned.privacy.differential import Privacy
from coopoc.learned.recipes import sensors, untrained

TINY = {
    "recipe": "fedkalmannet",
    "rounds": 2,
    "local-epochs": 1,
    "net-in-mult": 2,
    "net-out-mult": 1,
    "piece": 10,
    "batch": 4,
}
LENGTHS = (60, 90, 130, 70)


def fleet() -> Fleet:
    t = np.arange(max(LENGTHS)) / 10
    wave = t[:, None] / 4 + np.arange(len(LENGTHS))
    velocity = np.stack([9 * np.cos(wave), 9 * np.sin(wave), 0.1 + 0 * wave], axis=-1)
    position = np.cumsum(0.1 * velocity, axis=0)
    for column, length in enumerate(LENGTHS):
        velocity[length:, column] = position[length:, column] = np.nan
    return Fleet(tuple(f"c{i}" for i in range(len(LENGTHS))), t, position, velocity)


class Local(Grid):  # type: ignore[misc]
    """Flower's messages without a network: each node's app answers at once, and what it raises is Flower's error."""

    def __init__(self, app: ClientApp, nodes: int, silent: tuple[int, int] | None = None) -> None:
        TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = 1  # who sends the server's messages
        self.app, self.silent, self.asked, self.received = app, silent, 0, list[Message]()
        self.contexts = {n + 1: Context(1, n + 1, {"partition-id": n}, RecordDict(), {}) for n in range(nodes)}

    run = SimpleNamespace(run_id=1)

    def set_run(self, run: Any) -> None: ...

    def create_message(self, *args: Any, **options: Any) -> Message:
        raise NotImplementedError

    push_messages = pull_messages = create_message

    def get_node_ids(self) -> list[int]:
        return list(self.contexts)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Stage after stage; the `silent` (node, stage) does not answer from that stage on."""
        replies = [self._answer(message) for message in messages]
        self.asked += 1
        self.received += [r for r in replies if r.has_content()]
        return replies

    def _answer(self, message: Message) -> Message:
        node = message.metadata.dst_node_id
        if self.silent is not None and self.silent[0] == node and self.asked >= self.silent[1]:
            return Message(Error(code=1, reason="gone"), reply_to=message)
        try:
            return deepcopy(self.app(deepcopy(message), self.contexts[node]))  # a network copies, too
        except Exception as error:
            return Message(Error(code=0, reason=str(error)), reply_to=message)


def led(app: ServerApp, grid: Grid) -> None:
    app(grid, Context(1, 0, {}, RecordDict(), {}))


@pytest.mark.parametrize("aggregate", ["mean", "fedavgm", "private"])
def test_secagg_plus_gives_the_weights_of_federate(aggregate: str) -> None:
    """Weighted mean, momentum at the server, and clipped updates: to the fixed point's 1e-6."""
    privacy = Privacy(0.05, 0.0, clients=4, keyed=False) if aggregate == "private" else None
    rule = "uniform" if privacy else aggregate
    job, drives, found = job_of(TINY | {"aggregate": rule}), fleet(), dict[int, torch.Tensor]()
    group = clients(drives, sensors(job.setting), seed=job.setting.seed, piece=10)
    largest = 1 if privacy else max(len(c.training) for c in group)
    grid = Local(secure_client_app(partial(partition, fleet=drives, job=job), privacy), 4)
    led(secure_server_app(job, 4, found.__setitem__, largest), grid)
    recipe = job.recipe
    ours = federate(untrained(job), group, 2, rule, 1, job.setting.seed, recipe.schedule, privacy=privacy)
    assert sorted(found) == [1, 2]
    for number, theta in found.items():
        torch.testing.assert_close(theta, ours.history[number].weights, rtol=0, atol=1e-6)
    assert float((found[2] - ours.history[0].weights).norm()) > 0.01


def test_deployed_noise_is_secret_and_of_the_promised_size() -> None:
    """Two runs differ; each round's mean is the clipped one plus noise of standard deviation z S / C."""
    job, drives, found = job_of(TINY | {"aggregate": "uniform", "rounds": 1}), fleet(), list[torch.Tensor]()
    for z in (0.0, 1.0, 1.0):
        privacy = Privacy(0.05, z, clients=4, keyed=False)
        grid = Local(secure_client_app(partial(partition, fleet=drives, job=job), privacy), 4)
        led(secure_server_app(job, 4, lambda number, theta: found.append(theta)), grid)
    noise = [(theta - found[0]).numpy() / (0.05 / 4) for theta in found[1:]]
    assert all(stats.kstest(n, "norm").pvalue > 1e-6 for n in noise)
    assert abs(np.corrcoef(*noise)[0, 1]) < 6 / np.sqrt(len(noise[0]))


def test_what_a_client_sends_is_masked() -> None:
    """No array leaves in the clear, and what leaves is uniform on the words of 32 bits."""
    job, drives = job_of(TINY | {"rounds": 1}), fleet()
    grid = Local(secure_client_app(partial(partition, fleet=drives, job=job)), 4)
    led(secure_server_app(job, 4, lambda number, theta: None, 12), grid)
    arrays = [array for m in grid.received for record in m.content.array_records.values() for array in record.values()]
    assert not arrays
    sent = [
        record[Key.MASKED_PARAMETERS]
        for m in grid.received
        for record in m.content.config_records.values()
        if Key.MASKED_PARAMETERS in record
    ]
    words = [np.load(BytesIO(data)).ravel() for parts in sent for data in parts]
    weights = [w / 2.0**32 for w in words if w.size > 1]
    assert [w.size for w in weights] == [sum(p.numel() for p in untrained(job).parameters())] * 4
    assert all(stats.kstest(w, "uniform").pvalue > 1e-7 for w in weights)
    assert {w.dtype for w in words} == {np.dtype(np.int64)}  # twice the bytes of a float32


def test_the_masks_of_this_flower_have_32_bits() -> None:
    """Seeds of 32 bytes whose words have the same exclusive or give the same mask: see docs/privacy.md."""
    seed = bytes(range(32))
    folded = seed[4:8] + seed[:4] + seed[8:]
    (one,), (two,) = (pseudo_rand_gen(s, 2**32, [(50,)]) for s in (seed, folded))
    assert seed != folded
    assert (one == two).all()


def test_a_client_that_is_gone_is_left_out() -> None:
    """Client 2 shares its keys and then leaves: the round is the mean of the other three."""
    job, drives, found = job_of(TINY | {"rounds": 1, "aggregate": "uniform"}), fleet(), dict[int, torch.Tensor]()
    grid = Local(secure_client_app(partial(partition, fleet=drives, job=job)), 4, silent=(2, 2))
    led(secure_server_app(job, 4, found.__setitem__), grid)
    group = clients(drives.select([0, 2, 3]), sensors(job.setting), seed=job.setting.seed, piece=10)
    ours = federate(untrained(job), group, 1, "uniform", 1, job.setting.seed, job.recipe.schedule)
    torch.testing.assert_close(found[1], ours.history[1].weights, rtol=0, atol=1e-6)


def test_what_cannot_be_is_named() -> None:
    with pytest.raises(InputError, match="clients = 2"):
        secure_server_app(job_of(TINY), 2, lambda number, theta: None)
    with pytest.raises(InputError, match="aggregate"):
        secure_server_app(job_of(TINY | {"aggregate": "median"}), 4, lambda number, theta: None)
    with pytest.raises(InputError, match="clients = None"):
        secure_client_app(privacy=Privacy(1.0, 1.0, keyed=False))
    with pytest.raises(InputError, match="keyed = True: must be False in a deployment"):
        secure_client_app(privacy=Privacy(1.0, 1.0, clients=4))
