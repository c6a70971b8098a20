"""docs/extend.md as it stands: its files are written, its Python and its commands are run, in a folder of their own."""

import os
import re
import shutil
import sys
from dataclasses import replace
from textwrap import indent

import numpy as np
import pandas as pd
import pytest
from conftest import refused, textbook
from random_graphs import AB, PAIR
from shell import ROOT, python, ran

from coopoc import GNSS, V2X, JointFilter, Kalman, Sensors, observe, rt_le
from coopoc.data.registry import load_fleet
from coopoc.evaluate.metrics import measure
from coopoc.methods.catalogue import needs_whole_fleet
from coopoc.optimize import MEASUREMENTS, Problem, Status, solve
from coopoc.plugins import find, from_file
from coopoc.studies.lineup import own
from coopoc.study.results import Results
from coopoc.study.run import run_study
from coopoc.world.channels import channel

PAGE = ROOT / "docs" / "extend.md"
COOPOC = "-W error -m coopoc.cli"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)


def shell(command, folder, **env: str):
    """What a command prints; the test fails with its complaint if it fails."""
    return python(*command.replace("coopoc ", f"{COOPOC} ", 1).split(), cwd=folder, env={**os.environ, **env})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page's files: a block that begins with the name of a file is that file."""
    out = tmp_path_factory.mktemp("own")
    for text in blocks("python"):
        named = re.match(r"# (\w+\.py)\n", text)
        if named:
            (out / named[1]).write_text(text)
    return out


def commands(word):
    return [line for block in blocks("sh") for line in block.splitlines() if word in line]


def output(folder, word, change=str):
    """What the page's block with a word in it prints."""
    (block,) = [text for text in blocks("python") if word in text]
    (folder / "block.py").write_text(change(block))
    printed = python("-W", "error", "block.py", cwd=folder)
    counts = (np.array(re.findall(r"SOLVED in (\d+)", text), int) for text in (block, printed))
    np.testing.assert_allclose(*counts, rtol=0.2)  # of all starts, which differ between machines
    return printed


def test_a_method_of_ones_own_beside_others(folder):
    (command,) = commands("alpha.py:Alpha")
    table = shell(f"{command} --tracks tum", folder)
    rows, fleet = Results.load(folder / "runs/side_by_side").select(method="alpha.py:Alpha"), load_fleet("town10")
    for _, row in rows.iterrows():
        name = f"{row['max_neighbours']},alpha.py%3AAlpha,nominal,{row['ego']}-run{row['run']}.tum"
        error = (
            np.loadtxt(folder / "runs/side_by_side/tracks" / name)[:, 1:4] - fleet.position[:, fleet.index(row["ego"])]
        )
        assert np.sqrt(np.mean(np.sum(error**2, 1))) == pytest.approx(row["rt_le_m"], rel=1e-6)
    alpha, *_, bound = re.findall(r"^\| (\S.*?) +\|(?: [a-z]+ +\|)? +\**([\d.]+)\**", table, flags=re.MULTILINE)[:4]
    assert (alpha[0], bound[0]) == ("alpha", "Cramér-Rao bound")
    assert float(alpha[1]) > float(bound[1])


def test_a_cooperative_filter_in_thirty_lines(folder, formation):
    """It errs as the joint filter does, through losses and delays, and alone it is the Kalman filter."""
    ekf, fleet, sensors = (
        from_file(f"{folder}/ekf.py:CooperativeEKF")(),
        formation.between(0, 100),
        Sensors.paper_scenario2(),
    )
    seen = observe(fleet, sensors, V2X(max_neighbours=4, loss=0.2, latency=0.1), runs=5, observers=[0])
    ours, theirs = (rt_le(method(seen, [0]), fleet).mean() for method in (ekf, textbook(JointFilter())))
    assert ours == pytest.approx(theirs, rel=0.03)
    alone = observe(fleet, sensors, V2X(max_neighbours=0), runs=2)
    np.testing.assert_allclose(ekf(alone, [0]).x, textbook(Kalman())(alone, [0]).x, atol=2e-4)


