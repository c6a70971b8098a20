"""Spoofed neighbours: the attack itself, the window estimate that sees through it, and the example."""

import numpy as np
import outlier_attack
import pytest
from conftest import refused

import coopoc as co
from coopoc import V2X, Sensors, observe
from coopoc.world.spoofing import Spoofing, spoofed

S2 = Sensors.paper_scenario2()


@pytest.fixture(scope="module")
def lied_to(crossing):
    """Neighbours that come and go, two thirds of them spoofed, some messages lost."""
    seen = observe(crossing.between(0, 14), S2, V2X(max_neighbours=4, radius=40), runs=3, observers=[0, 3])
    return spoofed(seen, 0.6, honest=[0, 3])


@pytest.fixture(scope="module")
def clean(crossing):
    return observe(crossing, S2, V2X(max_neighbours=4), runs=40)


def test_an_attack_moves_the_fixes_of_some_by_a_constant(crossing, clean):
    few, many = (spoofed(clean, share, seed=2, honest=["c0"]) for share in (0.2, 0.5))
    offset = few.gnss - clean.gnss
    assert np.ptp(offset, axis=1).max() < 1e-9
    moved, more = (abs(r.gnss - clean.gnss).max(axis=(1, 3)) > 1e-9 for r in (few, many))
    assert not moved[:, 0].any()
    assert (more >= moved).all()
    assert offset[:, 0][moved] == pytest.approx((many.gnss - clean.gnss)[:, 0][moved], abs=1e-9)
    size = abs(offset[:, 0][moved])
    assert size.min() > 5.0 - 1e-9
    assert size.max() < 40.0 + 1e-9
    signs = np.sign(many.gnss - clean.gnss)[:, 0]  # of liars and axes, independent: squares of sums are counts
    assert (signs.sum(axis=(1, 2)) ** 2).sum() < 1.7 * abs(signs).sum()
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
        ({"attack": 0.1, "honest": ["missing"]}, "honest"),
        ({"attack": 0.1, "remove_outliers": 1}, "remove_outliers"),
        ({"offset": (9.0, 5.0)}, "offset"),
        ({"offset": 3.0}, "offset"),
        ({"start": -1.0}, "start"),
        ({"collude": 1}, "c"),
    ],
)
def test_an_attack_says_what_is_wrong(lied_to, options, field):
    with refused(field):
        spoofed(lied_to, **options) if "attack" in options else Spoofing(0.2, **options)


def test_an_attack_begins_creeps_and_colludes(crossing, clean):
    full, late, slow, alike = (
        spoofed(clean, Spoofing(0.4, **options), seed=2, honest=[0]).gnss - clean.gnss
        for options in ({}, {"start": 1.0}, {"start": 1.0, "ramp": 2.0}, {"collude": True})
    )
    for step, t in enumerate(crossing.t - crossing.t[0]):
        assert late[:, step] == pytest.approx(full[:, step] * (t > 0.99), abs=1e-9)
        assert slow[:, step] == pytest.approx(full[:, step] * min(max(t - 1.0, 0.0) / 2.0, 1.0), abs=1e-9)
    wrong = abs(alike[:, 0]).max(-1) > 1e-9
    assert np.array_equal(wrong, abs(full[:, 0]).max(-1) > 1e-9)
    for one, offsets in zip(wrong, alike[:, 0], strict=True):
        assert abs(offsets[one] - offsets[one][:1]).max(initial=0.0) < 1e-9


def test_an_estimator_that_is_told_of_an_attack_lacks_the_false_fixes(clean):
    false = spoofed(clean, Spoofing(0.4, start=1.0), seed=2, honest=[0])
    told = spoofed(clean, Spoofing(0.4, start=1.0), seed=2, honest=[0], remove_outliers=True)
    assert np.array_equal(told.gnss, np.where(false.gnss == clean.gnss, clean.gnss, np.nan), equal_nan=True)
    assert told.notes[-1].endswith("removed")


def test_the_example_prints_its_table(capsys):
    clean, few = outlier_attack.main(shares=(0.0, 0.2))
    assert capsys.readouterr().out.count("\n") == 3
    assert few.least_squares > 3 * clean.least_squares
    assert few.robust < 1.3 * clean.least_squares


def test_a_fleet_in_which_a_fifth_lies_is_better_than_alone():
    """At the first fixes, 5 m apart by noise, each number of a liar is within its gate: their vector is not. A centre
    doubts the fixes that others contradict (2.3 m if those were judged by their own vehicle's odometer alone)."""
    fleet = co.load_fleet("town10-validation").between(0, 100)
    seen = spoofed(observe(fleet, S2, V2X(max_neighbours=6), runs=2), 0.2, seed=1, honest=range(5))
    alone, together = (
        co.rt_le(which("nominal")(seen, range(5)), fleet).mean() for which in (co.Kalman, co.BatchSmoother)
    )
    assert together < 0.25 * alone
