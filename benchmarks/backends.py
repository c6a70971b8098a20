"""The libraries through `coopoc.optimize` against a hand-written loop on the same library, and the plain rebuilt way.

    OMP_NUM_THREADS=1 python benchmarks/backends.py            # a Markdown table on stdout, about a minute

A star of ten neighbours, as many noise realisations as a row names. Ours is what a user writes, `solve_batch(problem,
backend)`: start, whitening, the check of every answer and the covariances are in its time. The hand-written loops keep
what they can between two solves, get whitened arrays or starts that are prepared before their clock starts, and give x
only. Rows of a job are timed one after the other in every round; times are this thread's own, medians of rounds. "x
hand-written" is a row's time over that of the loop. A row counts only if its answer is that of gauss-newton: cost
within 1e-6 relative and positions within 1 mm.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi
import cvxpy
import gtsam
import numpy as np
import osqp
from classical import KNOWN, NEIGHBOURS, SENSORS, timed
from scipy.sparse import csc_matrix, triu
from tabulate import tabulate

import coopoc as co
from coopoc.optimize import Problem, solve, solve_batch
from coopoc.optimize.incremental import FixedLag
from coopoc.optimize.initial import converted, initial_guess
from coopoc.world.spherical import spherical, wrap

ROUNDS, RUNS, STEPS, SIZE = 7, 200, 60, 3 * (NEIGHBOURS + 1)
TOLERANCE = 1e-4
"""m, of the iterated solves of all rows."""


class Row(NamedTuple):
    """One way to do a job: the job, its words, solves per call and the call, whose answer is (solves, n, 3)."""

    job: str
    words: str
    solves: int
    call: Callable[[], Any]


class Job(NamedTuple):
    """Rows of one job, the hand-written loop second, and who says that an answer (solves, n, 3) is right."""

    rows: list[Row]
    right: Callable[[Any], bool]


def star(runs: int, neighbours: int = NEIGHBOURS) -> Problem:
    """An ego with ten neighbours around it, all realisations at once."""
    around = np.linspace(0, 2 * np.pi, neighbours, endpoint=False)
    gap = np.linspace(12, 25, neighbours)
    offset = np.vstack([np.zeros(3), np.stack([gap * np.cos(around), gap * np.sin(around), 0.05 * gap], axis=1)])
    velocity = np.tile([10.0, 0.0, 0.0], (2, neighbours + 1, 1))
    fleet = co.Fleet(tuple(f"v{i}" for i in range(neighbours + 1)), [0.0, 0.1],
                     np.stack([offset, offset + 0.1 * velocity[0]]), velocity)  # fmt: skip
    recording = co.observe(fleet, SENSORS, co.V2X(max_neighbours=neighbours), runs=runs, observers=[0])
    return Problem.from_snapshot(recording, 1, 0, run=None, noise=KNOWN)


def as_good(problem: Problem) -> Callable[[Any], bool]:
    """Whether x (solves, n, 3) is gauss-newton's, cost and position."""
    best = solve_batch(problem, tolerance=1e-10)
    assert best.converged.all()

    def right(x: Any) -> bool:
        few = np.arange(len(x))
        cost = problem.pick(few).linearise(np.asarray(x)).cost
        return float(np.abs(x - best.x[few]).max()) < 1e-3 and float((cost / best.cost[few] - 1).max()) < 1e-6

    return right


def ours(problem: Problem, backend: str, count: int, **options: Any) -> Callable[[], Any]:
    """`solve_batch` of the first realisations."""
    part = problem.pick(np.arange(count))
    return lambda: solve_batch(part, backend, **options).x


def single(problem: Problem, backend: str, count: int, **options: Any) -> Callable[[], Any]:
    """`solve` of one after the other: status, saddle and free points looked at for each."""
    parts = [problem.pick(k) for k in range(count)]
    return lambda: np.stack([solve(part, backend, **options).x for part in parts])


