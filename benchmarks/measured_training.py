"""Gains as shipped and trained on the first part of a made drive, scored on its last 20 minutes: RT-LE in m.

A robot at 1.5 m/s for 40 minutes (with --minutes 60: an hour to train, 100 minutes in all): heading and slip err by 0.1
rad and 5 % and are correlated over 60 and 30 s, fixes at 1 Hz err by 1 m, drift by 3 m over 60 s, jump by 15 m for 3 s.
`python benchmarks/measured_training.py` makes the table of docs/learned.md, in a quarter of an hour.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

import coopoc as co
from coopoc.arrays import Floats
from coopoc.learned import MeasuredDrives, Setting, load_method
from coopoc.learned.recipes import jobs_of
from coopoc.learned.train import trained
from coopoc.methods.track import Method

DT, SCORED, RECIPES = 0.1, 1200, ("okf", "fedkalmannet", "road")


def drive(seed: int, seconds: int) -> tuple[co.Recording, co.Fleet]:
    """What the robot measured, and its truth."""
    rng, n = np.random.default_rng(seed), int(seconds / DT)
    t = DT * np.arange(n)
    course = np.cumsum(rng.normal(0, 0.03, n) * 0.3) + 0.4 * np.sin(0.05 * t)
    speed = 1.5 + 0.3 * np.sin(0.1 * t)
    velocity = np.stack([speed * np.cos(course), speed * np.sin(course), 0 * t], axis=1)
    position = np.cumsum(DT * velocity, axis=0)
    heading = course + correlated(rng, n, 60, 0.1)[:, 0] + rng.normal(0, 0.02, n)
    wheels = speed * (1.02 + correlated(rng, n, 30, 0.05)[:, 0])
    odometry = np.stack([wheels * np.cos(heading), wheels * np.sin(heading), 0 * t], axis=1)
    flat = np.array([1.0, 1.0, 0.0])
    fixes = position + correlated(rng, n, 60, 3.0, 3) * flat + rng.normal(0, 1.0, (n, 3)) * flat
    rng.random(n)
    k = 0
    while k < n:
        if rng.random() < 0.002:
            fixes[k : k + 30, :2] += rng.normal(0, 15, 2)
            k += 30
        k += 1
    fixes[np.arange(n) % 10 != 0] = np.nan
    fleet = co.Fleet(("robot",), t, position[:, None], velocity[:, None])
    known = co.Sensors(gnss_std=(3.2, 3.2, 0.5), velocity_std_ratio=0.0, velocity_floor=0.1)
    recording = co.observe(fleet, known, co.V2X(max_neighbours=0))
    return replace(recording, gnss=fixes[None, :, None], velocity=odometry[None, :, None]), fleet


def correlated(rng: np.random.Generator, steps: int, time: float, std: float, axes: int = 1) -> Floats:
    """Gauss-Markov errors (steps, axes) of a correlation time s."""
    a = np.exp(-DT / time)
    drawn = rng.normal(0, std * np.sqrt(1 - a * a), (steps, axes))
    drawn[0] = rng.normal(0, std, axes)
    return np.asarray(lfilter([1.0], [1.0, -a], drawn, axis=0))


def main() -> None:
    """Print a row per drive and the means."""
    options = argparse.ArgumentParser()
    options.add_argument("--drives", type=int, default=3)
    options.add_argument("--minutes", type=int, default=10, help="of the first part, which trains")
    given = options.parse_args()
    steps, rows = int(60 * given.minutes / DT), []
    for seed in range(given.drives):
        recording, fleet = drive(seed, 2400 if given.minutes <= 10 else 6000)
        first = MeasuredDrives(recording.between(0, steps), fleet.between(0, steps))
        begin = len(fleet.t) - int(SCORED / DT)
        rest, truth = recording.between(begin, len(fleet.t)), fleet.between(begin, len(fleet.t))
        fixed = np.isfinite(rest.gnss[0, :, 0, 0])
        row = {"fixes": float(np.sqrt(np.square(rest.gnss[0, :, 0] - truth.position[:, 0])[fixed].sum(1).mean()))}
        methods: dict[str, Method] = {"KF, nominal": co.Kalman("nominal"), "Adaptive KF": co.AdaptiveKalman()}
        methods["KF, fitted"] = co.Kalman(co.NoiseModel.fitted(first.recording, first.truth))
        for name in RECIPES:
            (made,) = trained(jobs_of(name, Setting(), first), first, progress=False)
            methods |= {f"{name}, shipped": load_method(name), f"{name}, trained": made.model.method(name)}
        rows.append(row | {name: float(co.rt_le(method(rest, [0]), truth).mean()) for name, method in methods.items()})
        print(f"drive {seed}: " + ", ".join(f"{name} {value:.2f}" for name, value in rows[-1].items()), flush=True)
    print("mean: " + ", ".join(f"{name} {np.mean([row[name] for row in rows]):.2f}" for name in rows[0]))


if __name__ == "__main__":
    main()
