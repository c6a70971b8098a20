"""publish: write the tables and figures of a study beside its cells, and the views.json that the report reads."""

from __future__ import annotations

import glob
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ..errors import InputError
from ..file_names import file_name, given_path
from ..plugins import unknown
from . import reference, store
from .results import Results
from .study import Study
from .tables import FORMATS, Table

VIEWS = "views.json"
_FIELDS = {
    "tables": list,
    "figures": list,
    "findings": dict,
    "recipe": dict,
    "missing": dict,
    "limitations": list,
    "minutes": (int, float, type(None)),
}


def publish(study: Study, results: Results, folder: str | Path, progress: bool = True) -> None:
    """Write results.parquet, tables/*.{md,csv,tex,html}, figures/*.{pdf,png,svg} and views.json into a folder.

    Views of an earlier run that this one does not make are removed. If cells have failed, a view that cannot be made
    without them is named with its reason; otherwise its error is the study's own and is raised.

    Args:
        study: whose views are made.
        results: of the study.
        folder: of the study.
        progress: show a bar on stderr.
    """
    folder = given_path(folder)
    results.to_parquet(folder / "results.parquet")
    missing: dict[str, str] = {}
    made: dict[str, list[dict[str, Any]]] = {"tables": [], "figures": []}
    total = len(study.tables) + len(study.figures)
    with tqdm(total=total, desc=f"{study.name}: views", unit="view", disable=not progress, leave=False) as bar:
        for kind, found, save in (("tables", study.tables, _save_table), ("figures", study.figures, _save_figure)):
            for name, view in found.items():
                shown = _made(view, results, missing, name)
                if shown is not None:
                    made[kind].append({"name": name, **save(shown, folder / kind / name)})
                bar.update()
    findings = _made(study.found, results, missing, "findings") or {}
    recipe = _made(study.recipe, results, missing, "recipe") if study.recipe else None
    content = {
        **made,
        "findings": {**findings, **_reference(study, results)},
        "recipe": dict(recipe or {}),
        "missing": missing,
        "limitations": list(study.limitations),
        "minutes": study.minutes,
    }
    _remove_others(folder, made)
    store.write(folder / VIEWS, json.dumps(content, indent=1, default=_data, ensure_ascii=False) + "\n")


def views(folder: str | Path) -> Mapping[str, Any]:
    """Read the views of a study: tables and figures by name, findings by key, recipe, missing views, limitations.

    Raises:
        InputError: the study was not run to its end, the file is damaged, or a view's name is no file name.
    """
    path = given_path(folder) / VIEWS
    found = store.content(path, _FIELDS, "holds no views yet", "Run the study to its end: coopoc run NAME.")
    for view in (*found["tables"], *found["figures"]):
        if not isinstance(view, dict) or not isinstance(view.get("caption"), str):
            raise store.damaged(path, "a view without a caption")
        marks = view.get("marks", [])
        if not isinstance(marks, list) or not all(map(_is_mark, marks)):
            raise store.damaged(path, "a mark without its series, place or text")
        file_name("view", view.get("name"), f"Run the study again: {path} was not written by coopoc run.")
    return found


def tables(folder: str | Path, form: str = "markdown", name: str | None = None) -> list[str]:
    """Text of the tables in the folder of a study, or of the one that is named.

    Args:
        folder: of the study.
        form: one of `FORMATS`.
        name: of one table.

    Raises:
        InputError: as `views`, or an unknown name or format.
    """
    known = {view["name"]: view for view in views(folder)["tables"]}
    if name is not None and name not in known:
        raise unknown("table", name, known)
    return [Table.from_data(known[n].get("table")).render(form) for n in (known if name is None else [name])]


def _made(view: Callable[[Results], Any], results: Results, missing: dict[str, str], name: str) -> Any:
    if not results.failed:
        return view(results)
    try:
        return view(results)
    except Exception as error:
        missing[name] = f"{type(error).__name__}: {error}"
        return None


def _reference(study: Study, results: Results) -> dict[str, str]:
    """How many reference values hold; nothing for a run of other settings."""
    if study.reference is None or not Path(study.reference).is_file():
        return {}
    known = reference.Reference.load(study.reference)
    if reference.differing(results, known):
        return {}
    found = reference.check(results, known)
    return {"reference": f"{reference.summary(found)[:-1]} (coopoc reference)."} if found else {}


def _remove_others(folder: Path, made: Mapping[str, list[dict[str, Any]]]) -> None:
    """Remove the files of views that an earlier run made here and this one does not: they show other numbers."""
    try:
        before = views(folder)
    except InputError:
        return
    for kind, now in made.items():
        for name in {view["name"] for view in before[kind]} - {view["name"] for view in now}:
            for path in (folder / kind).glob(f"{glob.escape(name)}.*"):
                path.unlink()


def _save_table(table: Table, path: Path) -> dict[str, Any]:
    for form, suffix in FORMATS.items():
        store.write(Path(f"{path}.{suffix}"), table.render(form))
    return {"caption": " ".join(table.words), "table": vars(table)}


def _save_figure(plot: Any, path: Path) -> dict[str, Any]:
    return {"caption": str(plot.save(path)), "marks": plot.marks() if hasattr(plot, "marks") else []}


def _is_mark(mark: Any) -> bool:
    if not isinstance(mark, dict) or not all(isinstance(mark.get(key), str) for key in ("series", "text")):
        return False
    at = mark.get("at")
    return isinstance(at, list) and len(at) == 2 and all(isinstance(share, int | float) for share in at)


def _data(value: Any) -> Any:
    """An interval as a mapping, a NumPy number as Python's own, anything else as text."""
    return value.item() if hasattr(value, "item") else vars(value) if hasattr(value, "mean") else str(value)
