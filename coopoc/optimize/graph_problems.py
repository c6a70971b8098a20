"""A graph of poses and landmarks as a Problem, and where to start it."""

import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from ..arrays import TWO_TURNS, Floats, Ints, instance, one_of
from ..errors import InputError
from ..formats import load_graph
from ..formats.graph import Graph
from ..kernels.compiling.waiting import clock, load
from .algebra.sparse import LIBRARIES
from .model.factor import Factor, unchecked
from .model.problem import Problem, Search
from .model.space import Space
from .starts.graph_starts import (
    STARTS,
    contenders,
    incremental_start,
    parts,
    position_variance,
    rotation_variance,
)
from .starts.initial import crossed, directed, graph_of
from .starts.race import eased, race

Objective = Literal["chordal", "geodesic"]
MEASUREMENT_KINDS = {
    "relative_pose": "relative_pose",
    "pose_prior": "pose",
    "relative_point": "relative_position",
    "point_prior": "position",
}
"""Of measurements, by the name of a graph's edges."""
UNEVEN = 4.0
"""Ratio of the variances of a position, by direction, from which one weight does not do."""
Start = Literal["odometry", "file", "tree", "incremental", "auto"]


def read_graph(
    path: str | Path, objective: Objective = "chordal", start: Start = "auto", repair: bool = False
) -> Problem:
    """The problem of a PyFG or g2o file; see `from_graph` and, of `repair`, `coopoc.formats.load_graph`.

    Raises:
        InputError: a line that is wrong, with file and number; an unknown suffix, objective or start.
    """
    return from_graph(load_graph(path, repair), objective, start)


def from_graph(graph: Graph, objective: Objective = "chordal", start: Start = "auto") -> Problem:
    """The problem of a graph; of each connected part without priors and fixed vertices the first pose is fixed.

    chordal: kappa |R_j - R_i R_ij|_F^2 + tau |t_j - t_i - R_i t_ij|^2, tau = d / trace(cov_t) and kappa = 1 / var_theta
    in the plane, 3 / (2 trace(cov_R)) in space: quadratic, so that it can be certified. These are the weights of CORA
    (arXiv 2302.11614), and those of SE-Sync (Rosen et al., IJRR 2019) where heading and position are not correlated;
    else SE-Sync's kappa is the information of theta, which is larger. One weight stands for all directions, in the
    answer and in its covariance; a note says where noise differs by direction. geodesic: R_ij^T (R_i^T (t_j - t_i) -
    t_ij) and log(R_ij^T R_i^T R_j) with the full covariance.

    Args:
        graph: of `coopoc.formats.load_graph`.
        start: "odometry" chains each robot's relative poses from a pose with a prior, else from its first vertex in the
            file; "file" takes the vertices as they are, which in PyFG are the truth; "tree" follows loop closures and
            measurements between robots, too, and averages them; "incremental" solves the first poses of all robots,
            then more with them (`starts/graph_starts.py`); "auto" tries all that the graph offers and keeps the one
            that leads lowest (`starts/race.py`). Landmarks are put at their priors, or where the first pose that
            measures them sees them, or by ranges. The Solution names the start in extras["start"].

    Raises:
        InputError: an unknown objective or start, a measurement without variance, by its vertices.

    >>> from coopoc.formats.graph import RangeEdges
    >>> ranges = RangeEdges([[0, 1]], [5.0], [0.01])
    >>> from_graph(Graph(2, ("A0", "L0"), [True, False], [[0, 0], [3, 4]], [[0], [0]], ranges=ranges))
    Problem(2 nodes in the plane; 1 range)
    """
    one_of("objective", objective, Objective)
    one_of("start", start, Start)
    load(*LIBRARIES)
    began, notes, factors = clock(), _counted(graph.notes), _factors(graph, objective)
    poses = tuple(np.flatnonzero(graph.is_pose).tolist())
    given, graph = graph, unchecked(graph, fixed=_fixed(graph))
    first = "odometry" if start in ("auto", "incremental") else start
    start_x = _x0(graph, poses, first)
    problem = Problem(
        graph.names,
        factors,
        start_x,
        dimension=graph.dimension,
        poses=poses,
        fixed=tuple(graph.fixed.tolist()),
        search=Search(first),
    )
    problem = problem.starting_at(directed(problem, start_x))
    if len(graph.fixed) - len(given.fixed) > (not len(given.fixed)):
        notes.append(
            f"no measurement joins all parts: {', '.join(graph.names[k] for k in problem.fixed[:5])} are fixed, "
            "and nothing places one to another"
        )
    if graph.dimension == 2 and (beyond := int((abs(graph.relative_pose.orientation) > TWO_TURNS).sum())):
        notes.append(f"relative poses beyond two turns, {beyond} in all: are angles in degrees?")
    if objective == "chordal":
        d, kinds = graph.dimension, MEASUREMENT_KINDS
        size = np.linalg.eigvalsh(np.concatenate([getattr(graph, kind).covariance[:, :d, :d] for kind in kinds]))
        if uneven := int((size[:, -1] > UNEVEN * size[:, 0]).sum()):
            notes.append(f"one weight stands for noise that differs by direction, of {uneven} in all: take geodesic")
    if start == "auto":
        problem = _raced(graph, problem)
    elif start == "incremental" and poses:
        x0, steps = incremental_start(graph, problem)
        problem = problem.starting_at(x0).replace_unchecked(search=Search(start, steps))
    won = problem.search
    if won.start.startswith("file") and not graph.guess:
        notes.append("the start is the file's vertices, which may be the truth")
    search = won._replace(seconds=clock() - began, notes=(*notes, *won.notes), x0=problem.x0)
    return problem.replace_unchecked(search=search)


