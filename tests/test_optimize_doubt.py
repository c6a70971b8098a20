"""Where an answer may be wrong the solution has a note: its cost, what a loss rejects, its start, its solver."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from numpy import inf
from numpy.linalg import eigh, inv, norm
from random_graphs import PAIR, random_drive, torn
from scipy.stats import chi2

import coopoc as co
from coopoc.cli import main
from coopoc.formats import load_graph
from coopoc.optimize import Loss, Problem, Status, solve
from coopoc.optimize.assess.assess import TAIL
from coopoc.optimize.graph_problems import from_graph
from coopoc.optimize.model.problem import Search


def ranged(seed):
    """Eight points in space from random starts: three have a fix, and all ranges between them are measured."""
    rng, pairs = np.random.default_rng(seed), np.column_stack(np.triu_indices(8, 1))
    truth, x0 = rng.uniform(-20, 20, (2, 8, 3))
    z = norm(np.diff(truth[pairs], axis=1), axis=(1, 2)) + rng.normal(0, 0.1, 28)
    fixes = truth[:3] + rng.normal(0, 0.3, (3, 3))
    alone = Search("random", x0=x0)
    problem = Problem([f"v{k}" for k in range(8)], x0=x0, search=alone).add("position", range(3), fixes, std=0.3)
    return problem.add("range", pairs, z, std=0.1)


def test_a_cost_that_the_noise_does_not_explain_is_noted():
    """Ranges from random starts; SciPy's chi-square is the referee."""
    noted = []
    for seed in range(12):
        found = solve(ranged(seed), throw=False)
        numbers = 3 * 3 + 28 - 24
        assert found.expected == pytest.approx(0.5 * numbers)
        noted.append(chi2.sf(2 * found.cost, numbers) < TAIL)
        assert any("local minimum" in note for note in found.notes) == noted[-1]
        assert ("noise explains" in str(found)) == noted[-1]
        assert f"expected {found.expected:.4g}" in str(found)
    assert 0 < sum(noted) < len(noted)


@pytest.mark.parametrize("noise", [{"std": [inf, inf, 0.1]}, {"sqrt_information": 10 * np.eye(3)[[2, 2, 2]] / 3**0.5}])
def test_what_is_not_measured_is_no_number(noise):
    heights = Problem([*"a"]).add("position", "a", [0, 0, 0], std=[1.0, 1.0, inf])
    heights = heights.add("position", ["a"] * 100, np.zeros((100, 3)), **noise)
    assert solve(heights).expected == pytest.approx(99 / 2)


def test_points_that_a_loss_sets_free_are_told_from_unmeasured_ones():
    with refused(r"a can move|truncated loss rejects 2 of 2.*larger scale"):
        solve(torn(Loss("truncated", 1.0)))


def test_an_indefinite_information_is_repaired_where_asked(tmp_path, capsys):
    vertices = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(3))
    (file := tmp_path / "bad.g2o").write_text(
        f"{vertices}EDGE_SE2 0 1 1 0 0 4 0 0 4 0 9\nEDGE_SE2 1 2 1 0 0 1 2 0 1 0 9\n"
    )
    with refused(r"line 5 = information.*positive definite.*--repair"):
        load_graph(file)
    own, axes = eigh([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 9.0]])
    assert inv(load_graph(file, repair=True).relative_pose.covariance[1]) == pytest.approx(
        axes * np.maximum(own, 0.0) @ axes.T, abs=1e-4
    )
    with pytest.raises(SystemExit):
        main(["solve", str(file), "--repair"])
    out, err = capsys.readouterr()
    assert "line 5: information was not positive definite" in err
    assert json.loads(out)["notes"] != []
    file.write_text(file.read_text().replace("4 0 0 4 0 9", "0 0 0 0 0 0"))
    with refused("leave the measurement out.$"):
        load_graph(file, repair=True)


@pytest.mark.parametrize("seed", [7, 13, 20])
def test_a_race_ends_as_low_as_the_best_of_all_starts(seed):
    """Odometry that turns by 0.6 rad a step: some starts, of 13 and 20 all but the truth, wind cycles up."""
    graph = random_drive(seed, steps=40, loops=4, turn_std=0.6)
    costs = [solve(from_graph(graph, start=start), throw=False).cost for start in ("odometry", "file", "tree")]
    assert max(costs) > 1.01 * min(costs)
    assert solve(from_graph(replace(graph, position=np.full_like(graph.position, np.nan)))).cost <= min(costs) * (
        1 + 1e-9
    )
    truth = solve(from_graph(graph, start="file"))
    assert any("may be the truth" in note for note in truth.notes)


def test_covariances_of_many_nodes_are_computed_where_asked():
    """Also without them a free node is named, and the time that is printed is what was waited."""
    problem = from_graph(random_drive(5, steps=1100, loops=20))
    plain, full = solve(problem), solve(problem, covariance=True)
    assert np.isnan(plain.covariance).all()
    assert "+-" not in str(plain)
    assert np.isfinite(full.covariance).all()
    assert plain.cost == full.cost
    assert plain.seconds >= plain.solve_seconds + plain.check_seconds > plain.solve_seconds
    found = solve(
        replace(problem, names=(*problem.names, "L0"), x0=np.vstack([problem.x0, problem.x0[:1]])), throw=False
    )
    assert (found.status, found.unobservable) == (Status.RANK_DEFICIENT, ("L0",))


def test_anchors_among_poses_and_constraints_without_a_backend():
    with refused(r"anchors.*co.pose\(anchor, 0\)"):
        Problem([*"al"], x0=[[*co.pose([0.0, 0.0])], [3, 4, 0, 0, 0, 0]], dimension=2, poses=[*"a"])
    for kind, nodes, backend in (("displacement", ("a", "b"), "osqp"), ("range", ("a", "b"), "casadi")):
        found = solve(PAIR.constrain(kind, nodes, upper=[7, 9, 9] if kind == "displacement" else 7.0))
        assert (found.backend, found.x[1, 0] - found.x[0, 0]) == (backend, pytest.approx(7.0, abs=1e-6))
        assert f"solved by {backend}: gauss-newton cannot" in found.notes


@pytest.mark.parametrize(("kind", "z"), [("azimuth", 1.0), ("bearing", 1.0), ("displacement", [0.0, 0, 0])])
def test_a_minimum_at_which_an_angle_has_no_derivative_is_named(kind, z):
    """The fixes put the second node on the axis of the angle; two that coincide have a displacement."""
    problem = Problem([*"ab"], poses=(0,)).add("pose", "a", co.pose([0.0, 0, 0], [np.pi / 2, 0, 0]), std=0.1)
    problem = problem.add("position", "b", [0, -3.0 * (kind == "bearing"), 0], std=1.0)
    found = solve(problem.add(kind, (0, 1), z, std=0.1), throw=False)
    assert ("nearly coincide" in str(found.notes)) == (kind != "displacement")
