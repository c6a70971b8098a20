"""Wrong loop closures, and robots that only doubtful measurements join: GNC from the known inliers, against labels and
dense algebra."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from conftest import refused
from graph_files import write_graph

import coopoc as co
from coopoc.arrays import Bools, Floats, Ints
from coopoc.evaluate.metrics import alignment_error
from coopoc.formats.graph import Graph, PointEdges, PoseEdges
from coopoc.formats.values import to_orientation
from coopoc.optimize import Problem, Status, pose, solve_gnc
from coopoc.optimize.graph_problems import from_graph, loop_closures
from coopoc.optimize.model.space import exp
from coopoc.optimize.robust.candidates import mark
from coopoc.optimize.robust.loop_closures import predicted
from coopoc.optimize.solver_commands import solve_file

STD = np.array([0.02, 0.02, 0.01])


def drive(seed: int, steps: int = 400, loops: int = 120, wrong: float = 0.4) -> tuple[Graph, Bools]:
    """A robot that walks on a grid of streets and closes loops, a share `wrong` of which is anything; which these
    are."""
    rng = np.random.default_rng(seed)
    turn = np.where(np.arange(steps) % 5 == 4, rng.choice([-1, 0, 1], steps), 0) * np.pi / 2
    heading = np.cumsum(turn)
    position = np.cumsum(np.c_[np.cos(heading), np.sin(heading)], axis=0)
    rotation = exp(heading[:, None])
    i, j = np.triu_indices(steps, 11)
    near = rng.permutation(np.flatnonzero(np.linalg.norm(position[i] - position[j], axis=1) < 1.5))[:loops]
    k = np.arange(steps - 1)
    pairs = np.concatenate([np.c_[k, k + 1], np.c_[i[near], j[near]]])
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


def from_known(graph: Graph) -> tuple[co.Solution, Ints, Bools]:
    """The answer of GNC that begins with odometry, its candidates, and which of them it rejects."""
    problem = from_graph(graph, start="odometry")
    ((factor, rows),) = loop_closures(problem)
    solution = solve_gnc(problem, [(factor, rows)])
    rejected = solution.extras["weights"] < 0.5
    return solution, np.asarray(rows), rejected


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("wrong", [0.1, 0.4, 0.7])
def test_wrong_loops_are_found_where_odometry_is_known(seed, wrong):
    """Oracle: the labels, and the solution of the graph that never had the wrong ones."""
    graph, bad = drive(seed, wrong=wrong)
    solution, rows, rejected = from_known(graph)
    assert solution.status is Status.SOLVED
    assert not (bad[rows] & ~rejected).any()
    assert (~bad[rows] & rejected).sum() <= 0.05 * len(rows)  # a threshold of 0.99
    edges = graph.relative_pose
    clean = replace(edges, **{f.name: getattr(edges, f.name)[~bad] for f in fields(edges)})
    wanted = co.solve(from_graph(replace(graph, relative_pose=clean)))
    assert np.abs(solution.position - wanted.position).max() < 0.1


def test_predictions_are_those_of_dense_algebra():
    """Oracle: the inverse of J^T J of the known inliers by NumPy."""
    problem = replace(from_graph(drive(1, steps=150, loops=20)[0], start="odometry"), fixed=(75,))
    (candidate,) = loop_closures(problem)
    x = np.asarray(problem.x0)
    distance, spread = predicted(mark(problem, [candidate]), np.zeros(len(candidate[1])), x)
    linear = problem.linearise(x)
    whole = problem.jacobian(linear).toarray()
    size = problem.factors[0].size
    rows: Ints = (size * np.array(candidate[1])[:, None] + np.arange(size)).ravel()
    known = np.delete(whole, rows, axis=0)
    moving = np.flatnonzero(np.abs(whole).sum(axis=0))
    P = np.linalg.inv((known.T @ known)[np.ix_(moving, moving)])
    for k, row in enumerate(candidate[1]):
        J = whole[size * row : size * row + size][:, moving]
        S, r = J @ P @ J.T + np.eye(size), linear.residual[0][row]
        assert distance[k] == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)
        assert spread[k] == pytest.approx(np.log(np.linalg.det(S)), rel=1e-6)


def test_known_inliers_that_do_not_hold_a_body_in_itself_are_refused():
    problem = Problem(("A0", "A1", "L0"), x0=pose(np.zeros((3, 2))), dimension=2, poses=(0, 1), fixed=(0,))
    problem = problem.add("relative_position", ("A1", "L0"), [1.0, 0.0], std=0.1)
    problem = problem.add("range", ("A0", "A1"), 1.0, std=0.1)
    problem = problem.add("relative_pose", ("A0", "A1"), pose([1.0, 0.0]), std=STD)
    with refused(r"candidates.*known inliers that hold all nodes.*any"):
        solve_gnc(problem.replace_unchecked(x0=pose(np.array([[0.0, 0], [1, 0], [2, 0]]))), [2], start="known")


def test_points_join_as_poses_do():
    """Closed form: of two fixes beside a known one the near one fits, and the mean of both is the answer."""
    problem = Problem(("a",)).add("position", "a", [0, 0, 0], std=1.0)
    problem = problem.add("position", ["a", "a"], [[1.0, 0, 0], [50, 0, 0]], std=1.0)
    solution = solve_gnc(problem, [1], start="known")
    np.testing.assert_allclose(solution.x[0], [0.5, 0, 0], atol=1e-9)
    assert solution.extras["weights"].tolist() == [1.0, 0.0]


def test_the_command_names_what_it_rejects(tmp_path, capsys):

    graph, bad = drive(1)
    write_graph(graph, tmp_path / "drive.g2o")
    assert solve_file(tmp_path / "drive.g2o", outliers=True) == 0
    found = json.loads(capsys.readouterr().out)["rejected"]
    wanted = {tuple(graph.names[i] for i in pair) for pair in graph.relative_pose.nodes[bad].tolist()}
    assert wanted <= {tuple(pair) for pair in found}
    chain, _ = drive(1, loops=0)
    write_graph(chain, tmp_path / "chain.g2o")
    with refused("outliers"):
        solve_file(tmp_path / "chain.g2o", outliers=True)


STEPS, REACH = 120, 12.0
ODOMETRY, LOOPS = (0.05, 0.02), (0.1, 0.03)
"""Standard deviations, m and rad."""


class Fleet:
    """Robots that each drive about the same square, in space up and down as well, and what they measure.

    Args:
        seed: of all that is random.
        d: 2 or 3.
        robots: how many.
    """

    def __init__(self, seed: int, d: int, robots: int) -> None:
        self.rng, self.d, self.robots = np.random.default_rng(seed), d, robots
        self.position, self.rotation = np.zeros((0, d)), np.zeros((0, d, d))
        for _ in range(robots):
            at, course = self.rng.uniform(-8, 8, d), self.rng.uniform(-np.pi, np.pi)
            for step in range(STEPS):
                course += 0.1 * self.rng.normal() + 0.3 * np.sin(np.arctan2(-at[1], -at[0]) - course)
                tilt = np.array([0.05 * self.rng.normal(), 0.1 * np.sin(0.1 * step), 0.0])
                turn = exp(np.array([course])) if d == 2 else exp(np.array([0, 0, course])) @ exp(tilt)
                self.position = np.concatenate([self.position, at[None]])
                self.rotation = np.concatenate([self.rotation, turn[None]])
                at = at + turn[:, 0]
        k = np.arange(robots * STEPS - 1)
        k = k[(k + 1) % STEPS > 0]
        self.chain = np.c_[k, k + 1]

    def between(self, count: int) -> Ints:
        """(count, 2) poses of two robots within reach of each other."""
        i, j = np.triu_indices(len(self.position), STEPS // 2)
        near = np.linalg.norm(self.position[i] - self.position[j], axis=1) < REACH
        rows = self.rng.permutation(np.flatnonzero(near & (i // STEPS != j // STEPS)))[:count]
        return np.c_[i[rows], j[rows]]

    def relative(self, pairs: Ints, std: tuple[float, float], bad: Bools) -> PoseEdges:
        """Relative poses with noise; those that are bad are anything."""
        d, turns = self.d, 1 if self.d == 2 else 3
        noise = exp(std[1] * self.rng.normal(size=(len(pairs), turns)))
        turned = np.swapaxes(self.rotation[pairs[:, 0]], 1, 2) @ self.rotation[pairs[:, 1]] @ noise
        turned[bad] = exp(self.rng.uniform(-np.pi, np.pi, (int(bad.sum()), turns)))
        moved = self.seen(pairs, std[0])
        moved[bad] += self.rng.choice([-1, 1], (int(bad.sum()), d)) * self.rng.uniform(2, 15, (int(bad.sum()), d))
        cov = np.diag(np.r_[np.full(d, std[0] ** 2), np.full(turns, std[1] ** 2)])
        return PoseEdges(pairs, moved, to_orientation(turned), np.tile(cov, (len(pairs), 1, 1)))

    def seen(self, pairs: Ints, std: float) -> Floats:
        """(M, d) the second of each pair in the frame of the first."""
        gap = self.position[pairs[:, 1]] - self.position[pairs[:, 0]]
        found = np.einsum("mji,mj->mi", self.rotation[pairs[:, 0]], gap)
        return np.asarray(found + std * self.rng.normal(size=gap.shape))

    def graph(self, loops: PoseEdges, points: PointEdges | None = None) -> Graph:
        """Odometry and loops; nothing says where any robot begins."""
        odometry = self.relative(self.chain, ODOMETRY, np.zeros(len(self.chain), dtype=bool))
        names = ("nodes", "position", "orientation", "covariance")
        edges = PoseEdges(*(np.concatenate([getattr(part, name) for part in (odometry, loops)]) for name in names))
        poses = self.robots * STEPS
        every = [f"{'ABCDE'[k // STEPS]}{k % STEPS}" for k in range(poses)]
        every += [f"L{k}" for k in range(len(self.position) - poses)]
        nowhere = np.full((len(every), self.d), np.nan)
        orientation = to_orientation(np.tile(np.eye(self.d), (len(every), 1, 1)))
        more = {} if points is None else {"relative_point": points}
        return Graph(
            self.d,
            tuple(every),
            np.arange(len(every)) < poses,
            nowhere,
            orientation,
            relative_pose=edges,
            **more,
        )


def judged(fleet: Fleet, graph: Graph, bad: Bools) -> tuple[int, int, float, float, co.Solution]:
    """Wrong ones kept, right ones lost, the error of the answer and of that of the right ones alone, m."""
    solution, _, rejected = from_known(graph)
    count = len(fleet.chain)
    kept, edges = np.concatenate([np.arange(count), count + np.flatnonzero(~bad)]), graph.relative_pose
    right = replace(edges, **{field.name: getattr(edges, field.name)[kept] for field in fields(edges)})
    clean = co.solve(from_graph(replace(graph, relative_pose=right), start="tree"))
    errors = [alignment_error(x[: len(fleet.position)], fleet.position) for x in (solution.position, clean.position)]
    return int((bad & ~rejected).sum()), int((~bad & rejected).sum()), *errors, solution  # type: ignore[return-value]


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("wrong", [0.1, 0.3, 0.6])
@pytest.mark.parametrize(("d", "robots"), [(2, 5), (3, 3)])
def test_robots_are_joined_by_what_agrees(seed, wrong, d, robots):
    """Oracle: the labels, the truth, and the solution of the graph that never had the wrong ones."""
    fleet = Fleet(seed, d, robots)
    pairs = fleet.between(120)
    bad = fleet.rng.random(len(pairs)) < wrong
    kept, lost, error, clean, solution = judged(fleet, fleet.graph(fleet.relative(pairs, LOOPS, bad)), bad)
    assert solution.status is Status.SOLVED
    assert kept == 0
    assert lost <= 0.05 * len(pairs)
    assert error <= 1.1 * clean + 0.05
    assert len(solution.extras["joined"]) == robots - 1
    assert all(joint["agree"] > joint["rival"] for joint in solution.extras["joined"])


def test_wrong_loops_that_agree_with_each_other_are_reported():
    """Of two robots' 40 loops 12 place the second 5 m to the side: 28 are kept, and the answer names the 12; of two
    groups of 20 neither is taken."""
    fleet = Fleet(5, 2, 2)
    pairs = fleet.between(40)
    nothing = np.zeros(len(pairs), dtype=bool)
    loops = fleet.relative(pairs, LOOPS, nothing)
    own = pairs[:, 0]

    def turned(count: int) -> Graph:
        """The first `count` loops as if the second robot were 5 m further along x and turned by 1 rad."""
        moved, rotation = np.array(loops.position), np.array(loops.rotation)
        swing = exp(np.array([1.0]))
        for k in range(count):
            at = fleet.rotation[own[k]] @ moved[k] + fleet.position[own[k]]
            at = swing @ at + [5.0, 0.0]
            moved[k] = fleet.rotation[own[k]].T @ (at - fleet.position[own[k]])
            rotation[k] = fleet.rotation[own[k]].T @ swing @ fleet.rotation[own[k]] @ rotation[k]
        return fleet.graph(replace(loops, position=moved, orientation=to_orientation(rotation)))

    bad = np.arange(40) < 12
    kept, lost, _, _, solution = judged(fleet, turned(12), bad)
    assert (kept, lost) == (0, 0)
    (joint,) = solution.extras["joined"]
    assert (joint["body"], joint["to"], joint["candidates"]) == ("B0", "world", 40)
    assert 26 <= joint["agree"] <= 28
    assert 10 <= joint["rival"] <= 12
    problem = from_graph(turned(20), start="odometry")
    with refused(r"40 between B0 and world \d\d agree, \d\d otherwise"):
        solve_gnc(problem, loop_closures(problem), start="known")


def test_one_measurement_decides_nothing():
    problem = Problem(("A0", "B0"), x0=pose(np.zeros((2, 2))), dimension=2, poses=(0, 1), fixed=(0,))
    problem = problem.add("relative_pose", ("A0", "B0"), pose([1.0, 0.0]), std=[0.1, 0.1, 0.1])
    with refused(r"of 1 between B0 and world 1 agree"):
        solve_gnc(problem, [0], start="known")
    with refused(r"between B0 and world"):
        solve_gnc(problem.add("bearing", ("A0", "B0"), 0.1, std=0.1), [0, 1], start="known")
