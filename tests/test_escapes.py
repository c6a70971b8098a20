"""Hostile names of vehicles, methods and studies: text in every picture, table, page and file that shows them."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from latex import compiled
from matplotlib.figure import Figure
from test_security import Page

import coopoc as co
from coopoc.data.log.check import check
from coopoc.data.log.picture import draw
from coopoc.data.log.read import read_log
from coopoc.study.plot import legend
from coopoc.study.publish import views
from coopoc.study.report import report
from coopoc.study.results import Results
from coopoc.study.run import run_study
from coopoc.study.study import Params, Row, Study
from coopoc.study.tables import Table

NAMES = {
    "tag": "<script>alert(1)</script>",
    "input": r"\input{/etc/passwd}",
    "mathematics": r"$\frac{$",
    "path": "../../etc/passwd",
    "formula": "=cmd|' /C calc'!A0",
    "formula behind a blank": " =1+1",
    "line": "a\n\n# b",
    "right to left": "a\u202egnp.exe",
    "terminal": "a\x1b[2Jb",
    "hidden": "_a",
    "percent": "%s {0} {{ 7 * 7 }}",
}


def controls(text: str) -> set[str]:
    return {letter for letter in text if letter != "\n" and unicodedata.category(letter)[0] == "C"}


def words(figure: Figure) -> str:
    """What a figure shows, from its SVG with text as text."""
    out = io.BytesIO()
    figure.savefig(out, format="svg")
    return out.getvalue().decode()


@pytest.fixture(autouse=True)
def text_as_text(monkeypatch: pytest.MonkeyPatch) -> None:
    """In SVG, where matplotlib draws letters as paths otherwise."""
    monkeypatch.setitem(matplotlib.rcParams, "svg.fonttype", "none")


@pytest.mark.parametrize("kind", NAMES)
def test_pictures_show_names_as_text(kind: str, tmp_path: Path) -> None:
    """Of recordings, tracks, logs and studies; the name is in the legend, whatever it holds."""
    name, t = NAMES[kind], np.arange(40) / 10
    position = np.stack([np.column_stack([8 * t, y + 0 * t, 0 * t]) for y in (0.0, 9.0)], axis=1)
    fleet = co.Fleet((name, "b"), t, position, np.gradient(position, 0.1, axis=0))
    rec = co.observe(fleet, co.Sensors(), co.V2X(max_neighbours=1))
    studied = Figure()
    axes = studied.subplots()
    legend(axes, [{"method": name}, {"method": "kalman"}])
    rows = [
        (k / 10, name.strip(), what, value)
        for k in range(40)
        for what, value in (("x", 0.8 * k), ("y", 0.0), ("vx", 8.0), ("vy", 0.0))
    ]
    with (tmp_path / "log.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("t", "vehicle", "kind", "value"), *rows])
    log = read_log(tmp_path / "log.csv")
    figures = [co.Kalman()(rec, [0]).plot(fleet=fleet).figure, rec.plot().figure, studied]
    texts = [*map(words, figures), draw(check(log), tmp_path / "log.svg").read_text()]
    shown = re.sub(r"[\s_]+", "", "".join(c for c in name if c.isalnum() or c in " _="))[:6]
    for text in texts:
        assert "<script" not in text
        assert not controls(text)
        plain = re.sub(r"<[^>]*>", "", re.sub(r"(?s)<style.*?</style>", "", text))
        assert shown in "".join(c for c in plain if c.isalnum() or c == "=")


def cell(p: Params) -> list[Row]:
    return [{"run": run, "ego": p["name"], "rt_le_m": 1.0 + run} for run in range(2)]


def test_pages_and_tables_show_names_as_text(tmp_path: Path) -> None:
    def table(results: Results) -> Table:
        rows = tuple((name, 1.0, f"{name} [m]") for name in NAMES.values())
        return Table(("Name", "RT-LE", r"$\input{x}$"), rows, " ".join(NAMES.values()), notes=tuple(NAMES.values()))

    grid = {"name": tuple(NAMES.values())}
    study = Study("made", "What?\u202e", cell, grid, tables={"t": table}, limitations=tuple(NAMES.values()))
    assert run_study(study, tmp_path, progress=False).failed == 0
    folder = tmp_path / "made"
    page = Page(report([folder], tmp_path / "report.html").read_text())
    assert page.tags.count("script") == 1
    assert page.tags.count("base") == page.tags.count("iframe") == 0
    assert not controls(page.text)
    assert "{{ 7 * 7 }}" in page.text
    made = Table.from_data(views(folder)["tables"][0]["table"])
    for text in (made.to_markdown(), made.to_latex(), made.to_html()):
        assert not controls(text)
    assert "\\input" not in made.to_latex()
    assert "Output written" in compiled(made.to_latex(), tmp_path)
    cells = [row[0] for row in csv.reader(io.StringIO(made.to_csv()))][1:]
    assert len(cells) >= len(NAMES)
    assert not any(re.match(r"\s*[=+@-]", text) for text in cells)
    known = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert not any(name.strip("./") in known for name in NAMES.values())
