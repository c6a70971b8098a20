"""report: one self-contained page from folders of studies; it needs neither network nor what ran."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from ..arrays import listed
from ..errors import InputError
from ..paths import given_path, inside, write
from ..text import uncontrolled
from .publish import views
from .results import Results
from .store import environments
from .style import label, look, title, words
from .tables import Table

TEMPLATES = Path(__file__).parent
LARGEST_DRAWING = 1_000_000
"""Bytes of an SVG beyond which the page shows the PNG."""


def report(
    folders: Sequence[str | Path],
    out: str | Path,
    title: str = "",
    lead: Sequence[str] = (),
    cards: Mapping[str, Mapping[str, Any]] | None = None,
) -> Path:
    """Write one page that shows several studies, and return its path.

    That of several opens with the first finding of each, and the first figure.

    Args:
        folders: of finished studies, in the order of the page.
        out: the file.
        title: of the page.
        lead: sentences under the title, before the first study.
        cards: name of a data set -> field -> value.

    Raises:
        InputError: no folder, a folder that holds no study, two studies of one name, or an `out` that is a folder.
    """
    out = given_path(out)
    if out.is_dir() or out.suffix not in (".html", ".htm"):
        hint = f"Name the file, such as {(out if out.is_dir() else out.parent) / 'report.html'}."
        raise InputError("out", str(out), "must be a file that ends in .html", hint)
    sections = [_section(given_path(folder)) for folder in listed("folders", folders, "Give a list of folders.")]
    names = [section["name"] for section in sections]
    if not sections or len(set(names)) < len(names):
        raise InputError(
            "folders", names or "none", "must be at least one, of different studies", "Give coopoc report FOLDER."
        )
    several = sections if len(sections) > 1 else []
    page = _template().render(
        title=title or f"coopoc: {', '.join(section['title'] for section in sections)}",
        lead=lead,
        answers={s["question"]: s["findings"][0] for s in several if s["findings"]},
        first=next((number for number, s in enumerate(several, 1) if s["figures"]), 0),
        sections=sections,
        cards=cards or {},
        environment=environments([section["environment"] for section in sections]),
        css=Markup((TEMPLATES / "report.css").read_text("utf-8")),
        script=Markup((TEMPLATES / "report.js").read_text("utf-8")),
    )
    write(out, page)
    return out


def _section(folder: Path) -> dict[str, Any]:
    results, shown = Results.load(folder), views(folder)
    return {
        **shown,
        "name": results.study,
        "title": words(results.study),
        "question": results.question,
        "settings": {key: value for key, value in results.settings.items() if key not in shown["idle"]},
        "environment": results.environment,
        "pending": results.pending,
        "cells": results.frame["cell"].nunique() if len(results.frame) else 0,
        "tables": [
            {**view, "html": Markup(Table.from_data(view.get("table")).to_html())}  # HTML on the disk is never embedded
            for view in shown["tables"]
        ],
        "figures": [_figure(folder, view) for view in shown["figures"]],
        "failures": [
            {"cell": ", ".join(title(axis, row[axis]) for axis in results.axes if axis in row), "reason": row["reason"]}
            for _, row in results.failures.iterrows()
        ],
    }


def _figure(folder: Path, view: Mapping[str, Any]) -> dict[str, Any]:
    svg, png = (inside(folder, folder / "figures" / f"{view['name']}.{form}") for form in ("svg", "png"))
    for path in (svg, png):
        if not path.is_file():
            hint = "Repeat coopoc run: it writes the views again."
            raise InputError("folder", str(folder), f"lacks figures/{path.name}", hint)
    path, kind = (svg, "svg+xml") if svg.stat().st_size <= LARGEST_DRAWING else (png, "png")
    return {**view, "uri": f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"}


def _template() -> jinja2.Template:
    jinja = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: uncontrolled(value) if type(value) is str else value,
    )
    jinja.filters["named"] = _named
    jinja.filters["shown"] = _shown
    return jinja.get_template("report.html.j2")


def _named(field: str) -> str:
    """A method by its label, another field in words."""
    shown = look(field).label
    return words(field) if shown == field.replace("_", " ") else shown


def _shown(value: Any) -> str:
    return ", ".join(map(_shown, value)) if isinstance(value, list | tuple) else label("", value)
