"""What collaboration gives and what it costs: six studies, and one report whose first lines answer the questions."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from coopoc.study.study import Finding

if TYPE_CHECKING:
    from coopoc.study.results import Results

NAMES = ("budget", "correlated_gnss", "latency_loss", "heading_error", "robustness", "consistency")
TITLE = "What collaboration gives, and what it costs"
PRIOR = {
    "with the noise known": ("nominal", "trained", "none"),
    "with the noise fitted elsewhere": ("fitted", "trained"),
}
"""What a method may know: the sensors' true figures, or what vehicles learned while they drove alone."""


def survey(
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/survey"),
    jobs: Annotated[int, tyro.conf.arg(metavar="N")] = 2,
    data: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")] = "town10",
    runs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
) -> int:
    """Run the studies of bytes, lasting errors, late messages, headings, lies and consistency, and write one report.

    Example: coopoc survey --out runs/survey --jobs 2

    Args:
        out: of weights, studies and report. jobs: worker processes. data: test fleet, a name or a path.
        runs: noise draws of every study instead of its own number.
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
    """Say what it took and where the report is; 1 if cells have failed."""
    failed, took = sum(results.failed for results in found.values()), (time.perf_counter() - began) / 60
    print(f"coopoc: done in {took:.1f} min, {failed} failed cells. The report is {page}", file=sys.stderr)
    return int(failed > 0)


def answers(found: Mapping[str, Results]) -> dict[str, str]:
    """Question -> answer, from what was run."""
    said = {}
    for limit, words in LIMITS.items():
        if "budget" in found and (answer := _under(found["budget"], limit)):
            said[f"Which method with {words}?"] = answer
    for name, (question, keys) in QUESTIONS.items():
        given = _findings(name, found[name]) if name in found else []
        texts = [str(f) for f in given if not keys or (isinstance(f, Finding) and f.key in keys)]
        if texts:
            said[question] = " ".join(map(_sentence, texts[:2]))
    return said


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


LIMITS = {5000.0: "at most 5 kB/s", 300.0: "at most 300 B/s", 0.0: "no V2X"}
QUESTIONS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "correlated_gnss": ("If errors of GNSS last?", ("own", "common")),
    "latency_loss": ("If messages are late or lost?", ()),
    "heading_error": ("If the heading is wrong?", ("heading_bias_deg",)),
    "robustness": ("If neighbours lie?", ()),
    "consistency": ("Whose covariance can be believed?", ()),
}
"""Study -> question, and the keys of the findings that answer it; none for all of them."""


def _findings(name: str, results: Results) -> Sequence[Finding | str]:
    from coopoc.plugins import find

    study = find("coopoc.studies", name)
    return list(study.findings(results)) if study.findings else []


def _under(results: Results, limit: float) -> str:
    """The best on an ideal channel within a limit of bytes per second, for each kind of knowledge, beside the bound."""
    from coopoc.study.style import look

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
