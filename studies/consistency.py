"""Which methods are consistent: NEES of all that claim a covariance."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.methods.catalogue import METHODS
from coopoc.study.numbers import Where, mean
from coopoc.study.style import look

from . import lineup, scene
from .views import HEAD, labelled, of, selections

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

SILENT = ("gnss", "mds", "cooperative-map-gnc")
"""Methods without a covariance, or with that of a fix; the last takes as long as all others together."""
TRAINED = ("okf", "recursive", "cooperative")
SOLO = ("kalman", "kalman-adaptive", "okf", "recursive")
GATE = 0.95
USUAL = ("nominal", "trained")
NOTE = (
    "NEES of the ego's position (3 is consistent; less is cautious, more is over-confident) and share of the steps "
    "whose run-averaged NEES is in its 99 % band. Cooperative methods at K = 6."
)


def _grid() -> list[dict[str, Any]]:
    pairs = [(name, "nominal") for name in METHODS if name not in SILENT]
    pairs += [(name, "trained") for name in TRAINED]
    pairs += [("kalman", "fitted"), ("joint", "fitted"), ("kalman", "identity"), ("lkf-sa", "identity")]
    return [of(*pair, max_neighbours=0 if pair[0] in SOLO else 6) for pair in pairs]


def _inside(results: Results, where: Where) -> float:
    return mean(results, where, "nees_inside") or 0.0


def _consistent(results: Results, where: Where) -> str:
    return "yes" if _inside(results, where) >= GATE else "no"


def _ran(results: Results) -> list[tuple[str, str]]:
    """Methods and noise models that were run and claim a covariance, the most credible first."""
    if "nees" not in results.frame:
        return []
    kept = results.frame[results.frame["nees"].notna()]
    pairs = dict.fromkeys(zip(kept["method"], kept["noise_model"], strict=True))
    return sorted(pairs, key=lambda pair: -_inside(results, of(*pair)))


def _figure(results: Results) -> Plot | None:
    """One row per method: its NEES per ego on a logarithmic axis, and the mean of a consistent filter."""
    from coopoc.study.plot import Plot, canvas, plain_log, strokes

    ran = _ran(results)
    if not ran:
        return None
    with canvas(1, 1, width=6.2, height=0.9 + 0.2 * len(ran)) as (figure, panel):
        panel.axvline(3.0, color="black", linewidth=0.9)
        for row, pair in enumerate(ran):
            each = np.nanmean(results.values("nees", of(*pair)), axis=1)
            panel.plot(
                each, np.full(len(each), row), **{**strokes({"method": pair[0]}), "linestyle": "none"}, alpha=0.8
            )
        plain_log(panel.xaxis)
        labels = [look(method).label + ("" if known in USUAL else f", {known}") for method, known in ran]
        panel.set(yticks=range(len(ran)), yticklabels=labels, ylim=(len(ran) - 0.4, -0.6), xlabel="NEES, one per ego")
    return Plot(figure, scene.caption(results, NOTE))


def _findings(results: Results) -> dict[str, str]:
    good = [look(m).label for m, k in _ran(results) if k in USUAL and _inside(results, of(m, k)) >= GATE]
    return {"credible": f"At least {GATE:g} of the steps in the band: {', '.join(good)}." if good else ""}


STUDY = lineup.study(
    "consistency",
    "Which methods are consistent?",
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "backend": "gauss-newton", "runs": 20, "train_seeds": 1},
    shares=("max_neighbours",),
    tables={
        "nees": selections(
            HEAD,
            lambda results: labelled(_ran(results)),
            {
                "NEES": partial(mean, value="nees"),
                "In band": partial(mean, value="nees_inside"),
                f"At least {GATE:g}": _consistent,
                "RT-LE [m]": mean,
            },
            NOTE,
        )
    },
    figures={"nees": _figure},
    findings=_findings,
    limitations=(
        "White noise and an ideal channel; other studies cover late messages, correlated errors and spoofing.",
    ),
    minutes=10,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
