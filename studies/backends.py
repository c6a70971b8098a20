"""Agreement of the optimization backends with a referee, and the cost of a solve with each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.optimize.model.factor import Factor
from coopoc.optimize.model.problem import Problem
from coopoc.optimize.solution import Status
from coopoc.optimize.solve import solve
from coopoc.optimize.starts.initial import initial_guess
from coopoc.study.numbers import Number, Where, across, present
from coopoc.study.study import Params, Row
from coopoc.study.style import Panel, look
from coopoc.world.recording import Recording

from . import lineup, scene
from .views import TableView, curves, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

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

    best = least_squares(residual, start.ravel(), jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-12, max_nfev=500)
    return np.asarray(best.x.reshape(start.shape))


def cell(p: Params) -> list[Row]:
    """Rows of one backend on one kind of problem: every ego at evenly spaced steps, `run` counting those."""
    seen = scene.recording({**p, "runs": 1})
    steps = np.linspace(WINDOW, len(seen.t) - 1, int(p["samples"])).astype(int).tolist()
    rows: list[Row] = []
    for ego in scene.egos(p["data"], str(p["egos"])):
        for number, step in enumerate(steps):
            problem = PROBLEMS[p["problem"]](seen, step, ego, 0)
            rows.append({"run": number, "ego": ego, **_solved(problem, p["method"])})
    return rows


def _solved(problem: Problem, backend: str) -> Row:
    """Answer of a backend to one problem, beside the referee; the second call is timed, as imports are once."""
    solve(problem, backend, throw=False)
    began = time.perf_counter()
    solution = solve(problem, backend, throw=False)
    whole = time.perf_counter() - began
    fair = referee(problem)
    gap, cost = float(np.abs(solution.x - fair).max()), problem.cost(fair)
    return {
        "gap_m": gap,
        "same": float(gap < SAME_M),
        "cost_gap": (solution.cost - cost) / max(cost, 1e-12),
        "solved": float(solution.status is Status.SOLVED),
        "iterations": solution.iterations,
        "solve_ms": 1e3 * solution.solve_seconds,
        "whole_ms": 1e3 * whole,
        "seconds": whole,
    }


def _column(value: str, number: Callable[[Any], Any], agreed: bool = False) -> Number:
    """A number of a column over all solves of a backend, or over those that ended where the referee does."""

    def column(results: Results, where: Where) -> Any:
        kept = present(results, {**where, **({"same": 1.0} if agreed else {})}, value)
        return None if kept is None else number(results.select(kept)[value])

    return column


def _percent(values: Any) -> str:
    return f"{100 * values.mean():.0f} %"


_median = {name: _column(name, lambda values: float(values.median())) for name in ("solve_ms", "whole_ms")}


def _table(columns: Mapping[str, Number], text: str) -> TableView:
    rows = [
        ((words, look(backend).label), {"problem": problem, "method": backend})
        for problem, words in WORDS.items()
        for backend in BACKENDS
    ]
    return selections(("Problem", "Backend"), rows, columns, text, at={"runs": 1})


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
    tables={
        "agreement": _table(
            {
                "Solves": _column("gap_m", len),
                "At a minimum": _column("solved", _percent),
                "The referee's": _column("same", _percent),
                "Farthest [µm]": _column("gap_m", lambda gaps: f"{1e6 * gaps.max():.2g}", agreed=True),
                "Cost differs": _column("cost_gap", lambda gaps: f"{gaps.abs().max():.0e}", agreed=True),
                "Lower": _column("cost_gap", lambda gaps: int((gaps < -1e-6).sum())),
                "Higher": _column("cost_gap", lambda gaps: int((gaps > 1e-6).sum())),
            },
            "Answers beside SciPy's trust-region least squares from the same start. The referee's: less than 1 mm "
            "away; of those, the farthest and the largest relative difference of cost. Lower, higher: solves that "
            "ended in a better or a worse minimum than the referee.",
        ),
        "cost": _table(
            across(_median["solve_ms"], {f"Solver, K = {k}": {"max_neighbours": k} for k in KS})
            | across(_median["whole_ms"], {f"All, K = {k}": {"max_neighbours": k} for k in KS}),
            "Milliseconds of one solve() from its first guess, median. Solver: the backend alone. All: with structure, "
            "checks, cost and covariance. Batches and streams, which keep the structure, are in docs/performance.md; "
            "times depend on the machine.",
        ),
    },
    figures={
        "cost": curves(
            [
                Panel({k: {"max_neighbours": k} for k in KS}, {"problem": p}, WORDS[p].capitalize(), "Neighbours K")
                for p in PROBLEMS
            ],
            [{"method": backend} for backend in BACKENDS],
            "Milliseconds of one solve() from its first guess, checks and covariance included, median.",
            at={"runs": 1},
            number=_median["whole_ms"],
            ylabel="Time [ms]",
            log=True,
        )
    },
    findings=_findings,
    limitations=(
        "The reference solver is local, too: where there are several minima it does not show which is the lowest.",
        "Times are of one call at a time and of this machine.",
    ),
    minutes=2,
    metrics={"solved": "higher", "same": "higher"},
)
