"""coopoc paper: its studies with shared weights, and one report that answers their questions."""

from pathlib import Path
from time import perf_counter
from typing import Annotated

from tyro.conf import arg

PAPER_STUDIES = ("neighbours", "convergence", "error_cdf")
"""Studies of the paper, that which answers the question of the page first."""
LEAD = "After “Federated Data-Driven Kalman Filtering for State Estimation” (arXiv 2411.05847), on {where}."


def paper(
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/paper"),
    jobs: int = 2,
    data: Annotated[str, arg(metavar="NAME_OR_PATH")] = "town10",
) -> int:
    """Reproduce the paper's comparison: train, run its three studies, write one report. Repeat to resume.

    Example: coopoc paper --out runs/paper --jobs 2

    Args:
        out: folder of weights, studies and report.
        jobs: number of worker processes.
        data: fleet to test on, a name or a path.
    """
    from coopoc import run_study
    from coopoc.data.registry import DATASETS, card
    from coopoc.study.report import report
    from coopoc.workers import say

    began, failed, inputs = perf_counter(), 0, {"weights": str(out / "weights"), "data": data}
    for number, name in enumerate(PAPER_STUDIES, start=1):
        say(f"stage {number} of {len(PAPER_STUDIES) + 1}: {name}")
        failed += run_study(name, out=out, jobs=jobs, settings=inputs, retry_failed=True).failed
    say(f"stage {len(PAPER_STUDIES) + 1} of {len(PAPER_STUDIES) + 1}: report")
    bundled = [name for name in dict.fromkeys((data, "town10-clients")) if name in DATASETS]
    chosen = "our fleets" if data in DATASETS else f"{Path(data).name} after training on ours"
    page = report(
        [out / name for name in PAPER_STUDIES],
        out / "report.html",
        title="Should vehicles collaborate while they train, or while they decide?",
        lead=[LEAD.format(where=chosen)],
        cards={name: card(name)["words"] for name in bundled},
    )
    took = f"{(perf_counter() - began) / 60:.1f} min"
    say(f"done in {took}, {failed} failed cells. The report is {page}")
    return int(failed > 0)