def gtsam_linear(problem: Problem) -> Job:
    """Prior and Between factors of the converted problem."""
    fixes, edges = problem.factors
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))
    zero, keys = gtsam.Values(), range(NEIGHBOURS + 1)
    for k in keys:
        zero.insert(k, np.zeros(3))

    def one(fix: Any, vector: Any, root: Any) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        for k in keys:
            graph.add(gtsam.PriorFactorPoint3(k, fix[k], model))
        for k in range(NEIGHBOURS):
            edge = gtsam.noiseModel.Gaussian.SqrtInformation(root[k], False)
            graph.add(gtsam.BetweenFactorPoint3(0, k + 1, vector[k], edge))
        return graph.linearize(zero).optimize().vector().reshape(-1, 3)

    def batch() -> Any:
        return np.stack([one(*given) for given in zip(fixes.z, edges.z, edges.root, strict=True)])

    def custom() -> Any:
        return np.stack([custom_factors(fixes.z[b], edges.z[b], edges.root[b]) for b in range(4)])

    job = "gtsam, snapshot, converted"
    return Job([Row(job, "ours", RUNS, ours(problem, "gtsam", RUNS)), Row(job, "hand-written", RUNS, batch),
                Row(job, "CustomFactors and Levenberg-Marquardt", 4, custom),
                Row(job, "ours, solve() one by one", 4, single(problem, "gtsam", 4))], as_good(problem))  # fmt: skip


def custom_factors(fix: Any, vector: Any, root: Any) -> Any:
    """The same by Python's callbacks, derivatives by hand."""
    graph, at, unit = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel.Unit.Create(3)
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))

    def edge(k: int) -> Callable[..., Any]:
        def error(factor: Any, found: Any, slopes: Any) -> Any:
            if slopes is not None:
                slopes[0], slopes[1] = -root[k], root[k]
            return root[k] @ (found.atPoint3(k + 1) - found.atPoint3(0) - vector[k])

        return error

    for k, z in enumerate(fix):
        graph.add(gtsam.PriorFactorPoint3(k, z, model))
        at.insert(k, z)
    for k in range(len(vector)):
        graph.add(gtsam.CustomFactor(unit, [0, k + 1], edge(k)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    found = gtsam.LevenbergMarquardtOptimizer(graph, at, params).optimize()
    return np.stack([found.atPoint3(k) for k in range(len(fix))])


def fixed_lag(problem: Problem) -> Job:
    """The star that drives on, realisation by realisation one step later; a lag of ten steps."""
    fixes, edges = problem.factors
    n, lag, moved = NEIGHBOURS + 1, 1.05, np.tile([1.0, 0.0, 0.0], (NEIGHBOURS + 1, 1))
    odometry = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.process_std))
    prior = gtsam.noiseModel.Diagonal.Sigmas(np.array(KNOWN.gnss_std))
    z = fixes.z[:STEPS] + np.arange(STEPS)[:, None, None] * moved

    def piece(names: list[str], first: int, steps: int) -> Problem:
        """The steps from `first` on, and the odometry from the nodes before them where the names have those."""
        found, each = Problem(names), np.arange(n)
        before = len(names) - n * steps
        for k in range(steps):
            at = before + n * k + each
            found = found.add("position", at.tolist(), z[first + k], std=KNOWN.gnss_std)
            if before or k:
                found = found.add("displacement", np.stack([at - n, at], 1).tolist(), moved, std=KNOWN.process_std)
            star = np.stack([np.full(NEIGHBOURS, at[0]), at[1:]], 1).tolist()
            found = found.add("displacement", star, edges.z[first + k], sqrt_information=edges.root[first + k])
        return found

    def called(t: int) -> list[str]:
        return [f"{i}@{t}" for i in range(n)]

    pieces = [piece([*(called(t - 1) if t else []), *called(t)], t, 1) for t in range(STEPS)]
    whole = {t: piece([name for s in range(t + 1) for name in called(s)], 0, t + 1) for t in (20, STEPS - 1)}
    best = {t: solve(problem).x[-n] for t, problem in whole.items()}

    def mine() -> Any:
        smoother = FixedLag(lag, threshold=1e6)  # what is linear is never linearised again
        return np.stack([smoother.update(part, dict.fromkeys(called(t), 0.1 * t), [f"0@{t}"]).x
                         for t, part in enumerate(pieces)])  # fmt: skip

    def hand() -> Any:
        params = gtsam.ISAM2Params()
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        smoother, found = gtsam.IncrementalFixedLagSmoother(lag, params), []
        for t in range(STEPS):
            graph, fresh, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), n * t
            for k in range(n):
                graph.add(gtsam.PriorFactorPoint3(key + k, z[t, k], prior))
                fresh.insert(key + k, z[t, k])
                if t:
                    graph.add(gtsam.BetweenFactorPoint3(key - n + k, key + k, moved[k], odometry))
            for k in range(NEIGHBOURS):
                model = gtsam.noiseModel.Gaussian.SqrtInformation(edges.root[t, k], False)
                graph.add(gtsam.BetweenFactorPoint3(key, key + k + 1, edges.z[t, k], model))
            smoother.update(graph, fresh, dict.fromkeys(range(key, key + n), 0.1 * t))
            found.append(smoother.calculateEstimate().atPoint3(key))
            smoother.marginalCovariance(key)
        return np.stack(found)[:, None]

    def right(x: Any) -> bool:
        return all(float(np.abs(x[t, 0] - wanted).max()) < 1e-3 for t, wanted in best.items())

    job = "gtsam, fixed lag, converted"
    return Job([Row(job, "ours", STEPS, mine), Row(job, "hand-written", STEPS, hand)], right)


