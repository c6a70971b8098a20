"""publish: write the tables and figures of a study beside its cells, and the views.json that the report reads."""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

from ..arrays import one_of
from ..errors import InputError
from ..paths import file_name, given_path, write
from ..workers import progress_bar
from . import store
from .results import Results
from .study import Study
from .tables import FORMATS, Table

VIEWS = "views.json"
_FIELDS = {
    "tables": list,
    "figures": list,
    "findings": list,
    "recipe": dict,
    "missing": dict,
    "idle": list,
    "limitations": list,
}


def publish(study: Study, results: Results, folder: str | Path, progress: bool) -> None:
    """Write results.parquet, tables/*.{md,csv,tex,html}, figures/*.{pdf,png,svg} and views.json into a folder.

    Views of an earlier run that this one does not make are removed. A view that cannot be made is named with its
    reason; where no cell failed, the error is the study's own and is raised once all others are written.

    Args:
        study: whose views are made.
        results: of the study.
        folder: of the study.
        progress: show a bar on stderr.
    """
    folder = given_path(folder)
    write(folder / "results.parquet", lambda file: results.frame.to_parquet(file, index=False))
    missing, errors = {}, []

    def made(name: str, view: Callable[[Results], Any]) -> Any:
        try:
            return view(results)
        except Exception as error:
            missing[name] = f"{type(error).__name__}: {error}"
            errors.append(error)
            return None

    shown: dict[str, list[dict[str, Any]]] = {"tables": [], "figures": []}
    total = len(study.tables) + len(study.figures)
    with progress_bar(total=total, desc=f"{study.name}: views", unit="view", disable=not progress, leave=False) as bar:
        for kind, listed in shown.items():
            for name, view in getattr(study, kind).items():
                if (each := made(name, view)) is not None:
                    content = {"table": vars(each)} if kind == "tables" else {}
                    listed.append({"name": name, "caption": each.save(folder / kind / name), **content})
                bar.update()
    with suppress(InputError):  # files of views that an earlier run made, and this one does not, show other numbers
        before = _stored(folder)
        for kind, listed in shown.items():
            old = {view["name"] for view in before[kind]} - {view["name"] for view in listed}
            for name, suffix in product(old, (*FORMATS.values(), "pdf", "png", "svg")):
                (folder / kind / f"{name}.{suffix}").unlink(missing_ok=True)
    stored = {
        "cells": [*store.read(folder).cells],
        **shown,
        "findings": made("findings", study.answers) or [],
        "recipe": dict(made("recipe", study.recipe) or {}),
        "missing": missing,
        "idle": sorted(made("idle", study.idle) or ()),
        "limitations": list(study.limitations),
    }
    write(folder / VIEWS, json.dumps(stored, indent=1, default=_data, ensure_ascii=False) + "\n")
    if errors and not results.failed:
        raise errors[0]


def views(folder: str | Path) -> Mapping[str, Any]:
    """Read the views of a study: tables and figures by name, findings, recipe, missing views, limitations.

    Raises:
        InputError: the study was not run to its end, or its last run was not, the file is damaged, or a view's name is
            no file name.
    """
    stored = _stored(folder)
    if stored.get("cells") != [*store.read(given_path(folder)).cells]:
        allowed = "has tables and figures of other cells: a run since then, with other settings, has not ended"
        raise InputError("folder", str(folder), allowed, "Repeat coopoc run: finished cells are kept.")
    return stored


def _stored(folder: str | Path) -> Mapping[str, Any]:
    path = given_path(folder) / VIEWS
    stored = store.content(path, _FIELDS)
    for view in (*stored["tables"], *stored["figures"]):
        if not isinstance(view, dict) or not isinstance(view.get("caption"), str):
            raise store.damaged(path, "a view without a caption")
        file_name("view", view.get("name"), f"Run the study again: {path} was not written by coopoc run.")
    return stored


def tables(folder: str | Path, form: str = "markdown", name: str | None = None) -> list[str]:
    """Text of the tables in the folder of a study, or of the one that is named.

    Args:
        folder: of the study.
        form: one of `FORMATS`.
        name: of one table.

    Raises:
        InputError: as `views`, or an unknown name or format.
    """
    shown = {view["name"]: view for view in views(folder)["tables"]}
    wanted = shown if name is None else [one_of("table", name, shown)]
    return [Table.from_data(shown[one].get("table")).render(form) for one in wanted]


def _data(value: Any) -> Any:
    """An interval as a mapping, a NumPy number as Python's own, anything else as text."""
    return value.item() if hasattr(value, "item") else vars(value) if hasattr(value, "mean") else str(value)
