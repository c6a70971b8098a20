"""The Flower apps: the weights of `federate`, Flower's own average, bad and missing answers, silent errors."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest
import torch
from logs import long, seen, write
from torch import Tensor

from coopoc import Fleet, InputError, load_fleet
from coopoc.arrays import Floats
from coopoc.cli import main
from coopoc.data.fleet_files import write_table
from coopoc.errors import MissingLibraryError
from coopoc.learned import clients, federate, load
from coopoc.learned.federation.history import Federation
from coopoc.learned.federation.local import local_fit
from coopoc.learned.flower import client_app, rounds, train
from coopoc.learned.flower.ask import Wait
from coopoc.learned.flower.job import job_of, local
from coopoc.learned.flower.rows import Row, federation
from coopoc.learned.flower.simulation import partition
from coopoc.learned.flower.wire import Report, answer
from coopoc.learned.recipes import RECIPES, Job, Setting, job_clients, untrained

if TYPE_CHECKING:
    from flwr.app import Message

ROOT = Path(__file__).resolve().parents[1]
TINY: dict[str, Any] = {
    "recipe": "fedkalmannet",
    "rounds": 3,
    "local-epochs": 1,
    "piece": 10,
    "net-in-mult": 2,
    "net-out-mult": 1,
}
Node = Callable[["Message"], "Message | None"]
pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("flwr") is None, reason="flwr is not installed: coopoc[flower]"),
    pytest.mark.filterwarnings("ignore:'click.utils:DeprecationWarning"),
]


def drives(vehicles: int = 4, steps: int = 100) -> Fleet:
    """Vehicles that drive circles of their own."""
    t = np.arange(steps) / 10
    wave = t[:, None] / 4 + np.arange(vehicles)
    velocity = np.stack([9 * np.cos(wave), 9 * np.sin(wave), 0.1 + 0 * wave], axis=-1)
    return Fleet(tuple(f"c{i}" for i in range(vehicles)), t, np.cumsum(0.1 * velocity, axis=0), velocity)


def in_process(job: Job, fleet: Fleet) -> Federation:
    recipe, seed, own = job.recipe, job.setting.seed, job_clients(job, fleet)
    return federate(untrained(job), own, recipe.rounds, recipe.aggregate, recipe.local_epochs, seed, recipe.schedule)


def average(job: Job, fleet: Fleet, names: Sequence[str], number: int, theta: Tensor) -> Floats:
    """Weights (P,) after round `number` of these clients only, averaged by NumPy."""
    recipe, made, sizes = job.recipe, list[Floats](), list[int]()
    for client in job_clients(job, fleet):
        if client.name in names:
            weights, _, _ = local_fit(
                untrained(job), theta, client, job.setting.seed, number, recipe.rounds, local(job)
            )
            made.append(weights.double().numpy())
            sizes.append(len(client.training))
    return np.asarray(np.average(np.stack(made), axis=0, weights=sizes))


def room(nodes: Mapping[int, Node]) -> Any:
    """A Flower grid without a network: every node answers at once, and the last that was asked answers first."""
    from flwr.proto.node_pb2 import NodeInfo
    from flwr.serverapp import Grid
    from flwr.supercore.task_identity import TaskIdentity

    TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = 1

    class Room(Grid):
        replies: list[Message]
        run: Any = None

        def set_run(self, run: Any) -> None: ...

        def create_message(self, *args: Any, **options: Any) -> Any: ...

        def get_node_ids(self) -> Iterable[int]:
            return list(nodes)

        def get_nodes(self) -> Iterable[Any]:
            return [NodeInfo(node_id=node) for node in nodes]

        def push_messages(self, messages: Iterable[Message]) -> Iterable[str]:
            asked = list(messages)
            for message in asked:
                message.metadata.__dict__["_message_id"] = f"{message.metadata.dst_node_id}"
            self.replies = [reply for message in asked if (reply := nodes[message.metadata.dst_node_id](message))]
            return [message.metadata.message_id for message in asked]

        def pull_messages(self, message_ids: Iterable[str]) -> Iterable[Message]:
            return [self.replies.pop()] if self.replies else []

        def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Any: ...

    return Room()


def honest(job: Job, fleet: Fleet, vehicle: int) -> Node:
    """The ClientApp of one vehicle, as Flower calls it."""
    from flwr.app import Context, RecordDict

    app = client_app(partial(partition, fleet=fleet, job=job))
    return lambda message: app(message, Context(1, vehicle, {"partition-id": vehicle}, RecordDict(), {}))


def deployed(job: Job, nodes: Mapping[int, Node], timeout: float = 60.0) -> tuple[list[Row], Federation]:
    rows = list(rounds(room(nodes), job, len(nodes), Wait(timeout, 10.0, lambda _: None)))
    return rows, federation(rows, job, 0.0)


@pytest.mark.parametrize("rule", ["mean", "fedadam", "uncertainty"])
def test_the_rounds_are_those_of_federate(rule: str) -> None:
    """Weights, losses and the round that is kept, bit by bit, whatever the order in which answers arrive."""
    job, fleet = job_of(TINY | {"aggregate": rule}), drives()
    expected = in_process(job, fleet)
    _, found = deployed(job, {i: honest(job, fleet, i) for i in range(4)})
    assert found.names == expected.names
    assert found.best.number == expected.best.number
    for mine, theirs in zip(found.history, expected.history, strict=True):
        assert torch.equal(mine.weights, theirs.weights)
        assert mine.validation_loss == theirs.validation_loss
        assert mine.training_loss == theirs.training_loss or mine.number == 0


def test_flowers_own_average_of_the_answers_is_the_new_net() -> None:
    """flwr's FedAvg reads our answers and finds the weights of our first round."""
    from flwr.app import Message
    from flwr.serverapp.strategy import FedAvg

    job, fleet, answers = job_of(TINY | {"rounds": 1}), drives(), list[Message]()

    def recorded(node: Node, message: Message) -> Message | None:
        answers.extend([reply] if (reply := node(message)) and message.metadata.message_type == "train" else [])
        return reply

    rows, _ = deployed(job, {i: partial(recorded, honest(job, fleet, i)) for i in range(4)})
    arrays, _ = FedAvg().aggregate_train(1, answers)
    assert arrays
    assert rows[1].weights.numpy() == pytest.approx(arrays["theta"].numpy(), abs=1e-7)
    assert not torch.equal(rows[1].weights, rows[0].weights)


