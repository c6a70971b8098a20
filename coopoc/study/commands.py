"""coopoc reference: a study's results against its committed reference values."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..errors import InputError
from ..plugins import names


def reference(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")],
    /,
    study: Annotated[str, arg(metavar="NAME")] = "",
    file: Annotated[Path | None, arg(metavar="FILE")] = None,
    write: bool = False,
    all: bool = False,
) -> int:
    """Check the results of a study against its committed reference values; the status is 1 if one is worse.

    Example: coopoc reference runs/budget

    Example: coopoc reference runs/mine --study mine.py:STUDY

    Args:
        folder: folder of the study.
        study: the study, FILE.py:NAME, if it is not an installed one.
        file: file of the reference values, instead of the study's own.
        write: write the reference values from these results.
        all: show every value, not only those that moved.
    """
    from . import reference as known
    from .results import Results
    from .run import find_study

    results = Results.load(folder)
    if not study and results.study not in names("coopoc.studies"):
        hint = f"If it is a file of your own, name it: coopoc reference {folder} --study FILE.py:NAME."
        raise InputError("study", repr(results.study), "is not installed", hint)
    of = find_study(study or results.study)
    if of.name != results.study:
        raise InputError("study", repr(of.name), f"must be {results.study}, as in the folder", "Name that study.")
    file = file or (Path(of.reference) if of.reference else None)
    if file is None or not of.metrics:
        raise InputError("study", of.name, "has no reference numbers", "Name its metrics, and give --file.")
    if write:
        made = known.measure(results, of.metrics)
        made.save(file)
        print(f"coopoc: {len(made.numbers)} numbers are in {file}", file=sys.stderr)
        return 0
    found = known.check(results, known.Reference.load(file))
    shown = known.table(found, everything=all)
    print(shown.to_markdown() if shown else known.summary(found))
    return int(any(change.verdict == "worse" for change in found))
