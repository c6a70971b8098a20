"""The studies of consistency, of cost as fleets grow, and of other places, on few cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coopoc import load_fleet, run_study
from coopoc.studies import generalisation, scaling
from coopoc.study import numbers
from coopoc.world.sensing import find_links


def test_a_consistent_filter_is_told_from_one_that_is_not(tmp_path: Path, short_town: str) -> None:
    wanted = {
        "data": short_town,
        "runs": 4,
        "egos": "2",
        "method": "kalman,joint,lkf-sa",
        "noise_model": "nominal,identity",
    }
    results = run_study("consistency", tmp_path, settings=wanted, progress=False)
    table = (tmp_path / "consistency" / "tables" / "nees.md").read_text()
    good = numbers.mean(results, {"method": "joint", "noise_model": "nominal"}, "nees_inside")
    bad = numbers.mean(results, {"method": "lkf-sa", "noise_model": "identity"}, "nees_inside")
    assert good is not None
    assert bad is not None
    assert good > 0.9 > 0.1 > bad
    rows = [[cell.strip() for cell in line.split("|")[1:3]] for line in table.splitlines()]
    assert rows.index(["Joint filter", "nominal"]) < rows.index(["LKF-SA", "identity"])  # the most credible first


def test_copies_do_not_see_each_other_and_cost_is_counted_per_vehicle(tmp_path: Path) -> None:
    fleet = scaling.copied("town10", 2, 10)
    links = find_links(fleet, range(len(fleet.ids)), 6, 30.0)
    assert ((links.observer < 60) == (links.neighbour < 60)).all()
    assert len(links) == 2 * len(find_links(load_fleet("town10").between(0, 10), range(60), 6, 30.0))
    wanted = {"steps": 10, "runs": 1, "repeats": 1, "copies": "1,2", "method": "observe,kalman,gbp"}
    results = run_study("scaling", tmp_path, settings=wanted, progress=False)
    each = [scaling.costs(results, "gbp")[vehicles] for vehicles in (60, 120)]
    assert all(value is not None and np.isfinite(value) and value > 0 for value in each)
    assert "Largest / smallest" in (tmp_path / "scaling" / "tables" / "cost.md").read_text()


@pytest.mark.slow
def test_generalisation_is_relative_to_the_oracle_of_each_place(tmp_path: Path) -> None:
    wanted = {"runs": 2, "egos": "2", "method": "kalman,kalman-adaptive", "data": "town10,town04", "scenario": "2"}
    results = run_study("generalisation", tmp_path, settings=wanted, progress=False)
    for fleet in ("town10", "town04"):
        where = {**generalisation.at(fleet, "scenario 2"), "method": "kalman"}
        oracle, fitted = (
            generalisation.multiple(results, {**where, "noise_model": known}) for known in ("oracle", "fitted")
        )
        assert oracle == 1.0
        assert fitted is not None
        assert fitted > 1.05
    assert "Adaptive KF" in (tmp_path / "generalisation" / "tables" / "multiples.md").read_text()
