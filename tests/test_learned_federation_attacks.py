"""Byzantine clients against aggregation, the selected round and the server; a server that is killed and restarted."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_learned_flower import TINY, deployed, drives, honest, in_process, room
from torch import Tensor

from coopoc import InputError
from coopoc.learned import GainNet, Privacy, SecureAggregation, load
from coopoc.learned.federation.aggregate import rule
from coopoc.learned.federation.history import Federation, Round
from coopoc.learned.federation.means import inverse_variance
from coopoc.learned.federation.server import Answer, combine
from coopoc.learned.flower.ask import Wait
from coopoc.learned.flower.job import job_of
from coopoc.learned.flower.progress import Progress, read, write
from coopoc.learned.flower.server import configured, rounds
from coopoc.learned.flower.wire import Report, answer
from coopoc.learned.privacy.masks import secure_normal

flower = pytest.mark.skipif(importlib.util.find_spec("flwr") is None, reason="flwr is not installed: coopoc[flower]")
pytestmark = pytest.mark.filterwarnings("ignore:'click.utils:DeprecationWarning")
LOSSES = [math.nan, math.inf, -math.inf, 1e308, -1.0]


@pytest.mark.parametrize("loss", [0.0, -1.0, 1e-320, math.nan, math.inf, 1e308])
def test_no_reported_loss_ruins_the_uncertainty_rule(loss: float) -> None:
    """The weights stay finite and inside the hull of the answers; no client outweighs a median one by over 100."""
    weights = torch.tensor([[0.0], [1.0], [1.0], [1.0], [1.0]])
    answers = {str(i): Answer(w, 7, loss if i == 0 else 2.0) for i, w in enumerate(weights)}
    done = combine(rule("uncertainty"), (), torch.zeros(1), answers)
    assert 0.0 < float(done.theta) <= 1.0
    alone = float(inverse_variance(weights, torch.full((5,), 7), torch.tensor([loss, 2.0, 2.0, 2.0, 2.0])))
    assert 4 / 104 - 1e-6 <= alone <= 1.0


@pytest.mark.parametrize("losses", [(0.0, 0.0), (1e-320, 0.0), (-1.0, math.nan)])
def test_losses_without_a_valid_median_still_give_finite_weights(losses: tuple[float, float]) -> None:
    answers = {str(i): Answer(torch.full((3,), 0.1), 50, loss) for i, loss in enumerate(losses)}
    found = combine(rule("uncertainty"), (), torch.zeros(3), answers).theta
    torch.testing.assert_close(found, torch.full((3,), 0.1))


def test_weights_that_are_not_finite_are_never_taken() -> None:
    """Neither from a rule that divides by zero nor into the state of Adam; the round says why nothing changed."""
    answers = {name: Answer(torch.full((2,), 0.1), 1, 1.0) for name in "ab"}
    done = combine(rule(lambda w, n, v: w.sum(0) / 0.0), (), torch.zeros(2), answers)
    assert done.theta.tolist() == [0.0, 0.0]
    assert done.note == "<lambda> gives weights that are not finite: weights unchanged"
    adam, far = rule("fedadam"), {name: Answer(torch.full((2,), 1e30), 1, 1.0) for name in "abc"}
    state = adam.start(torch.zeros(2))
    after = combine(adam, state, torch.zeros(2), far, usual=1e30)
    assert "not finite" in after.note
    assert after.state is state
    with pytest.raises(InputError, match=r"must have the shape \(2,\)"):
        combine(rule(lambda w, n, v: w), (), torch.zeros(2), answers)


def federation(losses: np.ndarray) -> Federation:  # type: ignore[type-arg]
    """A history with these losses (rounds, C)."""
    names = tuple(f"c{i}" for i in range(losses.shape[1]))
    rows = [Round(k, torch.zeros(1), (math.nan,) * len(row), tuple(row)) for k, row in enumerate(losses.tolist())]
    return Federation(GainNet(2, 1), tuple(rows), (5,) * len(names), 0.0, names)


@pytest.mark.parametrize("false", [math.nan, math.inf, 1e308, 1e5, 0.0])
@pytest.mark.parametrize("clients", [3, 4, 12])
def test_one_client_cannot_select_the_untrained_round(false: float, clients: int) -> None:
    """It praises the start and condemns every other round; the others' losses fall from 4 to 1 m^2."""
    curve = np.linspace(4.0, 1.0, 8)[:, None] * np.linspace(0.8, 1.2, clients)
    assert federation(curve).best.number == 7
    curve[:, 0] = [1e-9, *[false] * 7]
    assert federation(curve).best.number >= 6


def test_honest_reports_select_the_least_mean() -> None:
    """Within ten percent of the least median the mean decides, as it did before."""
    curve = 1.0 + 0.04 * np.random.default_rng(3).random((20, 4))
    assert federation(curve).best.number == int(curve.mean(1).argmin())
    assert federation(curve[:, :2]).best.number == int(curve[:, :2].mean(1).argmin())


