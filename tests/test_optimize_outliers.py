"""Wrong loop closures: GNC from the known inliers, against labels, dense algebra and GTSAM's GNC."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import coopoc as co
from coopoc.arrays import Bools, Ints
from coopoc.formats import write_graph
from coopoc.formats.graph import Graph, PoseEdges
from coopoc.optimize import Problem, Status, pose, solve_gnc
from coopoc.optimize.graphs import from_graph, loop_closures
from coopoc.optimize.model.space import exp
from coopoc.optimize.robust.candidates import mark
from coopoc.optimize.robust.loop_closures import predicted

STD = np.array([0.02, 0.02, 0.01])


def drive(seed: int, steps: int = 400, loops: int = 120, wrong: float = 0.4) -> tuple[Graph, Bools]:
    """A robot that walks on a grid of streets and closes loops, a share `wrong` of which is anything; which these
    are."""
    rng = np.random.default_rng(seed)
    turn = np.where(np.arange(steps) % 5 == 4, rng.choice([-1, 0, 1], steps), 0) * np.pi / 2
    heading = np.cumsum(turn)
    position = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    rotation = exp(heading[:, None])
    i, j = np.triu_indices(steps, 11)
    near = rng.permutation(np.flatnonzero(np.linalg.norm(position[i] - position[j], axis=1) < 1.5))[:loops]
    k = np.arange(steps - 1)
    pairs = np.concatenate([np.stack([k, k + 1], axis=1), np.stack([i[near], j[near]], axis=1)])
    bad = np.append(np.zeros(steps - 1, dtype=bool), rng.random(len(near)) < wrong)
    noise = STD * rng.normal(size=(len(pairs), 3))
    gap = position[pairs[:, 1]] - position[pairs[:, 0]]
    moved = np.einsum("mji,mj->mi", rotation[pairs[:, 0]], gap) + noise[:, :2]
    turned = heading[pairs[:, 1]] - heading[pairs[:, 0]] + noise[:, 2]
    moved[bad] += rng.normal(0, 5, (int(bad.sum()), 2))
    turned[bad] = rng.uniform(-np.pi, np.pi, int(bad.sum()))
    edges = PoseEdges(pairs, moved, turned[:, None], np.tile(np.diag(STD**2), (len(pairs), 1, 1)))
    names, poses = tuple(f"A{n}" for n in range(steps)), np.ones(steps, dtype=bool)
    return Graph(2, names, poses, position, heading[:, None], relative_pose=edges), bad


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("wrong", [0.1, 0.4, 0.7])
def test_wrong_loops_are_found_where_odometry_is_known(seed: int, wrong: float) -> None:
    """Oracle: the labels, and the solution of the graph that never had the wrong ones."""
    graph, bad = drive(seed, wrong=wrong)
    problem = from_graph(graph, start="odometry")
    ((factor, rows),) = loop_closures(problem)
    solution = solve_gnc(problem, [(factor, rows)], start="known")
    rejected = solution.extras["weights"] < 0.5
    assert solution.status is Status.SOLVED
    assert not (bad[rows] & ~rejected).any()
    assert (~bad[rows] & rejected).sum() <= 0.05 * len(rows)  # a threshold of 0.99
    edges = graph.relative_pose
    clean = replace(edges, **{f.name: getattr(edges, f.name)[~bad] for f in fields(edges)})
    wanted = co.solve(from_graph(replace(graph, relative_pose=clean)))
    assert np.abs(solution.position - wanted.position).max() < 0.1


def test_predictions_are_those_of_dense_algebra() -> None:
    """Oracle: the inverse of J^T J of the known inliers by NumPy."""
    problem = from_graph(drive(5, steps=150, loops=20)[0], start="odometry")
    (candidate,) = loop_closures(problem)
    marked = mark(problem, [candidate])
    x = np.asarray(problem.x0)
    distance, spread = predicted(problem, marked, np.zeros(len(candidate[1])), x)
    linear = problem.linearise(x[None])
    whole = problem.jacobian(linear).toarray()
    size = problem.factors[0].size
    rows: Ints = (size * np.array(candidate[1])[:, None] + np.arange(size)).ravel()
    known = np.delete(whole, rows, axis=0)
    moving = np.flatnonzero(np.abs(whole).sum(axis=0))
    P = np.linalg.inv((known.T @ known)[np.ix_(moving, moving)])
    for k, row in enumerate(candidate[1]):
        J = whole[size * row : size * row + size][:, moving]
        S, r = J @ P @ J.T + np.eye(size), linear.residual[0][0, row]
        assert distance[k] == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)
        assert spread[k] == pytest.approx(np.log(np.linalg.det(S)), rel=1e-6)


def test_known_inliers_that_do_not_hold_a_body_in_itself_are_refused() -> None:
    problem = Problem(("A0", "A1", "L0"), x0=pose(np.zeros((3, 2))), dimension=2, poses=(0, 1), fixed=(0,))
    problem = problem.add("relative_position", ("A1", "L0"), [1.0, 0.0], std=0.1)
    problem = problem.add("range", ("A0", "A1"), 1.0, std=0.1)
    problem = problem.add("relative_pose", ("A0", "A1"), pose([1.0, 0.0]), std=STD)
    with pytest.raises(co.InputError, match=r"candidates.*known inliers that hold all nodes.*all"):
        solve_gnc(problem.replace_unchecked(x0=pose(np.array([[0.0, 0], [1, 0], [2, 0]]))), [2], start="known")


def test_points_join_as_poses_do() -> None:
    """Closed form: of two fixes beside a known one the near one fits, and the mean of both is the answer."""
    problem = Problem(("a",)).add("position", "a", [0, 0, 0], std=1.0)
    problem = problem.add("position", ["a", "a"], [[1.0, 0, 0], [50, 0, 0]], std=1.0)
    solution = solve_gnc(problem, [1], start="known")
    np.testing.assert_allclose(solution.x[0], [0.5, 0, 0], atol=1e-9)
    assert solution.extras["weights"].tolist() == [1.0, 0.0]


def test_the_command_names_what_it_rejects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from coopoc.optimize.commands import solve_file

    graph, bad = drive(1)
    write_graph(graph, tmp_path / "drive.g2o")
    assert solve_file(tmp_path / "drive.g2o", outliers=True) == 0
    found = json.loads(capsys.readouterr().out)["rejected"]
    wanted = {tuple(graph.names[i] for i in pair) for pair in graph.relative_pose.nodes[bad].tolist()}
    assert wanted <= {tuple(pair) for pair in found}
    chain, _ = drive(1, loops=0)
    write_graph(chain, tmp_path / "chain.g2o")
    with pytest.raises(co.InputError, match="outliers"):
        solve_file(tmp_path / "chain.g2o", outliers=True)


@pytest.mark.parametrize("shape", ["sphere", "torus"])
@pytest.mark.parametrize("seed", [1, 3])
def test_wrong_loops_of_a_drive_in_space_are_found(shape: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the labels, and the solution of the graph that never had the wrong ones."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    from unseen_graphs import joined, surface

    drive_, loops = surface(seed, 15, 30, shape)
    edges = drive_.relative(loops, 0.1, 0.02, wrong=0.2)
    gap = drive_.position[loops[:, 1]] - drive_.position[loops[:, 0]]
    error = np.einsum("mji,mj->mi", drive_.rotation[loops[:, 0]], gap) - edges.position
    bad = np.linalg.norm(error, axis=1) > 1.0  # ten standard deviations
    odometry = drive_.relative(drive_.chain(), 0.1, 0.02)
    solution = solve_gnc(
        problem := from_graph(drive_.graph(relative_pose=joined(odometry, edges)), start="odometry"),
        loop_closures(problem),
        start="known",
    )
    rejected = solution.extras["weights"] < 0.5
    assert solution.status is Status.SOLVED
    assert not (bad & ~rejected).any()
    assert (~bad & rejected).sum() <= 0.02 * len(loops)
    kept = replace(edges, **{f.name: getattr(edges, f.name)[~bad] for f in fields(edges)})
    clean = co.solve(from_graph(drive_.graph(relative_pose=joined(odometry, kept))))
    assert np.abs(solution.position - clean.position).max() < 0.3
