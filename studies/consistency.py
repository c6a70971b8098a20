"""Which methods are consistent: NEES of all that claim a covariance."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from coopoc.methods.catalogue import METHODS
from coopoc.study.numbers import Where, mean, present
from coopoc.study.style import look

from . import lineup, scene
from .views import HEAD, labelled, multiples, of, selections

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

SILENT = ("gnss",)
"""Methods without a covariance, or with that of a fix; the last takes as long as all others together."""
TRAINED = ("okf",)
SOLO = ("kalman", "kalman-adaptive", "road-kalman", "okf")
GATE = 0.95
USUAL = ("nominal", "trained")
NOTE = (
    "NEES of the ego's position (3 is consistent; less is cautious, more is over-confident) and share of the steps "
    "whose run-averaged NEES is in its 99 % band. Cooperative methods at K = 6."
)


def _grid() -> list[Where]:
    pairs = [(name, "nominal") for name in METHODS if name not in SILENT]
    pairs += [(name, "trained") for name in TRAINED]
    pairs += [("kalman", "fitted"), ("joint", "fitted"), ("kalman", "identity"), ("lkf-sa", "identity")]
    return [of(*pair, max_neighbours=0 if pair[0] in SOLO else 6) for pair in pairs]


def _inside(results: Results, where: Where) -> float:
    return mean(results, where, "nees_inside") or 0.0


def _ran(results: Results) -> list[tuple[str, str]]:
    """Methods and noise models that were run and claim a covariance, the most credible first."""
    if "nees" not in results.frame:
        return []
    kept = results.frame[results.frame["nees"].notna()]
    pairs = dict.fromkeys(zip(kept["method"], kept["noise_model"], strict=True))
    return sorted(pairs, key=lambda pair: -_inside(results, of(*pair)))


def _each_ego(results: Results, where: Where) -> list[float]:
    """NEES of each ego, as a multiple of that of a consistent filter; none of a method that was not run."""
    kept = present(results, where, "nees")
    return list(np.nanmean(results.values("nees", kept), axis=1) / 3.0) if kept else []


def _figure(results: Results) -> Plot | None:
    text = "NEES over 3, a dot per ego: 1 is consistent."
    return multiples(_ran(results), {"NEES / 3": {}}, _each_ego, text, NOTE)(results)


def _findings(results: Results) -> dict[str, str]:
    good = [look(m).label for m, k in _ran(results) if k in USUAL and _inside(results, of(m, k)) >= GATE]
    return {"credible": f"At least {GATE:g} of the steps in the band: {', '.join(good)}." if good else ""}


STUDY = lineup.study(
    "consistency",
    "Which methods are consistent?",
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "runs": 20, "train_seeds": 1},
    shares=("max_neighbours",),
    tables={
        "nees": selections(
            HEAD,
            lambda results: labelled(_ran(results)),
            {
                "NEES": partial(mean, value="nees"),
                "In band": partial(mean, value="nees_inside"),
                f"At least {GATE:g}": lambda results, where: "yes" if _inside(results, where) >= GATE else "no",
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
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
