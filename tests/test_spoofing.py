"""Spoofed neighbours: the attack itself, the window estimate that sees through it, and the example."""

from __future__ import annotations

import importlib.util
import itertools
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from coopoc import V2X, CooperativeMAP, Fleet, InputError, Sensors, observe, rt_le
from coopoc.optimize import Problem, Solution, solve, solve_gnc
from coopoc.world.recording import Recording
from coopoc.world.spoofing import Spoofing, spoofed

S2 = Sensors.paper_scenario2()


@pytest.fixture(scope="module")
def lied_to(crossing: Fleet) -> Recording:
    """Neighbours that come and go, two thirds of them spoofed, some messages lost."""
    seen = observe(crossing.between(0, 14), S2, V2X(max_neighbours=4, radius=40), runs=3, observers=[0, 3])
    return spoofed(seen, 0.6, honest=[0, 3])


def test_an_attack_moves_the_fixes_of_some_by_a_constant(crossing: Fleet) -> None:
    clean = observe(crossing, S2, V2X(max_neighbours=4), runs=40)
    few, many = (spoofed(clean, share, seed=2, honest=["c0"]) for share in (0.2, 0.5))
    offset = few.gnss - clean.gnss
    assert np.ptp(offset, axis=1).max() < 1e-9
    moved, more = (np.abs(r.gnss - clean.gnss).max(axis=(1, 3)) > 1e-9 for r in (few, many))
    assert not moved[:, 0].any()
    assert (more >= moved).all()
    assert offset[:, 0][moved] == pytest.approx((many.gnss - clean.gnss)[:, 0][moved], abs=1e-9)
    size = np.abs(offset[:, 0][moved])
    assert size.min() > 5.0 - 1e-9
    assert size.max() < 40.0 + 1e-9
    assert abs((offset[:, 0][moved] > 0).mean() - 0.5) < 3 * 0.5 / np.sqrt(size.size)
    assert abs(moved[:, 1:].mean() - 0.2) < 3 * np.sqrt(0.2 * 0.8 / moved[:, 1:].size)
    assert abs(more[:, 1:].mean() - 0.5) < 3 * np.sqrt(0.5 * 0.5 / more[:, 1:].size)
    prefix = spoofed(observe(crossing, S2, V2X(max_neighbours=4), runs=3), 0.2, seed=2, honest=["c0"])
    assert np.array_equal(prefix.gnss, few.gnss[:3])
    for name in ("velocity", "relative", "arrival", "links"):
        assert getattr(few, name) is getattr(clean, name)
    assert "20 %" in few.notes[-1]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"attack": 1.2}, "share"),
        ({"attack": 0.1, "seed": -1}, "seed"),
        ({"attack": 0.1, "honest": ["missing"]}, "egos"),
        ({"attack": 0.1, "told": 1}, "told"),
    ],
)
def test_an_attack_says_what_is_wrong(lied_to: Recording, options: dict, field: str) -> None:
    with pytest.raises(InputError, match=field):
        spoofed(lied_to, **options)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"offset": (9.0, 5.0)}, "offset"),
        ({"offset": 3.0}, "offset"),
        ({"start": -1.0}, "start"),
        ({"collude": 1}, "c"),
    ],
)
def test_an_attack_is_described_in_full(options: dict, field: str) -> None:
    with pytest.raises(InputError, match=field):
        Spoofing(0.2, **options)


def test_an_attack_begins_creeps_and_colludes(crossing: Fleet) -> None:
    clean = observe(crossing, S2, V2X(max_neighbours=4), runs=40)
    full, late, slow, alike = (
        spoofed(clean, Spoofing(0.4, **options), seed=2, honest=[0]).gnss - clean.gnss
        for options in ({}, {"start": 1.0}, {"start": 1.0, "ramp": 2.0}, {"collude": True})
    )
    for step, t in enumerate(crossing.t - crossing.t[0]):
        assert late[:, step] == pytest.approx(full[:, step] * (t > 0.99), abs=1e-9)
        assert slow[:, step] == pytest.approx(full[:, step] * min(max(t - 1.0, 0.0) / 2.0, 1.0), abs=1e-9)
    wrong = np.abs(alike[:, 0]).max(axis=-1) > 1e-9
    assert np.array_equal(wrong, np.abs(full[:, 0]).max(axis=-1) > 1e-9)
    for one, offsets in zip(wrong, alike[:, 0], strict=True):
        assert np.abs(offsets[one] - offsets[one][:1]).max(initial=0.0) < 1e-9


def test_an_estimator_that_is_told_of_an_attack_lacks_the_false_fixes(crossing: Fleet) -> None:
    clean = observe(crossing, S2, V2X(max_neighbours=4), runs=3)
    false = spoofed(clean, Spoofing(0.4, start=1.0), seed=2, honest=[0])
    told = spoofed(clean, Spoofing(0.4, start=1.0), seed=2, honest=[0], told=True)
    assert np.array_equal(told.gnss, np.where(false.gnss == clean.gnss, clean.gnss, np.nan), equal_nan=True)
    assert told.notes[-1].endswith("removed")


