"""The Flower apps: the weights of `federate`, Flower's own average, bad and missing answers, silent errors."""

import importlib.util
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest
import torch
from conftest import refused, winding
from logs import long, observed, write
from make_fleet import write_table
from shell import ROOT

from coopoc.errors import MissingLibraryError
from coopoc.learned import clients, federate, load
from coopoc.learned.flower import client_app, rounds
from coopoc.learned.flower.client import job_of
from coopoc.learned.flower.server import Row, federation
from coopoc.learned.recipes import RECIPES, Job, Setting, job_clients, untrained

if TYPE_CHECKING:
    from flwr.app import Message

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


def drives(vehicles=4, steps=100):
    """Vehicles that wind about."""
    return winding(steps, 9.0, 4.0, vehicles)


def in_process(job, fleet):
    recipe, seed, own = job.recipe, job.setting.seed, job_clients(job, fleet)
    return federate(untrained(job), own, recipe.rounds, recipe.aggregate, recipe.local_epochs, seed, recipe.schedule)


def honest(job, fleet, vehicle):
    """The ClientApp of one vehicle, as Flower calls it."""
    from flwr.app import Context, RecordDict

    app = client_app(lambda context: (job_clients(job, fleet)[vehicle], job))
    return lambda message: app(message, Context(1, vehicle, {}, RecordDict(), {}))


def vehicles(job, fleet, count):
    """The first ones by their number."""
    return {i: honest(job, fleet, i) for i in range(count)}


def room(nodes):
    """A Flower grid without a network: every node answers at once, in the opposite order."""
    from flwr.serverapp import Grid
    from flwr.supercore.task_identity import TaskIdentity

    TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = 1

    class Room(Grid):
        run: Any = None

        def set_run(self, run): ...

        def create_message(self, *args, **options): ...

        def get_node_ids(self):
            return list(nodes)

        def get_nodes(self): ...

        def push_messages(self, messages): ...

        def pull_messages(self, message_ids): ...

        def send_and_receive(self, messages, *, timeout=None):
            return [reply for m in reversed([*messages]) if (reply := nodes[m.metadata.dst_node_id](m))]

    return Room()


def deployed(job, nodes):
    rows: list[Row] = []
    rounds(room(nodes), job, len(nodes), 5.0, rows.append, {})
    return rows, federation(rows, job, 0.0)


@pytest.mark.parametrize("rule", ["mean", "median", "trimmed_mean"])
def test_the_rounds_are_those_of_federate(rule):
    """Weights and losses to rounding, and the round that is kept, whatever the order in which answers arrive."""
    job, fleet = job_of(TINY | {"aggregate": rule}), drives()
    expected = in_process(job, fleet)
    _, found = deployed(job, vehicles(job, fleet, 4))
    assert found.names == expected.names
    for mine, theirs in zip(found.history[1:], expected.history[1:], strict=True):
        torch.testing.assert_close(mine.weights, theirs.weights, rtol=0, atol=1e-6)
        assert mine.validation_loss == pytest.approx(theirs.validation_loss, rel=1e-4)
        assert mine.received_bytes == 2 * theirs.received_bytes  # to train, and to validate
        assert mine.training_loss == pytest.approx(theirs.training_loss, rel=1e-4)
    assert found.best.number == 1 + int(np.argmin([expected.validation_loss(row) for row in expected.history[1:]]))


def sends(name, weights, **changes: object):
    """A node that answers with these weights, and with values of its own."""
    from flwr.app import Array, ArrayRecord, ConfigRecord, Message, MetricRecord, RecordDict

    def node(message):
        loss = "training-loss" if message.metadata.message_type == "train" else "validation-loss"
        metrics: dict[str, Any] = {"num-examples": 3, loss: 1.0}
        about: dict[str, Any] = {"name": name, "version": version("coopoc")}
        for key, value in changes.items():
            for entries in (metrics, about):
                if (entry := key.replace("_", "-")) in entries:
                    entries[entry] = value
        content = RecordDict({"metrics": MetricRecord(metrics), "client": ConfigRecord(about)})
        if message.metadata.message_type == "train":
            content["arrays"] = ArrayRecord({"theta": Array(weights.numpy())})
        return Message(content, reply_to=message)

    return node


