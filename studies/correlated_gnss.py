"""Gain of cooperation under time-correlated GNSS errors: each receiver's own, or common to all vehicles."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Number, mean, present, ratio, rms, sentence
from coopoc.study.tables import across, crossed
from coopoc.study.style import look

from . import lineup, scene
from .lineup import BOUND, of

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

ERRORS = {
    "white": (0.0, 0.0),
    "half own": (0.5, 0.0),
    "own": (0.9, 0.0),
    "own and common": (0.45, 0.45),
    "common": (0.0, 0.9),
}
"""Name -> shares of a fix's variance that are time-correlated: of each receiver, and common to all vehicles."""
NEIGHBOURS = (0, 2, 6, 10)
SOLO = (("gnss", "none"), ("kalman", "nominal"), ("fedkalmannet", "trained"), ("recursive", "trained"))
SHARED = (("joint", "nominal"), ("split-ci", "nominal"), ("drift", "nominal"))
"""Nominal noise model: all but `drift` take the whole error of a fix as white, of the same variance."""
LINES = (*SOLO, *SHARED, BOUND)
NOTE = (
    "Lasting errors are 50 % or 90 % of a fix's variance, {drift_time_s:g} s correlated. All "
    "but the drift filter take them as white noise of the same variance. The bound knows how they last."
)


def _grid() -> list[dict[str, Any]]:
    """Solo methods at K = 0 only; the drift filter there, too, as the solo filter of coloured noise."""
    return [
        of(*line, **case(name), max_neighbours=k)
        for name in ERRORS
        for k in NEIGHBOURS
        for line in ((*SOLO, *SHARED[2:], BOUND) if k == 0 else (*SHARED, BOUND))
    ]


def case(name: str) -> dict[str, Any]:
    """An error model as a selection."""
    return dict(zip(scene.LASTING, ERRORS[name], strict=True))


def _table(results: Results, number: Number, text: str, decimals: int) -> Table | None:
    """Methods down, K across, one block per error model."""
    rows = [((name, look(line[0]).label), of(*line, **case(name))) for name in ERRORS for line in LINES]
    columns = across(number, {f"K = {k}": {"max_neighbours": k} for k in NEIGHBOURS})
    head = ("Errors of GNSS that last", "Method")
    return crossed(results, head, rows, columns, scene.caption(results, text, NOTE), decimals=decimals)


def _figure(results: Results) -> Plot | None:
    """rms against K, one panel per error model; solo methods ran at K = 0."""
    from coopoc.study.lines import Line, Panel, panels

    shown = []
    for name in ERRORS:
        if present(results, case(name)):
            lines = [
                Line(
                    of(*line),
                    {
                        k: rms(results, of(*line, **case(name), max_neighbours=0 if line in SOLO else k))
                        for k in NEIGHBOURS
                    },
                )
                for line in LINES[1:]
            ]
            shown.append(Panel(lines, name, "Neighbours K", NEIGHBOURS))
    text = scene.caption(results, "rms over runs of RT-LE against the number of neighbours.", NOTE)
    return panels(shown, text, 1.2 + 1.55 * len(shown), ylabel="rms RT-LE [m]")


FINDING = (
    "{name}: {most} neighbours take the filter from {alone:.2f} m alone to {joint:.2f} m ({share:.2f} times); to "
    "{drift:.2f} m if it knows how errors last; bound {bound:.2f} m."
)


def _findings(results: Results) -> dict[str, str]:
    most = max((k for k in NEIGHBOURS if present(results, {"max_neighbours": k})), default=0)
    found = {}
    for name in ERRORS if most else ():
        at = {"kalman": 0, "joint": most, "drift": most, "bound": most}
        alone, joint, drift, bound = (
            rms(results, {**case(name), "method": method, "max_neighbours": k}) for method, k in at.items()
        )
        numbers = {"alone": alone, "joint": joint, "share": ratio(joint, alone), "drift": drift, "bound": bound}
        found[name] = sentence(FINDING, name=name, most=most, **numbers)
    return found


STUDY = lineup.study(
    "correlated_gnss",
    "What is cooperation worth when GNSS errors are time-correlated, so that no solo filter averages them out?",
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "drift_time_s": 60.0, "runs": 30, "train_seeds": 1},
    shares=(*scene.LASTING, "max_neighbours"),
    tables={
        "rms": partial(_table, number=rms, text="rms over runs of RT-LE [m].", decimals=2),
        "nees": partial(_table, number=partial(mean, value="nees"), text="NEES (3 is consistent).", decimals=1),
    },
    figures={"rms": _figure},
    findings=_findings,
    limitations=(
        "A Gauss-Markov error with one correlation time stands for multipath and atmosphere; real ones depend on the "
        "place and on the satellites in view.",
        "The common error is the same over the whole map, which is nearly true over some hundred metres.",
        "The drift filter and the bound treat a returning neighbour as new, although its error was partly known: "
        "the filter is somewhat over-confident, and the bound is not tight.",
        "Learned gains were trained with white noise.",
    ),
    minutes=12,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
