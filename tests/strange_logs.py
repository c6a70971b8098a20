"""Logs of drones, cars and robots with a truth, clean or with faults that are planted in them."""

from typing import Any

import numpy as np
import pandas as pd
from numpy import exp
from numpy.random import default_rng

KINDS: dict[str, tuple[int, float, float, float, float, float, tuple[float, ...]]] = {
    "drone": (4, 5.0, 15.0, 8.0, 0.5, 0.1, (5.0, 10.0, 5.0)),
    "car": (4, 15.0, 25.0, 0.0, 1.0, 0.3, (1.0, 10.0, 10.0)),
    "robot": (2, 0.8, 3.0, 0.0, 0.0, 0.1, (1.0, 10.0, 5.0)),
}
"""Vehicles, m/s, m apart, m of climb, standard deviations m of fixes and ranges, Hz of fixes, odometry and ranges."""


def strange(folder, kind, seed=0, seconds=180.0, rate=1.0, **fault: Any):
    """A log and its truth: drones that range each other, cars with a radar to the one ahead, robots with an anchor.

    Args:
        folder: is made.
        kind: of vehicles.
        seed: of paths and noise.
        seconds: of the drive.
        rate: factor of all rates.
        fault: `pairs` (a, b) -> m, `clocks` s, `wheels` (share of the speed) and `tags` m of vehicles, `late` fixes s,
            `unit` of ranges, `tunnel` (from, to) s without fixes, `body` where drones log velocities in theirs.
    """
    get = fault.get
    count, pace, apart, climb, fix, reach, rates = KINDS[kind]
    rng, noise, t = default_rng(seed), default_rng([seed, 1]), 0.02 * np.arange(int(seconds * 50))
    drones, cars, robots = (kind == name for name in KINDS)
    names, axes = [f"{kind}{k}" for k in range(count)], list("xyz" if drones else "xy")
    (begin, end), body = get("tunnel", (-1, -1)), "body" in fault
    place, tip, speed, course, tables = {}, {}, {}, {}, []
    shape = rng.uniform(0.6, 1.4, (count, 3))
    for k, name in enumerate(names):
        s, (a, b, c) = t - k * apart / pace * cars, shape[0 if cars else k]
        course[name] = 0.15 * s * robots * (-1) ** k + 1.6 * a * np.sin(0.08 * b * s + 2 * k * drones)
        speed[name] = pace * (1 + 0.3 * np.sin(0.15 * c * s))
        path = np.cumsum(0.02 * speed[name] * exp(1j * course[name]))
        path += -k * apart if cars else apart * exp(1.9j * k) * (k > 0)
        place[name] = np.c_[path.real, path.imag, climb * np.sin(0.1 * t + k)]
        ahead, left, up = get("tags", {}).get(name, (0, 0, 0))
        aside = exp(1j * course[name]) * (ahead + 1j * left)
        tip[name] = place[name] + np.c_[aside.real, aside.imag, 0 * t + up]
    tip |= {"anchor": 0 * place[names[0]] + [2.0, -1.0, 0.0]} if robots else {}

    def at(values, times):
        return np.column_stack([np.interp(times, t, axis) for axis in np.atleast_2d(values.T)])

    def add(name, times, kinds, values, std, **more):
        values = values + noise.normal(0, std, values.shape)
        columns = dict(zip(kinds, values.T, strict=True)) | {f"{one}_std": std for one in kinds}
        now = times + get("clocks", {}).get(name, 0.0)
        frame = pd.DataFrame({"t": now, "vehicle": name, **columns, **more})
        tables.append(frame[frame[kinds[0]].gt(0) | (kinds[0] != "range")])

    for k, name in enumerate(names):
        fixed, moved, ranged = (np.arange(1 + 0.01 * k, seconds - 1, 1 / hertz / rate) for hertz in rates)
        fixed = fixed[(fixed < begin) | (fixed > end)]
        scale, late = 1 + get("wheels", {}).get(name, 0.0), get("late", 0.0)
        if not robots:
            add(name, fixed + late, axes, at(place[name], fixed)[:, : len(axes)], fix)
        if drones:
            u = (at(place[name], moved + 0.05) - at(place[name], moved - 0.05)) / 0.1
            along = (u @ [1, 1j, 0]) * exp(-1j * body * at(course[name], moved)[:, 0])
            u, end_of = np.c_[along.real, along.imag, u[:, 2]], "_body" * body
            add(name, moved, [f"{one}{end_of}" for one in ("vx", "vy", "vz")], scale * u, 0.1)
        else:
            add(name, moved, ["speed"], scale * at(speed[name], moved), 0.02 if robots else 0.1)
        if body or not drones:
            turn = (at(course[name], moved + 0.05) - at(course[name], moved - 0.05)) / 0.1
            add(name, moved, ["yaw_rate"], turn, 0.01)
        if cars:
            add(name, moved, ["heading"], at(course[name], moved), 0.01)
        for other in names[k - 1 : k] if cars else [one for one in tip if one != name]:
            gap = at(tip[other], ranged) - at(tip[name], ranged)
            pairs, unit = get("pairs", {}), get("unit", 1.0)
            far = np.linalg.norm(gap, axis=1, keepdims=True) + pairs.get((name, other), pairs.get((other, name), 0.0))
            add(name, ranged, ["range"], far / unit, reach / unit, partner=other)
            if cars:
                side = np.arctan2(gap[:, 1:2], gap[:, :1]) - at(course[name], ranged)
                add(name, ranged, ["bearing"], np.angle(exp(1j * side)), 0.02, partner=other)
    tables += [pd.DataFrame({"t": [1.0], "vehicle": "anchor", "x": [2.0], "y": [-1.0]})] * robots
    folder.mkdir(parents=True, exist_ok=True)
    pd.concat(tables).sort_values("t", kind="stable").to_csv(folder / "log.csv", index=False)
    for name in names:
        heading = np.angle(exp(1j * course[name]))
        true = dict(zip(axes, place[name].T, strict=False))
        tables.append(pd.DataFrame({"t": t, "vehicle": name, **true, "heading": heading})[::5])
    pd.concat(tables[-count:]).to_csv(folder / "truth.csv", index=False)
    return folder
