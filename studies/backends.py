"""Agreement of the optimization backends with a referee, and the cost of a solve with each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.optimize.initialisation.initial import initial_guess
from coopoc.optimize.model.factor import Factor
from coopoc.optimize.model.problem import Problem
from coopoc.optimize.solution import Status
from coopoc.optimize.solve import solve
from coopoc.study.numbers import Number, Where, present
from coopoc.study.tables import across, crossed
from coopoc.study.study import Params, Row
from coopoc.study.style import look
from coopoc.world.recording import Recording

from . import lineup, scene

if TYPE_CHECKING:
    import pandas as pd

    from coopoc.study.plot import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

BACKENDS = ("gauss-newton", "gtsam", "casadi", "osqp", "cvxpy")
CONVEX = ("ranges", "converted")
"""Problems that cvxpy can state: angles have no convex form."""
KS = (2, 6, 10)
WINDOW = 5
SAME_M = 1e-3
"""m, closer than which two answers are one minimum."""


def _ranges(seen: Recording, step: int, ego: str, run: int) -> Problem:
    """The snapshot without its angles."""
    whole = Problem.from_snapshot(seen, step, ego, run)
    return whole.replace_unchecked(factors=tuple(map(_distance, whole.factors)))


def _distance(factor: Factor) -> Factor:
    """A factor of range and angles as one of ranges, std (M, 1) m; any other as it is."""
    if factor.kind != "spherical":
        return factor
    return Factor("range", factor.nodes, factor.z[..., :1], std=np.asarray(1.0 / factor.root[..., 0, :1]))


PROBLEMS: Mapping[str, Callable[[Recording, int, str, int], Problem]] = {
    "snapshot": Problem.from_snapshot,
    "window": lambda seen, step, ego, run: Problem.from_window(seen, step, ego, WINDOW, run),
    "ranges": _ranges,
    "converted": lambda seen, step, ego, run: Problem.from_snapshot(seen, step, ego, run, NoiseModel.identity()),
}
"""Kinds of problems of an ego at a step; converted: relative measurements as vectors of unit covariance, linear."""
WORDS = {
    "snapshot": "snapshot, range and angles",
    "window": f"window of {WINDOW} steps",
    "ranges": "snapshot, ranges",
    "converted": "snapshot, converted vectors",
}


def referee(problem: Problem) -> Floats:
    """The minimum that SciPy's trust-region least squares finds from where all backends start, (n, 3) m."""
    start = initial_guess(problem)[0]

    def residual(flat: Floats) -> Floats:
        return problem.whiten(flat.reshape(start.shape))[0]

    def jacobian(flat: Floats) -> Floats:
        return np.asarray(problem.whiten(flat.reshape(start.shape))[1].toarray())

    found = least_squares(residual, start.ravel(), jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-12, max_nfev=500)
    return np.asarray(found.x.reshape(start.shape))


def cell(p: Params) -> list[Row]:
    """Rows of one backend on one kind of problem: every ego at evenly spaced steps, `run` counting those."""
    seen = scene.recording({**p, "runs": 1})
    steps = np.linspace(WINDOW, len(seen.t) - 1, int(p["samples"])).astype(int).tolist()
    found: list[Row] = []
    for ego in scene.egos(p["data"], str(p["egos"])):
        for place, step in enumerate(steps):
            problem = PROBLEMS[p["problem"]](seen, step, ego, 0)
            found.append({"run": place, "ego": ego, **_solved(problem, p["method"])})
    return found


def _solved(problem: Problem, backend: str) -> Row:
    """Answer of a backend to one problem, beside the referee; the second call is timed, as imports are once."""
    solve(problem, backend, throw=False)
    began = time.perf_counter()
    mine = solve(problem, backend, throw=False)
    whole = time.perf_counter() - began
    fair = referee(problem)
    gap, cost = float(np.abs(mine.x - fair).max()), problem.cost(fair)
    return {
        "gap_m": gap,
        "same": float(gap < SAME_M),
        "cost_gap": (mine.cost - cost) / max(cost, 1e-12),
        "solved": float(mine.status is Status.SOLVED),
        "iterations": mine.iterations,
        "solve_ms": 1e3 * mine.solve_seconds,
        "whole_ms": 1e3 * whole,
        "seconds": whole,
    }


ROWS = [
    ((words, look(backend).label), {"problem": problem, "method": backend})
    for problem, words in WORDS.items()
    for backend in BACKENDS
]


def _percent(values: pd.Series[float]) -> str:
    return f"{100 * values.mean():.0f} %"


