"""Whether all backends find the same positions, and what a solve costs with each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.optimize.factor import Factor
from coopoc.optimize.initial import initial_guess
from coopoc.optimize.problem import Problem
from coopoc.optimize.solution import Status
from coopoc.optimize.solve import solve
from coopoc.study.study import Params, Row, Study
from coopoc.world.recording import Recording

from . import scene, views

if TYPE_CHECKING:
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

BACKENDS = ("gauss-newton", "gtsam", "casadi", "osqp", "cvxpy")
CONVEX = ("ranges", "converted")
"""Problems that cvxpy can state: angles have no convex form."""
WINDOW = 5
SAME_M = 1e-3
"""m, closer than which two answers are one minimum."""


def _snapshot(seen: Recording, step: int, ego: str, run: int) -> Problem:
    return Problem.from_snapshot(seen, step, ego, run)


def _window(seen: Recording, step: int, ego: str, run: int) -> Problem:
    return Problem.from_window(seen, step, ego, WINDOW, run)


def _converted(seen: Recording, step: int, ego: str, run: int) -> Problem:
    """Sightings as vectors of unit covariance: a linear problem."""
    return Problem.from_snapshot(seen, step, ego, run, NoiseModel.identity())


def _ranges(seen: Recording, step: int, ego: str, run: int) -> Problem:
    """The snapshot without its angles."""
    whole = Problem.from_snapshot(seen, step, ego, run)
    return whole.replace_unchecked(factors=tuple(map(_distance, whole.factors)))


def _distance(factor: Factor) -> Factor:
    if factor.kind != "spherical":
        return factor
    return Factor("range", factor.nodes, factor.z[..., :1], std=_std(factor))


def _std(factor: Factor) -> Floats:
    """(M, 1) m of the ranges."""
    return np.asarray(1.0 / factor.root[..., 0, :1])


PROBLEMS: Mapping[str, Callable[[Recording, int, str, int], Problem]] = {
    "snapshot": _snapshot,
    "window": _window,
    "ranges": _ranges,
    "converted": _converted,
}
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
    """What a backend says of one problem, beside the referee; the second call is timed, as imports are once."""
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


def _agreement(results: Results) -> Table | None:
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    for problem, words in WORDS.items():
        for backend in BACKENDS:
            where = views.present(results, {"problem": problem, "method": backend}, "gap_m")
            if where is None:
                continue
            rows = results.select(where)
            one = rows[rows["same"] == 1.0]
            worst = f"{1e6 * one['gap_m'].max():.2g}" if len(one) else None
            body.append(
                (
                    words,
                    look(backend).label,
                    len(rows),
                    f"{100 * rows['solved'].mean():.0f} %",
                    f"{100 * rows['same'].mean():.0f} %",
                    worst,
                    f"{one['cost_gap'].abs().max():.0e}" if len(one) else None,
                    int((rows["cost_gap"] < -1e-6).sum()),
                    int((rows["cost_gap"] > 1e-6).sum()),
                )
            )
    header = (
        "Problem",
        "Backend",
        "Solves",
        "At a minimum",
        "The referee's",
        "Farthest [µm]",
        "Cost differs",
        "Lower",
        "Higher",
    )
    text = (
        "Answers beside SciPy's trust-region least squares from the same start. The referee's: less than 1 mm away; of "
        "those, the farthest and the largest relative difference of cost. Lower, higher: solves that ended in a better "
        f"or a worse minimum than the referee. {scene.conditions({**results.settings, 'runs': 1})}"
    )
    return Table(header, tuple(body), text) if body else None


def _cost(results: Results) -> Table | None:
    from coopoc.study.style import look

    rows = [
        ((words, look(backend).label), {"problem": problem, "method": backend})
        for problem, words in WORDS.items()
        for backend in BACKENDS
    ]
    ks = sorted(results.frame["max_neighbours"].unique()) if len(results.frame) else []
    columns = [
        (f"{label}, K = {k}", {"max_neighbours": k, "value": value})
        for value, label in (("solve_ms", "Solver"), ("whole_ms", "All"))
        for k in ks
    ]
    text = (
        "Milliseconds of one solve() from its first guess, median. Solver: the backend alone. All: with structure, "
        "checks, cost and covariance. Batches and streams, which keep the structure, are in docs/performance.md; times "
        f"depend on the machine. {scene.conditions({**results.settings, 'runs': 1})}"
    )
    return views.crossed(results, ("Problem", "Backend"), rows, columns, _median, text)


def _median(results: Results, where: dict[str, Any]) -> float | None:
    value = where["value"]
    kept = views.present(results, {name: given for name, given in where.items() if name != "value"}, value)
    return None if kept is None else float(results.select(kept)[value].median())


def _findings(results: Results) -> Sequence[str]:
    if "same" not in results.frame:
        return []
    frame = results.frame
    apart = frame[(frame["same"] == 0.0) & (frame["cost_gap"] > 1e-6)]
    said = [
        f"{len(frame)} solves; {100 * frame['same'].mean():.1f} % end where SciPy's least squares does, and "
        f"{len(apart)} in a worse minimum."
    ]
    wrong = frame[(frame["same"] == 0.0) & (frame["solved"] == 1.0) & (frame["cost_gap"].abs() <= 1e-6)]
    if len(wrong):
        said.append(f"{len(wrong)} have the referee's cost at another place.")
    failed = frame[frame["solved"] == 0.0]
    if len(failed):
        counts = failed.groupby("method").size()
        said.append("Not at a minimum, and said so: " + ", ".join(f"{name} {n}" for name, n in counts.items()) + ".")
    return said


def key(p: Params) -> Mapping[str, str]:
    """What changes the numbers beyond the parameters."""
    return scene.facts(p)


STUDY = Study(
    name="backends",
    question="Do all backends find the same positions, and what does a solve cost with each?",
    cell=cell,
    key=key,
    grid=[
        {"max_neighbours": k, "problem": problem, "method": backend}
        for k in (2, 6, 10)
        for problem in PROBLEMS
        for backend in BACKENDS
        if backend != "cvxpy" or problem in CONVEX
    ],
    settings={
        "data": "town10",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "egos": "auto",
        "samples": 12,
        "seed": 0,
        "train_seeds": 0,
    },
    shares=("max_neighbours",),
    tables={"agreement": _agreement, "cost": _cost},
    findings=_findings,
    limitations=(
        "The referee is local, too: of problems with several minima it says which was found, not which is the lowest.",
        "Times are of one call at a time and of this machine.",
    ),
    minutes=2,
    metrics={"solved": "higher", "same": "higher"},
    reference=views.reference("backends"),
)
