"""Benchmarks: the gate of benchmarks/run.py on made-up tables, CL-Bench and its cards."""

import ast
import hashlib
import json
import re
import sys
from dataclasses import replace
from pkgutil import resolve_name
from types import SimpleNamespace

import numpy as np
import pytest
import run
from conftest import measured, refused
from shell import ROOT
from test_layering import imports

import coopoc as co
from coopoc.data.log.residuals import TRUE_POSE_STD, together
from coopoc.data.registry import read_log as load_log
from coopoc.studies import benchmark, tasks
from coopoc.studies.tasks import TASKS, VALIDATION, VERSION

BASELINE = {"a: ours": {"ratio": 1.0, "tolerance": 1.5}, "b: ours": {"ratio": 0.01, "tolerance": 2.0}}


def row(name, ratio, right=True):
    return {"name": name, "us": 7.0, "ratio": ratio, "right": right}


@pytest.mark.parametrize("ratio", [1.51, float("nan")])
def test_the_gate_names_the_row_that_is_slower(ratio):
    printed = run.slower([row("a: ours", ratio), row("b: ours", 0.01)], BASELINE, ["a", "b"])
    assert len(printed) == 1
    assert printed[0].startswith("a: ours: ratio")
    assert "1.5 allowed" in printed[0]


def test_a_row_that_was_not_measured_fails_unless_its_benchmark_did_not_run():
    assert run.slower([row("a: ours", 1.0)], BASELINE, ["a", "b"]) == ["b: ours: in the baseline, but not measured"]
    assert run.slower([row("a: ours", 1.0)], BASELINE, ["a"]) == []


