"""PyFG as a Recording in body frames: read against the file's lines, and range-only cooperation on a real log."""

import json
import sys
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from conftest import measured, refused
from graph_files import write_graph
from shell import ran

import coopoc as co
from coopoc.data.commands import check as data_check
from coopoc.data.registry import read_log as load_log
from coopoc.formats.pyfg import read_pyfg
from coopoc.world.body_frames import body_motion
from coopoc.world.links import wrap


@pytest.fixture(scope="module")
def tiers():
    return load_log(measured("tiers.pyfg"))


def test_odometry_and_ranges_are_those_of_the_file(tiers):
    """Counts of the raw text, and the truth of its vertices: ranges err by their stated 0.04 m."""
    seen, fleet = tiers.recording, tiers.truth
    assert fleet.ids == ("L0", "A", "B", "C", "D")
    assert seen.landmarks == (0,)
    place = np.where(np.arange(5)[:, None] == 0, seen.gnss[0], fleet.position)
    assert 0.9 * 7789 < len(seen.links) <= 7789  # several of a pair in a step are one
    gap = place[seen.links.step, seen.links.neighbour] - place[seen.links.step, seen.links.observer]
    assert np.nanmedian(abs(seen.relative[0, :, 0] - np.linalg.norm(gap, axis=1))) < 0.04
    assert seen.sensors.range_std == pytest.approx(0.04, abs=0.005)
    assert seen.sensors.velocity_std_ratio == 0
    motion, rate = body_motion(fleet)[0], wrap(np.diff(fleet.heading, axis=0, prepend=np.nan)) / 0.1
    for ours, true, least in ((seen.velocity[0, ..., 0], motion[..., 0], 0.75), (seen.body.yaw_rate[0], rate, 0.5)):
        there = np.isfinite(ours + true)[:, 1:] & (np.arange(len(true)) > 0)[:, None]
        assert np.corrcoef(ours[:, 1:][there], true[:, 1:][there])[0, 1] > least


def test_the_command_says_what_was_read(tmp_path, capsys):
    data_check(str(measured("tiers.pyfg")), picture=tmp_path / "tiers.png")
    said = capsys.readouterr().out
    assert "read: 7074 ranges" in said
    assert "where all are there, from the truth's first poses" in said
    assert "not used: 707 relative measurements beside a nearer one of the same pair, kind and step" in said


def test_graphs_that_are_no_recording_are_named(tmp_path):
    lines = [f"VERTEX_SE2 {0.1 * k} A{k} {k} 0 0" for k in range(30)]
    edges = [f"EDGE_SE2 {0.1 * k} A{k} A{k + 1} 1 0 0 0.01 0 0 0.01 0 0.01" for k in range(29)]
    file = tmp_path / "one.pyfg"
    file.write_text("\n".join(lines + edges) + "\n")
    log = load_log(file)
    seen, fleet = log.recording, log.truth
    assert np.allclose(seen.velocity[0, 1:, 0], [10.0, 0.0, 0.0])
    assert len(seen.links) == 0
    assert fleet.position[-1, 0, 0] == pytest.approx(28.0, abs=1.0)
    assert co.read_log(file, frame="body").recording.ids == ("A",)
    file.write_text("\n".join(lines + edges[:9] + edges[10:]) + "\n")
    with refused("no odometry from A9 to A10"):
        load_log(file)
    file.write_text("\n".join(lines + edges) + "\n")
    with refused("must be well below"):
        load_log(file, dt=9.0)


def test_points_and_poses_of_others_are_counted():
    log = load_log(measured("mrclam6.pyfg"))
    assert log.summary.refused["measured points and poses other than odometry"][0] == 13121


def without_stamps(part):
    """A graph as g2o can hold it."""
    if not is_dataclass(part):
        return part
    changes = {f.name: without_stamps(getattr(part, f.name)) for f in fields(part)}
    if isinstance(changes.get("stamps"), np.ndarray):
        changes["stamps"] = np.full_like(changes["stamps"], np.nan)
    return replace(part, **changes)  # type: ignore[type-var]


def inverted(line):
    """An edge of poses in the plane with the covariance in the place of the information."""
    words = line.split()
    if words[0] == "EDGE_SE2":
        matrix = np.zeros((3, 3))
        matrix[np.triu_indices(3)] = [float(word) for word in words[6:12]]
        covariance = np.linalg.inv(matrix + np.triu(matrix, 1).T)
        words[6:12] = [f"{value:.12g}" for value in covariance[np.triu_indices(3)]]
    return " ".join(words)


def test_covariances_for_information_are_named_where_a_graph_is_solved(tmp_path):
    write_graph(without_stamps(read_pyfg(measured("mrclam5a.pyfg"))), tmp_path / "right.g2o")
    lines = (tmp_path / "right.g2o").read_text().splitlines()
    (tmp_path / "wrong.g2o").write_text("\n".join(map(inverted, lines)) + "\n")
    found = {}
    for name in ("right", "wrong"):
        command = [sys.executable, "-m", "coopoc.cli", "solve", f"{name}.g2o", "--objective", "geodesic"]
        done = ran(command, cwd=tmp_path)
        found[name] = json.loads(done.stdout)["misfit"], "covariances where the format has information" in done.stderr
    assert 0.1 < found["right"][0] < 1.0
    assert not found["right"][1]
    assert found["wrong"][0] < 1 / 30
    assert found["wrong"][1]
