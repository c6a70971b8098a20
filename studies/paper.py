"""The paper's comparison, end to end: train, run its three studies, write one report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import tyro

from .survey import ended, reported, stages


def paper(
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/paper"),
    jobs: Annotated[int, tyro.conf.arg(metavar="N")] = 2,
    data: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")] = "town10",
) -> int:
    """Reproduce the paper's comparison: train, run its three studies, write one report. Repeat to resume.

    Example: coopoc paper --out runs/paper --jobs 2

    Args:
        out: folder of weights, studies and report.
        jobs: number of worker processes.
        data: fleet to test on, a name or a path.
    """
    from coopoc.data.registry import DATASETS
    from coopoc.study.report import report

    began = time.perf_counter()
    found = stages(tuple(ANSWERS), out, jobs, {"data": data})
    cards = {
        name: DATASETS[name].card().fields() for name in dict.fromkeys((data, "town10-clients")) if name in DATASETS
    }
    answers = {found[name].question: reported(name, found[name], keys) for name, keys in ANSWERS.items()}
    given = {question: answer for question, answer in answers.items() if answer}
    folders = [out / name for name in ANSWERS]
    page = report(folders, out / "report.html", title=TITLE, lead=lead(data), answers=given, cards=cards)
    return ended(began, found, page)


ANSWERS = {
    "convergence": ("centralised",),
    "error_cdf": ("scenario 1", "scenario 2"),
    "neighbours": ("identity", "fitted"),
}
"""Studies, and the keys of the findings that answer their questions: baselines with identity and with fitted noise."""
TITLE = "Collaborative training against collaborative decision"


def lead(data: str) -> tuple[str, str]:
    """Sentences under the title of the page, for a test fleet by name or path."""
    from coopoc.data.registry import DATASETS

    where = "our fleets" if data in DATASETS else f"{Path(data).name} after training on ours"
    return (
        "Three results of “Federated Data-Driven Kalman Filtering for State Estimation” (arXiv 2411.05847), on "
        f"{where}.",
        "The paper's baselines use identity covariances; each comparison is shown with them and with fitted ones.",
    )