def seen(x: Any, z: Any, std: Any) -> tuple[Any, Any]:
    """Whitened residuals (B, K, 3) of ranges and angles at x (B, n, 3), and derivatives (B, K, 3, 3)."""
    dx, dy, dz = np.moveaxis(x[:, 1:] - x[:, :1], 2, 0)
    flat2 = dx**2 + dy**2
    flat, r2 = np.sqrt(flat2), flat2 + dz**2
    r = np.sqrt(r2)
    slope = np.stack([np.stack([dx / r, dy / r, dz / r], -1), np.stack([-dy / flat2, dx / flat2, 0 * r], -1),
                      np.stack([dx * dz / (flat * r2), dy * dz / (flat * r2), -flat / r2], -1)], -2)  # fmt: skip
    return wrap(np.stack(spherical(dx, dy, dz), -1) - z) / std, slope / std[..., None]


def gtsam_exact(problem: Problem) -> Job:
    """Gauss-Newton whose JacobianFactors come from NumPy, all realisations at once."""
    fixes, edges = problem.factors
    start, keys = initial_guess(problem), range(NEIGHBOURS + 1)
    unit = gtsam.noiseModel.Unit.Create(3)
    weight, std = 1.0 / np.array(KNOWN.gnss_std), np.array(SENSORS.relative_std)
    eye = np.diag(weight)

    def one(prior: Any, residual: Any, slope: Any, order: Any) -> Any:
        graph = gtsam.GaussianFactorGraph()
        for k in keys:
            graph.add(k, eye, prior[k], unit)
        for k, (a, b, c) in enumerate(zip(-slope, slope, -residual, strict=True), 1):
            graph.add(0, a, k, b, c, unit)
        return graph.optimize(order).vector().reshape(-1, 3)

    def batch() -> Any:
        x, going = start.copy(), np.arange(RUNS)
        order = gtsam.Ordering()
        for k in [*keys[1:], 0]:
            order.push_back(k)
        while len(going):
            near = x[going]
            residual, slope = seen(near, edges.z[going], std)
            prior = (fixes.z[going] - near) * weight
            step = np.stack([one(*given, order) for given in zip(prior, residual, slope, strict=True)])
            x[going] += step
            going = going[np.abs(step).max(axis=(1, 2)) > TOLERANCE]
        return x

    job = "gtsam, snapshot, exact"
    return Job([Row(job, "ours", RUNS, ours(problem, "gtsam", RUNS, tolerance=TOLERANCE)),
                Row(job, "hand-written", RUNS, batch)], as_good(problem))  # fmt: skip


