"""The paper's comparison, end to end: train, run its three studies, write one report."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import tyro


def paper(
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/paper"),
    jobs: Annotated[int, tyro.conf.arg(metavar="N")] = 2,
    data: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")] = "town10",
) -> int:
    """Reproduce the paper's comparison: train, run its three studies, write one report. Repeat it to resume.

    Example: coopoc paper --out runs/paper --jobs 2

    Args:
        out: of weights, studies and report. jobs: worker processes. data: test fleet, a name or a path.
    """
    from coopoc.data.registry import DATASETS
    from coopoc.study.report import report
    from coopoc.study.run import run

    began, failed = time.perf_counter(), 0
    names = ("convergence", "error_cdf", "neighbours")
    for number, name in enumerate(names, start=1):
        print(f"coopoc: stage {number} of {len(names) + 1}: {name}", file=sys.stderr)
        changes = {"weights": str(out / "weights"), "data": data}
        results = run(name, out=out, jobs=jobs, settings=changes, retry_failed=True)
        failed += results.failed
    print(f"coopoc: stage {len(names) + 1} of {len(names) + 1}: report", file=sys.stderr)
    cards = {
        name: DATASETS[name].card().fields() for name in dict.fromkeys((data, "town10-clients")) if name in DATASETS
    }
    page = report([out / name for name in names], out / "report.html", title=TITLE, lead=lead(data), cards=cards)
    took = (time.perf_counter() - began) / 60
    print(f"coopoc: done in {took:.1f} min, {failed} failed cells. The report is {page}", file=sys.stderr)
    return int(failed > 0)


TITLE = "Collaborative training against collaborative decision"


def lead(data: str) -> tuple[str, str]:
    """What the page is about, for a test fleet by name or path."""
    from coopoc.data.registry import DATASETS

    where = "our fleets" if data in DATASETS else f"{Path(data).name} after training on ours"
    return (
        "Three results of “Federated Data-Driven Kalman Filtering for State Estimation” (arXiv 2411.05847), on "
        f"{where}.",
        "The paper's baselines use identity covariances; each comparison is shown with them and with fitted ones.",
    )
