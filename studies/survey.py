"""Gain and cost of collaboration: six studies, and one report whose first lines answer the questions."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from coopoc.study.style import look

if TYPE_CHECKING:
    from coopoc.study.results import Results

NAMES = ("budget", "correlated_gnss", "latency_loss", "heading_error", "robustness", "consistency")
TITLE = "What collaboration gives, and what it costs"
PRIOR = {
    "with the noise known": ("nominal", "trained", "none"),
    "with the noise fitted elsewhere": ("fitted", "trained"),
}
"""Noise models that are compared: the sensors' true figures, or figures fitted and trained without neighbours."""


def survey(
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/survey"),
    jobs: Annotated[int, tyro.conf.arg(metavar="N")] = 2,
    data: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")] = "town10",
    runs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
) -> int:
    """Run the studies of bytes, correlated errors, latency, headings, spoofing and consistency; write one report.

    Example: coopoc survey --out runs/survey --jobs 2

    Args:
        out: folder of weights, studies and report.
        jobs: number of worker processes.
        data: fleet to test on, a name or a path.
        runs: number of noise draws of every study, instead of its own.
    """
    from coopoc.study.report import report

    began = time.perf_counter()
    changes = {"data": data, **({} if runs is None else {"runs": runs})}
    found = stages(NAMES, out, jobs, changes)
    page = report([out / name for name in NAMES], out / "report.html", title=TITLE, answers=answers(found))
    return ended(began, found, page)


def stages(names: Sequence[str], out: Path, jobs: int, changes: Mapping[str, Any]) -> dict[str, Results]:
    """Results of studies that share their trained weights, one study after the other, each stage named on stderr."""
    from coopoc.plugins import find
    from coopoc.study.run import run_study

    found: dict[str, Results] = {}
    for number, name in enumerate(names, start=1):
        print(f"coopoc: stage {number} of {len(names) + 1}: {name}", file=sys.stderr)
        study = find("coopoc.studies", name)
        given = {
            key: value
            for key, value in {"weights": str(out / "weights"), **changes}.items()
            if key in study.settings or key in study.axes
        }
        found[name] = run_study(study, out=out, jobs=jobs, settings=given, retry_failed=True)
    print(f"coopoc: stage {len(names) + 1} of {len(names) + 1}: report", file=sys.stderr)
    return found


def ended(began: float, found: Mapping[str, Results], page: Path) -> int:
    """Print the time and where the report is; 1 if cells have failed."""
    failed, took = sum(results.failed for results in found.values()), (time.perf_counter() - began) / 60
    print(f"coopoc: done in {took:.1f} min, {failed} failed cells. The report is {page}", file=sys.stderr)
    return int(failed > 0)


LIMITS = {5000.0: "at most 5 kB/s", 300.0: "at most 300 B/s", 0.0: "no V2X"}
QUESTIONS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "correlated_gnss": ("If GNSS errors are time-correlated?", ("own", "common")),
    "latency_loss": ("If messages are late or lost?", ("late", "lost one by one")),
    "heading_error": ("If the heading is not known?", ("cost, K = 2", "found, K = 2")),
    "robustness": ("If neighbours are spoofed?", ("K = 4", "K = 10")),
    "consistency": ("Which methods are consistent?", ("credible",)),
}
"""Study -> question, and the keys of the findings that answer it."""


def answers(found: Mapping[str, Results]) -> dict[str, str]:
    """Question -> answer, from the results of the studies that were run."""
    given = {}
    for limit, words in LIMITS.items() if "budget" in found else ():
        given[f"Which method with {words}?"] = _under(found["budget"], limit)
    for name, (question, keys) in QUESTIONS.items():
        if name in found:
            given[question] = reported(name, found[name], keys)
    return {question: answer for question, answer in given.items() if answer}


def reported(name: str, results: Results, keys: Sequence[str]) -> str:
    """The findings of a study under these keys, one after the other."""
    from coopoc.plugins import find

    texts = find("coopoc.studies", name).found(results)
    return " ".join(_sentence(texts[key]) for key in keys if key in texts)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _under(results: Results, limit: float) -> str:
    """The best on an ideal channel within a limit of bytes per second, for each noise model, beside the bound."""
    from . import budget

    parts, ran = [], budget.choices(results)
    for words, known in PRIOR.items():
        best = budget.best_under([one for one in ran if one.where["noise_model"] in known], limit)
        if best is not None:
            k = best.where["max_neighbours"]
            use = f" with K = {k} and {best.size:.0f} B/s" if k else ""
            far = budget.gap(results, best.where)
            parts.append(f"{words}, {look(best.where['method']).label}{use}: {best.error:.2f} m{far}")
    return _sentence(f"{'; '.join(parts)}.") if parts else ""