def test_bad_answers_are_rejected_and_training_goes_on():
    """The rest trains as if the Byzantine clients were not there; the history has the reason for each.

    Where one reply holds more than the others, strategies raise InconsistentMessageReplies for all.
    """
    from flwr.app import Array, ArrayRecord, ConfigRecord, Error, Message, RecordDict

    job, fleet = job_of(TINY), drives()
    expected = in_process(job, fleet)
    theta = expected.history[0].weights
    byzantine: dict[int, Node] = {
        4: sends("nan", theta * torch.nan),
        5: sends("long", torch.cat([theta, theta])),
        6: sends("far", theta + 1e4),
        7: sends("double", theta.double()),
        8: sends(8, theta),  # type: ignore[arg-type]
        9: lambda message: Message(RecordDict({"junk": ConfigRecord({"a": 1})}), reply_to=message),
        10: lambda message: Message(Error(0, "out of\nmemory"), reply_to=message),
        11: sends("", theta),
        12: sends("a\nb", theta),
        13: sends("loss", theta, training_loss=-1e13),
        14: sends("none", theta, num_examples=0),
        15: sends("old", theta, version="0"),
        16: sends("server", theta),
    }
    array = Array(np.ones(1, np.float32))
    more: list[Callable[[Any], object]] = [
        lambda content: content["arrays"].update(extra=array) if "arrays" in content else None,
        lambda content: content.update(more=ArrayRecord({"theta": array})),
        lambda content: content.update(more=ConfigRecord({"a": 1})),
        lambda content: content["client"].update(more=1),
        lambda content: content["metrics"].update(more=1.0),
    ]

    def changed(message, change):
        reply: Any = sends("more", theta)(message)
        change(reply.content)
        return reply

    byzantine |= {17 + k: partial(changed, change=change) for k, change in enumerate(more)}
    rows, _ = deployed(job, vehicles(job, fleet, 4) | byzantine)
    for row, theirs in zip(rows[1:], expected.history[1:], strict=True):
        assert set(row.training_loss) == set(fleet.ids)
        torch.testing.assert_close(row.weights, theirs.weights, rtol=0, atol=1e-6)
        assert len(row.rejected) == len(byzantine)
        assert list(row.rejected.values()).count("other records than were asked for") == 1 + len(more)
        for reason in (
            "not finite",
            "weights of shape",
            "changes the weights",
            "weights in float64, must be float32",
            "malformed answer (TypeError)",
            "other records than were asked for",
            "out of memory",
            "1 to 200 printable",
            "a training-loss of -1e+13 m^2, must be in [-1e+12, 1e+12]",
            "number of pieces",
            "another version",
            "or the server's",
        ):
            assert any(reason in found for found in row.rejected.values()), (reason, row.rejected)


def test_no_node_answers_in_place_of_another():
    """Every honest vehicle takes part, whichever client claims its name, whenever, and with any node number."""
    job, fleet, known = job_of(TINY), drives(3), dict[int, str]()
    theta = in_process(job, fleet).history[0].weights
    late: Node = lambda message: None if message.content["config"]["server-round"] == 1 else sends("a", theta)(message)  # noqa: E731
    nodes = {i + 10: honest(job, fleet, i) for i in range(3)} | {8: late, 11: sends("a", theta)}
    rows: list[Row] = []
    rounds(room(nodes), job, 3, 5.0, rows.append, known)
    assert known == {8: "a, node 8", 10: "a", 11: "a, node 11", 12: "c"}
    assert all(not row.rejected and {"a", "c"} <= set(row.training_loss) for row in rows[1:])
    names = iter("abab" * 9)
    two = {1: lambda message: sends(next(names), theta)(message), 2: honest(job, fleet, 2)}
    assert "calls itself b" in str(deployed(job, two)[0][2].rejected)


def test_a_claimed_number_of_pieces_counts_ten_times_the_median_at_most():
    job, fleet = job_of(TINY), drives(3)
    rows, found = deployed(
        job, vehicles(job, fleet, 3) | {3: sends("d", in_process(job, fleet).history[0].weights, num_examples=2**30)}
    )
    pieces = rows[1].pieces
    assert pieces["d"] == 10 * int(np.median([pieces["a"], pieces["b"], pieces["c"], 2**30]))
    assert found.history[1].note == f"d claims {2**30} pieces and counts with {pieces['d']}"


@pytest.mark.parametrize(("aggregate", "least"), [("krum", 5), ("trimmed_mean", 4)])
def test_rules_take_the_same_number_of_clients_in_both_paths(aggregate, least):
    """Refused at the start; where too few answers are accepted later, the weights stay, and the round has a note."""
    job, fleet = job_of(TINY | {"aggregate": aggregate}), drives(least)
    few = vehicles(job, fleet, least - 1)
    with refused(f"takes at least {least}"):
        deployed(job, few)
    with refused(f"takes at least {least}"):
        in_process(job, drives(least - 1))
    theta = in_process(job, fleet).history[0].weights
    rows, found = deployed(job, few | {least: sends("bad", theta * torch.nan)})
    assert all(torch.equal(row.weights, theta) for row in rows)
    assert "weights unchanged" in found.history[1].note


def test_a_silent_client_is_absent_and_welcome_back():
    job, fleet = job_of(TINY), drives(3)
    nodes = vehicles(job, fleet, 3)
    node = nodes[1]
    nodes[1] = lambda m: None if m.content["config"]["server-round"] == 2 else node(m)  # type: ignore[index]
    rows, found = deployed(job, nodes)
    assert [sorted(row.training_loss) for row in rows] == [[], ["a", "b", "c"], ["a", "c"], ["a", "b", "c"]]
    assert found.history[2].absent == {"b": "no answer"}
    assert found.history[2].validation_loss[1] == found.history[1].validation_loss[1]


