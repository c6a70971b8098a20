"""Noise that methods may assume of a log: the standard deviations in it, as Sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from coopoc.arrays import Floats
from coopoc.world.sensors import Sensors

from .kinds import KINDS
from .log_rows import Rows
from .log_summary import Tally

PLANE_STD = 0.01
"""m, how well z = 0 is known where no height was logged; rad, the inclination that goes with it."""
HEADING_STD = 0.05
"""rad, of a compass in body frames whose noise was not logged."""
VARIED = 1.5
"""Ratio of large to small standard deviations (98 and 2 %) beyond which one for all is worth a word."""


def stds(rows: Rows) -> Mapping[str, Floats]:
    """Kind in SI units -> standard deviations of the rows that have one, in SI units; those of degrees in metres."""
    found: dict[str, list[Floats]] = {}
    names = {"longitude": "x", "latitude": "y", "height": "z"}
    for kind in dict.fromkeys(rows.kind.tolist()):
        one = KINDS[kind]
        given = rows.std[(rows.kind == kind) & np.isfinite(rows.std)] * one.scale
        if len(given):
            found.setdefault(names.get(one.name, one.name), []).append(given)
    return {name: np.concatenate(parts) for name, parts in found.items()}


def assumed(
    given: Mapping[str, Floats],
    sensors: Sensors | None,
    rows: Rows,
    planar: bool,
    body: bool,
    tally: Tally,
    dt: float,
) -> Sensors:
    """Sensors of a log: those that are given, else the root mean square of the logged standard deviations of each kind.

    A Recording holds one standard deviation per kind; what is not logged is that of `Sensors()`, and reported.
    """
    flat = PLANE_STD if planar else None
    if sensors is not None:
        return sensors
    base = Sensors()
    used = set(rows.kind.tolist())

    def of(*names: str, default: float, unit: str) -> float:
        parts = [given[name] for name in names if name in given]
        if parts:
            every = np.concatenate(parts)
            level = float(np.sqrt(np.mean(every**2)))
            low, high = np.percentile(every, [2, 98])
            if high > VARIED * low:
                what = f"{low:.3g} to {high:.3g} {unit}"
                tally.assume(f"one standard deviation of {names[0]} for all, {level:.3g} {unit}; the log has {what}")
            return level
        if used & set(names):
            tally.assume("standard deviations of {}: none was logged", f"{default:.3g} {unit} ({names[0]})")
        return default

    z = flat or of("z", default=base.gnss_std[2], unit="m")
    speed = of("vx", "vy", "speed", default=0.0, unit="m/s") if set(given) & {"vx", "vy", "speed"} else None
    if speed is None:
        tally.assume(f"{base.velocity_std_ratio:.0%} of a velocity as its noise, {base.velocity_floor} m/s at least")
    found = replace(
        base,
        gnss_std=(of("x", default=base.gnss_std[0], unit="m"), of("y", default=base.gnss_std[1], unit="m"), z),
        range_std=of("range", default=base.range_std, unit="m"),
        azimuth_std=of("azimuth", "bearing", default=base.azimuth_std, unit="rad"),
        inclination_std=of("inclination", default=flat or base.inclination_std, unit="rad"),
        heading_std=of("heading", default=0.0, unit="rad") if "heading" in given and "bearing" in used else 0.0,
        min_range=0.0,
    )
    if body:
        found = replace(
            found,
            velocity_reading="speed",
            yaw_rate_std=of("yaw_rate", default=base.yaw_rate_std, unit="rad/s"),
            heading_std=of("heading", default=HEADING_STD, unit="rad"),
            compass="heading" in used,
        )
    if speed is None:
        return found
    if not body and {"speed", "heading"} <= set(given):
        speed = _across(speed, of("heading", default=0.0, unit="rad"), rows, dt)
        tally.assume(f"{speed:.2g} m/s as the noise of a velocity, with that of the headings which turn the speeds")
    return replace(found, velocity_std_ratio=0.0, velocity_floor=speed)


def _across(speed: float, heading: float, rows: Rows, dt: float) -> float:
    """Standard deviation m/s of each axis of a velocity that is a speed v turned by a measured heading: the mean of the
    variances along, s_v^2, and across, v^2 s_h^2 n, where a heading's error lasts for the n steps to the next one; at
    least s_v."""
    v = rows.value[rows.kind == "speed"]
    turned = rows.kind == "heading"
    vehicles = set(rows.vehicle[turned].tolist())
    gaps = [np.diff(np.unique(rows.t[turned & (rows.vehicle == one)])) for one in vehicles]
    interval = float(np.median(np.concatenate([*gaps, [dt]])))
    across = float(np.mean(v**2)) * heading**2 * max(interval / dt, 1.0)
    return max(speed, float(np.sqrt((speed**2 + across) / 2)))