def test_secure_aggregation_rejects_what_its_fixed_point_cannot_hold() -> None:
    """The guard accepts a change that is 75 times the usual one; the other clients' mean is the result."""
    theta = torch.full((4,), 900.0)
    answers = {name: Answer(theta + step, 2, 1.0) for name, step in (("a", 2.0), ("b", 4.0), ("c", 300.0))}
    done = combine(SecureAggregation(), (), theta, answers)
    assert set(done.rejected) == {"c"}
    assert "does not fit the fixed point" in done.rejected["c"]
    torch.testing.assert_close(done.theta, theta + 3.0)
    few = combine(SecureAggregation(threshold=3), (), theta, answers)
    assert few.note.startswith("2 answers accepted")
    assert torch.equal(few.theta, theta)


def test_secure_noise_is_standard_normal_and_never_repeats() -> None:
    from scipy import stats

    one, two = secure_normal(40_000), secure_normal(40_000)
    assert stats.kstest(one, "norm").pvalue > 1e-7
    assert abs(np.corrcoef(one, two)[0, 1]) < 6 / 200
    private = Privacy(1.0, 1.0, clients=1, keyed=False)
    noise = private.protect(torch.zeros(1, 40_000), ["a"], 0, 1)
    assert stats.kstest(noise[0].numpy(), "norm").pvalue > 1e-7


def sends(name: str, weights: Tensor, loss: float = 1.0, change: Callable[[Any], object] = lambda content: None) -> Any:
    """A node that answers with these weights and this loss, and a content that is changed further."""
    from flwr.app import Message

    def node(message: Any) -> Any:
        content = answer(Report(name, 3, loss, 1.0, weights))
        change(content)
        return Message(content, reply_to=message)

    return node


def put(record: str, key: str, value: object) -> Callable[[Any], object]:
    return lambda content: content[record].__setitem__(key, value)


@flower
def test_malformed_answers_are_rejected_with_a_reason_and_training_goes_on() -> None:
    """Empty texts and lists, names and numbers of other types, losses that cannot be: the others train undisturbed."""
    job, fleet = job_of(TINY | {"rounds": 2}), drives(3)
    expected = in_process(job, fleet)
    theta = expected.history[0].weights
    changes = [
        put("client", "name", ""),
        put("client", "name", []),
        put("client", "name", "a\nb"),
        put("client", "name", 3.0),
        put("client", "failure", []),
        put("client", "extra", ""),
        put("client", "extra", []),
        put("metrics", "num-examples", []),
        put("metrics", "num-examples", 0),
        put("metrics", "validation-loss", []),
        put("metrics", "training-loss", math.nan),
        lambda content: content.__delitem__("metrics"),
    ]
    nodes = {10 + i: sends(f"bad{i}", theta, change=change) for i, change in enumerate(changes)}
    nodes |= {30 + i: sends(f"loss{i}", theta, loss) for i, loss in enumerate(LOSSES)}
    rows, found = deployed(job, {i: honest(job, fleet, i) for i in range(3)} | nodes)
    assert found.names == fleet.ids
    assert found.best.number == expected.best.number
    for row, other in zip(rows, expected.history, strict=True):
        assert torch.equal(row.weights, other.weights)
        assert row.number == 0 or set(row.rejected) == {f"node {node}" for node in nodes}
    assert rows[1].rejected["node 10"] == "malformed answer: a name that is not 1 to 200 printable characters"
    assert rows[1].rejected["node 33"] == "malformed answer: a validation-loss of 1e+308 m^2, must be in [0, 1e+12]"


@flower
def test_a_client_of_another_version_is_rejected_with_both_versions() -> None:
    """Its answers may mean something else; the others' weights are those of `federate` without it."""
    job, fleet = job_of(TINY | {"rounds": 2}), drives(3)
    expected = in_process(job, fleet)
    theta = expected.history[0].weights
    versions = {7: "99.1.0", 8: "", 9: 3, 10: "9" * 4000}
    others = {node: sends(f"other{node}", theta, change=put("client", "version", v)) for node, v in versions.items()}
    others[11] = sends("other11", theta, change=lambda content: content["client"].__delitem__("version"))
    rows, _ = deployed(job, {i: honest(job, fleet, i) for i in range(3)} | others)
    for row, other in zip(rows, expected.history, strict=True):
        assert torch.equal(row.weights, other.weights)
    mine = importlib.metadata.version("coopoc")
    wanted = f"malformed answer: made by coopoc {{}}, the server has {mine}: install the same"
    assert rows[1].rejected == {
        f"node {node}": wanted.format("99.1.0" if node == 7 else "an unknown version") for node in others
    }


@flower
def test_replayed_answers_change_nothing() -> None:
    """A node on the way delivers each answer twice and those of the rounds before again, before the new ones."""
    job, fleet = job_of(TINY), drives(3)
    expected, grid, kept = in_process(job, fleet), room({i: honest(job, fleet, i) for i in range(3)}), list[Any]()
    pushed = grid.push_messages

    def replaying(messages: Any) -> Any:
        asked = list(messages)
        names = pushed(asked)
        for message, reply in zip(asked, grid.replies, strict=True):  # every question and answer has a name of its own
            name = f"{message.metadata.group_id}-{message.metadata.dst_node_id}-{message.metadata.message_type}"
            message.metadata.__dict__["_message_id"] = name
            reply.metadata.__dict__["_reply_to_message_id"] = name
        kept.extend(grid.replies)
        grid.replies = [*grid.replies, *grid.replies, *kept]  # the last is delivered first
        return names

    grid.push_messages = replaying
    rows = list(rounds(grid, job, 3, Wait(60.0, 10.0, lambda _: None)))
    assert len(kept) > 9
    for row, other in zip(rows, expected.history, strict=True):
        assert torch.equal(row.weights, other.weights)
        assert not row.rejected


