"""The gate of benchmarks/run.py on made-up tables, and that its baseline names rows that the benchmarks have."""

from __future__ import annotations

import importlib
import json
import statistics
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
BASELINE = {"a: ours": {"ratio": 1.0, "tolerance": 1.5}, "b: ours": {"ratio": 0.01, "tolerance": 2.0}}


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import a benchmark by name, as its neighbours do."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module


@pytest.fixture
def run(load: Any) -> ModuleType:
    module: ModuleType = load("run")
    return module


def row(name: str, ratio: float, right: bool | None = True) -> dict[str, Any]:
    return {"name": name, "us": 7.0, "ratio": ratio, "right": right}


def test_the_gate_allows_what_is_within_the_tolerance(run: ModuleType) -> None:
    rows = [row("a: ours", 1.5), row("b: ours", 0.0001), row("b: a new row", 1e9)]
    assert run.slower(rows, BASELINE, ["a", "b"]) == []


@pytest.mark.parametrize("ratio", [1.51, float("nan")])
def test_the_gate_names_the_row_that_is_slower(run: ModuleType, ratio: float) -> None:
    printed = run.slower([row("a: ours", ratio), row("b: ours", 0.01)], BASELINE, ["a", "b"])
    assert len(printed) == 1
    assert printed[0].startswith("a: ours: ratio")
    assert "1.5 allowed" in printed[0]


def test_a_row_that_was_not_measured_fails_unless_its_benchmark_did_not_run(run: ModuleType) -> None:
    assert run.slower([row("a: ours", 1.0)], BASELINE, ["a", "b"]) == ["b: ours: in the baseline, but not measured"]
    assert run.slower([row("a: ours", 1.0)], BASELINE, ["a"]) == []


def test_only_false_is_wrong(run: ModuleType) -> None:
    rows = [row("a: ours", 1.0, right=False), row("b: ours", 1.0), row("b: a peer by another way", 1.0, right=None)]
    assert run.wrong(rows) == ["a: ours: the answer is wrong"]


def test_a_new_baseline_keeps_tolerances_and_leaves_out_peers_and_wrong_rows(run: ModuleType) -> None:
    rows = [
        row("b: ours", 0.0123456),
        row("a: ours, new", 3.0),
        row("a: filterpy", 1.0),
        row("a: ours", 2.0, right=False),
    ]
    assert run.kept(rows, BASELINE) == {
        "b: ours": {"ratio": 0.0123, "tolerance": 2.0},
        "a: ours, new": {"ratio": 3.0, "tolerance": run.TOLERANCE},
    }


