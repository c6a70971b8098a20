"""coopoc reference: a study's results against the numbers that were committed with it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..errors import InputError


def reference(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")],
    /,
    file: Annotated[Path | None, arg(metavar="FILE")] = None,
    write: bool = False,
    all: bool = False,
) -> int:
    """Hold the results of a study against the numbers that were committed with it; the status is 1 if one is worse.

    Example: coopoc reference runs/budget

    Args:
        folder: of the study.
        file: with the reference numbers, instead of the study's own.
        write: write them from these results instead.
        all: show the numbers that hold, too.
    """
    from ..plugins import find
    from . import reference as known
    from .results import Results
    from .study import Study

    results = Results.load(folder)
    study: Study = find("coopoc.studies", results.study)
    file = file or (Path(study.reference) if study.reference else None)
    if file is None or not study.metrics:
        raise InputError("study", results.study, "has no reference numbers", "Name its metrics, and give --file.")
    if write:
        made = known.measure(results, study.metrics)
        made.save(file)
        print(f"coopoc: {len(made.numbers)} numbers are in {file}", file=sys.stderr)
        return 0
    found = known.hold(results, known.Reference.load(file))
    shown = known.table(found, everything=all)
    print(shown.to_markdown() if shown else known.summary(found))
    return int(any(held.verdict == "worse" for held in found))