@flower
@pytest.mark.parametrize("rule_", ["mean", "fedadam"])
def test_a_restarted_server_continues_to_the_same_weights(rule_: str, tmp_path: Path) -> None:
    """Killed while it waits in round 3; what the new server makes is what an undisturbed one would have made."""
    job, fleet, path = job_of(TINY | {"aggregate": rule_}), drives(3), tmp_path / "net.safetensors.progress"
    nodes = {i: honest(job, fleet, i) for i in range(3)}

    def killed(message: Any) -> Any:
        if message.metadata.group_id == "3":
            raise KeyboardInterrupt
        return nodes[1](message)

    wait = Wait(60.0, 10.0, lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        list(rounds(room(nodes | {1: killed}), job, 3, wait, None, partial(write, path, job)))
    saved = read(path, job)
    assert saved is not None
    assert [row.number for row in saved.rows] == [0, 1, 2]
    again = list(rounds(room(nodes), job, 3, wait, saved))
    whole, _ = deployed(job, nodes)
    for mine, other in zip(again, whole, strict=True):
        assert torch.equal(mine.weights, other.weights)
        assert (mine.validation_loss, mine.traffic, mine.pieces) == (
            other.validation_loss,
            other.traffic,
            other.pieces,
        )
    with pytest.raises(InputError, match=r"progress = .*must be of the same recipe"):
        read(path, job_of(TINY | {"aggregate": rule_, "seed": 1}))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"progress = .*cannot be read"):
        read(path, job)


@pytest.mark.slow
@flower
def test_a_failed_run_raises_and_leaves_its_last_round(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All nodes vanish after round 1: the ServerApp ends with an error, its checkpoint and progress are on disk, and
    a second run of the app completes the training."""
    from flwr.app import Context, RecordDict

    config = TINY | {"nodes": 2, "timeout": 10.0, "patience": 10.0, "out": str(tmp_path / "net.safetensors")}
    job, fleet = job_of(config), drives(2)
    expected = in_process(job, fleet)  # compiles the engine before the timeout counts
    nodes = {i: honest(job, fleet, i) for i in range(2)}
    online = dict(nodes)

    def leaves(message: Any) -> Any:
        online.clear()
        return nodes[1](message)

    online[1] = leaves
    with pytest.raises(TimeoutError):
        configured(room(online), Context(1, 0, {}, RecordDict(), config))
    assert len(load(tmp_path / "net.safetensors").card["history"]) == 1
    configured(room(nodes), Context(2, 0, {}, RecordDict(), config))
    card = load(tmp_path / "net.safetensors").card
    assert [row["round"] for row in card["history"]] == [0, 1, 2, 3]
    assert card["best"] == expected.best.number
    assert not list(tmp_path.glob("*.progress"))
    assert "round 3" in capsys.readouterr().out
    assert json.dumps(card["history"][1]["rejected"]) == "{}"


@flower
def test_a_progress_file_is_whole_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that is interrupted leaves the previous file."""
    import coopoc.learned.checkpoint as module
    from coopoc.learned.flower.rows import Row

    job, path = job_of(TINY), tmp_path / "p"
    first = Progress((Row(0, torch.zeros(3)),), (torch.ones(3),), 2.5)
    write(path, job, first)

    def broken(*arguments: object, **options: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(module.os, "replace", broken)
    with pytest.raises(OSError, match="disk full"):
        write(path, job, replace_usual(first))
    back = read(path, job)
    assert back is not None
    assert (back.usual, back.rows[0].number, back.state[0].tolist()) == (2.5, 0, [1.0, 1.0, 1.0])
    damaged = bytearray(path.read_bytes())
    damaged[-1] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"progress.*cannot be read"):
        read(path, job)


def replace_usual(progress: Progress) -> Progress:
    return progress._replace(usual=9.0, rows=tuple(replace(row, note="x") for row in progress.rows))


@flower
def test_what_a_client_says_went_wrong_is_one_line_of_text() -> None:
    """The server prints it: no terminal may take it for a command, no reader for a round of its own."""
    from coopoc.learned.flower.wire import Report, answer, reported

    told = reported(answer(Report("a", 3, 1.0, failure="disk\x1b[2J\nround 9: validation 0.0" + 300 * "x")))
    assert told.failure.startswith("disk [2J round 9: validation 0.0x")
    assert len(told.failure) <= 200


@pytest.mark.parametrize("given", [{"timeout": math.nan}, {"timeout": -1}, {"timeout": "x"}, {"patience": -1.0}])
def test_a_wait_that_ends_at_once_or_never_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(given))):
        Wait(**given)
