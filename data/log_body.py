"""One vehicle of a log in its own frame: forward speed, yaw rate, fixes and compass on the steps of a Recording."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.errors import InputError

from . import motion
from .log_rows import Rows
from .log_summary import Tally
from .log_vehicle import Vehicle, begun, described, fixes_of, heading_from, on_steps, samples, standing, stands
from .motion import Signal
from .nearest import nearest, steps_of

HINT = 'Log both, or read the log with frame="world".'


def body_vehicle(name: str, rows: Rows, grid: Floats, max_gap: float | None, planar: bool, tally: Tally) -> Vehicle:
    """A vehicle that moves by its own speed and yaw rate, or a landmark: what has one fix and no odometry.

    Args:
        name: its id.
        rows: its own, in SI units and metres.
        grid: (T,) s.
        max_gap: s, of its odometry; None as in `assemble`.
        planar: whether heights were not measured, and are 0.
        tally: counts what is not used.

    Raises:
        InputError: no speeds, or no yaw rates.
    """
    fixes, first = fixes_of(rows, planar, tally)
    if stands(rows, fixes):
        found = standing(rows, fixes, grid, tally)
        return replace(found, heading=None, yaw_rate=np.zeros(len(grid)), compass=np.full(len(grid), np.nan))
    dt = float(grid[1] - grid[0])
    speed, turn = (samples(rows, (kind,), tally, 1)[0] for kind in ("speed", "yaw_rate"))
    for kind, signal in (("speed", speed), ("yaw_rate", turn)):
        if not len(signal.t):
            raise InputError(f"vehicle {name}", f"no {kind}", "must have speeds and yaw rates in body frames", HINT)
    tally.refuse("world velocities in body frames", int(np.isin(rows.kind, ["vx", "vy", "vz"]).sum()))
    measured, _ = samples(rows, ("heading",), tally, 1)
    heading = motion.heading_at(measured, turn, np.inf) if len(measured.t) else None
    u, rate = motion.step_means(speed, grid), motion.step_means(turn, grid)[:, 0]
    there = np.ones(len(grid), dtype=bool)
    for signal in (speed, turn):
        there &= motion.covered(signal, grid, motion.bridged(signal, dt, max_gap), max(dt, 0.6 * signal.interval))
    gnss = on_steps(rows, fixes, first, grid, _moved(rows, fixes, turn, grid, u[:, 0], max_gap), there, tally)
    if np.isfinite(gnss[:, 0]).any():
        there &= begun(name, gnss, there, tally)
    compass = np.where(there, _compass(measured, grid, rate), np.nan)
    text = f"{len(speed.t)} speeds, {len(turn.t)} yaw rates, {int(np.isfinite(compass).sum())} headings"
    velocity = np.where(there[:, None], np.column_stack([u, 0 * u, 0 * u]), np.nan)
    rate = np.where(there, rate, np.nan)
    return Vehicle(gnss, velocity, heading, described(gnss, text, there), yaw_rate=rate, compass=compass)


def _moved(rows: Rows, fixes: Signal, turn: Signal, grid: Floats, speed: Floats, max_gap: float | None) -> Floats:
    """(T, 3) m/s in the world by the heading that was measured, else the course of the fixes; 0 where both are unknown:
    it brings a fix to its step."""
    dt = float(grid[1] - grid[0])
    derived = motion.velocity_of_fixes(fixes, motion.bridged(fixes, dt, max_gap)) if len(fixes.t) > 1 else None
    heading = heading_from(rows, turn, ((derived, "fixes"),), dt, max_gap, Tally())[0]
    if heading is None:
        return np.zeros((len(grid), 3))
    ahead = heading(grid)
    moved = np.column_stack([speed * np.cos(ahead), speed * np.sin(ahead), 0.0 * speed])
    return np.where(np.isnan(ahead)[:, None], 0.0, moved)


def _compass(measured: Signal, grid: Floats, rate: Floats) -> Floats:
    """(T,) headings rad, each brought to the nearest step by the yaw rate; of several at a step the nearest in time."""
    found = np.full(len(grid), np.nan)
    step, late = steps_of(measured.t - grid[0], float(grid[1] - grid[0]), len(grid))
    none: Ints = np.zeros(len(step), dtype=np.int64)
    kept = nearest(late, step, none, none)
    at = step[kept]
    turned = measured.value[kept, 0] + (grid[at] - measured.t[kept]) * rate[at]
    found[at] = np.arctan2(np.sin(turned), np.cos(turned))
    return found


def seen_by_vehicles(rows: Rows, landmarks: Collection[str], tally: Tally) -> Rows:
    """Rows in which vehicles measure: a range that a landmark measured is one to it; whatever else it measured or sent
    says nothing without its heading."""
    mine = np.isin(rows.vehicle, list(landmarks))
    other = np.isin(rows.partner, list(landmarks))
    turned = mine & ~other & (rows.kind == "range")
    vehicle, partner = rows.vehicle.copy(), rows.partner.copy()
    vehicle[turned], partner[turned] = rows.partner[turned], rows.vehicle[turned]
    left = mine & ~turned & np.isin(rows.group, ["relative", "message"])
    if left.any():
        what = "messages of landmarks, and what they measured but ranges to vehicles"
        tally.refuse(what, int(left.sum()), rows.place(int(np.flatnonzero(left)[0])))
    return replace(rows, vehicle=vehicle, partner=partner).take(~left)
