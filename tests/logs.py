"""Logs written from simulated recordings, for tests of what reads them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy import arange, sin
from numpy.random import default_rng

from coopoc import V2X, Fleet, Sensors, observe


def drive(vehicles=4, steps=200, dt=0.1, start=0.0, gap=8.0):
    """Vehicles side by side on a wide bend at 8 m/s, `gap` metres apart."""
    t = dt * arange(steps)
    course = 0.4 * sin(0.15 * t)
    step = dt * 8 * np.c_[np.cos(course), sin(course), 0 * t]
    path = np.cumsum(step, 0)
    aside = gap * arange(vehicles)[:, None] * [0.2, 1.0, 0.0]
    position = path[:, None] + aside
    velocity = np.repeat(step[:, None] / dt, vehicles, 1)
    return Fleet(tuple(f"car{k}" for k in range(vehicles)), start + t, position, velocity)


NOISE = Sensors(gnss_std=(1.5, 1.5, 0.5), velocity_std_ratio=0.0, velocity_floor=0.1, range_std=0.3, min_range=0.0)


def observed(fleet, k=3, **channel: Any):
    """One run of noisy measurements, with noise on the velocity as wide as its floor."""
    recording = observe(fleet, NOISE, V2X(k, 120.0, **channel), seed=3)
    noise = default_rng(0).normal(0, 0.1, recording.velocity.shape) * [1, 1, 0]
    return replace(recording, velocity=recording.velocity + noise)


def long(recording, messages=True):
    """One row per number that a recording holds."""
    rows: list[dict[str, Any]] = []
    ids, t = recording.ids, recording.t
    for step, column in zip(*np.nonzero(np.isfinite(recording.velocity[0, :, :, 0])), strict=True):
        base = {"t": t[step], "vehicle": ids[column]}
        for axis, kind in enumerate("xyz"):
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


def write(frame, path):
    """A table as CSV or Parquet."""
    getattr(frame, f"to_{path.suffix[1:]}")(path, index=False)
    return path


def at(fleet, name, t):
    """(M, 3) m, where a vehicle is at times between the steps."""
    return np.column_stack([np.interp(t, fleet.t, axis) for axis in fleet.position[:, fleet.ids.index(name)].T])


def fixes(fleet, name, every, std, seed=0):
    """Fixes x, y, z of one vehicle, in a wide table."""
    t = arange(fleet.t[0], fleet.t[-1], every)
    x = at(fleet, name, t) + default_rng(seed).normal(0, std, (len(t), 3))
    return pd.DataFrame({"t": t, "vehicle": name, **dict(zip("xyz", x.T, strict=True)), "x_std": std, "y_std": std})


def motion(fleet, name, every, std, seed=0):
    """World velocities vx, vy, vz of one vehicle, in a wide table."""
    t = arange(fleet.t[0], fleet.t[-1], every)
    u = (at(fleet, name, t + 0.05) - at(fleet, name, t - 0.05)) / 0.1
    u += default_rng(seed).normal(0, std, u.shape)
    return pd.DataFrame({"t": t, "vehicle": name, "vx_std": std, **dict(zip(("vx", "vy", "vz"), u.T, strict=True))})


def ranges(fleet, name, other, every, std, seed=0):
    """Ranges of one vehicle to another, in a wide table."""
    t = arange(fleet.t[0], fleet.t[-1], every)
    gap = np.linalg.norm(at(fleet, other, t) - at(fleet, name, t), axis=1)
    return noisy(default_rng(seed), t, name, {"range": (gap, std)}).assign(partner=other)


def noisy(rng, t, name, columns):
    """What one vehicle measures, in a wide table: kind -> (truth, std)."""
    measured = {kind: values + rng.normal(0, std, len(t)) for kind, (values, std) in columns.items()}
    return pd.DataFrame(
        {"t": t, "vehicle": name, **measured, **{f"{kind}_std": std for kind, (_, std) in columns.items()}}
    )


def star(t, rng, name, ways, velocity, seen):
    """Velocities, fixes and ranges to all others of one of those on complex `ways`, in a wide table."""
    columns = {"vx": (velocity.real, 0.1), "vy": (velocity.imag, 0.1), "x": (seen.real, 1.3), "y": (seen.imag, 1.3)}
    reach = {f"range_{other}": (abs(way - ways[name]), 0.1) for other, way in ways.items() if other != name}
    return noisy(rng, t, name, columns | reach)


def bends(vehicles=2, minutes=3.0, climb=0.0):
    """Vehicles on bends through all directions at 8 m/s, 12 m apart; `climb` m of height that come and go."""
    t = 0.02 * arange(int(minutes * 3000))
    course = 2.5 * sin(0.1 * t)
    velocity = np.c_[8 * np.cos(course), 8 * sin(course), 0.1 * climb * np.cos(0.1 * t)]
    apart = 12.0 * arange(vehicles)[:, None] * [0.3, 0.9, 0.0]
    position = np.cumsum(0.02 * velocity, 0)[:, None] + apart
    return Fleet(tuple(f"car{k}" for k in range(vehicles)), t, position, np.repeat(velocity[:, None], vehicles, 1))


def outliers(values, share=0.05):
    """Ranges of which a share is 3 to 10 m too long, as by reflections."""
    rng = default_rng(9)
    return values + np.where(rng.random(len(values)) < share, rng.uniform(3, 10, len(values)), 0.0)
