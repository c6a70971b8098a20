"""Relative measurements between two steps, against the closed form of motions at constant speed and yaw rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import coopoc as co

LATE = 0.04
"""s, behind every step of 0.1 s."""
MAST = np.array([40.0, 60.0])


def straight(t: Any) -> dict[str, Any]:
    """Two cars that pass each other at 25 m/s."""
    here = np.asarray(t, dtype=float)
    return {"east": np.array([15 * here - 100, 0 * here]), "west": np.array([60 - 10 * here, 4 + 0 * here])}


def circle(t: float) -> tuple[Any, float]:
    """Place m and heading rad of a car at 6 m/s that turns by 0.5 rad/s."""
    return np.array([12 * np.sin(0.5 * t), -12 * np.cos(0.5 * t)]), 0.5 * t


def read(rows: list[tuple[Any, ...]], folder: Path, **options: Any) -> co.Recording:
    file = folder / "log.csv"
    pd.DataFrame(rows, columns=["t", "vehicle", "kind", "partner", "value"]).to_csv(file, index=False)
    return co.load_recording(file, **options)


@pytest.mark.parametrize("late", [0.0, LATE, -LATE])
def test_ranges_and_azimuths_of_passing_cars_are_those_at_the_step(tmp_path: Path, late: float) -> None:
    """Moved by the nearest step alone, ranges were wrong by 1 m."""
    rows: list[tuple[Any, ...]] = [(0.0, "mast", kind, "", MAST[k]) for k, kind in enumerate("xy")]
    for t in np.round(np.arange(0, 8, 0.1), 1):
        at = straight(t)
        for name, speed in (("east", 15.0), ("west", -10.0)):
            rows += [(t, name, kind, "", value) for kind, value in zip(("x", "y"), at[name], strict=True)]
            rows += [(t, name, "vx", "", speed), (t, name, "vy", "", 0.0)]
        then = straight(t + late)
        for other, place in (("west", then["west"]), ("mast", MAST)):
            gap = place - then["east"]
            rows += [(t + late, "east", "range", other, np.hypot(*gap))]
            rows += [(t + late, "east", "azimuth", other, np.arctan2(gap[1], gap[0]))]
    found = read(rows, tmp_path)
    links, place = found.links, found.gnss[0]
    gap = (place[links.step, links.neighbour] - place[links.step, links.observer])[:, :2]
    far = np.hypot(*gap.T) > 12.0  # nearer, fixes would not know the direction
    assert far.sum() > 120
    np.testing.assert_allclose(found.relative[0, far, 0], np.hypot(*gap[far].T), atol=1e-9)
    np.testing.assert_allclose(found.relative[0, far, 1], np.arctan2(gap[far, 1], gap[far, 0]), atol=1e-9)
    assert np.isfinite(found.relative[0]).all()
    assert (found.relative[0, :, 0] > 0).all()


@pytest.mark.parametrize("late", [LATE, -LATE])
def test_bearings_in_body_frames_turn_with_the_car(tmp_path: Path, late: float) -> None:
    """A bearing alone is turned; a range and a bearing of what stands are moved, too."""
    rows: list[tuple[Any, ...]] = []
    for name, place in (("mast", MAST), ("far", 1e6 * MAST)):
        rows += [(0.0, name, kind, "", value) for kind, value in zip(("x", "y"), place, strict=True)]
    for t in np.round(np.arange(0, 6, 0.1), 1):
        place, _ = circle(t)
        rows += [(t, "car", "speed", "", 6.0), (t, "car", "yaw_rate", "", 0.5)]
        rows += [(t, "car", kind, "", value) for kind, value in zip(("x", "y"), place, strict=True)]
        then, heading = circle(t + late)
        for name, other in (("mast", MAST), ("far", 1e6 * MAST)):
            gap = other - then
            bearing = np.arctan2(gap[1], gap[0]) - heading
            rows.append((t + late, "car", "bearing", name, np.arctan2(np.sin(bearing), np.cos(bearing))))
            if name == "mast":
                rows.append((t + late, "car", "range", name, np.hypot(*gap)))
    found = read(rows, tmp_path, frame="body", any_scale=True)
    assert len(found.links) >= 118
    for step, neighbour, relative in zip(found.links.step, found.links.neighbour, found.relative[0], strict=True):
        place, heading = circle(found.t[step])
        gap = (MAST if found.ids[neighbour] == "mast" else 1e6 * MAST) - place
        off = relative[1] - np.arctan2(gap[1], gap[0]) + heading
        assert np.arctan2(np.sin(off), np.cos(off)) == pytest.approx(0, abs=1e-4)
        if found.ids[neighbour] == "mast":
            assert relative[0] == pytest.approx(np.hypot(*gap), abs=5e-3)
