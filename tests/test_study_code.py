"""A cell's name changes with the code that makes its numbers, and with nothing else; views are checked beforehand."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from coopoc.errors import InputError
from coopoc.study.provenance import code_of
from coopoc.study.results import Results
from coopoc.study.run import find_study, plan, run_study
from coopoc.study.study import Study
from coopoc.study.tables import Table, pivot

PACKAGE = {
    "__init__": "",
    "cells": '''"""Cells."""
from . import numbers
from .views import table, SHARED
import numpy as np

def cell(p):
    """One row."""
    return [{"y": numbers.double(p["x"]) + SHARED}]
''',
    "numbers": "def double(x):\n    return FACTOR * x\n\nFACTOR = 2\nUNUSED = 1\n",
    "views": "SHARED = 3\nCAPTION = 'old'\n\ndef table(results):\n    return CAPTION\n",
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
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
        ("numbers", "FACTOR * x", "FACTOR * x + 1", False),
        ("numbers", "FACTOR = 2", "FACTOR = 3", False),
        ("views", "SHARED = 3", "SHARED = 4", False),
        ("cells", "+ SHARED", "- SHARED", False),
        ("cells", "import numpy as np", "import numpy as np\nimport math", True),
        ("cells", "One row.", "A row.", True),
        ("numbers", "FACTOR * x", "FACTOR * x  # doubled", True),
        ("numbers", "UNUSED = 1", "UNUSED = 2", True),
        ("views", "'old'", "'new'", True),
        ("views", "return CAPTION", "return CAPTION * 2", True),
    ],
)
def test_only_what_a_cell_reaches_is_in_its_name(package: Path, name: str, old: str, new: str, same: bool) -> None:
    before = code_of(importlib.import_module("reached_package.cells").cell)
    file = package / f"{name}.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    for module in [module for module in sys.modules if module.startswith("reached_package")]:
        del sys.modules[module]
    importlib.invalidate_caches()
    cell = importlib.import_module("reached_package.cells").cell
    assert (code_of(cell) == before) is same
    assert (code_of(partial(cell)) == before) is same


FILE = """
import coopoc as co
from coopoc.study.tables import Table

def cell(p):
    return [{{"run": 0, "ego": "a", "y": {number} * p["x"]}}]

def shown(results):
    return Table(("x", "y"), tuple((x, y) for x, y in zip(results.frame["x"], results.frame["y"])), "{caption}")

STUDY = co.Study("own", "Does it?", cell, {{"x": (1, 2)}}, tables={{"{name}": shown}})
"""


def test_a_caption_or_a_views_name_recomputes_nothing(tmp_path: Path) -> None:
    """A file study: caption and name of its table change, and all cells are finished; a number changes, and none is."""
    file, out = tmp_path / "mine.py", tmp_path / "runs"
    study = f"{file}:STUDY"
    for number, caption, name, finished in ((2, "One", "a", 0), (2, "Two", "b", 2), (3, "Two", "b", 0)):
        file.write_text(FILE.format(number=number, caption=caption, name=name))
        assert plan(study, out)["finished"] == finished
        results = run_study(study, out, progress=False)
        assert results.frame["y"].tolist() == [number, 2 * number]
        assert [path.stem for path in (out / "own" / "tables").glob("*.md")] == [name]
        assert caption in (out / "own" / "tables" / f"{name}.md").read_text()


def test_bundled_cells_count_by_what_they_run() -> None:
    """`robustness` and `latency_loss` share their cell and none of their views; `real` has a cell of its own."""
    codes = {name: code_of(find_study(name).cell) for name in ("robustness", "latency_loss", "real")}
    assert codes["robustness"] == codes["latency_loss"] != codes["real"]


def computed(p: object) -> list[dict[str, object]]:
    raise AssertionError("a cell was computed before the views were checked")


def demo(view: object) -> Study:
    return Study("demo", "?", computed, {"noise_model": ("nominal",), "x": (1,)}, tables={"a": view})  # type: ignore[dict-item]


def no_results() -> Table | None:
    return None


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (partial(pivot, row="x", columns="x", value="y"), r"tables\['a'\].*must be a function of the Results alone"),
        (partial(pivot, rows="x"), "must be a function of the Results alone"),
        (no_results, "must be a function of the Results alone"),
        (3, "must be a function of the Results alone"),
    ],
)
def test_a_view_is_checked_before_the_first_cell(tmp_path: Path, view: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        run_study(demo(view), tmp_path, progress=False)


def test_names_of_views_are_names_of_files(tmp_path: Path) -> None:
    def view(results: Results) -> Table | None:
        return None

    with pytest.raises(InputError, match="must be a file name"):
        run_study(Study("demo", "?", computed, {"x": (1,)}, figures={"a/b": view}), tmp_path)  # type: ignore[dict-item]
