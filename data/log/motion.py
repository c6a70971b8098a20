"""Resampling of one member of a log to steps: fixes, velocity or speed and yaw rate, heading, presence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from coopoc.arrays import Bools, Floats, Ints, checked
from coopoc.errors import InputError
from coopoc.world.body_frames import turned
from coopoc.world.links import wrap

from ..assemble import PER_ROW, SAME, longest_gap, nearest, smooth, steps_of
from .units import Rows, Summary, in_group, place

MOVING = 1.0
"""m/s, least speed at which a course is a heading."""
STANDS = 0.5
"""m/s, a speed below which what has no heading is taken to stand."""
COURSE_RATE = 0.25
"""Half-power frequency, in fixes, of the smoother that makes velocities of fixes."""
COURSE = "the heading of {} is the course of the {}: no vehicle slips or reverses"
ARM = "fixes are those of the reference point, less the arm to the antenna, of {}; none slips or reverses"
DERIVED = "the velocity of {} is derived from the fixes: their errors depend on each other"

AHEAD: Floats = np.array([1.0, 0.0, 0.0])

HeadingAt = Callable[[Floats], Floats]


class Signal(NamedTuple):
    """Samples of a vehicle at their own times: (M,) s, increasing, and (M, C)."""

    t: Floats
    value: Floats


class Steps(NamedTuple):
    """How a log is brought to steps.

    Attributes:
        grid: (T,) s.
        max_gap: s, of odometry; None as of `longest_gap`.
        planar: whether heights were not measured, and are 0.
        body: whether speed and yaw rate stay as they were measured.
        summary: counts what is read and what is not.
    """

    grid: Floats
    max_gap: float | None
    planar: bool
    body: bool
    summary: Summary

    @property
    def dt(self) -> float:
        """s."""
        return float(self.grid[1] - self.grid[0])

    def gap(self, t: Floats) -> float:
        """s, the longest gap of samples at times (M,) that is bridged."""
        return longest_gap(t, self.dt, self.max_gap)

    def nearest(self, t: Floats) -> tuple[Ints, Floats]:
        """Nearest step of each time (M,) s, -1 outside, and how much later than the step the time is, s."""
        step, _ = steps_of(t - self.grid[0], self.dt, len(self.grid))
        return step, t - self.grid[step]


@dataclass(frozen=True, eq=False)
class Member:
    """A member of a log on T steps.

    Args:
        gnss: (T, 3) m, NaN without a fix.
        velocity: (T, 3) m/s, mean over the step that ends at each instant, in body frames forward; NaN where absent.
        heading: function from times s to headings rad, NaN where unknown; None if there is none at all.
        text: what was read, in words.
        course: what its heading is the course of, "" where it was measured.
        stands: whether it stands, as a road-side unit does.
        yaw_rate: (T,) rad/s as velocity, of body frames.
        compass: (T,) rad, NaN without a heading, of body frames.
    """

    gnss: Floats
    velocity: Floats
    heading: HeadingAt | None
    text: str
    course: str
    stands: bool
    yaw_rate: Floats
    compass: Floats


def samples(rows: Rows, names: Sequence[str], summary: Summary, required: int = 1) -> Signal:
    """Rows of one vehicle as samples (M, C) of some kinds at one time each, NaN where a kind is missing.

    Args:
        rows: in SI units.
        names: kinds, the columns of the samples.
        summary: counts samples without the first `required` kinds.
        required: how many of the kinds a sample needs.
    """
    rows = rows[rows["kind"].isin(names)]
    table = rows.pivot(index="t", columns="kind", values="value").reindex(columns=list(names))
    whole = table[list(names[:required])].notna().all(axis=1)
    reason = f"incomplete rows, without all of {', '.join(names[:required])} at one time"
    summary.refuse(reason, rows[rows["t"].isin(table.index[~whole]) & rows["kind"].isin(names[:required])])
    return Signal(table.index[whole].to_numpy(), table[whole].to_numpy(copy=True))


def member(name: str, rows: Rows, steps: Steps, arm: Any = None) -> Member:
    """A vehicle, or what stands: a road-side unit, in body frames a landmark, has fixes at one instant and no odometry.

    With an arm a, a fix z becomes that of the reference point, z - R(h) a; h is the heading that was measured, else the
    course of what moves, turned by the yaw rate in between, at both ends the nearest one.

    Args:
        name: its id.
        rows: its own, in SI units and metres.
        steps: of the recording.
        arm: (3,) m forward, left, up to the antenna; None: fixes are those of the reference point.

    Raises:
        InputError: neither odometry nor two fixes, a speed or an arm without a heading; in body frames no speed or yaw
            rate.
    """
    grid, summary, body = steps.grid, steps.summary, steps.body
    fixes = samples(rows, ("x", "y", "z"), summary, 2 if steps.planar else 3)
    if steps.planar:
        fixes.value[:, 2] = 0.0
    measured, turn, speed = (samples(rows, (kind,), summary) for kind in ("heading", "yaw_rate", "speed"))
    still: Floats = np.zeros((len(grid), 3))
    none: Floats = np.full(len(grid), np.nan)
    if len(fixes.t) == 1 and not in_group(rows, "odometry").any():
        text = f"stands at ({', '.join(f'{v:.1f}' for v in fixes.value[0])}) m{', arm left in' * (arm is not None)}"
        heading = heading_at(measured, None, np.inf) if len(measured.t) and not body else None
        return Member(still + fixes.value[0], still, heading, text, "", True, still[:, 0], none)
    derived = velocity_of_fixes(fixes, steps.gap(fixes.t)) if len(fixes.t) > 1 else None
    if arm is not None:
        off = checked(f"antenna of {name}", arm, "(3,)", (3,)) * [1, 1, 1 - steps.planar]
        world, ever = samples(rows, ("vx", "vy"), Summary(), 2), steps._replace(max_gap=np.inf)
        pointing, source = _heading(measured, turn, ((world, "odometry"), (derived, "fixes")), ever)
        if pointing is None or not np.isfinite(off).all():
            hint = f"Log heading or compass_deg, or vx and vy; a course counts above {MOVING:g} m/s."
            raise InputError(f"antenna of {name}", f"{arm} m", "needs numbers, and a heading of the vehicle", hint)
        by = f"{f'the course of the {source}' if source else 'its heading'}"
        summary.assume(ARM, f"{name} ({', '.join(map('{:g}'.format, off))} m forward, left, up, by {by})")
        fixes = Signal(fixes.t, fixes.value - turned(off, pointing(fixes.t)))
        derived = derived and velocity_of_fixes(fixes, steps.gap(fixes.t))
    if body:
        for kind, signal in (("speed", speed), ("yaw_rate", turn)):
            if not len(signal.t):
                allowed, hint = "must have speeds and yaw rates in body frames", 'Log both, or pass frame="world".'
                raise InputError(f"vehicle {name}", f"no {kind}", allowed, hint)
        summary.refuse("world velocities in body frames", rows[rows["kind"].isin(["vx", "vy", "vz"])])
        signals, course = [speed, turn], ""
        heading = heading_at(measured, turn, np.inf) if len(measured.t) else None
        along, _ = _heading(measured, turn, ((derived, "fixes"),), steps)
        forward, rate = step_means(speed, grid), step_means(turn, grid)[:, 0]
        carried: Floats = still if along is None else np.nan_to_num(forward * turned(AHEAD, along(grid)))
        velocity: Floats = forward * AHEAD
    else:
        moved, heading, course = _in_world(name, rows, (measured, turn, speed), derived, steps)
        signals, rate = [moved], none
        velocity = carried = step_means(moved, grid)
    there = np.ones(len(grid), dtype=bool)
    for signal in signals:
        interval = float(np.median(np.diff(signal.t))) if len(signal.t) > 1 else 0.0
        there &= covered(signal.t, grid, steps.gap(signal.t), max(steps.dt, 0.6 * interval))
    gnss = _fixes_on_steps(rows, fixes, carried, there, steps)
    fixed = np.maximum.accumulate(np.isfinite(gnss[:, 0]))
    if fixed.any() or not body:
        summary.refuse(f"steps of {name} before its first fix", int((there & ~fixed).sum()))
        there &= fixed
    span = "throughout" if there.all() else f"{there.mean():.0%} of the time{_longest(there, grid)}"
    text = f"{len(fixes.t)} fixes, {len(signals[0].t)} samples of odometry, {len(measured.t)} headings, {span}"
    absent, compass = np.where(there, 0.0, np.nan), none
    if body:
        kept, step, lag = _nearest_of_each(measured, there, steps)
        compass[step] = wrap(measured.value[kept, 0] - lag * rate[step])
    return Member(gnss, velocity + absent[:, None], heading, text, course, False, rate + absent, compass)


def _in_world(
    name: str, rows: Rows, body: tuple[Signal, Signal, Signal], derived: Signal | None, steps: Steps
) -> tuple[Signal, HeadingAt | None, str]:
    """Velocity at its own times, heading, and whose course the heading is; `body` are heading, yaw rate and speed."""
    summary, (measured, turn, speed) = steps.summary, body
    world, speeds = samples(rows, ("vx", "vy", "vz"), summary, 2), rows[rows["kind"] == "speed"]
    heading, course = _heading(measured, turn, ((world, "odometry"), (derived, "fixes")), steps)
    if len(world.t):
        summary.refuse("speeds where a world velocity is given", speeds)
        return Signal(world.t, np.nan_to_num(world.value)), heading, course
    standing = np.abs(speed.value[:, 0]) < STANDS
    if len(speed.t) and (heading is not None or standing.all()):
        if course:
            summary.assume(COURSE.format("{}", course), name)
        angle = np.full(len(standing), np.nan) if heading is None else heading(speed.t)
        known = np.isfinite(angle) | standing
        summary.refuse("speeds without a heading", speeds[speeds["t"].isin(speed.t[~known])])
        velocity = speed.value * np.nan_to_num(turned(AHEAD, angle))
        return Signal(speed.t[known], velocity[known]), heading, course
    if len(speed.t):
        allowed, hint = "needs heading, compass_deg, or fixes of a moving vehicle", "Add one, or give vx and vy."
        raise InputError(f"{place(speeds)}, speed", f"of {name}, which has no heading", allowed, hint)
    if derived is None:
        hint = "Log a fix and odometry, or two fixes and more; give a road-side unit one row with x, y, z."
        raise InputError(f"vehicle {name}", "no odometry, and less than two fixes", "cannot be placed", hint)
    summary.assume(DERIVED, name)
    return derived, heading, course


def _heading(
    measured: Signal, turn: Signal, moves: Sequence[tuple[Signal | None, str]], steps: Steps
) -> tuple[HeadingAt | None, str]:
    """Heading that was measured, else the course of the first of `moves` that moves, and whose course it is."""
    rate = turn if len(turn.t) > 1 else None
    if len(measured.t):
        return heading_at(measured, rate, steps.gap(measured.t)), ""
    for velocity, source in moves:
        if velocity is not None and (moving := np.hypot(*velocity.value[:, :2].T) > MOVING).any():
            east, north = velocity.value[moving, :2].T
            return heading_at(Signal(velocity.t[moving], np.arctan2(north, east)[:, None]), rate, np.inf), source
    return None, ""


def _longest(there: Bools, grid: Floats) -> str:
    """The longest gap between steps of a member, in words; none of less than a second."""
    at = np.flatnonzero(there)
    gaps = np.diff(grid[at])
    if not len(gaps) or gaps.max() < 1.0:
        return ""
    k = int(np.argmax(gaps))
    return f", longest gap {gaps[k]:.1f} s from {grid[at[k]] - grid[0]:.1f} s on"


def covered(t: Floats, at: Floats, gap: float, edge: float) -> Bools:
    """True between samples at most `gap` apart, and up to `edge` beyond a sample.

    >>> covered(np.array([0.0, 1, 5]), np.array([0.5, 2, 4.8]), 2.0, 0.3).tolist()
    [True, False, True]
    """
    right = np.clip(np.searchsorted(t, at), min(1, len(t) - 1), len(t) - 1)
    left = np.maximum(right - 1, 0)
    between = (at >= t[left] - SAME) & (at <= t[right] + SAME) & (t[right] - t[left] <= gap + SAME)
    near = np.minimum(np.abs(at - t[left]), np.abs(at - t[right])) <= edge + SAME
    return between | near


def step_means(signal: Signal, grid: Floats) -> Floats:
    """(T, C) mean over the step that ends at each instant, of the samples joined by straight lines.

    >>> speed = Signal(np.array([0.0, 1]), np.array([[0.0], [2]]))
    >>> step_means(speed, np.array([0.0, 0.5, 1])).ravel().tolist()
    [0.0, 0.5, 1.5]
    """
    dt = grid[1] - grid[0]
    means: Floats = np.diff(_integral(signal, np.append(grid[0] - dt, grid)), axis=0) / dt
    return means


def _integral(signal: Signal, at: Floats) -> Floats:
    """(G, C) integral from the first sample, which holds before it, as the last one does behind it."""
    start = signal.t[0]
    ends = np.append(at, signal.t) - start
    t = np.concatenate([[ends.min() - 1], signal.t - start, [ends.max() + 1]])
    path = scipy.interpolate.make_interp_spline(t, np.pad(signal.value, ((1, 1), (0, 0)), "edge"), k=1).antiderivative()
    return np.asarray(path(at - start) - path(0.0))


def heading_at(heading: Signal, yaw_rate: Signal | None, gap: float) -> HeadingAt:
    """Function from times (G,) s to headings (G,) rad, NaN where unknown.

    Between measured headings h_j it is W(t) + the line through h_j - W(t_j), with the integral W of the yaw rate, which
    is zero where there is none. Without a yaw rate, gaps longer than `gap` are unknown.

    >>> heading = heading_at(Signal(np.array([0.0, 1]), np.array([[3.0], [-3.1]])), None, 2.0)
    >>> heading(np.array([0.5, 9.0])).round(3).tolist()
    [3.092, nan]
    """
    turned = (lambda at: _integral(yaw_rate, at)[:, 0]) if yaw_rate is not None else np.zeros_like
    offset = np.unwrap(heading.value[:, 0] - turned(heading.t))
    sampled = heading.t if yaw_rate is None else yaw_rate.t

    def at(times: Floats) -> Floats:
        angle = wrap(np.interp(times, heading.t, offset) + turned(times))
        return np.where(covered(sampled, times, gap, gap / 2), angle, np.nan)

    return at


def velocity_of_fixes(fixes: Signal, gap: float) -> Signal:
    """Velocity (M, 3) m/s at the times of the fixes, from a smooth curve through each stretch without a gap.

    Its errors are those of the fixes: a filter that takes both for independent believes too much.
    """
    t, x = fixes.t, fixes.value
    velocity = np.zeros_like(x)
    for part in np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > gap + SAME) + 1):
        step = float(np.max([np.median(np.diff(t)), SAME, np.ptp(t[part]) / (PER_ROW * len(t))]))
        grid = np.arange(t[part[0]], t[part[-1]] + step / 2, step)
        if len(grid) > 1:
            even = np.column_stack([np.interp(grid, t[part], column) for column in x[part].T])
            slope = np.gradient(smooth(even, step, COURSE_RATE / step), step, axis=0)
            velocity[part] = np.column_stack([np.interp(t[part], grid, column) for column in slope.T])
    return Signal(t, velocity)


def _nearest_of_each(signal: Signal, there: Bools, steps: Steps) -> tuple[Ints, Ints, Floats]:
    """Index of the sample nearest in time to each step that has one while the member is there, these steps, and how
    much later the samples are, s."""
    step, lag = steps.nearest(signal.t)
    here = np.where(there[step], step, -1)
    kept = nearest(np.abs(lag), here, step, step)
    return kept, step[kept], lag[kept]


def _fixes_on_steps(rows: Rows, fixes: Signal, velocity: Floats, there: Bools, steps: Steps) -> Floats:
    """(T, 3) fixes, each brought to the nearest step by the velocity; of several at a step the nearest in time."""
    gnss, summary = np.full((len(steps.grid), 3), np.nan), steps.summary
    nearest, _ = steps.nearest(fixes.t)
    kept, step, lag = _nearest_of_each(fixes, there, steps)
    absent = (nearest >= 0) & ~there[nearest]
    beside = ~np.isin(np.arange(len(nearest)), kept) & (nearest >= 0) & ~absent
    rows = rows[rows["kind"].eq("x")]
    for why, left in (
        ("fixes outside the recording", nearest < 0),
        ("fixes in gaps of the odometry", absent),
        ("fixes beside a nearer one of the same step", beside),
    ):
        summary.refuse(why, rows[rows["t"].isin(fixes.t[left])].drop_duplicates("t"))
    after = np.minimum(step + 1, len(gnss) - 1)
    between = np.where((lag > 0) & there[after], after, step)
    gnss[step] = fixes.value[kept] - lag[:, None] * velocity[between]
    summary.count("fixes", len(kept))
    return gnss