def test_a_fleet_made_by_code(folder, monkeypatch):
    (command,) = commands("--data ring.py:ring")
    assert "egos of ring.py:ring" in shell(command, folder)
    monkeypatch.chdir(folder)
    assert len(load_fleet("ring.py:ring").ids) == 12


def test_a_backend_is_checked_as_all_are(folder, monkeypatch):
    assert output(folder, "least_squares.py:BACKEND").startswith("SOLVED")
    monkeypatch.chdir(folder)
    problem = Problem(("ego", "b")).add("position", ["ego", "b"], [[0, 0, 0], [9, 4, 0]], std=[1.0, 2.0, 3.0])
    problem = problem.add("range", ("ego", "b"), 10.0, std=1.0)
    mine, ours = solve(problem, "least_squares.py:BACKEND"), solve(problem, "gtsam")
    assert mine.x == pytest.approx(ours.x, abs=1e-8)
    early = solve(replace(problem, x0=problem.factors[0].z), "least_squares.py:BACKEND", throw=False, max_iterations=1)
    assert early.status is not Status.SOLVED  # it may claim what it likes
    with refused(r"rounds = 3: is no option of least-squares"):
        solve(problem, "least_squares.py:BACKEND", rounds=3)
    with refused(r"must be a Backend"):
        solve(problem, "least_squares.py:solver")


def test_a_measurement_is_at_once_in_the_backends_and_in_constraints(folder, monkeypatch):
    assert output(folder, '"lidar.py:elevation"').startswith("SOLVED")
    monkeypatch.chdir(folder)
    problem = PAIR.add("lidar.py:elevation", AB, 0.2, std=0.01)
    try:
        every = ("gauss-newton", "gtsam", "osqp", "casadi", "least_squares.py:BACKEND")
        bounded = problem.constrain("lidar.py:elevation", AB, upper=0.18)
        for each, backend, angle, near in (*((problem, b, 0.2, 0.01) for b in every), (bounded, "casadi", 0.18, 1e-6)):
            dx, dy, dz = np.diff(solve(each, backend).x, axis=0)[0]
            assert np.arctan2(dz, np.hypot(dx, dy)) == pytest.approx(angle, abs=near)
        source = folder / "lidar.py"
        source.write_text(source.read_text().replace("m.atan2(dz,", "m.atan2(-dz,"))
        dz = np.diff(solve(problem.add("lidar.py:elevation", AB, 0.2, std=0.01)).x, axis=0)[0, 2]
        assert dz < 0  # both rows have the formula of the edited file
        with refused(r"is no measurement.*@measurement"):
            problem.add("least_squares.py:solver", AB, 0.2, std=0.01)
    finally:
        MEASUREMENTS.pop("elevation", None)
    with refused("Did you mean spherical"):
        problem.add("sperical", AB, [9.0, 0.0, 1.5], std=0.1)


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("channel(name", ["ideal", "cam", "rain.py:rain"]),
        ("measure(name", ["rt_le_m", "nees", "late.py:final_error_m"]),
    ],
)
def test_a_channel_and_a_metric_go_by_their_file(folder, word, names):
    rows = [line.split() for line in output(folder, word).splitlines()]
    assert [row[0] for row in rows] == names
    assert all(float(row[1]) > 0 for row in rows)


@pytest.mark.parametrize(("word", "column"), [("rain.py:rain", "rt_le_m"), ("late.py:final_error_m", "final_error_m")])
def test_a_study_takes_a_channel_and_a_metric_by_their_file(folder, word, column):
    command = commands(f"={word}")[0]
    shell(command, folder)
    frame = pd.read_parquet(folder / command.split("--out ")[1] / "side_by_side" / "results.parquet")
    assert np.isfinite(frame[column]).all()
    assert set(frame["method"]) == {"joint", "kalman"}


