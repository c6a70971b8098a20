"""Study: what names a cell, how --set changes a study, and which code counts."""

import hashlib
import importlib
import sys
from functools import partial
from types import ModuleType

import numpy as np
import pytest
from conftest import refused

from coopoc.study.cell import assignments, parse
from coopoc.study.provenance import code_of
from coopoc.study.run import find_study, plan, run_study
from coopoc.study.study import Study, digest
from coopoc.study.tables import pivot


def study(**changes: object):
    options = {"grid": {"k": np.arange(2), "method": ("a", "b")}, "settings": {"runs": 3, "egos": (0, 1), "ratio": 0.1}}
    return Study(**{"name": "s", "question": "?", "cell": dict, **options, **changes})  # type: ignore[arg-type]


def names(**changes: object):
    return [cell.name for cell in study(**changes).cells()]


def test_the_grid_is_the_product_in_order():
    assert [tuple(c.params.values()) for c in study().cells()] == [(0, "a"), (0, "b"), (1, "a"), (1, "b")]
    assert study().cells()[0].settings == {"runs": 3, "egos": (0, 1), "ratio": 0.1, "k": 0, "method": "a"}
    assert len(study(where=lambda p: p["k"] > 0 or p["method"] == "a").cells()) == 3


def test_a_list_of_cells_is_taken_as_it_stands():
    listed = study(grid=[{"k": 1, "method": "a"}, {"k": 0, "method": "b"}])
    assert listed.axes == ("k", "method")
    assert [c.params["k"] for c in listed.cells()] == [1, 0]
    assert [c.params["method"] for c in listed.override({"k": "0"}).cells()] == ["b"]
    with refused(r"k = 7: must be among \[1, 0\]"):
        listed.override({"k": 7})
    with refused("grid = 1: must be"):
        study(grid=[1])


def test_all_that_changes_the_numbers_changes_the_name_and_nothing_else_does():
    base = names()
    assert len(set(base)) == 4
    assert names() == base
    assert names(question="Another wording?", limitations=("x",)) == base
    assert names(settings={"ratio": 0.1, "egos": [0, 1], "runs": 3}) == base
    for changed in ({"settings": {"runs": 4, "egos": (0, 1), "ratio": 0.1}}, {"key": lambda p: {"fleet": "f00d"}}):
        assert not set(names(**changed)) & set(base)


def test_names_are_stable_between_processes():
    text = b'{"data":"town10","ratio":0.1,"runs":3}'
    assert digest({"runs": 3, "data": "town10", "ratio": 0.1}) == hashlib.sha256(text).hexdigest()[:20]


def test_settings_are_read_as_the_type_of_their_default():
    changed = study().override({"runs": "100", "egos": "4,5,6", "ratio": "0.15", "k": "2"})
    assert changed.settings == {"runs": 100, "egos": (4, 5, 6), "ratio": 0.15}
    assert [c.params["k"] for c in changed.cells()] == [2, 2]
    assert study().override({"ratio": 1}).settings["ratio"] == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rums": "1"}, r"setting = 'rums': must be one of .*Did you mean runs\?"),
        ({"runs": "many"}, "runs = 'many': must be a whole number"),
        ({"runs": "2.5"}, "runs = '2.5': must be a whole number"),
        ({"runs": None}, "runs = None: must be a whole number"),
        ({"ratio": "high"}, "ratio = 'high': must be a number"),
        ({"egos": "0,x"}, "egos = 'x': must be a whole number"),
    ],
)
def test_a_setting_that_cannot_be_is_named(changes, message):
    with refused(message):
        study().override(changes)


def test_grids_that_cannot_be():
    with refused("must not name an axis"):
        study(settings={"k": 1})
    with refused("k = .*must be a sequence"):
        study(grid={"k": iter((1, 2))})
    with refused("must have at least one"):
        study(where=lambda p: False).cells()
    with refused(r"grid = \{'k': 4, 'method': 'a'\}: must not be there twice"):
        study().override({"k": "4,4"}).cells()
    with refused("must be a number, a word"):
        study(grid={"k": ({"x": 1},)}).cells()
    with refused("lists of them"):
        study(settings={"fleet": object()}).cells()


def test_assignments():
    assert assignments(["a=1", "b=x=y"]) == {"a": "1", "b": "x=y"}
    with refused("gives a twice"):
        assignments(["a=1", "a=2"])
    assert parse("flag", "yes", False) is True
    with refused("runs = True: must be a whole number"):
        parse("runs", True, 30)
    assert [parse("x", text, None) for text in ("none", "3", "0.5", "word")] == [None, 3, 0.5, "word"]


