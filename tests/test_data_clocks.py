"""Clocks that disagree are named by `check`: one vehicle's, the truth's, and stamps of another time zone."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from coopoc.data.log.check import check
from coopoc.data.log.read import read_log
from coopoc.errors import InputError

NAMES = ("tug", "barge", "pilot")


def tables(seed: int, vehicles: int = 3) -> tuple[pd.DataFrame, pd.DataFrame]:
    """80 s of vehicles on bends of their own: speed and heading at 5 Hz, fixes at 1 Hz, ranges and bearings; truth."""
    rng, t, rows, true = np.random.default_rng(seed), np.round(np.arange(0, 80, 0.2), 2), [], []
    head = [0.4 * k + 0.5 * np.sin(0.05 * t + k) for k in range(vehicles)]
    speed = [4 + 0.8 * k + 0.8 * np.sin(0.1 * t + k) for k in range(vehicles)]
    step = [0.2 * u[:, None] * np.column_stack([np.cos(a), np.sin(a)]) for u, a in zip(speed, head, strict=True)]
    x = [k * np.array([25.0, 14.0]) + np.cumsum(moved, axis=0) for k, moved in enumerate(step)]
    for i, now in enumerate(t):
        for k, name in enumerate(NAMES[:vehicles]):
            true.append((now, name, *x[k][i]))
            seen = [("speed", "", speed[k][i], 0.05), ("heading", "", head[k][i], 0.01)]
            seen += [("x", "", x[k][i, 0], 0.8), ("y", "", x[k][i, 1], 0.8)] if i % 5 == 0 else []
            for j in range(vehicles) if i % 3 == 0 else ():
                if j != k:
                    east, north = x[j][i] - x[k][i]
                    bearing = np.angle(np.exp(1j * (np.arctan2(north, east) - head[k][i])))
                    seen += [("range", NAMES[j], np.hypot(east, north), 0.2), ("bearing", NAMES[j], bearing, 0.03)]
            rows += [(now, name, kind, other, value + rng.normal(0, std), std) for kind, other, value, std in seen]
    columns = ["t", "vehicle", "kind", "partner", "value", "std"]
    return pd.DataFrame(rows, columns=columns), pd.DataFrame(true, columns=["t", "vehicle", "x", "y"])


def doubts(folder: Path, log: pd.DataFrame, truth: pd.DataFrame | None = None) -> tuple[str, ...]:
    log.to_csv(folder / "measurements.csv", index=False)
    if truth is not None:
        truth.to_csv(folder / "truth.csv", index=False)
    return check(read_log(folder)).warnings


@pytest.mark.parametrize("seed", [1, 2])
def test_clocks_that_agree_raise_no_doubt(tmp_path: Path, seed: int) -> None:
    assert doubts(tmp_path, *tables(seed)) == ()


@pytest.mark.parametrize(("late", "vehicles"), [(0.5, 3), (-0.6, 3), (0.8, 2)])
def test_the_clock_of_one_vehicle_is_found(tmp_path: Path, late: float, vehicles: int) -> None:
    """Within a fifth of what was added to its stamps; the clock that is named mends the log."""
    log, _ = tables(3, vehicles)
    mine = log.vehicle == "barge"
    (found, *_) = doubts(tmp_path, log.assign(t=log.t + late * mine))
    named = re.fullmatch(
        r"(\w+): its stamps are about (\S+) s ahead of the others'.* Give clock=\{'(\w+)': \S+\}.*", found
    )
    assert named is not None
    assert named[1] == named[3] == "barge"
    assert float(named[2]) == pytest.approx(late, rel=0.2)
    assert check(read_log(tmp_path, clock={"barge": late})).warnings == ()


def test_stamps_of_another_time_zone_are_named(tmp_path: Path) -> None:
    log, _ = tables(4)
    (found, *_) = doubts(tmp_path, log.assign(t=log.t + 7200.0 * (log.vehicle == "pilot")))
    assert found.startswith("pilot: is there while no other vehicle is, its log begins 7200 s after theirs.")
    assert "clock={'pilot': 7200}" in found


@pytest.mark.parametrize("late", [0.5, -0.4])
def test_a_truth_with_another_clock_is_named(tmp_path: Path, late: float) -> None:
    log, truth = tables(5)
    found = doubts(tmp_path, log, truth.assign(t=truth.t + late))
    assert len(found) >= 2
    for sentence in found:  # six standard errors are many for the slowest
        named = re.search(r"its fixes are (\S+) s (ahead of|behind) the truth", sentence)
        assert named is not None
        assert float(named[1]) == pytest.approx(abs(late), abs=0.1)
        assert (named[2] == "ahead of") == (late > 0)


def bodily(folder: Path, late: float, truth_late: float = 0.0) -> tuple[str, ...]:
    """What is said of the same log in body frames, with yaw rates, one clock and that of the truth moved."""
    log, truth = tables(3)
    t = np.unique(log.t)
    rates = [
        pd.DataFrame({"t": t, "vehicle": name, "kind": "yaw_rate", "value": 0.025 * np.cos(0.05 * t + k), "std": 2e-3})
        for k, name in enumerate(NAMES)
    ]
    log = pd.concat([log, *rates], ignore_index=True)
    log.assign(t=log.t + late * (log.vehicle == "barge")).to_csv(folder / "measurements.csv", index=False)
    truth.assign(t=truth.t + truth_late).to_csv(folder / "truth.csv", index=False)
    return tuple(check(read_log(folder, frame="body")).warnings)


@pytest.mark.parametrize("late", [0.0, 0.5, -0.6])
def test_the_clock_of_one_vehicle_is_found_in_body_frames(tmp_path: Path, late: float) -> None:
    found = [text for text in bodily(tmp_path, late) if "its stamps are" in text]
    assert len(found) == (late != 0)
    for text in found:
        (clock,) = re.findall(r"clock=\{'barge': (\S+)\}", text)
        assert float(clock) == pytest.approx(late, rel=0.2)


def test_other_clocks_of_the_truth_and_of_a_time_zone_are_named_in_body_frames(tmp_path: Path) -> None:
    found = re.findall(r"its fixes are (\S+) s ahead of the truth", "\n".join(bodily(tmp_path, 0.0, 0.7)))
    assert [float(late) for late in found] == pytest.approx([0.7] * 3, rel=0.1)
    with pytest.raises(InputError, match=r"all vehicles are there\. barge: is there while no other .*'barge': 3600"):
        bodily(tmp_path, 3600.0)


@pytest.mark.parametrize(
    "option", [{"columns": 3}, {"kinds": [1]}, {"ignore": 3}, {"origin": (1, 2)}, {"any_scale": "x"}, {"dt": "x"}]
)
def test_options_of_the_wrong_kind_are_refused(tmp_path: Path, option: dict[str, Any]) -> None:
    tables(3)[0].to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(InputError, match=next(iter(option))):
        read_log(tmp_path, **option)