def _agreement(results: Results) -> Table | None:
    """Numbers of all solves of a backend, and of those that ended where the referee does."""

    def of(number: Callable[[pd.DataFrame], Any], agreed: bool = False) -> Number:
        def column(results: Results, where: Where) -> Any:
            kept = present(results, where, "gap_m")
            rows = None if kept is None else results.select(kept)
            rows = rows if rows is None or not agreed else rows[rows["same"] == 1.0]
            return None if rows is None or rows.empty else number(rows)

        return column

    columns = [
        ("Solves", of(len)),
        ("At a minimum", of(lambda rows: _percent(rows["solved"]))),
        ("The referee's", of(lambda rows: _percent(rows["same"]))),
        ("Farthest [µm]", of(lambda rows: f"{1e6 * rows['gap_m'].max():.2g}", agreed=True)),
        ("Cost differs", of(lambda rows: f"{rows['cost_gap'].abs().max():.0e}", agreed=True)),
        ("Lower", of(lambda rows: int((rows["cost_gap"] < -1e-6).sum()))),
        ("Higher", of(lambda rows: int((rows["cost_gap"] > 1e-6).sum()))),
    ]
    text = (
        "Answers beside SciPy's trust-region least squares from the same start. The referee's: less than 1 mm away; of "
        "those, the farthest and the largest relative difference of cost. Lower, higher: solves that ended in a better "
        "or a worse minimum than the referee."
    )
    return crossed(results, ("Problem", "Backend"), ROWS, columns, scene.caption(results, text, runs=1))


def _cost(results: Results) -> Table | None:
    ks = sorted(results.frame["max_neighbours"].unique()) if len(results.frame) else []
    columns = [
        column
        for value, label in (("solve_ms", "Solver"), ("whole_ms", "All"))
        for column in across(partial(_median, value=value), {f"{label}, K = {k}": {"max_neighbours": k} for k in ks})
    ]
    text = (
        "Milliseconds of one solve() from its first guess, median. Solver: the backend alone. All: with structure, "
        "checks, cost and covariance. Batches and streams, which keep the structure, are in docs/performance.md; times "
        "depend on the machine."
    )
    return crossed(results, ("Problem", "Backend"), ROWS, columns, scene.caption(results, text, runs=1))


def _median(results: Results, where: Where, value: str) -> float | None:
    kept = present(results, where, value)
    return None if kept is None else float(results.select(kept)[value].median())


def _figure(results: Results) -> Plot | None:
    """Time of a solve against neighbours, one panel per problem."""
    from coopoc.study.lines import Line, Panel, panels

    def line(backend: str, problem: str) -> Line:
        at = {"method": backend, "problem": problem}
        return Line({"method": backend}, {k: _median(results, {**at, "max_neighbours": k}, "whole_ms") for k in KS})

    shown = [Panel([line(b, p) for b in BACKENDS], WORDS[p].capitalize(), "Neighbours K", KS) for p in PROBLEMS]
    text = "Milliseconds of one solve() from its first guess, checks and covariance included, median."
    return panels(shown, scene.caption(results, text, runs=1), 9.6, ylabel="Time [ms]", log=True)


def _findings(results: Results) -> dict[str, str]:
    frame = results.frame
    if "same" not in frame:
        return {}
    other, failed = frame[frame["same"] == 0.0], frame[frame["solved"] == 0.0]
    wrong = other[(other["solved"] == 1.0) & (other["cost_gap"].abs() <= 1e-6)]
    counts = ", ".join(f"{name} {n}" for name, n in failed.groupby("method").size().items())
    return {
        "minima": f"{len(frame)} solves; {100 * frame['same'].mean():.1f} % end where SciPy's least squares does, and "
        f"{(other['cost_gap'] > 1e-6).sum()} in a worse minimum.",
        "same cost": f"{len(wrong)} have the referee's cost at another place." if len(wrong) else "",
        "failed": f"Not at a minimum, and reported as such: {counts}." if counts else "",
    }


STUDY = lineup.study(
    "backends",
    "Do all backends find the same positions, and how long does each take?",
    cell=cell,
    key=scene.facts,
    recipe=None,
    grid=[
        {"max_neighbours": k, "problem": problem, "method": backend}
        for k in KS
        for problem in PROBLEMS
        for backend in BACKENDS
        if backend != "cvxpy" or problem in CONVEX
    ],
    settings={**scene.TOWN, "samples": 12, "train_seeds": 0},
    scored=False,
    shares=("max_neighbours",),
    tables={"agreement": _agreement, "cost": _cost},
    figures={"cost": _figure},
    findings=_findings,
    limitations=(
        "The reference solver is local, too: where there are several minima it does not show which is the lowest.",
        "Times are of one call at a time and of this machine.",
    ),
    minutes=2,
    metrics={"solved": "higher", "same": "higher"},
)