def by_name(recording: Recording, step: int, ego: int, length: int, run: int) -> tuple[Solution, np.ndarray]:
    """The graduation of Problem.from_window whose groups are the names of its points, and where the ego is."""
    problem = Problem.from_window(recording, step, ego, length, run)
    rows = [k for k in range(len(problem.names)) if k not in problem.separator]
    alone = solve_gnc(problem, [(0, rows)], groups=[problem.names[k].split("@")[0] for k in rows])
    return alone, alone.x[alone.shown]


def test_the_robust_track_is_the_windows_own_graduation(lied_to: Recording) -> None:
    """Against Problem.from_window, whose groups are the names of its points; and gtsam's rounds give the same track."""
    track = CooperativeMAP(window=4, robust="truncated")(lied_to, [0, 3])
    for ego, run, step in itertools.product((0, 3), range(2), (2, 13)):
        alone, at = by_name(lied_to, step, ego, min(step + 1, 4), run)
        assert track.x[run, step, track.egos.index(ego)] == pytest.approx(at, abs=2e-4)
        spread = alone.covariance[alone.shown]
        assert track.covariance[run, step, track.egos.index(ego)] == pytest.approx(spread, abs=2e-4)


def test_other_backends_give_the_same_robust_track(lied_to: Recording, crossing: Fleet) -> None:
    short = observe(crossing.between(0, 4), S2, V2X(max_neighbours=4, radius=40))
    nearest = int(short.links.neighbour[0])  # the first link is of vehicle 0
    for attacked in (spoofed(short, 0.6, honest=[0]), spoofed(short, 1.0, honest=sorted(set(range(8)) - {nearest}))):
        ours, theirs = (
            CooperativeMAP(backend=backend, window=3, robust="truncated")(attacked, [0])
            for backend in ("gauss-newton", "gtsam")
        )
        assert theirs.x == pytest.approx(ours.x, abs=5e-5)
        assert theirs.notes == ("gtsam loops over the runs",)


def test_a_vehicle_that_returns_is_the_same_suspect() -> None:
    """Two vehicles are the nearest in turn; one false fix may pass where those of its vehicle together do not."""
    t, weave = 0.1 * np.arange(30), (-1.0) ** np.arange(30)
    position = np.zeros((30, 3, 3))
    position[:, 1, 0], position[:, 2, 1] = 10 + weave, 10 - weave
    fleet = Fleet(("ego", "b", "c"), t, position, np.gradient(position, 0.1, axis=0))
    recording = spoofed(observe(fleet, S2, V2X(max_neighbours=1)), Spoofing(1.0, (5.0, 7.0)), honest=["ego", "b"])
    track = CooperativeMAP(window=6, robust="truncated")(recording, [0])
    apart = 0
    for step in range(5, 30, 4):
        together, at = by_name(recording, step, 0, 6, 0)
        assert track.x[0, step, 0] == pytest.approx(at, abs=2e-4)
        problem = Problem.from_window(recording, step, 0, 6)
        rows = [k for k in range(len(problem.names)) if k not in problem.separator]
        each = solve_gnc(problem, [(0, rows)])
        apart += not np.array_equal(each.extras["weights"], together.extras["weights"])
    assert apart >= 2


def test_each_neighbour_gets_its_own_estimate(crossing: Fleet) -> None:
    """Where the order of the distances changes within the window; Problem.from_window keeps that order."""
    recording = observe(crossing, S2, V2X(max_neighbours=4), observers=[0])
    track, changed = CooperativeMAP(window=4)(recording, [0]), 0
    for step in range(3, 60, 3):
        links = [recording.links.of(0)[recording.links.step[recording.links.of(0)] == t] for t in (step - 3, step)]
        before, now = (recording.links.neighbour[at].tolist() for at in links)
        both = [v for v in before if v in now]
        if both != [v for v in now if v in before]:
            problem = Problem.from_window(recording, step, 0, 4)
            assert track.neighbours[0, links[1]] == pytest.approx(
                solve(problem).x[problem.separator[-1] + 1 :], abs=2e-4
            )
            changed += 1
    assert changed >= 2


def test_spoofed_neighbours_are_unmasked(formation: Fleet) -> None:
    """A rigid ring of ten: the robust estimate stays near the clean one where least squares is metres off."""
    fleet = formation.between(0, 10)
    clean = observe(fleet, S2, V2X.ideal(10), runs=8, observers=[0])
    attacked = spoofed(clean, 0.2, honest=[0])
    plain, robust = CooperativeMAP(window=5), CooperativeMAP(window=5, robust="truncated")
    at_best = rt_le(plain(clean, [0]), fleet).mean()
    assert rt_le(plain(attacked, [0]), fleet).mean() > 3 * at_best
    assert rt_le(robust(attacked, [0]), fleet).mean() < 1.3 * at_best
    assert rt_le(robust(clean, [0]), fleet).mean() < 1.05 * at_best
    trusting = replace(robust, threshold=1 - 1e-12)(clean, [0])
    assert trusting.x == pytest.approx(plain(clean, [0]).x, abs=1e-3)


EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "outlier_attack.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("outlier_attack", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["outlier_attack"] = module
    spec.loader.exec_module(module)
    return module


def test_the_example_prints_its_table(example: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    clean, few = example.main(shares=(0.0, 0.2))
    assert capsys.readouterr().out.count("\n") == 3
    assert few.least_squares > 3 * clean.least_squares
    assert few.robust < 1.3 * clean.least_squares
