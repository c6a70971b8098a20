"""One vehicle of a log on the steps of a Recording: its fixes, its velocity, its heading, and when it is there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError

from . import motion
from .log_rows import Rows
from .log_summary import Tally
from .motion import Signal
from .rows import SAME

HeadingAt = Callable[[Floats], Floats]
COURSE = "the heading of {} is the course of the {}: no vehicle slips or reverses"
DERIVED = "the velocity of {} is derived from the fixes: their errors depend on each other"


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A member of a log on T steps.

    Args:
        gnss: (T, 3) m, NaN without a fix.
        velocity: (T, 3) m/s, mean over the step that ends at each instant; NaN where absent.
        heading: function from times s to headings rad, NaN where unknown; None if there is none at all.
        text: what was read, in words.
        station: whether it stands, as a road-side unit does.
        course: what its heading is the course of, "" where it was measured.
        yaw_rate: (T,) rad/s as velocity, in body frames.
        compass: (T,) rad, NaN without a heading, in body frames.
    """

    gnss: Floats
    velocity: Floats
    heading: HeadingAt | None
    text: str
    station: bool = False
    course: str = ""
    yaw_rate: Floats | None = None
    compass: Floats | None = None


def samples(rows: Rows, names: Sequence[str], tally: Tally, required: int) -> tuple[Signal, Ints]:
    """Rows of one vehicle as samples (M, C) of some kinds at one time each, NaN where a kind is missing, and the first
    row (M,) of each.

    Args:
        rows: in SI units.
        names: kinds, the columns of the samples.
        tally: counts rows that repeat a kind at one time, and samples without the first `required` kinds.
        required: how many of the kinds a sample needs.
    """
    mine = np.flatnonzero(np.isin(rows.kind, list(names)))
    mine = mine[np.argsort(rows.t[mine], kind="stable")]
    t = rows.t[mine]
    fresh = np.append(True, np.diff(t) > SAME)[: len(t)]
    sample = np.cumsum(fresh) - 1
    column = np.array([list(names).index(kind) for kind in rows.kind[mine].tolist()], dtype=np.int64)
    value = np.full((int(fresh.sum()), len(names)), np.nan)
    first = np.unique(sample * len(names) + column, return_index=True)[1]
    again = np.setdiff1d(np.arange(len(mine)), first)
    if len(again):
        tally.refuse("repeated rows (same time, vehicle and kind)", len(again), rows.place(mine[again[0]]))
    value[sample[first], column[first]] = rows.value[mine[first]]
    whole = np.isfinite(value[:, :required]).all(axis=1)
    begins = mine[fresh]
    if not whole.all():
        reason = f"incomplete rows, without all of {', '.join(names[:required])} at one time"
        tally.refuse(reason, int(np.isfinite(value[~whole]).sum()), rows.place(begins[~whole][0]))
    return Signal(t[fresh][whole], value[whole]), begins[whole]


def vehicle(name: str, rows: Rows, grid: Floats, max_gap: float | None, planar: bool, tally: Tally) -> Vehicle:
    """A vehicle, or a road-side unit: what has fixes at one instant only, and no odometry, stands there throughout.

    Args:
        name: its id.
        rows: its own, in SI units and metres.
        grid: (T,) s.
        max_gap: s, of its odometry; None as in `assemble`.
        planar: whether heights were not measured, and are 0.
        tally: counts what is not used.

    Raises:
        InputError: neither odometry nor two fixes, or a speed without a heading.
    """
    dt = float(grid[1] - grid[0])
    fixes, first = fixes_of(rows, planar, tally)
    if stands(rows, fixes):
        return standing(rows, fixes, grid, tally)
    velocity, heading, text, course = _motion(name, rows, fixes, dt, max_gap, tally)
    gap = motion.bridged(velocity, dt, max_gap)
    there = motion.covered(velocity, grid, gap, max(dt, 0.6 * velocity.interval))
    u = motion.step_means(velocity, grid)
    gnss = on_steps(rows, fixes, first, grid, u, there, tally)
    there &= begun(name, gnss, there, tally)
    text = described(gnss, text, there)
    return Vehicle(gnss, np.where(there[:, None], u, np.nan), heading, text, course=course)


def fixes_of(rows: Rows, planar: bool, tally: Tally) -> tuple[Signal, Ints]:
    """Fixes (M, 3) m of a vehicle, of height 0 where none was measured, and the first row (M,) of each."""
    fixes, first = samples(rows, ("x", "y", "z"), tally, 2 if planar else 3)
    if planar:
        fixes = Signal(fixes.t, np.column_stack([fixes.value[:, :2], np.zeros(len(fixes.t))]))
    return fixes, first


def stands(rows: Rows, fixes: Signal) -> bool:
    """Whether it has fixes at one instant only, and no odometry."""
    return len(fixes.t) == 1 and not (rows.group == "odometry").any()


def begun(name: str, gnss: Floats, there: Bools, tally: Tally) -> Bools:
    """(T,) True from the first fix (T, 3) on; steps before it are counted."""
    known: Bools = np.maximum.accumulate(np.isfinite(gnss[:, 0]))
    if known.any():
        tally.refuse(f"steps of {name} before its first fix", int((there & ~known).sum()))
    return known