PACKAGE = {
    "__init__": "",
    "cells": '''"""Cells."""
import reached_package.numbers
from .views import table, SHARED

def cell(p):
    """One row."""
    return [{"y": getattr(reached_package.numbers, "double")(p["x"]) + SHARED}]
''',
    "numbers": "def double(x):\n    return FACTOR.real * x\n\nFACTOR = complex(1, 2)\nUNUSED = 1\n",
    "views": "SHARED = 3\nCAPTION = 'old'\n\ndef table(results):\n    return CAPTION\n",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    folder = tmp_path / "reached_package"
    folder.mkdir()
    for name, text in PACKAGE.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder
    for name in [name for name in sys.modules if name.startswith("reached_package")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("name", "old", "new", "same"),
    [
        ("numbers", "FACTOR.real * x", "FACTOR.real * x + 1", False),
        ("numbers", "(1, 2)", "(2, 1)", False),
        ("views", "SHARED = 3", "SHARED = 4", False),
        ("numbers", "FACTOR.real * x", "FACTOR.real * x  # doubled", True),
        ("numbers", "UNUSED = 1", "UNUSED = 2", True),
        ("views", "'old'", "'new'", True),
        ("views", "return CAPTION", "return CAPTION * 2", True),
    ],
)
def test_only_what_a_cell_reaches_is_in_its_name(package, name, old, new, same):
    before = code_of(importlib.import_module("reached_package.cells").cell)
    file = package / f"{name}.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    for module in [module for module in sys.modules if module.startswith("reached_package")]:
        del sys.modules[module]
    importlib.invalidate_caches()
    cell = importlib.import_module("reached_package.cells").cell
    assert (code_of(cell) == before) is same


def test_a_cell_without_a_file_counts_by_what_it_names(monkeypatch):
    """As in a shell."""
    monkeypatch.setitem(sys.modules, "__main__", shell := ModuleType("__main__"))
    codes = []
    for number in (3, 5, 3):
        exec(f"k = {number}\ncell = lambda p: [k for _ in p]", vars(shell))
        codes.append(code_of(shell.cell))
    assert codes[0] == codes[2] != codes[1]


FILE = """
import coopoc as co
from coopoc.study.tables import Table

def cell(p):
    return [{{"run": 0, "ego": "a", "y": {number} * p["x"]}}]

def shown(results):
    return Table(("x", "y"), tuple((x, y) for x, y in zip(results.frame["x"], results.frame["y"])), "{caption}")

STUDY = co.Study("own", "Does it?", cell, {{"x": (1, 2)}}, tables={{"{name}": shown}})
"""


def test_a_caption_or_a_views_name_recomputes_nothing(tmp_path):
    """A file study: caption and name of its table change, and all cells are finished; a number changes, and none is."""
    file, out = tmp_path / "mine.py", tmp_path / "runs"
    study = f"{file}:STUDY"
    for number, caption, name, finished in ((2, "One", "a", 0), (2, "Two", "b", 2), (3, "Two", "b", 0)):
        file.write_text(FILE.format(number=number, caption=caption, name=name))
        assert plan(study, out)["finished"] == finished
        assert run_study(study, out).frame["y"].tolist() == [number, 2 * number]
        assert [path.stem for path in (out / "own" / "tables").glob("*.md")] == [name]
        assert caption in (out / "own" / "tables" / f"{name}.md").read_text()


def test_bundled_cells_count_by_what_they_run():
    """`robustness` and `latency_loss` share their cell and none of their views; `real` has a cell of its own."""
    codes = {name: code_of(find_study(name).cell) for name in ("robustness", "latency_loss", "real")}
    assert codes["robustness"] == codes["latency_loss"] != codes["real"]


def computed(p):
    raise AssertionError("a cell was computed before the views were checked")


def demo(view):
    return Study("demo", "?", computed, {"noise_model": ("nominal",), "x": (1,)}, tables={"a": view})  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (partial(pivot, row="x", columns="x", value="y"), r"tables\['a'\].*must be a function of the Results alone"),
        (partial(pivot, rows="x"), "must be a function of the Results alone"),
        (lambda: None, "must be a function of the Results alone"),
        (3, "must be a function of the Results alone"),
    ],
)
def test_a_view_is_checked_before_the_first_cell(tmp_path, view, message):
    with refused(message):
        run_study(demo(view), tmp_path)


def test_names_of_views_are_names_of_files(tmp_path):
    def view(results):
        return None

    with refused("must be a file name"):
        run_study(Study("demo", "?", computed, {"x": (1,)}, figures={"a/b": view}), tmp_path)  # type: ignore[dict-item]