def test_too_few_nodes_end_the_run():
    with pytest.raises(TimeoutError, match="only 1 came online in 0 s"):
        rounds(room({1: lambda _: None}), job_of(TINY), 2, 0.0, print, {})
    with refused("aggregate = 'multi_krum'"):
        rounds(room({1: lambda _: None}), job_of(TINY | {"aggregate": "multi_krum"}), 1, 1.0, print, {})


def test_the_text_of_an_error_stays_in_the_client(tmp_path, capsys):
    """A faulty drive raises an error that quotes a coordinate: it is in the client's log and not in its answer."""
    from flwr.app import ConfigRecord, Context, Message, RecordDict

    write_table(drives(1), tmp_path / "drive.csv")
    lines = (tmp_path / "drive.csv").read_text().splitlines()
    lines[7] = lines[7].rpartition(",")[0] + ",8361947.125x"
    (tmp_path / "drive.csv").write_text("\n".join(lines))
    message = Message(RecordDict({"config": ConfigRecord({"server-round": 1})}), 1, "train")
    reply = client_app()(message, Context(1, 1, {"data": str(tmp_path / "drive.csv")}, RecordDict(), TINY))
    assert "8361947" in capsys.readouterr().err
    assert "8361947" not in str(reply.error)
    assert "in the client, see its own log" in str(reply.error.reason)


def test_a_node_must_say_which_drive_is_its_own(tmp_path):
    from flwr.app import Context, RecordDict

    from coopoc.learned.flower.client import configured

    write_table(drives(2), tmp_path / "two.csv")
    own: dict[str, Any] = {}
    for message in ("data = missing", "vehicle = missing"):
        with refused(message):
            configured(Context(1, 1, own, RecordDict(), TINY))
        own["data"] = str(tmp_path / "two.csv")
    own["vehicle"] = "b"
    client, job = configured(Context(1, 1, own, RecordDict(), TINY))
    assert (client.name, job) == ("b", job_of(TINY))


def test_a_node_may_train_on_what_it_measured(tmp_path):
    """The node's client has the fixes of its log, to a digit of float32."""
    from flwr.app import Context, RecordDict

    from coopoc.learned.flower.client import configured

    fleet = drives(2)
    recording = observed(fleet, 0)
    write(long(recording), tmp_path / "measurements.csv")
    there, column = np.nonzero(fleet.present)
    truth = {"t": fleet.t[there], "vehicle": [fleet.ids[c] for c in column]}
    truth |= dict(zip("xyz", fleet.position[there, column].T, strict=True))
    write(pd.DataFrame(truth), tmp_path / "truth.csv")
    client, job = configured(Context(1, 1, {"log": str(tmp_path), "vehicle": "b"}, RecordDict(), TINY))
    steps = job.recipe.piece + 1
    fixes = recording.gnss[0, :steps, 1]
    np.testing.assert_allclose(client.training.gnss[0], fixes - fixes[0], atol=1e-4)


def test_one_vehicle_alone_has_the_pieces_that_it_has_in_the_fleet():
    fleet = drives(3)
    for number, whole in enumerate(clients(fleet, piece=10, seed=4)):
        (alone,) = clients(fleet.select([number]), piece=10, seed=4)
        for part, field in product(("training", "validation", "long"), ("gnss", "velocity", "truth")):
            assert torch.equal(getattr(getattr(alone, part), field), getattr(getattr(whole, part), field))


def test_the_apps_configuration_is_the_recipe():
    config = tomllib.loads((ROOT / "examples" / "flower" / "pyproject.toml").read_text())
    assert job_of(config["tool"]["flwr"]["app"]["config"]) == Job("fedkalmannet", RECIPES["fedkalmannet"], Setting())
    with refused(r"change = 'round'.*Did you mean rounds"):
        job_of({"recipe": "fedkalmannet", "change": "round=3"})


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "flwr.app", None)
    with pytest.raises(MissingLibraryError, match=r"pip install .*\[flower\]'"):
        client_app()


def test_a_new_run_keeps_the_names_of_the_nodes(tmp_path):
    """They are in the card of the checkpoint that the killed server left."""
    from flwr.app import Context, RecordDict

    from coopoc.learned.flower.server import configured

    config, fleet = TINY | {"nodes": 1, "timeout": 5.0, "out": str(tmp_path / "net.safetensors")}, drives(1)
    job = job_of(config)
    theta = in_process(job, fleet).history[0].weights
    for nodes in ({9: honest(job, fleet, 0)}, {8: sends("a", theta), 9: honest(job, fleet, 0)}):
        configured(room(nodes), Context(1, 1, {}, RecordDict(), config))
    assert load(tmp_path / "net.safetensors").card["nodes"] == {"9": "a", "8": "a, node 8"}