def test_bad_answers_are_rejected_and_training_goes_on() -> None:
    """The rest trains as if the Byzantine clients were not there; the history has the reason for each."""
    from flwr.app import ConfigRecord, Error, Message, RecordDict

    job, fleet = job_of(TINY), drives()
    theta = in_process(job, fleet).history[0].weights

    def sends(name: str, weights: Tensor | None) -> Node:
        return lambda message: Message(answer(Report(name, 3, 1.0, 1.0, weights)), reply_to=message)

    byzantine: dict[int, Node] = {
        4: sends("nan", theta * torch.nan),
        5: sends("long", torch.cat([theta, theta])),
        6: sends("far", theta + 1e4),
        7: sends("double", theta.double()),
        8: sends("c1", theta),
        9: lambda message: Message(RecordDict({"junk": ConfigRecord({"a": 1})}), reply_to=message),
        10: lambda message: Message(Error(0, "out of memory"), reply_to=message),
    }
    rows, _ = deployed(job, {i: honest(job, fleet, i) for i in range(4)} | byzantine)
    for row, theirs in zip(rows, in_process(job, fleet).history, strict=True):
        assert torch.equal(row.weights, theirs.weights)
    for row in rows[1:]:
        assert "not finite" in row.rejected["nan"]
        assert "shape" in row.rejected["long"]
        assert "changes the weights" in row.rejected["far"]
        assert row.rejected["node 7"] == "malformed answer: weights in torch.float64, must be torch.float32"
        assert row.rejected["node 8"] == "claims the name c1 of another node"
        assert row.rejected["node 9"] == "malformed answer (KeyError)"
        assert row.absent == {"node 10": "out of memory"}


def test_a_silent_client_is_absent_and_welcome_back() -> None:
    """It misses round 2, of which the weights are then the average of the others', by NumPy."""
    job, fleet = job_of(TINY), drives(3)
    nodes = {i: honest(job, fleet, i) for i in range(3)}

    def sometimes(message: Message) -> Message | None:
        return None if message.metadata.group_id == "2" else honest(job, fleet, 1)(message)

    rows, found = deployed(job, nodes | {1: sometimes}, timeout=1.0)
    assert [sorted(row.training_loss) for row in rows] == [[], ["c0", "c1", "c2"], ["c0", "c2"], ["c0", "c1", "c2"]]
    assert rows[2].absent["c1"].startswith("no answer in")
    assert torch.equal(rows[1].weights, in_process(job, fleet).history[1].weights)
    assert found.history[1].validation_loss[1] == found.history[0].validation_loss[1]
    assert rows[2].weights.numpy() == pytest.approx(average(job, fleet, ["c0", "c2"], 2, rows[1].weights), abs=1e-6)
    assert rows[3].weights.numpy() == pytest.approx(average(job, fleet, fleet.ids, 3, rows[2].weights), abs=1e-6)


def test_nobody_who_can_answer_ends_the_run() -> None:
    from flwr.app import Error, Message

    with pytest.raises(RuntimeError, match="out of memory"):
        deployed(job_of(TINY), {1: lambda message: Message(Error(0, "out of memory"), reply_to=message)})
    with pytest.raises(TimeoutError, match="only 1 came online in 0 s"):
        list(rounds(room({1: lambda _: None}), job_of(TINY), 2, Wait(0.0)))
    with pytest.raises(InputError, match="nodes = 1"):
        list(rounds(room({1: lambda _: None}), job_of(TINY | {"aggregate": "krum"}), 1, Wait()))


