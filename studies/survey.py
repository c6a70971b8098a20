"""coopoc survey and coopoc paper: several studies with shared weights, and one report that answers their questions."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from coopoc.plugins import find
from coopoc.study.style import look

if TYPE_CHECKING:
    from coopoc.study.results import Results

PAPER: Mapping[str, tuple[str, ...]] = {
    "convergence": ("centralised",),
    "error_cdf": ("scenario 1", "scenario 2"),
    "neighbours": ("nominal",),
}
"""Studies of the paper, and the keys of the findings that answer their questions."""
SURVEY: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "correlated_gnss": ("If GNSS errors are time-correlated?", ("own", "common")),
    "latency_loss": ("If messages are late or lost?", ("late", "lost one by one")),
    "heading_error": ("If the heading is not known?", ("cost, K = 2", "estimated, K = 2")),
    "robustness": ("If measurements are wrong or neighbours spoofed?", ("5 % long ranges", "20 % spoofed")),
    "consistency": ("Which methods are consistent?", ("credible",)),
}
"""Study -> question, and the keys of the findings that answer it."""
EVIDENCE = re.compile(r" \(paired[^)]*\)")
"""What the first screen leaves to the sections."""
LIMITS = {5000.0: "at most 5 kB/s", 300.0: "at most 300 B/s", 0.0: "no V2X"}
PRIOR = {
    "with the noise known": ("nominal", "trained", "none"),
    "with the noise fitted elsewhere": ("fitted", "trained"),
}
"""Noise models that are compared: the sensors' true figures, or figures fitted and trained without neighbours."""
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
    from coopoc.data.fleet_cards import in_words
    from coopoc.data.registry import DATASETS, card

    def answers(results: Mapping[str, Results]) -> dict[str, str]:
        lead.insert(0, reported("neighbours", results["neighbours"], ["answer"]))
        texts = {results[name].question: reported(name, results[name], keys) for name, keys in PAPER.items()}
        return {question: EVIDENCE.sub("", text) for question, text in texts.items()}

    bundled = [name for name in dict.fromkeys((data, "town10-clients")) if name in DATASETS]
    place = "our fleets" if data in DATASETS else f"{Path(data).name} after training on ours"
    lead = [LEAD.format(where=place)]
    return _run(
        tuple(PAPER),
        out,
        jobs,
        {"data": data},
        answers,
        title="Should vehicles collaborate while they train, or while they decide?",
        lead=lead,
        first="neighbours",
        cards={name: in_words(card(name)) for name in bundled},
    )


def survey(
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/survey"),
    jobs: Annotated[int, arg(metavar="N")] = 2,
    data: Annotated[str, arg(metavar="NAME_OR_PATH")] = "town10",
    runs: Annotated[int | None, arg(metavar="N")] = None,
) -> int:
    """Run the studies of bytes, correlated errors, latency, headings, spoofing and consistency; write one report.

    Example: coopoc survey --out runs/survey --jobs 2

    Args:
        out: folder of weights, studies and report.
        jobs: number of worker processes.
        data: fleet to test on, a name or a path.
        runs: number of noise draws of every study, instead of its own.
    """
    changes = {"data": data, **({} if runs is None else {"runs": runs})}
    title = "What collaboration gives, and what it costs"
    return _run(("budget", *SURVEY), out, jobs, changes, survey_answers, title=title)


def _run(names: Sequence[str], out: Path, jobs: int, changes: Mapping[str, Any], answers: Any, **shown: Any) -> int:
    """Run studies that share their trained weights, each stage named on stderr; write the report; 1 if cells failed."""
    from coopoc.study.report import report
    from coopoc.study.run import run_study

    began, results = time.perf_counter(), dict[str, Any]()
    given = {"weights": str(out / "weights"), **changes}
    for number, name in enumerate(names, start=1):
        print(f"coopoc: stage {number} of {len(names) + 1}: {name}", file=sys.stderr)
        study = find("coopoc.studies", name)
        settings = {key: value for key, value in given.items() if key in study.settings or key in study.axes}
        results[name] = run_study(study, out=out, jobs=jobs, settings=settings, retry_failed=True)
    print(f"coopoc: stage {len(names) + 1} of {len(names) + 1}: report", file=sys.stderr)
    texts = {question: answer for question, answer in answers(results).items() if answer}
    page = report([out / name for name in names], out / "report.html", answers=texts, **shown)
    failed, took = sum(each.failed for each in results.values()), (time.perf_counter() - began) / 60
    print(f"coopoc: done in {took:.1f} min, {failed} failed cells. The report is {page}", file=sys.stderr)
    return int(failed > 0)


def survey_answers(results: Mapping[str, Results]) -> dict[str, str]:
    """Question -> answer, from the results of the studies that were run; empty where one has none."""
    texts = {}
    for limit, words in LIMITS.items() if "budget" in results else ():
        texts[f"Which method with {words}?"] = _under(results["budget"], limit)
    for name, (question, keys) in SURVEY.items():
        if name in results:
            texts[question] = reported(name, results[name], keys)
    return texts


def reported(name: str, results: Results, keys: Sequence[str]) -> str:
    """The findings of a study under these keys, one after the other."""
    texts = find("coopoc.studies", name).answers(results)
    return " ".join(texts[key][:1].upper() + texts[key][1:] for key in keys if key in texts)


def _under(results: Results, limit: float) -> str:
    """The best on an ideal channel within a limit of bytes per second, for each noise model, beside the bound."""
    from . import budget

    parts, each = [], budget.choices(results)
    for words, models in PRIOR.items():
        best = budget.best_under([choice for choice in each if choice.where["noise_model"] in models], limit)
        if best is not None:
            k = best.where["max_neighbours"]
            use = f" with K = {k} and {best.size:.0f} B/s" if k else ""
            far = budget.gap(results, best.where)
            parts.append(f"{words}, {look(best.where['method']).label}{use}: {best.error:.2f} m{far}")
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}." if parts else ""
