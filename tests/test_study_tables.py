"""Tables in every format: golden text, numbers that survive, LaTeX that compiles."""

import csv
import io
from html.parser import HTMLParser
from pathlib import Path

import pytest
from latex import compiled

from coopoc.errors import InputError
from coopoc.evaluate.statistics import Interval
from coopoc.study.tables import FORMATS, Table

TABLE = Table(
    ("K", "KF & co", "50 %_x", "Cramér-Rao bound"),
    (("0", Interval(0.8047, 0.75, 0.85, 30), Interval(1.2, 1.1, 1.3, 30), 0.5), ("4", 0.912, None, 0.4)),
    "RT-LE [m] at σ = 3.5 m, ±4°.",
    best="min",
    notes=("A note.",),
)


def test_markdown() -> None:
    assert TABLE.to_markdown().splitlines() == [
        "RT-LE [m] at σ = 3.5 m, ±4°.",
        "",
        "| K   |               KF & co |            50 %_x |   Cramér-Rao bound |",
        "|:----|----------------------:|------------------:|-------------------:|",
        "| 0   | **0.80** [0.75, 0.85] | 1.20 [1.10, 1.30] |               0.50 |",
        "| 4   |                  0.91 |                 – |               0.40 |",
        "",
        "A note.",
    ]


def test_latex() -> None:
    assert TABLE.to_latex().splitlines() == [
        r"\begin{table}",
        r"\centering",
        r"\caption{RT-LE [m] at $\sigma$ = 3.5 m, $\pm$4$^\circ$. A note.}",
        r"\smallskip",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        r"\begin{tabular}{lrrr}",
        r"\toprule",
        r"K & KF \& co & 50 \%\_x & Cramér-Rao bound \\",
        r"\midrule",
        r"0 & \textbf{0.80} {\scriptsize [0.75, 0.85]} & 1.20 {\scriptsize [1.10, 1.30]} & 0.50 \\",
        r"4 & 0.91 & -- & 0.40 \\",
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table}",
    ]


def test_csv_keeps_every_digit_and_the_interval() -> None:
    header, first, second = csv.reader(io.StringIO(TABLE.to_csv()))
    assert header == [
        "K",
        "KF & co",
        "KF & co low",
        "KF & co high",
        "50 %_x",
        "50 %_x low",
        "50 %_x high",
        "Cramér-Rao bound",
    ]
    assert first == ["0", "0.8047", "0.75", "0.85", "1.2", "1.1", "1.3", "0.5"]
    assert second == ["4", "0.912", "", "", "", "", "", "0.4"]


def test_html_is_well_formed_and_escaped() -> None:
    opened: list[str] = []

    class Checker(HTMLParser):
        def handle_starttag(self, tag: str, attrs: object) -> None:
            opened.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert opened.pop() == tag

    html = TABLE.to_html()
    Checker().feed(html)
    assert opened == []
    assert "KF &amp; co" in html
    assert "<strong>0.80</strong>" in html


def test_best_is_sought_among_methods_and_never_the_bound() -> None:
    rows = (("GNSS", 6.0, 5.0), ("KF", 1.0, 2.0), ("OKF", 1.001, 1.5), ("Oracle KF", 0.5, 0.5))
    table = Table(("Method", "a", "b"), rows, "", best="min", along="column")
    lines = table.to_markdown().splitlines()[2:]
    assert [line.count("**") for line in lines] == [0, 2, 4, 0]  # KF and OKF tie as shown
    assert Table(("K", "KF"), (("0", 1.0),), "", best="min").to_markdown().count("**") == 0
    assert "**6.00**" in Table(("Method", "a"), tuple(r[:2] for r in rows), "", "max", "column").to_markdown()


def test_what_cannot_be_shown_is_named() -> None:
    with pytest.raises(InputError, match="must have 2 entries"):
        Table(("a", "b"), ((1,),), "")
    with pytest.raises(InputError, match="format = 'word': must be one of markdown, csv, latex, html"):
        TABLE.render("word")
    assert all(TABLE.render(form) for form in FORMATS)


def test_latex_compiles(tmp_path: Path) -> None:
    odd = Table(tuple(r"&%$#_{}~^\<>|"), (tuple("±–≤≥×σ°²wxyz|"),) * 2, "100 % & more_")
    wide = Table(("Method", *map(str, range(12))), (("KF", *(Interval(0.5, 0.4, 0.6, 30),) * 12),), "Wide.")
    assert "Overfull" not in compiled(TABLE.to_latex() + odd.to_latex() + wide.to_latex(), tmp_path)
    assert (tmp_path / "t.pdf").stat().st_size > 5000