def casadi_exact(problem: Problem) -> Job:
    """IPOPT on one programme whose measurements are parameters."""
    fixes, edges = problem.factors
    start = initial_guess(problem)
    std, fix_std = np.array(SENSORS.relative_std), np.array(KNOWN.gnss_std)
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}

    def cost(x: Any, fix: Any, seen: Any) -> Any:
        """Of x and fix (3, n) and seen (3, K)."""
        gap = x[:, 1:] - casadi.repmat(x[:, 0], 1, NEIGHBOURS)
        flat = casadi.sqrt(gap[0, :] ** 2 + gap[1, :] ** 2)
        across = gap[1, :] * casadi.cos(seen[1, :]) - gap[0, :] * casadi.sin(seen[1, :])
        along = gap[0, :] * casadi.cos(seen[1, :]) + gap[1, :] * casadi.sin(seen[1, :])
        rest = casadi.vertcat((casadi.sqrt(flat**2 + gap[2, :] ** 2) - seen[0, :]) / std[0],
                              casadi.atan2(across, along) / std[1],
                              (casadi.atan2(flat, gap[2, :]) - seen[2, :]) / std[2])  # fmt: skip
        return 0.5 * (casadi.sumsqr((x - fix) / casadi.repmat(fix_std, 1, NEIGHBOURS + 1)) + casadi.sumsqr(rest))

    x, fix, sight = (casadi.SX.sym(name, 3, n) for name, n in
                     (("x", NEIGHBOURS + 1), ("fix", NEIGHBOURS + 1), ("seen", NEIGHBOURS)))  # fmt: skip
    nlp = {"x": casadi.vec(x), "p": casadi.veccat(fix, sight), "f": cost(x, fix, sight)}
    solver = casadi.nlpsol("solver", "ipopt", nlp, quiet)

    def batch() -> Any:
        numbers = np.concatenate([fixes.z.reshape(RUNS, -1), edges.z.reshape(RUNS, -1)], axis=1)
        return np.stack([np.asarray(solver(x0=a.ravel(), p=p)["x"]).reshape(-1, 3)
                         for a, p in zip(start, numbers, strict=True)])  # fmt: skip

    def opti() -> Any:
        found = []
        for b in range(2):
            model = casadi.Opti()
            nodes = [model.variable(3) for _ in range(NEIGHBOURS + 1)]
            total = sum(casadi.sumsqr((node - fix) / fix_std) for node, fix in zip(nodes, fixes.z[b], strict=True))
            for node, (r, azimuth, inclination) in zip(nodes[1:], edges.z[b], strict=True):
                gap = node - nodes[0]
                flat = casadi.sqrt(gap[0] ** 2 + gap[1] ** 2)
                turn = casadi.atan2(gap[1], gap[0]) - azimuth
                turn = casadi.atan2(casadi.sin(turn), casadi.cos(turn))
                total += ((casadi.norm_2(gap) - r) / std[0]) ** 2 + (turn / std[1]) ** 2
                total += ((casadi.atan2(flat, gap[2]) - inclination) / std[2]) ** 2
            model.minimize(0.5 * total)
            for node, at in zip(nodes, start[b], strict=True):
                model.set_initial(node, at)
            model.solver("ipopt", {"print_time": False}, quiet["ipopt"])
            answer = model.solve()
            found.append([answer.value(node) for node in nodes])
        return np.stack(found)

    job = "casadi, snapshot, exact"
    return Job([Row(job, "ours", RUNS, ours(problem, "casadi", RUNS)), Row(job, "hand-written", RUNS, batch),
                Row(job, "Opti, rebuilt", 2, opti),
                Row(job, "ours, sqp", RUNS, ours(problem, "casadi", RUNS, method="sqp"))],
               as_good(problem))  # fmt: skip


def osqp_linear(problem: Problem) -> Job:
    """One workspace; P and q are ready before the clock starts. `update` writes into the P of `setup`."""
    rows = [problem.pick(b).whiten(np.zeros((NEIGHBOURS + 1, 3))) for b in range(RUNS)]
    matrices = [csc_matrix(triu(J.T @ J, format="csc")) for _, J in rows]
    pulls = [np.asarray(J.T @ r) for r, J in rows]
    settings = {"scaling": 0, "rho": 1e-4, "alpha": 1.0, "eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 200,
                "check_termination": 1, "adaptive_rho": 0, "verbose": False}  # fmt: skip
    nothing = csc_matrix((0, SIZE)), np.empty(0), np.empty(0)

    def workspace(b: int) -> Any:
        made = osqp.OSQP()
        made.setup(matrices[b].copy(), pulls[b], *nothing, **settings)
        return made

    persistent = workspace(0)

    def batch() -> Any:
        found = []
        for matrix, pull in zip(matrices, pulls, strict=True):
            persistent.update(Px=matrix.data, q=pull)
            found.append(persistent.solve(raise_error=False).x)
        return np.stack(found).reshape(RUNS, -1, 3)

    def setups() -> Any:
        return np.stack([workspace(b).solve(raise_error=False).x for b in range(10)]).reshape(10, -1, 3)

    job = "osqp, snapshot, converted"
    return Job([Row(job, "ours", RUNS, ours(problem, "osqp", RUNS)), Row(job, "hand-written", RUNS, batch),
                Row(job, "setup at each solve", 10, setups),
                Row(job, "ours, solve() one by one", 4, single(problem, "osqp", 4))], as_good(problem))  # fmt: skip