def test_the_text_of_an_error_stays_in_the_client(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A faulty drive raises an error that quotes a coordinate: it is in the client's log and not in its answer."""
    from flwr.app import Context, Message, RecordDict

    from coopoc.learned.flower.wire import question

    fleet = drives(1)
    write_table(fleet, tmp_path / "drive.csv")
    lines = (tmp_path / "drive.csv").read_text().splitlines()
    lines[7] = lines[7].rpartition(",")[0] + ",8361947.125x"
    (tmp_path / "drive.csv").write_text("\n".join(lines))
    message = Message(question(torch.zeros(3), 1), 1, "train")
    context = Context(1, 1, {"data": str(tmp_path / "drive.csv")}, RecordDict(), TINY)
    reply = client_app()(message, context)
    assert "8361947" in capsys.readouterr().err
    assert "8361947" not in str(reply.error)
    assert "in the client, see its own log" in str(reply.error.reason)


def test_a_node_must_say_which_drive_is_its_own(tmp_path: Path) -> None:
    from flwr.app import Context, RecordDict

    from coopoc.learned.flower.client import configured

    write_table(drives(2), tmp_path / "two.csv")
    own: dict[str, Any] = {}
    for message in ("data = missing", "vehicle = missing"):
        with pytest.raises(InputError, match=message):
            configured(Context(1, 1, own, RecordDict(), TINY))
        own["data"] = str(tmp_path / "two.csv")
    own["vehicle"] = "c1"
    client, job = configured(Context(1, 1, own, RecordDict(), TINY))
    assert (client.name, job) == ("c1", job_of(TINY))


def test_a_node_may_train_on_what_it_measured(tmp_path: Path) -> None:
    """The node's client has the fixes of its log, to a digit of float32."""
    from flwr.app import Context, RecordDict

    from coopoc.learned.flower.client import configured

    fleet = drives(2)
    recording = seen(fleet, 0)
    write(long(recording), tmp_path / "measurements.csv")
    there, column = np.nonzero(fleet.present)
    truth = {"t": fleet.t[there], "vehicle": [fleet.ids[c] for c in column]}
    truth |= dict(zip("xyz", fleet.position[there, column].T, strict=True))
    write(pd.DataFrame(truth), tmp_path / "truth.csv")
    client, job = configured(Context(1, 1, {"log": str(tmp_path), "vehicle": "c1"}, RecordDict(), TINY))
    steps = job.recipe.piece + 1
    fixes = recording.gnss[0, :steps, 1]
    np.testing.assert_allclose(client.training.gnss[0], fixes - fixes[0], atol=1e-4)


def test_one_vehicle_alone_has_the_pieces_that_it_has_in_the_fleet() -> None:
    fleet = drives(3)
    for number, whole in enumerate(clients(fleet, piece=10, seed=4)):
        (alone,) = clients(fleet.select([number]), piece=10, seed=4)
        for part, field in product(("training", "validation", "long"), ("gnss", "velocity", "truth")):
            assert torch.equal(getattr(getattr(alone, part), field), getattr(getattr(whole, part), field))


def test_the_apps_configuration_is_the_recipe() -> None:
    config = tomllib.loads((ROOT / "examples" / "flower" / "pyproject.toml").read_text())
    assert job_of(config["tool"]["flwr"]["app"]["config"]) == Job("fedkalmannet", RECIPES["fedkalmannet"], Setting())
    with pytest.raises(InputError, match=r"change = 'round'.*Did you mean rounds"):
        job_of({"recipe": "fedkalmannet", "change": "round=3"})


@pytest.mark.parametrize("options", [["okf", "--flower"], ["fedkalmannet", "--rounds", "3"]])
def test_train_says_what_goes_with_flower(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["train", *options])
    assert ended.value.code == 2
    assert "lower" in capsys.readouterr().err


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flwr.app", None)
    with pytest.raises(MissingLibraryError, match=r"pip install 'coopoc\[flower\]'"):
        client_app()


@pytest.mark.slow
def test_train_with_flower_is_train(tmp_path: Path) -> None:
    """`coopoc train fedkalmannet --flower` writes the weights of `federate`; a second call finds them."""
    fleet = drives(2, steps=1010)
    write_table(fleet, tmp_path / "two.csv")
    command = [
        str(word)
        for word in (
            Path(sys.executable).with_name("coopoc"),
            "train",
            "fedkalmannet",
            "--flower",
            "--rounds",
            2,
            "--data",
            tmp_path / "two.csv",
            "--out",
            tmp_path / "weights",
        )
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "weights").iterdir()
    card, found, stamp = load(path).card, load(path).history, path.stat().st_mtime_ns
    job = job_of({"recipe": "fedkalmannet", "rounds": 2})
    expected = in_process(job, fleet)
    assert found is not None
    assert torch.equal(found, torch.stack([row.weights for row in expected.history]))
    assert str(card["engine"]).startswith("flower 1.")
    assert (card["best"], card["clients"], card["fleet"]) == (expected.best.number, ["c0", "c1"], "two")
    assert "train fedkalmannet" in done.stderr
    assert not [word for word in ("INFO", "WARN", "ERROR", "Warning") if word in done.stderr]
    again = train(job, load_fleet(tmp_path / "two.csv"), tmp_path / "weights")
    assert path.stat().st_mtime_ns == stamp
    assert list(again) == [path.stem]
