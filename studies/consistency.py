"""Which method's covariance can be believed: NEES of everything that claims one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.methods.catalogue import METHODS
from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

SILENT = ("gnss", "mds", "diffusion", "diffusion-anchored", "cooperative-map-gnc")
"""Without a covariance, or one that only says what a fix is; or, the last, as slow as all others together."""
CLASSICAL = tuple(name for name in METHODS if name not in SILENT)
TRAINED = ("okf", "recursive", "cooperative")
SOLO = ("kalman", "kalman-adaptive", "kalman-variational", "okf", "recursive")
GATE = 0.95
USUAL = ("nominal", "trained")


def _grid() -> list[dict[str, Any]]:
    pairs = [*((name, "nominal") for name in CLASSICAL), *((name, "trained") for name in TRAINED)]
    pairs += [("kalman", "fitted"), ("joint", "fitted"), ("kalman", "identity"), ("lkf-sa", "identity")]
    return [{"max_neighbours": 0 if name in SOLO else 6, "method": name, "noise_model": known} for name, known in pairs]


def cell(p: Params) -> list[Row]:
    """Rows of one method."""
    return lineup.rows(p)


def _ran(results: Results) -> list[tuple[str, str, dict[str, Any]]]:
    """Methods and knowledge that were run and claim a covariance, the most credible first."""
    frame = results.frame
    if "nees" not in frame:
        return []
    kept = frame[frame["nees"].notna()]
    found = [
        (m, k, {"method": m, "noise_model": k})
        for m, k in dict.fromkeys(zip(kept["method"], kept["noise_model"], strict=True))
    ]
    return sorted(found, key=lambda one: -(views.mean(results, one[2], "nees_inside") or 0.0))


def _table(results: Results) -> Table | None:
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body = []
    for method, known, where in _ran(results):
        inside = views.mean(results, where, "nees_inside")
        body.append(
            (
                look(method).label,
                known,
                views.mean(results, where, "nees"),
                inside,
                "yes" if inside is not None and inside >= GATE else "no",
                views.mean(results, where),
            )
        )
    header = ("Method", "NoiseModel", "NEES", "In band", f"At least {GATE:g}", "RT-LE [m]")
    return Table(header, tuple(body), _caption(results), decimals=2) if body else None


def _caption(results: Results) -> str:
    return (
        "NEES of the ego's position (3 is consistent; less is cautious, more is over-confident) and share of the steps "
        "whose run-averaged NEES is in its 99 % band. Cooperative methods at K = 6. "
        f"{scene.conditions(results.settings)}"
    )


def _figure(results: Results) -> Plot | None:
    """One row per method: its NEES per ego on a logarithmic axis, and the band of a single ego's mean."""
    from coopoc.study.plot import Plot, canvas, plain_log
    from coopoc.study.style import look

    ran = _ran(results)
    if not ran:
        return None
    with canvas(1, 1, width=6.2, height=0.9 + 0.2 * len(ran)) as (figure, panel):
        panel.axvline(3.0, color="black", linewidth=0.9)
        for row, (method, _, where) in enumerate(ran):
            shown = look(method)
            each = np.nanmean(results.values("nees", where), axis=1)
            panel.plot(
                each,
                np.full(len(each), row),
                linestyle="none",
                marker=shown.marker or "o",
                color=shown.color,
                alpha=0.8,
            )
        plain_log(panel.xaxis)
        labels = [look(method).label + ("" if known in USUAL else f", {known}") for method, known, _ in ran]
        panel.set(yticks=range(len(ran)), yticklabels=labels, ylim=(len(ran) - 0.4, -0.6), xlabel="NEES, one per ego")
    return Plot(figure, _caption(results))


def _findings(results: Results) -> Sequence[str]:
    from coopoc.study.style import look

    good = [
        look(method).label
        for method, known, where in _ran(results)
        if (views.mean(results, where, "nees_inside") or 0.0) >= GATE and known in USUAL
    ]
    return [f"At least {GATE:g} of the steps in the band: {', '.join(good)}."] if good else []


STUDY = Study(
    name="consistency",
    question="Which method's covariance can be believed?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=_grid(),
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "backend": "gauss-newton",
        "egos": "auto",
        "runs": 20,
        "seed": 0,
        "train_seeds": 1,
    },
    shares=("max_neighbours",),
    tables={"nees": _table},
    figures={"nees": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=("White noise over an ideal channel: what late messages, biases and lies do is in other studies.",),
    minutes=10,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("consistency"),
)
