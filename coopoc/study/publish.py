"""publish: write the tables and figures of a study beside its cells, and what the report needs to show them."""

from __future__ import annotations

import glob
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ..errors import InputError
from ..plugins import unknown
from . import reference, store
from .results import Results
from .study import Study
from .tables import FORMATS, Table

VIEWS = "views.json"


def publish(study: Study, results: Results, folder: str | Path, progress: bool = True) -> None:
    """Write results.parquet, tables/*.{md,csv,tex,html}, figures/*.{pdf,png,svg} and views.json into a folder.

    Views that an earlier run left there and that this one does not make are removed. If cells have failed, a view that
    cannot be made without them is named with its reason; otherwise its error is the study's own and is raised.
    """
    folder = Path(folder)
    results.to_parquet(folder / "results.parquet")
    missing: dict[str, str] = {}
    made: dict[str, list[dict[str, str]]] = {"tables": [], "figures": []}
    total = len(study.tables) + len(study.figures)
    with tqdm(total=total, desc=f"{study.name}: views", unit="view", disable=not progress, leave=False) as bar:
        for kind, views, save in (("tables", study.tables, _save_table), ("figures", study.figures, _save_figure)):
            for name, view in views.items():
                shown = _made(view, results, missing, name)
                if shown is not None:
                    made[kind].append({"name": name, "caption": save(shown, folder / kind / name)})
                bar.update()
    findings = _made(study.findings, results, missing, "findings") if study.findings else None
    recipe = _made(study.recipe, results, missing, "recipe") if study.recipe else None
    content = {
        **made, "findings": [*(findings or ()), *_reference(study, results)],
        "recipe": dict(recipe or {}), "missing": missing,
        "limitations": list(study.limitations), "minutes": study.minutes,
    }  # fmt: skip
    _forget(folder, made)
    store.write(folder / VIEWS, json.dumps(content, indent=1, default=str, ensure_ascii=False) + "\n")


def _made(view: Callable[[Results], Any], results: Results, missing: dict[str, str], name: str) -> Any:
    if not results.failed:
        return view(results)
    try:
        return view(results)
    except Exception as error:
        missing[name] = f"{type(error).__name__}: {error}"
        return None


def _reference(study: Study, results: Results) -> list[str]:
    """How the numbers stand to those that were committed; nothing for a run of other settings."""
    if study.reference is None or not Path(study.reference).is_file():
        return []
    known = reference.Reference.load(study.reference)
    if reference.differing(results, known):
        return []
    found = reference.hold(results, known)
    return [f"{reference.summary(found)[:-1]} (coopoc reference)."] if found else []


def _forget(folder: Path, made: Mapping[str, list[dict[str, str]]]) -> None:
    """Remove the files of views that an earlier run made here and this one does not: their numbers are not these."""
    try:
        before = views(folder)
    except InputError:
        return
    for kind, now in made.items():
        for name in {view["name"] for view in before[kind]} - {view["name"] for view in now}:
            for path in (folder / kind).glob(f"{glob.escape(name)}.*"):
                path.unlink()


def _save_table(table: Table, path: Path) -> str:
    for form, suffix in FORMATS.items():
        store.write(Path(f"{path}.{suffix}"), table.render(form))
    return " ".join(table.below)


def _save_figure(plot: Any, path: Path) -> str:
    return str(plot.save(path))


def views(folder: str | Path) -> Mapping[str, Any]:
    """What `publish` wrote; InputError if the study has not come so far."""
    return store.content(Path(folder) / VIEWS, "holds no views yet", "Run the study to its end: coopoc run NAME.")


def tables(folder: str | Path, form: str = "markdown", name: str | None = None) -> list[str]:
    """Text of the tables in the folder of a study, or of the one that is named; InputError if there is none."""
    known = [view["name"] for view in views(folder)["tables"]]
    if name is not None and name not in known:
        raise unknown("table", name, known)
    if form not in FORMATS:
        raise unknown("format", form, FORMATS)
    chosen = known if name is None else [name]
    return [(Path(folder) / "tables" / f"{n}.{FORMATS[form]}").read_text() for n in chosen]