def cvxpy_linear(problem: Problem) -> Job:
    """Weights and measurements as parameters, so that CVXPY canonicalises once."""
    fixes, edges = problem.factors
    weight, root = 1.0 / np.array(KNOWN.gnss_std), edges.root
    whitened = np.einsum("bkij,bkj->bki", root, edges.z)
    options = {"solver": "CLARABEL", "max_threads": 1}

    def programme(weights: Any, fix: Any, pull: Any) -> tuple[Any, Any]:
        """x (n, 3) and the programme; the weights (9, K), row by row, with the whitened vectors (K, 3)."""
        x = cvxpy.Variable((NEIGHBOURS + 1, 3))
        gap = (x[1:] - np.ones((NEIGHBOURS, 1)) @ x[:1]).T
        parts = [cvxpy.sum(cvxpy.multiply(weights[3 * i : 3 * i + 3], gap), axis=0) - pull[:, i] for i in range(3)]
        terms = [cvxpy.sum_squares(part) for part in (cvxpy.multiply(x - fix, np.tile(weight, (NEIGHBOURS + 1, 1))),
                                                      *parts)]  # fmt: skip
        return x, cvxpy.Problem(cvxpy.Minimize(sum(terms)))

    given = [cvxpy.Parameter(shape) for shape in ((9, NEIGHBOURS), (NEIGHBOURS + 1, 3), (NEIGHBOURS, 3))]
    held = programme(*given)

    def numbers(b: int) -> tuple[Any, Any, Any]:
        return root[b].reshape(NEIGHBOURS, 9).T, fixes.z[b], whitened[b]

    def batch() -> Any:
        found = []
        for b in range(10):
            for parameter, value in zip(given, numbers(b), strict=True):
                parameter.value = value
            held[1].solve(**options)
            found.append(held[0].value)
        return np.stack(found)

    def rebuilt() -> Any:
        found = []
        for b in range(4):
            x, model = programme(*numbers(b))
            model.solve(**options)
            found.append(x.value)
        return np.stack(found)

    job = "cvxpy, snapshot, converted"
    return Job([Row(job, "ours", 10, ours(problem, "cvxpy", 10)), Row(job, "hand-written", 10, batch),
                Row(job, "rebuilt", 4, rebuilt)], as_good(problem))  # fmt: skip


def jobs() -> list[Job]:
    """All of them; a call of each has run once."""
    exact = star(RUNS)
    linear = converted(exact)
    return [gtsam_linear(linear), gtsam_exact(exact), fixed_lag(linear), casadi_exact(exact), osqp_linear(linear),
            cvxpy_linear(linear)]  # fmt: skip


def measured(found: list[Job] | None = None, rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Per row its name, microseconds per solve, the ratio to the hand-written loop and whether its answer is right."""
    out: list[dict[str, Any]] = []
    for job in jobs() if found is None else found:
        right = [job.right(row.call()) for row in job.rows]
        spent = np.array([[timed(row.call) / row.solves for row in job.rows] for _ in range(rounds)])
        medians = np.median(spent, axis=0)
        for row, median, good in zip(job.rows, medians, right, strict=True):
            out.append({"name": f"{row.job}: {row.words}", "us": 1e6 * float(median),
                        "ratio": float(median / medians[1]), "right": good})  # fmt: skip
    return out


def main() -> None:
    """Print the table."""
    lines = [[row["name"], row["us"], row["ratio"], "yes" if row["right"] else "NO"] for row in measured()]
    header = ["", "us", "x hand-written", "same answer"]
    print(tabulate(lines, header, tablefmt="github", floatfmt=("", ".4g", ".3g", "")))


if __name__ == "__main__":
    main()
