"""Levenberg-Marquardt: its damping, laws that its steps obey, and the bar of a solve that lasts."""

import numpy as np
import pytest
from numpy import array
from numpy.linalg import norm

import coopoc as co
from coopoc import workers
from coopoc.optimize import Problem, solve
from coopoc.optimize.descent import levenberg_marquardt
from coopoc.optimize.model.problem import Search


def test_damping_grows_until_a_step_helps_however_much_that_takes():
    """A range that is too short, seen nearly along the height that is known: J^T J has a 4,000th of the curvature
    across it, so that no step helps below that damping. Closed form: straight above, and the range's share of the
    height is its information's."""
    z = array([9.0, 9.5])
    problem = Problem([*"av"], dimension=2, x0=[[0, 0], [0.05, 10]], fixed=(0,))
    problem = problem.add("position", "v", [0.0, 10.0], std=[1e3, 1e-3])
    found = [solve(problem.add("range", ("a", "v"), length, std=1.0)).x[1] for length in z]
    assert array(found) == pytest.approx(np.c_[0 * z, (1e6 * 10.0 + z) / (1e6 + 1.0)], abs=1e-6)


def test_what_hangs_on_a_weak_and_far_anchor_is_solved_to_rounding():
    """Closed form: exact differences; FAILED before, 3 km off."""
    truth = 1e7 + np.arange(60.0).reshape(20, 3) % 7
    problem = Problem(range(20)).add("position", 0, truth[0], std=1e4)
    std = np.where(np.arange(19) % 2, 0.1, 1e-3)[:, None] * np.ones(3)
    problem = problem.add("displacement", np.c_[:19, 1:20], np.diff(truth, axis=0), std=std)
    assert abs(solve(problem).x - truth).max() < 1e-6


def test_a_slope_that_bends_away_is_followed():
    """From the far side of a ring, where J^T J is a thousand times the curvature, which is negative: FAILED before."""
    problem = Problem([*"ar"], dimension=2, x0=[[0, 0], [10, 0.1]], fixed=(0,)).add("range", (0, 1), 10.0, std=0.1)
    assert solve(problem.add("position", "r", [-0.01, 0.0], std=1.0)).x[1] == pytest.approx(
        [-1000.01 / 101, 0.0], abs=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_unit_of_the_noise_changes_no_step(seed):
    """A law of damped least squares: all standard deviations times c divide every cost by c^2, and nothing else. One
    step less is taken where it promises 1e-9 standard deviations."""
    rng, names = np.random.default_rng(seed), list("abcde")
    pairs = [(i, j) for i in range(5) for j in range(i)]
    truth, start = rng.normal(0, 10, (2, 5, 3))
    distance = norm([truth[i] - truth[j] for i, j in pairs], axis=1) + rng.normal(0, 0.5, (3, 10))

    def solved(unit):
        problem = Problem(names, x0=start, search=Search(x0=start)).add("position", names, truth, std=2.0 * unit)
        ends = [(names[i], names[j]) for i, j in pairs]
        found = [solve(problem.add("range", ends, measured, std=0.1 * unit)) for measured in distance]
        return [one.iterations for one in found], [one.cost * unit**2 for one in found]

    steps, cost = solved(1.0)
    assert min(steps) > 8  # far from the minimum, so that the damping matters
    for unit in (1e-4, 1e4):
        again, same = solved(unit)
        assert all(new in (old, old - 1) for new, old in zip(again, steps, strict=True))
        assert same == pytest.approx(cost, rel=1e-9)


def ranged():
    x0 = array([[0.0, 0], [9, 0], [0, 9], [5, 5]])
    problem = Problem([*"abcx"], x0=x0, dimension=2).add("position", list("abc"), x0[:3], 1e-3)
    return problem.add("range", [("x", name) for name in "abc"], norm(x0[:3] - [3.0, 4.0], axis=1), 0.1)


@pytest.mark.parametrize("backend", ["gauss-newton", "osqp"])
def test_a_bar_shows_steps_and_cost(backend, monkeypatch, capsys):
    solve(ranged(), backend)  # the first call on a machine compiles
    capsys.readouterr()
    quick = solve(ranged(), backend)
    assert "solve" not in capsys.readouterr().err
    monkeypatch.setattr(levenberg_marquardt, "DELAY", -1.0)
    monkeypatch.setattr(workers, "LINE_SECONDS", 0.0)  # no terminal: a line at every step
    shown = solve(ranged(), backend)
    assert "cost" in capsys.readouterr().err
    assert np.array_equal(shown.position, quick.position)


def test_a_drive_that_turns_as_a_whole_needs_few_steps():
    """Straight lines move its far end off the circle; the next step corrects that, and both keep what was promised."""
    n, turn = 400, array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    x0 = co.pose(np.outer(np.arange(n), [1.0, 0.0]) @ turn, np.full(n, 0.5))
    drive = Problem(range(n), dimension=2, poses=range(n), x0=x0).add("pose", 0, co.pose([0, 0], 0.0), std=0.01)
    moved = np.tile(co.pose([1.0, 0.0], 0.0), (n - 1, 1))
    found = solve(drive.add("relative_pose", [(k, k + 1) for k in range(n - 1)], moved, std=[0.02, 0.02, 0.01]))
    assert found.cost < 1e-9
    assert found.iterations <= 5