def _raced(graph: Graph, problem: Problem, draws: bool = False, end: Floats | None = None) -> Problem:
    """The race of what a graph offers; the problem starts at chained odometry."""
    starts: dict[str, Callable[[], Floats]] = {
        name: partial(_x0, graph, problem.poses, name) for name in contenders(graph)
    }
    starts["odometry"], late = lambda: np.asarray(problem.x0), {}
    if not graph.guess and np.isfinite(graph.position).all():
        late["file"] = lambda _: (_x0(graph, problem.poses, "file"), 0)
    if problem.poses:
        if len(graph.ranges):
            late["eased"] = partial(eased, start=np.asarray(problem.x0))
        late["incremental"] = lambda _: incremental_start(graph, problem)
    return race(problem, starts, late, draws, end)


def started(problem: Problem, end: Floats | None = None) -> Problem:
    """A problem of poses without an x0 from where what it measures leads lowest, and one with an x0 from there if that
    is lower than the `end` (n, ambient) of its x0; any other as it is.

    >>> from coopoc.optimize import pose
    >>> problem = Problem(("here", "there"), dimension=2, poses=(0, 1)).add("pose", "here", pose([1.0, 2.0]), std=0.1)
    >>> started(problem.add("relative_pose", ("here", "there"), pose([3.0, 0.0]), std=0.1)).x0[1, :2]
    array([4., 2.])
    """
    if not problem.poses or (problem.x0 is not None and end is None):
        return problem
    with np.errstate(all="ignore"):  # the status of what is beyond all numbers is that of the answer
        graph = graph_of(problem)
        at = problem.starting_at(directed(problem, crossed(problem, _x0(graph, problem.poses, "odometry"))))
        return _raced(graph, at, True, end)


def _counted(notes: Sequence[str]) -> list[str]:
    """Notes "place: what" with one for all places of which the same is said.

    >>> _counted(["line 1: was repaired", "line 2: was repaired"])
    ['2 times, first in line 1: was repaired']
    """
    alike = defaultdict[str, list[str]](list)
    for note in notes:
        alike[note.rpartition(": ")[2]].append(note)
    return [f"{len(each)} times, first in {each[0]}" if len(each) > 1 else each[0] for each in alike.values()]


def _x0(graph: Graph, poses: tuple[int, ...], name: str) -> Floats:
    """(n, ambient) of a start that needs no search."""
    x0 = STARTS[name](graph)
    return x0 if poses else x0[:, : graph.dimension]