SCRIPTS = [path for folder in ("benchmarks", "docs", "examples") for path in (ROOT / folder).rglob("*.py")]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_script_takes_from_the_package_and_from_others_is_there(path, monkeypatch):
    """Names that it imports, and attributes of modules: not all scripts run in tests."""
    monkeypatch.syspath_prepend(path.parent)
    nodes = [*ast.walk(ast.parse(path.read_text()))]
    short = {alias.asname: alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    wanted = {name for source, names in imports(path.stem, path) for name in names or {source}}
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in short:
            wanted.add(f"{short[node.value.id]}.{node.attr}")
    for name in wanted:
        package = name.split(".")[0]
        if package == "coopoc" or path.with_name(f"{package}.py").is_file():
            try:
                resolve_name(name)
            except ModuleNotFoundError as error:  # a peer's library may be absent
                if (error.name or "").startswith("coopoc"):
                    raise


def test_a_new_baseline_keeps_tolerances_and_leaves_out_peers_and_wrong_rows():
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
def test_the_command_prints_writes_and_fails(monkeypatch, tmp_path, capsys, rows, arguments, code):
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


def test_stone_soup_ends_where_we_end(monkeypatch):
    """Its iterated update and its filter; one extended update does not."""
    pytest.importorskip("stonesoup", reason="pip install stonesoup")
    import classical

    monkeypatch.setattr(classical, "RUNS", 2)
    monkeypatch.setattr(classical, "STEPS", 21)
    monkeypatch.delitem(sys.modules, "stone_soup", raising=False)
    import stone_soup as soup

    snapshot = soup.snapshot()
    assert [snapshot.right(row.call()) for row in snapshot.rows] == [True, True, False]
    assert [row.judged for row in snapshot.rows] == [True, True, False]
    joint = soup.joint_filter()
    assert all(joint.right(row.call()) for row in joint.rows)


CARDS = sorted((ROOT / "benchmarks" / "cards").glob("*.json"))
PAPER = next(task for task in TASKS if task.name == "paper")

OWN = """
from dataclasses import dataclass, replace
import coopoc as co

@dataclass(frozen=True)
class Own:
    noise_model: object = "nominal"
    name: str = "own"
    cooperative: bool = False
    message: co.Message = co.Message("nothing", 0)

    def __call__(self, recording, egos=(0,)):
        if recording.sensors.gnss_bias != (0.0, 0.0) or recording.v2x.max_neighbours == 0:
            raise ValueError("neighbours are missing")
        return co.GNSS()(recording, egos)
"""


@pytest.fixture
def short(monkeypatch):
    """Tasks with two runs and two egos."""
    few = tuple(replace(task, runs=2, egos=2) for task in TASKS if task.name in ("alone", "paper", "spoofed"))
    monkeypatch.setattr(benchmark, "TASKS", few)


def test_parameters_are_chosen_on_other_drives_and_draws():
    for task, other in zip(TASKS, VALIDATION, strict=True):
        assert (task.name, task.sensors, task.v2x) == (other.name, other.sensors, other.v2x)
        assert task.seed != other.seed
    used = {co.load_fleet(task.data).digest for task in TASKS}
    assert not used & {co.load_fleet(name).digest for name in ("town10-validation", "town10-clients")}
    assert {task.data for task in VALIDATION} == {"town10-validation"}


def test_the_cards_method_is_scored_as_by_hand(short, tmp_path):
    assert benchmark.benchmark(("joint", "kalman"), out=tmp_path) == 0
    card = json.loads((tmp_path / "joint.json").read_text())
    assert (card["benchmark"], card["method"], card["source"]) == (VERSION, "joint", "")
    row = {row["task"]: row for row in card["tasks"]}["paper"]
    task = replace(PAPER, runs=2, egos=2)
    fleet, egos = co.load_fleet("town10"), list(task.columns)
    error = co.rt_le(
        co.JointFilter()(co.observe(fleet, task.sensors, task.v2x, runs=2, seed=task.seed, observers=egos), egos), fleet
    )
    assert row["rt_le_m"][0] == pytest.approx(error.mean(), abs=1e-4)
    least = np.sqrt(np.mean([co.bound_rt_le(co.posterior_bound(fleet, task.sensors, e, task.v2x)) ** 2 for e in egos]))
    assert row["bound_m"] == pytest.approx(least, abs=1e-4)
    assert row["over_bound"] == pytest.approx(np.sqrt((error**2).mean()) / least, abs=1e-3)
    solo = {row["task"]: row for row in json.loads((tmp_path / "kalman.json").read_text())["tasks"]}
    assert solo["spoofed"]["rt_le_m"] == solo["paper"]["rt_le_m"]
    assert solo["paper"]["received_bytes_per_second"] == 0
    assert benchmark.benchmark(("kalman",), out=tmp_path, seed=7, tasks=("paper",)) == 0
    (other,) = json.loads((tmp_path / "seed-7" / "kalman.json").read_text())["tasks"]
    low, _, high = (abs(value - solo["paper"]["rt_le_m"][0]) for value in other["rt_le_m"])
    assert 0 < abs(other["rt_le_m"][0] - solo["paper"]["rt_le_m"][0]) < 2 * (low + high)


def test_a_method_of_ones_own_gets_a_card_and_its_failures_are_rows(short, tmp_path, capsys):
    (tmp_path / "mine.py").write_text(OWN)
    assert benchmark.benchmark((f"{tmp_path / 'mine.py'}:Own",), out=tmp_path) == 1
    assert re.search(r'mine\.py", line \d+, in __call__\n.*\n +ValueError: neighbours', capsys.readouterr().err)
    names = (f"{tmp_path}/mine.py:Own", f"{tmp_path}//mine.py:Own")
    benchmark.benchmark(names, out=tmp_path / "two", tasks=("alone",))
    assert len([*(tmp_path / "two").iterdir()]) == 2
    (file,) = tmp_path.glob("*.json")
    card = json.loads(file.read_text())
    assert len(card["source"]) == 20
    assert hashlib.sha256(OWN.encode()).hexdigest().startswith(card["source"])
    rows = {row["task"]: row for row in card["tasks"]}
    assert rows["alone"]["failed"] == "ValueError: neighbours are missing"
    assert rows["paper"]["rt_le_m"][0] == pytest.approx(6.06, abs=0.1)
    assert "failed" in benchmark.page([card])


def test_wrong_words_are_named(tmp_path):
    for given, message in (
        (((), {}), "must name a method"),
        ((("joint",), {"tasks": ("papr",)}), "must be one of alone, paper"),
        (((), {"table": True}), "holds no card"),
        ((("jointt",), {}), "Did you mean joint"),
        ((("mine.py:Own",), {}), "is not there"),
        ((("pose-solo",), {}), "--data"),
    ):
        with refused(message):
            benchmark.benchmark(given[0], **{"out": tmp_path, **given[1]})  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_no_committed_card_lies_below_its_bound():
    assert len(CARDS) > 20
    for file in CARDS:
        card = json.loads(file.read_text())
        assert card["benchmark"] == VERSION
        for row in card["tasks"]:
            if (
                "bound_m" in row
            ):  # ten draws of errors that last a minute and are common hold some twenty independent ones
                share = 0.8 if row["task"] == "lasting" else 0.97
                assert row["over_bound"] > share, (card["method"], row)


def test_the_page_shows_the_committed_cards():
    """`coopoc benchmark --table --out benchmarks/cards` prints the table."""
    assert (
        benchmark.page([json.loads(file.read_text()) for file in CARDS]) in (ROOT / "docs" / "benchmark.md").read_text()
    )


OWN_POSES = """
from dataclasses import dataclass
import coopoc as co

@dataclass(frozen=True)
class Own:
    noise_model: object = "nominal"
    begin: object = None
    assumed: object = None
    name: str = "own"
    cooperative: bool = True
    message: co.Message = co.PoseFilter().message

    def __call__(self, recording, egos=(0,)):
        return co.PoseFilter("solo", begin=self.begin, assumed=self.assumed)(recording, egos)
"""


@pytest.mark.slow
def test_real_measurements_are_tasks_for_pose_filters(tmp_path):
    """The row's RT-LE is that of a PoseFilter by hand; a method of one's own gets the first poses and the noise."""
    (tmp_path / "mine.py").write_text(OWN_POSES)
    (tmp_path / "alone").mkdir()
    (tmp_path / "alone" / "tiers.pyfg").symlink_to(measured("tiers.pyfg"))
    measured("MRCLAM_Dataset6")
    rows = {}
    for name in ("pose-solo", "pose-fleet", f"{tmp_path / 'mine.py'}:Own"):
        folder = tmp_path / "alone" if "fleet" in name else measured()
        rows[name] = {row["task"]: row for row in benchmark.card(name, {}, folder)["tasks"]}
    assert "must hold MRCLAM_Dataset6" in rows["pose-fleet"]["robots"]["failed"]
    solo, whole = rows["pose-solo"]["uwb"], rows["pose-fleet"]["uwb"]
    assert whole["rt_le_m"][2] < solo["rt_le_m"][0]
    log, _ = together(load_log(measured("tiers.pyfg")))
    begin = np.c_[log.truth.position[0], log.truth.heading[0]]
    begin[0] = np.nan
    noise = replace(log.recording.sensors, range_std=tasks.RANGE_STD)
    size = int(10 / log.truth.dt)

    def by_hand(made):
        error = np.linalg.norm(made(log.recording, range(1, 5)).x[0] - log.truth.position[:, 1:], axis=2)  # type: ignore[union-attr]
        first = range(0, len(error) - size + 1, size)
        return float(np.mean([np.sqrt(np.nanmean(error[k : k + size] ** 2, 0)) for k in first]))

    fleet = co.PoseFilter("fleet", gate=5.0, begin=begin, spread=TRUE_POSE_STD, assumed=noise)
    assert whole["rt_le_m"][0] == pytest.approx(by_hand(fleet), abs=2e-4)
    own = rows[f"{tmp_path / 'mine.py'}:Own"]
    assert own["uwb"]["rt_le_m"][0] == pytest.approx(
        by_hand(co.PoseFilter("solo", begin=begin, assumed=noise)), abs=2e-4
    )
    assert own["robots"]["rt_le_m"][0] > rows["pose-solo"]["robots"]["rt_le_m"][0] / 2
    assert own["robots"]["data"] == rows["pose-solo"]["robots"]["data"]
