"""Every `coopoc` command on a page: its options parse, and its studies, methods, settings and data exist."""

import functools
import inspect
import re
import shlex
import shutil
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import tyro
from conftest import located
from shell import ROOT, TUTORIALS, python

import coopoc as co
from coopoc import plugins
from coopoc.cli import OWN_COMMANDS, _status
from coopoc.data.fetch import public
from coopoc.study.cell import assignments

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += [*TUTORIALS, ROOT / "docs" / "pages.py"]
WORDS = {"NAME": "neighbours", "FOLDER": "runs/neighbours", "METHOD": "joint", "RECIPE": "okf", "LOG": "mylog"}
WORDS["$SLURM_ARRAY_TASK_ID"] = "1"
"""What stands for a choice of the reader."""
FETCHED = {"mrclam-set6": "MRCLAM_Dataset6", "tiers": "tiers.pyfg"}
"""Data that the repository does not hold, and what they open."""


def commands(path):
    """Lines of commands and commands between backquotes, without their comments."""
    text = path.read_text().replace("\\\n", " ")
    lines = re.findall(r"^(?:# )? *(coopoc [^\n`]*)$", text, flags=re.MULTILINE)
    return [" ".join(line.partition(" #")[0].split()) for line in [*lines, *re.findall(r"`(coopoc [^`\n]+)`", text)]]


INSTALLED = "coopoc run side_by_side --data ring --set method=alpha,joint runs=2 max_neighbours=0 --out named"
"""Needs the package of its page, which another test installs."""
COMMANDS = sorted({(path.name, line) for path in PAGES for line in commands(path)} - {("extend.md", INSTALLED)})


def words(line):
    for word, chosen in WORDS.items():
        line = re.sub(rf"(?<![\w.:]){re.escape(word)}(?!\w)", chosen, line)
    return shlex.split(line, comments=True)[1:]


def parsed(argv):
    """The command of the words, and the arguments that tyro makes of the rest; nothing is called."""
    known: Mapping[str, Any] = {**plugins.points("coopoc.commands"), **OWN_COMMANDS}
    names = []
    while True:
        names.append(argv[0])
        found, argv = known[argv[0]], argv[1:]
        function = found.load() if isinstance(found, EntryPoint) else found
        if not isinstance(function, Mapping):
            break
        if not argv:
            return " ".join(names), {}
        known = function
    if not argv:
        return " ".join(names), {}  # a command that is mentioned
    bind = inspect.signature(function).bind

    @functools.wraps(function)
    def arguments(*given, **options):
        return dict(bind(*given, **options).arguments)

    return " ".join(names), tyro.cli(arguments, prog="coopoc", args=argv, config=(tyro.conf.FlagCreatePairsOff,))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the pages assume that a reader has: the files of two pages, a log, drives, a graph, a method."""
    out = tmp_path_factory.mktemp("reader")
    for page in ("extend", "your_data"):
        text = (ROOT / "docs" / f"{page}.md").read_text()
        for code in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
            if name := re.match(r"# (\w+\.py)\n", code):
                (out / name.group(1)).write_text(code)
    python("make_log.py", cwd=out)
    (out / "mine.py").write_text(f"{(out / 'alpha.py').read_text()}\nOwn = Alpha\n")
    body = re.search(r'```python\n((?:(?!```).)*"robots.csv", index=False\)\n)', text, flags=re.DOTALL)
    assert body
    (out / "robots.py").write_text(body.group(1))
    python("robots.py", cwd=out)
    (out / "log.csv").write_text((out / "mylog" / "measurements.csv").read_text().replace("t,vehicle", "zeit,auto", 1))
    fleet = co.load_fleet("town10").between(0, 50)
    rows = [
        f"{t},{k},{x},{y},{z}" for t, xs in zip(fleet.t, fleet.position, strict=True) for k, (x, y, z) in enumerate(xs)
    ]
    (out / "my_drive.csv").write_text("\n".join(["t,id,x,y,z", *rows]) + "\n")
    graph = [f"VERTEX_SE2 {k} {k} 0 0" for k in range(12)]
    graph += [f"EDGE_SE2 {k} {k + n} {n} 0 0 9 0 0 9 0 9" for n in (1, 4) for k in range(12 - n)]
    (out / "drive.g2o").write_text("\n".join(graph) + "\n")
    (out / "fetched").mkdir()
    for name, opens in FETCHED.items():
        if there := located(opens):
            (out / "fetched" / name).symlink_to(there.parent)
    for name in ("benchmarks", "examples"):
        (out / name).symlink_to(ROOT / name)
    return out


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=lambda text: text.replace("coopoc ", ""))
def test_a_command_parses_and_names_what_exists(page, line, folder, monkeypatch, capsys):
    name, given = parsed(words(line))
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COOPOC_DATA", str(folder / "fetched"))
    if name == "run" and given:
        status = _status([*words(line), "--dry-run"])
        told = capsys.readouterr().err
        to_get = re.search("Run coopoc data get (.*)[.]$", told)
        absent = to_get is not None and not (folder / "fetched" / to_get[1]).exists() and to_get[1] in public()
        assert status == (2 if absent else 0), told
        for pair in (text for group in given.get("set", ()) for text in group):
            assert len(assignments([pair])) == 1
    for study in given.get("folders", ()) if name == "report" else ():
        assert (folder / f"{Path(study).name}.py").exists() or plugins.find("coopoc.studies", Path(study).name)
    if name == "data get" and given:
        assert set(given["names"]) <= {*public()}
    if name == "train" and given:
        assert plugins.find("coopoc.recipes", given["recipe"])
    if name == "benchmark":
        from coopoc.studies.benchmark import simulated
        from coopoc.studies.lineup import named_method

        assert all(named_method(one) for one in given.get("methods", ()) if simulated(one))


CHEAP = [
    "coopoc list",
    "coopoc check",
    "coopoc data check mylog",
    "coopoc solve drive.g2o --outliers",
    "coopoc run neighbours --set runs=5 method=gnss,kalman max_neighbours=0,2",
    "coopoc table runs/neighbours --format latex",
    "coopoc report runs/neighbours --out report.html",
]
"""In this order, each from a page."""


def test_the_cheap_ones_run(folder, tmp_path, monkeypatch):
    shown = {line for _, line in COMMANDS}
    shutil.copytree(folder, tmp_path / "reader", symlinks=True)
    monkeypatch.chdir(tmp_path / "reader")
    for line in CHEAP:
        assert line in shown
        assert _status(words(line)) == 0, line
    assert Path("report.html").stat().st_size > 5e4


def test_scripts_and_targets_of_the_pages_exist():
    pages = [path.read_text() for path in PAGES]
    scripts = {
        name for text in pages for name in re.findall(r"python (?:-m )?((?:examples|benchmarks|tests)/\w+\.py)", text)
    }
    modules = {name for text in pages for name in re.findall(r"python -m (coopoc[\w.]*\w)", text)}
    targets = {name for text in pages for name in re.findall(r"(?:^|`)make ([a-z][a-z-]+)", text, flags=re.MULTILINE)}
    assert len(scripts) > 8
    assert {name for name in scripts if not (ROOT / name).is_file()} == set()
    assert {name for name in modules if find_spec(name) is None} == set()
    assert targets - set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)) == set()


def test_the_help_of_a_study_lists_its_settings():
    said = python("-m", "coopoc.cli", "run", "neighbours", "--help")
    for line in ("  runs=30", "  max_neighbours=0,1,2,3,4,6,8,10", "  data=town10  (of town04, town10, "):
        assert line in said
    assert "--retry-failed" in said