def described(gnss: Floats, text: str, there: Bools) -> str:
    """What was read of a vehicle, and how long it was there, in words."""
    span = "throughout" if there.all() else f"{there.mean():.0%} of the time"
    return f"{int(np.isfinite(gnss[:, 0]).sum())} fixes, {text}, {span}"


def _motion(
    name: str, rows: Rows, fixes: Signal, dt: float, max_gap: float | None, tally: Tally
) -> tuple[Signal, HeadingAt | None, str, str]:
    """Velocity at its own times, heading, where both come from in words, and the course that the heading is."""
    world, _ = samples(rows, ("vx", "vy", "vz"), tally, 2)
    speed, first = samples(rows, ("speed",), tally, 1)
    turn, _ = samples(rows, ("yaw_rate",), tally, 1)
    rate = turn if len(turn.t) > 1 else None
    derived = motion.velocity_of_fixes(fixes, motion.bridged(fixes, dt, max_gap)) if len(fixes.t) > 1 else None
    moves = ((world, "odometry"), (derived, "fixes"))
    heading, source, course = heading_from(rows, rate, moves, dt, max_gap, tally)
    if len(world.t):
        if len(speed.t):
            tally.refuse("speeds where a world velocity is given", len(speed.t), rows.place(first[0]))
        value = np.where(np.isnan(world.value), 0.0, world.value)
        text = ", ".join(filter(None, [f"{len(world.t)} velocities", source]))
        return Signal(world.t, value), heading, text, course
    if len(speed.t):
        if heading is None:
            raise InputError(
                f"{rows.place(first[0])}, speed",
                f"of {name}, which has no heading",
                "needs heading, compass_deg, or fixes of a moving vehicle",
                "Add a heading, or give vx and vy.",
            )
        turned = heading(speed.t)
        known = np.isfinite(turned)
        if not known.all():
            tally.refuse("speeds without a heading", int((~known).sum()), rows.place(first[~known][0]))
        ahead = np.column_stack([np.cos(turned), np.sin(turned), 0 * turned])[known]
        velocity = Signal(speed.t[known], speed.value[known] * ahead)
        if course:
            tally.assume(COURSE.format("{}", course), name)
        return velocity, heading, f"{len(velocity.t)} speeds, {source}", course
    if derived is None:
        hint = "Log a fix and odometry, or two fixes and more; give a road-side unit one row with x, y, z."
        raise InputError(f"vehicle {name}", f"{len(fixes.t)} fixes, no odometry", "cannot be placed", hint)
    tally.assume(DERIVED, name)
    return derived, heading, ", ".join(filter(None, ["velocity derived from them", source])), course


def heading_from(
    rows: Rows,
    rate: Signal | None,
    moves: Sequence[tuple[Signal | None, str]],
    dt: float,
    max_gap: float | None,
    tally: Tally,
) -> tuple[HeadingAt | None, str, str]:
    """Heading that was measured, else the course of the first of `moves` that moves; in words; whose course it is."""
    measured, _ = samples(rows, ("heading",), tally, 1)
    if len(measured.t):
        return motion.heading_at(measured, rate, motion.bridged(measured, dt, max_gap)), "heading measured", ""
    for moved, what in moves:
        way = motion.course(moved) if moved is not None and len(moved.t) else None
        if way is not None and len(way.t):
            return motion.heading_at(way, rate, np.inf), f"heading from the course of the {what}", what
    return None, "", ""


def on_steps(
    rows: Rows, fixes: Signal, first: Ints, grid: Floats, velocity: Floats, there: Bools, tally: Tally
) -> Floats:
    """(T, 3) fixes, each brought to the nearest step by the velocity; of several at a step the nearest in time."""
    dt = grid[1] - grid[0]
    gnss = np.full((len(grid), 3), np.nan)
    step = np.clip(np.rint((fixes.t - grid[0]) / dt).astype(np.int64), 0, len(grid) - 1)
    lag = grid[step] - fixes.t
    outside = np.abs(lag) > dt / 2 + SAME
    absent = ~there[step] & ~outside
    for wrong, reason in ((outside, "fixes outside the recording"), (absent, "fixes in gaps of the odometry")):
        if wrong.any():
            tally.refuse(reason, int(wrong.sum()), rows.place(first[wrong][0]))
    good = np.flatnonzero(~outside & ~absent)
    order = good[np.lexsort((np.abs(lag[good]), step[good]))]
    chosen = order[np.append(True, np.diff(step[order]) > 0)[: len(order)]]
    beside = np.setdiff1d(good, chosen)
    if len(beside):
        tally.refuse("fixes beside a nearer one of the same step", len(beside), rows.place(first[beside[0]]))
    after = np.minimum(step[chosen] + 1, len(grid) - 1)
    between = np.where((lag[chosen] < 0) & there[after], after, step[chosen])
    gnss[step[chosen]] = fixes.value[chosen] + lag[chosen, None] * velocity[between]
    tally.count("fixes", len(chosen))
    return gnss


def standing(rows: Rows, fixes: Signal, grid: Floats, tally: Tally) -> Vehicle:
    """What has one fix and no odometry; a heading that was measured holds throughout."""
    still = np.zeros((len(grid), 3))
    text = f"stands at ({', '.join(f'{v:.1f}' for v in fixes.value[0])}) m"
    measured, _ = samples(rows, ("heading",), tally, 1)
    heading = motion.heading_at(measured, None, np.inf) if len(measured.t) else None
    return Vehicle(still + fixes.value[0], still, heading, text, station=True)
