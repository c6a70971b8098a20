"""The command line as a stranger meets it: in a subprocess, from another folder."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from shell import python, ran
from small_runs import ENV

from coopoc.cli import main

COMMAND = [sys.executable, "-m", "coopoc.cli"]


def coopoc(*words, cwd):
    return ran([*COMMAND, *" ".join(words).split()], cwd=cwd, env=ENV, timeout=120)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder in which the small study has run."""
    out = tmp_path_factory.mktemp("cli")
    done = coopoc("run small --jobs 2 --set runs=3 --set max_neighbours=0,2", cwd=out)
    assert done.returncode == 0, done.stderr
    assert "\n\n| Neighbours K" in done.stdout  # after its caption
    assert "results are in runs/small" in done.stderr
    assert "small:" in done.stderr  # the bar names the stage
    return out


def test_help_a_list_and_a_mistake_load_nothing_heavy_and_show_what_others_add(tmp_path):
    heavy = ["numpy", "torch", "pandas", "pyarrow", "matplotlib", "joblib", "scipy", "gtsam", "casadi", "cvxpy"]
    mistake = ["run", "real", "--data", "nowhere"]
    for status, command, unused in (
        (0, ["--help"], heavy),
        (0, ["list"], heavy),
        (2, mistake, ["torch", "scipy.stats"]),
    ):
        code = (
            f"import sys, coopoc.cli as c\ntry: c.main({command})\nexcept SystemExit as e: "
            f"print(e.code, sorted(set({unused}) & set(sys.modules)))"
        )
        done = ran([sys.executable, "-c", code], cwd=tmp_path, timeout=60)
        assert done.stdout.splitlines()[-1] == f"{status} []", done.stdout
    own = coopoc("--help", cwd=tmp_path)
    assert re.search(r"greet +Greet somebody\.", own.stdout)
    assert re.search(r"run +Run a study", own.stdout)


NAMES = ("run", "table", "report", "list", "reference", "greet")
MISTAKES = (
    ("run smal", "study = 'smal': must be one of"),
    ("run mine.py", "Write mine.py:NAME."),
    ("rn", "command = 'rn': must be one of"),
    (
        "run small --set max_neighbours=-1",
        "max_neighbours = -1: must be >= 0, 0 for no neighbours. Give V2X(max_neighbours=...).",
    ),
    ("run small --set runs", "--set = 'runs': must be key=value"),
    ("run small --set rums=3", "Did you mean runs?"),
    ("run small --jobs 0", "jobs = 0: must be in 1..10000"),
    ("run small --data town10 --set data=town04", "gives data twice"),
    ("benchmark kalman --out /dev/null", "out = /dev/null: cannot be made"),
    ("run error_cdf --tracks tum", "tracks = error_cdf: has cells without estimates"),
    ("reference nowhere", "folder = nowhere: holds no manifest.json"),
    ("table nowhere", "folder = nowhere: holds no views.json"),
    ("solve drive.g2o --output drive.g2o", "ending of --output = '.g2o': must be one of .json"),
    ("data check drive.csv --picture a.foo", "ending of --picture = '.foo': must be one of .png"),
    ("data check /dev/zero", "data = /dev/zero: must be the path of a file or folder"),
    ("report", "folders = none"),
)
OF_OTHERS = ("greet --name x", "kin greet", "kin --help", "kin gret")
ONE_BY_ONE = """
import contextlib, io, json, sys
from coopoc.cli import main
for words in json.loads(sys.argv[1]):
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as ended:
            status = int(ended.code or 0)
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Status, stdout and stderr of commands that do nothing, one after the other in one process: most is its start."""
    lines = [
        *([name, "--help"] for name in NAMES),
        *(words.split() for words, _ in MISTAKES),
        *map(str.split, OF_OTHERS),
    ]
    cwd = tmp_path_factory.mktemp("answers")
    said = python("-c", ONE_BY_ONE, json.dumps(lines), cwd=cwd, env=ENV, timeout=120)
    assert not list(cwd.iterdir())
    return {tuple(words): json.loads(line) for words, line in zip(lines, said.splitlines(), strict=True)}


@pytest.mark.parametrize("name", NAMES)
def test_each_command_explains_itself_with_an_example(answers, name):
    status, out, err = answers[name, "--help"]
    assert status == 0, err
    assert f"Example: coopoc {name}" in out