@pytest.mark.parametrize(
    ("rows", "arguments", "code"),
    [
        ([row("ours", 1.0)], ["--gate"], 0),
        ([row("ours", 9.0)], [], 0),
        ([row("ours", 9.0)], ["--gate"], 1),
        ([row("ours", 1.0, right=False)], [], 1),
    ],
)
def test_the_command_prints_writes_and_fails(
    run: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    rows: list[dict[str, Any]],
    arguments: list[str],
    code: int,
) -> None:
    monkeypatch.setattr(run, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(run, "BASELINE", tmp_path / "baseline.json")
    run.BASELINE.write_text(json.dumps({"growth: ours": BASELINE["a: ours"]}))
    loaded = SimpleNamespace(measured=lambda: rows)
    gathered = run.gather
    monkeypatch.setattr(run, "gather", lambda names: gathered(names, lambda name: loaded))
    assert run.main(["--only", "growth", *arguments]) == code
    assert json.loads(run.RESULTS.read_text()) == [{**rows[0], "name": "growth: ours"}]
    printed = capsys.readouterr().out
    assert "| growth: ours" in printed
    assert ("FAILED growth: ours" in printed) == bool(code)


def test_medians_are_those_of_interleaved_rounds(load: Any) -> None:
    order, times = [], {"a": [3.0, 1.0, 2.0], "b": [9.0, 7.0, 30.0]}

    def spend(name: str) -> float:
        order.append(name)
        return times[name][order.count(name) - 1]

    found = load("timing").medians({name: lambda name=name: spend(name) for name in times}, 3)
    assert found == {name: statistics.median(each) for name, each in times.items()}
    assert order == ["a", "b"] * 3


def test_a_peer_that_is_not_installed_is_said(
    load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    peers = load("peers")
    monkeypatch.setattr(peers, "PEERS", {"no_such_peer": lambda: pytest.fail("it was asked for jobs")})
    assert peers.measured() == []
    assert "no_such_peer is not installed" in capsys.readouterr().err


def test_stone_soup_ends_where_we_end(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its iterated update and its filter; one extended update does not."""
    pytest.importorskip("stonesoup")
    classical = load("classical")
    monkeypatch.setattr(classical, "RUNS", 2)
    monkeypatch.setattr(classical, "STEPS", 21)
    monkeypatch.delitem(sys.modules, "stone_soup", raising=False)
    soup = load("stone_soup")
    snapshot = soup.snapshot()
    assert [snapshot.right(row.call()) for row in snapshot.rows] == [True, True, False]
    assert [row.judged for row in snapshot.rows] == [True, True, False]
    joint = soup.joint_filter()
    assert all(joint.right(row.call()) for row in joint.rows)


def test_the_baseline_names_rows_that_the_benchmarks_have(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The jobs are built small and none is timed."""
    baseline = json.loads((FOLDER / "baseline.json").read_text())
    growth = load("growth")
    found = {f"growth: {name}, {count} vehicles" for name in growth.METHOD_NAMES for count in growth.FLEETS}
    found |= {"growth: import coopoc"}
    for module in ("networked", "online_methods"):
        found |= {f"{module}: {name}, {word}" for name in load(module).JOBS for word in ("compiled",)}
    for name in ("gtsam", "casadi", "osqp", "cvxpy", "filterpy"):
        pytest.importorskip(name)
    backends, classical, fleet = load("backends"), load("classical"), load("fleet")
    found |= {f"backends: {each.job}: {each.words}" for job in backends.jobs(22) for each in job.rows}
    monkeypatch.setattr(classical, "RUNS", 2)
    monkeypatch.setattr(classical, "STEPS", 21)
    found |= {f"classical: {job}: {each.words}" for job, _, rows in classical.parts() for each in rows}
    monkeypatch.setattr(fleet, "VEHICLES", 20)
    monkeypatch.setattr(fleet, "SHORT", 12)
    found |= {f"fleet: {job}: {each.words}" for job, _, rows in fleet.parts() for each in rows}
    found |= {f"fleet: neighbours, {vehicles} vehicles" for vehicles, _ in fleet.SEARCHED}
    found |= {f"poses: poses, K = {neighbours}: compiled" for neighbours in load("poses").NEIGHBOURS}
    found |= {f"building: {row['name']}" for row in load("building").measured(rounds=1, count=20) if row["right"]}
    cliffs = load("cliffs")
    monkeypatch.setattr(cliffs, "STEPS", 4)
    monkeypatch.setattr(cliffs, "RUNS", 1)
    found |= {f"cliffs: {case.name}" for case in (*cliffs.method_cases(), *cliffs.stream_cases())}
    named = {name for name in baseline if not name.startswith("learned_gain: ")}
    assert named <= found
    assert {name for name in found if name.endswith((": ours", ", compiled"))} <= named


def test_the_baseline_names_rows_that_training_and_inference_have(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small net that is neither trained nor timed: names only."""
    learned = load("learned_gain")
    from torch import zeros

    from coopoc.learned.nets.gain_net import GainNet

    _, pieces, drive = learned.parts()
    monkeypatch.setattr(learned, "plain_training", lambda *_: zeros(1))
    monkeypatch.setattr(learned, "our_training", lambda *_: zeros(1))
    monkeypatch.setattr(learned, "seconds", lambda rows: {each.words: 1.0 for each in rows})
    rows = learned.measured((GainNet(in_mult=2, out_mult=1), pieces.take(range(36)), drive))
    baseline = json.loads((FOLDER / "baseline.json").read_text())
    named = {name for name in baseline if name.startswith("learned_gain: ")}
    assert named == {f"learned_gain: {each['name']}" for each in rows if "engine" in each["name"]}
