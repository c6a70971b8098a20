"""Logs written from simulated recordings, for tests of what reads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc import V2X, Fleet, Recording, Sensors, observe


def drive(vehicles: int = 4, steps: int = 200, dt: float = 0.1, start: float = 0.0, gap: float = 8.0) -> Fleet:
    """Vehicles side by side on a wide bend at 8 m/s, `gap` metres apart."""
    t = dt * np.arange(steps)
    course = 0.4 * np.sin(0.15 * t)
    step = dt * 8 * np.stack([np.cos(course), np.sin(course), 0 * t], axis=1)
    path = np.cumsum(step, axis=0)
    aside = gap * np.arange(vehicles)[:, None] * [0.2, 1.0, 0.0]
    position = path[:, None] + aside
    velocity = np.repeat(step[:, None] / dt, vehicles, axis=1)
    return Fleet(tuple(f"car{k}" for k in range(vehicles)), start + t, position, velocity)


NOISE = Sensors(gnss_std=(1.5, 1.5, 0.5), velocity_std_ratio=0.0, velocity_floor=0.1, range_std=0.3, min_range=0.0)


def seen(fleet: Fleet, k: int = 3, **channel: Any) -> Recording:
    """One run of noisy measurements, with noise on the velocity as wide as its floor."""
    recording = observe(fleet, NOISE, V2X(k, 120.0, **channel), runs=1, seed=3)
    noise = np.random.default_rng(0).normal(0, 0.1, recording.velocity.shape) * [1, 1, 0]
    return replace(recording, velocity=recording.velocity + noise)


def long(recording: Recording, messages: bool = True) -> pd.DataFrame:
    """One row per number that a recording holds."""
    rows: list[dict[str, Any]] = []
    ids, t = recording.ids, recording.t
    for step, column in zip(*np.nonzero(np.isfinite(recording.velocity[0, :, :, 0])), strict=True):
        base = {"t": t[step], "vehicle": ids[column]}
        for axis, kind in enumerate(("x", "y", "z")):
            value = recording.gnss[0, step, column, axis]
            if np.isfinite(value):
                rows.append({**base, "kind": kind, "value": value, "std": NOISE.gnss_std[axis]})
        for axis, kind in enumerate(("vx", "vy", "vz")):
            rows.append({**base, "kind": kind, "value": recording.velocity[0, step, column, axis], "std": 0.1})
    stds = (NOISE.range_std, NOISE.azimuth_std, NOISE.inclination_std)
    for link in range(len(recording.links)):
        step, observer = int(recording.links.step[link]), recording.links.observer[link]
        partner = ids[recording.links.neighbour[link]]
        for k, kind in enumerate(("range", "azimuth", "inclination")):
            value = recording.relative[0, link, k]
            row = {"t": t[step], "vehicle": ids[observer], "kind": kind, "partner": partner, "value": value}
            rows.append({**row, "std": stds[k]})
        if messages and recording.broadcasts[step, recording.links.neighbour[link]]:
            arrival = recording.arrival[0, link]
            at = "lost" if arrival < 0 else f"{t[step] + (arrival - step) * recording.dt:.6f}"
            rows.append({"t": t[step], "vehicle": partner, "kind": "message", "partner": ids[observer], "arrival": at})
    return pd.DataFrame(rows)


def write(frame: pd.DataFrame, path: Path) -> Path:
    """A table as CSV or Parquet."""
    if path.suffix == ".parquet":
        frame.to_parquet(path, index=False)
    else:
        frame.to_csv(path, index=False)
    return path
