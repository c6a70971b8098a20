"""Drawings within a page: their marks are the numbers, and nothing but shapes of a file on the disk passes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from coopoc.errors import InputError
from coopoc.study.inline_svg import inline
from coopoc.study.marks import described, marks, series
from coopoc.study.publish import views
from coopoc.study.terms import TERMS, explained

HOSTILE = """<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" onload="alert(1)">
<script>alert(2)</script><foreignObject>
<body xmlns="http://www.w3.org/1999/xhtml"><img src="x" onerror="alert(3)"/></body>
</foreignObject><a href="javascript:alert(4)"><path d="M0 0"/></a><image href="http://example.org/a.png"/>
<use xlink:href="http://example.org/a.svg#b"/><style>@import url(http://example.org/a.css)</style>
<g id="series:kalman/fitted" style="fill: url(http://example.org/a)" onclick="alert(5)"><path id="p" d="M0 0L1 1"
style="stroke: #E69F00; fill: none"/><use href="#p" x="1"/></g>
<animate attributeName="href" to="javascript:1"/></svg>"""


def test_nothing_that_runs_or_loads_passes() -> None:
    made = inline(HOSTILE.encode(), "one")
    assert made is not None
    for word in (
        "alert",
        "script",
        "http://example",
        "onclick",
        "onload",
        "foreign",
        "import",
        "animate",
        "<a ",
        "style>",
    ):
        assert word not in made, word
    for kept in (
        'data-series="series:kalman/fitted"',
        'id="one-p"',
        'href="#one-p"',
        "stroke: #E69F00",
        'd="M0 0L1 1"',
    ):
        assert kept in made, kept


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no xml",
        b"<html/>",
        b"<svg/>",
        b'<!DOCTYPE svg [<!ENTITY a "b">]><svg xmlns="http://www.w3.org/2000/svg"/>',
    ],
)
def test_what_is_no_drawing_is_not_drawn(content: bytes) -> None:
    assert inline(content, "a") is None


def test_marks_stand_where_matplotlib_draws_them() -> None:
    """Independent check: the place of a mark is a pixel of matplotlib's own raster that has the line's colour."""
    figure = Figure(figsize=(4, 3), dpi=100)
    axes = figure.subplots()
    axes.plot([1, 2, 4], [3.0, 1.0, 2.0], color="#ff0000", marker="o", gid=series("kalman", "fitted"))
    axes.plot([1, 2], [1, 2], color="#0000ff")
    axes.axhline(2.5, color="#00ff00", gid=series("bound"))
    axes.set(xlabel="Neighbours K", ylabel="RT-LE [m]")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    found = marks(figure)
    assert [mark["text"] for mark in found] == [
        f"KF, fitted: RT-LE {y} m at Neighbours K {x}" for x, y in ((1, 3), (2, 1), (4, 2))
    ]
    raster = np.asarray(canvas.buffer_rgba())
    for mark in found:
        column, row = round(mark["at"][0] * 400), round(mark["at"][1] * 300)
        assert tuple(raster[row, column][:3]) == (255, 0, 0)


def test_a_damaged_mark_is_named(tmp_path: Path) -> None:
    figure = {"name": "a", "caption": "b", "marks": [{"series": "series:x/", "at": [0.1, "2"], "text": "c"}]}
    content = {
        "tables": [],
        "figures": [figure],
        "findings": {},
        "recipe": {},
        "missing": {},
        "limitations": [],
        "minutes": 1,
    }
    (tmp_path / "views.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="a mark without its series, place or text"):
        views(tmp_path)


def test_terms_are_those_of_the_glossary() -> None:
    """Every term that a page explains stands in docs/glossary.md, or is a name of a method there."""
    pages = [
        (Path(__file__).parents[1] / "docs" / name).read_text() for name in ("glossary.md", "methods.md", "index.md")
    ]
    for term in TERMS:
        assert any(term in page for page in pages), term
    assert explained("<b>NEES</b>") == f'&lt;b&gt;<abbr title="{TERMS["NEES"]}">NEES</abbr>&lt;/b&gt;'
    assert "abbr" not in explained("NEESES, egoist, identity-like")
    assert described(series("mine.py:Own", "identity")) == "Own, identity"