def test_a_channel_and_a_metric_keep_their_promise(tmp_path, crossing):
    (tmp_path / "own.py").write_text(
        "def none(k):\n    return k\ndef flat(track, fleet):\n    return track.x[0, 0, 0]\n"
    )
    track = GNSS()(observe(crossing, Sensors()))
    with refused("must be a V2X"):
        channel(f"{tmp_path}/own.py:none")
    with refused(r"must have shape \(R, E\) = \(1, 1\)"):
        measure(f"{tmp_path}/own.py:flat", track, crossing)
    with refused(r"channel = 'camm': .*Did you mean cam\?"):
        channel("camm")
    with refused(r"metric = 'rt_le': .*Did you mean rt_le_m\?"):
        measure("rt_le", track, crossing)
    assert measure("nees", Kalman()(observe(crossing, Sensors())), crossing).shape == (1, 1)


@pytest.mark.slow
def test_an_aggregation_rule_goes_wherever_a_bundled_one_goes(folder, tmp_path):
    """In `federate`, in the study of rules, in `coopoc train`; an unknown rule is named with the nearest one."""
    differ = "\nassert not all(fed.history[0].weights == fed.history[2].weights)\n"
    output(folder, "own_rules.py:ClippedMean", lambda block: block + differ)
    (command,) = commands("own_rules.py:best_half")
    (folder / "examples").mkdir()
    shutil.copy(ROOT / "examples" / "aggregation.py", folder / "examples")
    assert "| best half " in shell(command, folder)
    wrong = f"{sys.executable} {COOPOC} train fedkalmannet --aggregate own_rules.py:best_hlaf --out {tmp_path}"
    done = ran(wrong.split(), cwd=folder)
    assert done.returncode == 2
    assert "Did you mean best_half?" in done.stderr


@pytest.mark.slow
def test_a_study_runs_in_worker_processes_and_reports(folder):
    ran, report = commands("rates")[:2]
    assert "| Every" in shell(ran, folder)
    assert (folder / shell(report, folder).strip()).is_file()


def test_a_notebook_gets_a_frame_and_a_table(folder):
    checks = "\nassert gain.low > 0, gain\nassert '<table>' in table._repr_html_()\n"
    output(folder, "results.frame", lambda block: f"if __name__ == '__main__':\n{indent(block + checks, '    ')}")


@pytest.mark.slow
def test_entry_points_give_names(folder, tmp_path):
    (toml,) = blocks("toml")
    info = tmp_path / "my_coopoc-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-coopoc\nVersion: 1.0\n")
    declared = toml[toml.index("[project.entry") : toml.index("[tool")].replace('"', "")
    (info / "entry_points.txt").write_text(re.sub(r"\[project\.entry-points\.(.*?)\]", r"[\1]", declared))
    env = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{folder}"}
    listed, ran = (command for command in blocks("sh")[-1].splitlines())
    names = shell(listed, tmp_path, **env)
    groups = {
        "methods": "alpha",
        "datasets": "ring",
        "backends": "least-squares",
        "channels": "rain",
        "metrics": "final_error_m",
        "rules": "best-half",
        "studies": "rates",
    }
    for group, name in groups.items():
        assert re.search(rf"^{group}: .*\b{name}\b", names, flags=re.MULTILINE), names
    assert "egos of ring" in shell(ran, tmp_path, **env)


def test_a_method_may_ask_for_the_whole_fleet(tmp_path):
    (tmp_path / "own.py").write_text("class All:\n    whole_fleet = True\nclass Some:\n    pass\n")
    assert needs_whole_fleet(f"{tmp_path}/own.py:All")
    assert not needs_whole_fleet(f"{tmp_path}/own.py:Some")


def test_what_is_not_there_is_named(tmp_path):
    (tmp_path / "own.py").write_text(
        "half = ''.index\nALPHA = 1\nclass Mute:\n    def __init__(self, noise):\n        pass\n"
    )
    for name, message in (("Mute", "must have a name"), ("half", "cannot be called")):
        with refused(message):
            own(f"{tmp_path}/own.py:{name}")
    with refused(r"ALPHA' = 1: must be a Study"):
        run_study(f"{tmp_path}/own.py:ALPHA")
    with pytest.raises(TypeError):
        load_fleet(f"{tmp_path}/own.py:ALPHA")
    (tmp_path / "own.py").write_text("import sys\nsys.exit('a script')\n")
    with refused("own.py = exit 'a script': must not end Python"):
        find("coopoc.methods", f"{tmp_path}/own.py:X")