def test_tables_on_stdout(folder):
    assert coopoc("table runs/small --format latex", cwd=folder).stdout.startswith(r"\begin{table}")
    done = coopoc("table runs/small --format csv", cwd=folder)
    header, *rows = done.stdout.splitlines()
    assert (
        header
        == "Neighbours K,GNSS,GNSS low,GNSS high,KF,KF low,KF high,Joint filter,Joint filter low,Joint filter high"
    )
    assert len(rows) == 2
    assert done.stderr == ""


@pytest.mark.parametrize("format", ["markdown", "latex"])
def test_a_reader_that_leaves_early_is_no_error(folder, format):
    words = " ".join([*COMMAND, "table", "runs/small", "--format", format])
    done = ran(["bash", "-c", f"{words} | true; exit ${{PIPESTATUS[0]}}"], cwd=folder, env=ENV, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_neither_an_ascii_locale_nor_a_narrow_terminal_matters(folder):
    env = ENV | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "COLUMNS": "1"}
    for words in ("run --help", "report runs/small", "table runs/small"):
        done = ran([*COMMAND, *words.split()], cwd=folder, env=env, timeout=60)
        assert done.returncode == 0, done.stderr


def test_a_closed_stdout_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with pytest.raises(SystemExit, match="0"):
        main(["list"])


def test_the_list_names_what_is_installed(tmp_path):
    done = coopoc("list", cwd=tmp_path)
    assert re.search(r"^studies: .*\bsmall\b", done.stdout, re.M)
    groups = [line.split(":")[0] for line in done.stdout.splitlines()]
    open_sets = ["measurements", "recipes", "nets", "rules", "channels", "metrics"]
    assert groups == ["datasets", "methods", "studies", "backends", *open_sets]


def test_commands_of_others(answers):
    assert answers["greet", "--name", "x"] == [0, "hello x\n", ""]
    assert answers["kin", "greet"] == [0, "hello you\n", ""]
    assert "greet" in answers["kin", "--help"][1]
    assert answers["kin", "gret"][0] == 2


@pytest.mark.parametrize(("words", "message"), MISTAKES)
def test_bad_usage_is_one_readable_line(answers, words, message):
    status, out, err = answers[tuple(words.split())]
    assert status == 2
    assert err.startswith("coopoc: ")
    assert message in err
    assert "Traceback" not in err
    assert len(err.splitlines()) == 1
    assert out == ""


def test_ctrl_c_while_libraries_load_ends_without_a_traceback(tmp_path):
    code = (
        "import sys\nclass Stop:\n    def find_spec(self, name, *rest):\n        if name == 'tyro':\n"
        "            raise KeyboardInterrupt\nsys.meta_path.insert(0, Stop())\nfrom coopoc.__main__ import main\nmain()"
    )
    done = ran([sys.executable, "-c", code, "list"], cwd=tmp_path)
    assert (done.returncode, done.stderr) == (130, "")


def test_failed_cells_set_the_status(tmp_path):
    (tmp_path / "trouble").write_text("raise")
    done = coopoc("run small --set runs=2", f"trouble={tmp_path / 'trouble'}", cwd=tmp_path)
    assert done.returncode == 1
    assert "diverged at step 3 (max_neighbours = 1" in done.stderr
    assert re.search(r'small_study.py", line \d+, in cell\n', done.stderr)
    assert "cells failed: 1, try them again with --retry-failed" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_an_interrupted_run_says_so_and_resumes(tmp_path, jobs):
    words = ["run", "small", "--jobs", jobs, "--set", "runs=2", "pause=0.4"]
    process = subprocess.Popen(
        [*COMMAND, *words],
        cwd=tmp_path,
        env=ENV,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells let background jobs ignore it
    )
    cells = tmp_path / "runs/small/cells"
    for _ in range(1000):
        if cells.is_dir() and len(list(cells.glob("*.parquet"))) >= 3:  # both workers are at work
            break
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "coopoc: interrupted. A study keeps its finished cells: repeat its command to resume." in stderr
    assert "Traceback" not in stderr
    assert 3 <= json.loads(coopoc(*words, "--dry-run", cwd=tmp_path).stdout)["finished"] < 9
