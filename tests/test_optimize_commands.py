"""coopoc solve and coopoc check, as a user types them."""

import json
import sys

import numpy as np
import pytest
from conftest import measured
from graph_files import write_graph
from shell import ROOT, ran

from coopoc.cli import _status
from coopoc.formats.graph import Graph, PoseEdges, RangeEdges
from coopoc.optimize import backends, solver_commands


@pytest.fixture
def file(tmp_path):
    """Three poses in a row and a landmark ranged by all, measured without error: cost zero at the truth."""
    position = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 1.0], [3.0, 6.0]])
    angle = np.array([[0.0], [0.2], [0.1], [0.0]])
    turn = np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    moved = [position[1] - position[0], turn @ (position[2] - position[1])]
    odometry = PoseEdges([[0, 1], [1, 2]], moved, [[0.2], [-0.1]], [np.diag([0.01, 0.01, 1e-4])] * 2, [0.1, 0.2])
    distance = np.linalg.norm(position[:3] - position[3], axis=1)
    ranges = RangeEdges([[0, 3], [1, 3], [2, 3]], distance, [0.01] * 3, [0.0, 0.1, 0.2])
    graph = Graph(
        2,
        ("A0", "A1", "A2", "L0"),
        [True] * 3 + [False],
        position,
        angle,
        [0.0, 0.1, 0.2, np.nan],
        relative_pose=odometry,
        ranges=ranges,
    )
    path = tmp_path / "drive.pyfg"
    write_graph(graph, path)
    return path


def run(capsys, *words):
    return _status([*words]), *capsys.readouterr()


@pytest.mark.parametrize("backend", ["gauss-newton", "gtsam", "casadi"])
def test_solve_writes_the_solution(file, capsys, backend):
    target = file.with_suffix(".json")
    status, out, err = run(capsys, "solve", str(file), "--backend", backend, "--output", str(target))
    assert (status, json.loads(out)["status"]) == (0, "SOLVED")
    assert str(target) in err
    assert "in the plane" in err
    found = json.loads(target.read_text())
    assert found["seconds"] >= found["solve_seconds"] + found["check_seconds"] > found["solve_seconds"]
    assert found["nodes"]["A2"]["position"] == pytest.approx([8.0, 1.0], abs=1e-4)
    assert np.shape(found["nodes"]["A2"]["covariance"]) == (3, 3)


def test_a_wrong_line_and_an_unknown_backend_are_named(file, capsys):
    status, _, err = run(capsys, "solve", str(file), "--backend", "ceres")
    assert (status, "gauss-newton" in err) == (2, True)
    file.write_text(file.read_text() + "EDGE_RANGE 0.1 A0 L9 5.0 0.01\n")
    status, _, err = run(capsys, "solve", str(file))
    assert status == 2
    assert f"{file.name}: line {len(file.read_text().splitlines())} = vertex L9" in err


def test_check_solves_one_problem_with_every_backend(capsys, monkeypatch):
    status, out, err = run(capsys, "check")
    assert (status, out.count("SOLVED")) == (0, len(backends()))
    assert "0 disagree" in err
    monkeypatch.setattr(solver_commands, "find_spec", lambda library: None)
    status, out, err = run(capsys, "check")
    assert (status, out.count(" needs "), "pip install casadi" in err) == (1, len(backends()), True)


def test_the_example_draws_a_graph_file(tmp_path):
    picture, script = tmp_path / "drive.png", ROOT / "examples" / "graph_file.py"
    out = ran([sys.executable, "-W", "error", script, measured("mrclam5a.pyfg"), picture], check=True).stdout
    assert "-> 69.10 in" in out
    assert "-> 0.214 m" in out
    assert picture.stat().st_size > 10_000
