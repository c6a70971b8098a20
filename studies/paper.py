"""coopoc paper: its studies with shared weights, and one report that answers their questions."""

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from coopoc.plugins import find

if TYPE_CHECKING:
    from coopoc import Results

PAPER_STUDIES: Mapping[str, tuple[str, ...]] = {
    "convergence": ("centralised",),
    "error_cdf": ("scenario 1", "scenario 2"),
    "neighbours": ("nominal",),
}
"""Studies of the paper, and the keys of the findings that answer their questions."""
LEAD = "After “Federated Data-Driven Kalman Filtering for State Estimation” (arXiv 2411.05847), on {where}."


def paper(
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/paper"),
    jobs: Annotated[int, arg(metavar="N")] = 2,
    data: Annotated[str, arg(metavar="NAME_OR_PATH")] = "town10",
) -> int:
    """Reproduce the paper's comparison: train, run its three studies, write one report. Repeat to resume.

    Example: coopoc paper --out runs/paper --jobs 2

    Args:
        out: folder of weights, studies and report.
        jobs: number of worker processes.
        data: fleet to test on, a name or a path.
    """
    from coopoc import Results, run_study
    from coopoc.data.registry import DATASETS, card, in_words
    from coopoc.study.report import report

    began, results, inputs = time.perf_counter(), dict[str, Results](), {"weights": str(out / "weights"), "data": data}
    for number, name in enumerate(PAPER_STUDIES, start=1):
        print(f"coopoc: stage {number} of {len(PAPER_STUDIES) + 1}: {name}", file=sys.stderr)
        study = find("coopoc.studies", name)
        results[name] = run_study(study, out=out, jobs=jobs, settings=inputs, retry_failed=True)
    print(f"coopoc: stage {len(PAPER_STUDIES) + 1} of {len(PAPER_STUDIES) + 1}: report", file=sys.stderr)
    texts = {results[name].question: reported(name, results[name], keys) for name, keys in PAPER_STUDIES.items()}
    bundled = [name for name in dict.fromkeys((data, "town10-clients")) if name in DATASETS]
    chosen = "our fleets" if data in DATASETS else f"{Path(data).name} after training on ours"
    page = report(
        [out / name for name in PAPER_STUDIES],
        out / "report.html",
        title="Should vehicles collaborate while they train, or while they decide?",
        lead=[reported("neighbours", results["neighbours"], ["answer"]), LEAD.format(where=chosen)],
        answers={question: answer for question, answer in texts.items() if answer},
        first="neighbours",
        cards={name: in_words(card(name)) for name in bundled},
    )
    failed, took = sum(each.failed for each in results.values()), (time.perf_counter() - began) / 60
    print(f"coopoc: done in {took:.1f} min, {failed} failed cells. The report is {page}", file=sys.stderr)
    return int(failed > 0)


def reported(name: str, results: "Results", keys: Sequence[str]) -> str:
    """The findings of a study under these keys, one after the other."""
    texts = find("coopoc.studies", name).answers(results)
    return " ".join(texts[key][:1].upper() + texts[key][1:] for key in keys if key in texts)