def loop_closures(problem: Problem) -> list[tuple[int, list[int]]]:
    """Candidates for `solve_gnc`, (factor, rows): relative poses but those from one pose of a robot to its next.

    Args:
        problem: of a graph; names are a robot's, with a number behind it that grows with time.

    >>> from coopoc.optimize import pose
    >>> problem = Problem(("A10", "A9", "A11"), x0=pose(np.zeros((3, 2))), dimension=2, poses=(0, 1, 2), fixed=(0,))
    >>> pairs = [("A9", "A10"), ("A10", "A11"), ("A11", "A9")]
    >>> loop_closures(problem.add("relative_pose", pairs, pose(np.zeros((3, 2))), std=[0.1, 0.1, 0.1]))
    [(0, [2])]
    """
    instance("problem", problem, Problem)
    after, last = np.full(len(problem.names), -1), dict[str, int]()
    named = {node: re.split(r"(\d*)$", problem.names[node], maxsplit=1)[:2] for node in problem.poses}
    for node, (robot, _) in sorted(named.items(), key=lambda each: int(each[1][1] or 0)):
        if robot in last:
            after[last[robot]] = node
        last[robot] = node
    closures = []
    for k, factor in enumerate(problem.factors):
        if factor.kind.startswith("relative_pose"):
            i, j = factor.nodes.T
            rows = np.flatnonzero((after[i] != j) & (after[j] != i)).tolist()
            closures += [(k, rows)] if rows else []
    return closures


def _factors(graph: Graph, objective: Objective) -> tuple[Factor, ...]:
    d, factors = graph.dimension, []
    for name, kind in MEASUREMENT_KINDS.items():
        edges = getattr(graph, name)
        if not len(edges):
            continue
        turns = kind in ("relative_pose", "pose")
        z = Space(d, has_rotation=True).join(edges.position, edges.rotation) if turns else edges.position
        if objective == "geodesic":
            _check_noise(graph, edges.nodes, np.linalg.eigvalsh(edges.covariance)[:, 0])
            factors.append(Factor(kind, edges.nodes, z, cov=edges.covariance))
            continue
        variance = [position_variance(edges, d)]
        if turns:
            kind = f"{kind}_chordal"
            variance.append(rotation_variance(edges, d))
        _check_noise(graph, edges.nodes, np.min(variance, axis=0))
        std = np.sqrt(variance).repeat([d, d * d][: len(variance)], axis=0).T
        factors.append(Factor(kind, edges.nodes, z, std=std, twice=turns and d == 2))
    _check_noise(graph, graph.ranges.nodes, graph.ranges.variance)
    ranges, sigma = graph.ranges, np.sqrt(graph.ranges.variance)[:, None]
    apart = ranges.distance > 0
    if apart.any():
        factors.append(Factor("range", ranges.nodes[apart], ranges.distance[apart, None], std=sigma[apart]))
    if not apart.all():  # (|v| - 0)^2 = |v|^2, which has a derivative at v = 0, too
        zero = np.zeros((int((~apart).sum()), d))
        factors.append(Factor("displacement", ranges.nodes[~apart], zero, std=sigma[~apart] + zero))
    return tuple(factors)


def _check_noise(graph: Graph, nodes: Ints, variance: Floats) -> None:
    """InputError unless the least variance (M,) of each measurement is positive."""
    for k in np.flatnonzero(~(variance > 0))[:1]:
        whose = f"of {' and '.join(graph.names[i] for i in nodes[k])}: least variance {variance[k]:.3g}"
        hint = "Give every component a variance, or remove the measurement."
        raise InputError("covariance", whose, "must be positive", hint)


def _fixed(graph: Graph) -> Ints:
    """The fixed vertices, and the first pose of each part of the graph that has neither those nor priors."""
    edges = (graph.relative_pose, graph.relative_point, graph.ranges)
    part = parts(len(graph.names), *(each.nodes for each in edges))
    held = np.concatenate([graph.fixed, graph.pose_prior.nodes[:, 0], graph.point_prior.nodes[:, 0]])
    loose = np.flatnonzero(graph.is_pose & ~np.isin(part, part[held]))
    return np.sort(np.concatenate([graph.fixed, loose[np.unique(part[loose], return_index=True)[1]]]))
