"""Gain of cooperation under time-correlated GNSS errors: each receiver's own, or common to all vehicles."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from coopoc.evaluate.statistics import Interval, mean_interval
from coopoc.study.numbers import Where, across, mean, present, ratio, rms, sentence
from coopoc.study.style import Panel, look

from . import lineup, scene
from .lineup import PAST
from .views import curves, of, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

ERRORS = {
    "white": (0.0, 0.0),
    "half own": (0.5, 0.0),
    "own": (0.9, 0.0),
    "own and common": (0.45, 0.45),
    "common": (0.0, 0.9),
}
"""Name -> shares of a fix's variance that are time-correlated: of each receiver, and common to all vehicles."""
CASES = {name: dict(zip(scene.LASTING, shares, strict=True)) for name, shares in ERRORS.items()}
"""Error models as selections."""
NEIGHBOURS = (0, 2, 6, 10)
X = {k: {"max_neighbours": k} for k in NEIGHBOURS}
KS = {f"K = {k}": also for k, also in X.items()}
SOLO = (("gnss", "none"), ("kalman", "nominal"), ("fedkalmannet", "trained"))
SHARED = (("joint", "nominal"), ("split-ci", "nominal"), ("cooperative-filter", "nominal"))
"""Nominal noise model: all but the last take the whole error of a fix as white, of the same variance."""
STAR = ("bound", "star")
"""The bound of filters whose newcomers have no past; PAST is that of messages which bring it along."""
NOTE = (
    "Lasting errors are 50 % or 90 % of a fix's variance, {drift_time_s:g} s correlated. All "
    "but the cooperative filter take them as white noise of the same variance. The bounds know how they last: of a "
    "star of newcomers without a past, and of messages which bring it along, as the cooperative filter's do."
)


def _grid() -> list[Where]:
    """Solo methods at K = 0 only; the cooperative filter there, too, as the solo filter of coloured noise."""
    return [
        of(*line, **case, max_neighbours=k)
        for case in CASES.values()
        for k in NEIGHBOURS
        for line in ((*SOLO, *SHARED[2:], STAR) if k == 0 else (*SHARED, STAR, PAST))
    ]


def _over_runs(results: Results, where: Where) -> Interval | float | None:
    """rms with its 95 % interval over runs: all egos of a run share the common error."""
    kept = present(results, where)
    if kept is None or where["method"] == "bound":
        return rms(results, where)
    each = mean_interval(np.square(results.values("rt_le_m", kept)).mean(axis=0))
    middle, low, high = (float(np.sqrt(max(end, 0.0))) for end in (each.mean, each.low, each.high))
    return Interval(middle, low, high, each.n)


FINDING = (
    "{name}: {most} neighbours take the filter from {alone:.2f} m alone to {joint:.2f} m ({share:.2f} times); to "
    "{drift:.2f} m if it knows how errors last; bound of the star {bound:.2f} m."
)


def _findings(results: Results) -> dict[str, str]:
    most = max((k for k in NEIGHBOURS if present(results, {"max_neighbours": k})), default=0)
    texts = {}
    for name, case in CASES.items() if most else ():
        ks = {SOLO[1]: 0, SHARED[0]: most, SHARED[2]: most, STAR: most}
        alone, joint, drift, bound = (rms(results, of(*line, **case, max_neighbours=k)) for line, k in ks.items())
        numbers = {"alone": alone, "joint": joint, "share": ratio(joint, alone), "drift": drift, "bound": bound}
        texts[name] = sentence(FINDING, name=name, most=most, **numbers)
    return texts


LABELS = {line: f"{look('bound').label}, {line[1]}" for line in (STAR, PAST)}
k_table = partial(
    selections,
    ("Errors of GNSS that last", "Method"),
    [
        ((name, LABELS.get(line, look(line[0]).label)), of(*line, **c))
        for name, c in CASES.items()
        for line in (*SOLO, *SHARED, STAR, PAST)
    ],
)
STUDY = lineup.study(
    "correlated_gnss",
    "What is cooperation worth when GNSS errors are time-correlated, so that no solo filter averages them out?",
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "drift_time_s": 60.0, "runs": 30, "train_seeds": 1},
    shares=(*scene.LASTING, "max_neighbours"),
    tables={
        "rms": k_table(across(rms, KS), "rms over runs of RT-LE [m].", NOTE),
        "nees": k_table(across(partial(mean, value="nees"), KS), "NEES (3 is consistent).", NOTE, decimals=1),
    },
    figures={
        "rms": curves(
            [Panel(X, case, name, "Neighbours K") for name, case in CASES.items()],
            [of(*line) for line in (*SHARED, STAR, PAST)],
            "rms over runs of RT-LE against the number of neighbours, with 95 % intervals over runs: {runs} draws of "
            "an error that all vehicles share scatter that much about the bound, also below it.",
            NOTE,
            number=_over_runs,
            levels=[of(*line) for line in SOLO[1:]],
            ylabel="rms RT-LE [m]",
        )
    },
    findings=_findings,
    limitations=(
        "A Gauss-Markov error with one correlation time stands for multipath and atmosphere; real ones depend on the "
        "place and on the satellites in view.",
        "The common error is the same over the whole map, which is nearly true over some hundred metres.",
        "The cooperative filter and the bound treat a returning neighbour as new, although its error was partly known: "
        "the filter is somewhat over-confident, and the bound is not tight.",
        "Learned gains were trained with white noise.",
    ),
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
