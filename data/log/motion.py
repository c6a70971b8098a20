"""Resampling of one member of a log to steps: fixes, velocity or speed and yaw rate, heading, presence."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy import inf, nan
from numpy.linalg import norm

from coopoc import InputError, Sensors
from coopoc.arrays import AnyArray, Bools, Floats, Ints, checked, last_true
from coopoc.kernels.constant_velocity import BANK, REMEMBERS, constant_velocity
from coopoc.world.body_frames import turned
from coopoc.world.links import wrap

from ..assemble import SAME_INSTANT, covered, longest_gap, nearest, steps_of
from .heading import (
    Course,
    Reckoning,
    Signal,
    between,
    heading_at,
    heading_of_rates,
    heading_until,
    held,
    step_means,
    unknown,
)
from .units import Rows, Summary, in_group, only, row_of

BETWEEN = (0.25, 0.5, 0.75)
"""Of the way from one speed to the next, where headings are interpolated, too: on a bend the chord is shorter."""
MOVING = 1.0
"""m/s, least speed at which a course is a heading."""
OF_FASTEST = 0.25
"""Share of its largest speed, below which what is slower than that has no course."""
LASTS = 1.0
"""s, for which errors of a gyro last beside those that are stated, which are white."""
SHOWN_STDS = 3.0
"""Standard deviations of a velocity that fixes have shown, above which it is one."""
STANDS = 0.5
"""m/s, a speed below which what has no heading is taken to stand."""
UNKNOWN_SPEED = 30.0
"""m/s, standard deviation of a velocity before fixes have shown it."""
CLIMBS = (0.5, 1.0, 2.0, 5.0, 10.0)
"""s, or halves of an interval of fixes that is longer, in which heights change where a road climbs."""
COURSE = (
    "the heading of {} is the course of the {}, between them by yaw rates if logged: assumes no slipping or reversing"
)
ARM = "fixes are moved from the antenna to the reference point, of {}; assumes no slipping or reversing"
HOLDS = "fixes that repeat while the odometry moves"
OTHER_RATES = "yaw rates are read as rad/s anticlockwise, which fixes of {} contradict: "
NO_ODOMETRY = "no odometry of {}: a nearly constant velocity is estimated from its past fixes"

UNUSED_SHARE, LEAST_FIXES = 0.05, 5
"""Share of what was logged that may be left out without a sentence; samples of which one says something."""

VELOCITIES, LEVEL = ("vx", "vy", "vz"), ("speed", "vy_body", "vz")
"""Velocity in the world, and forward, left and up once tilt is taken off."""


class Shown(NamedTuple):
    """What fixes show of a velocity.

    Attributes:
        velocity: (M, 3) m/s at the times of fixes, by these and those before.
        certain: (M,) whether they show it.
        wanders: m^2/s, by which a position that is predicted with the last one becomes uncertain.
        std: (M,) m/s, of the velocity.
        moved: (M,) m^2, by how much a position has moved otherwise than was predicted with it.
    """

    velocity: Signal
    certain: Bools
    wanders: float
    std: Floats
    moved: Floats


class Steps(NamedTuple):
    """How a log is brought to steps.

    Attributes:
        grid: (T,) s.
        max_gap: s, of odometry; None as of `longest_gap`.
        height: m, the usual one; NaN where none was measured, and all are 0.
        body: whether speed and yaw rate stay as they were measured.
        summary: counts what is read and what is not.
        offset: as of `read_log`.
    """

    grid: Floats
    max_gap: float | None
    height: float
    body: bool
    summary: Summary
    offset: Mapping[str, float] = {}

    @property
    def dt(self) -> float:
        """s."""
        return float(self.grid[1] - self.grid[0])

    @property
    def planar(self) -> bool:
        """Whether heights were not measured, and are 0."""
        return bool(np.isnan(self.height))

    def gap(self, t: Floats) -> float:
        """s, the longest gap of samples at times (M,) that is bridged."""
        return longest_gap(t, self.dt, self.max_gap)

    def nearest(self, t: Floats) -> tuple[Ints, Floats]:
        """Nearest step of each time (M,) s, of two the later one, -1 outside, and how much later than the step the time
        is, s."""
        step = steps_of(t - self.grid[0] + SAME_INSTANT, self.dt, len(self.grid))
        return step, t - self.grid[step]


class Member(NamedTuple):
    """A member of a log on T steps.

    Attributes:
        gnss: (T, 3) m, NaN without a fix.
        velocity: (T, 3) m/s, mean over the step that ends at each instant, in body frames forward; NaN where absent.
        heading: measured or derived; what wanders is the variance of a velocity or direction that fixes have shown.
        text: what was read, in words.
        stands: whether it stands, as a road-side unit does.
        yaw_rate: (T,) rad/s as velocity, of body frames.
        compass: (T,) rad, NaN without a heading, of body frames.
        moves: (T, 3) m/s, as velocity, in the world; in body frames NaN where no heading is known.
        wander: (T,) m^2/s, by which its position becomes uncertain, as fixes have shown its velocity or direction.
        climbs: m^2/s, as `climbing`, of heights whose velocity was not measured.
        shown: whether fixes alone have shown its velocity, or its direction without a gyro.
    """

    gnss: Floats
    velocity: Floats
    heading: Course
    text: str
    stands: bool
    yaw_rate: Floats
    compass: Floats
    moves: Floats
    wander: Floats
    climbs: float = 0.0
    shown: bool = False


Members = Mapping[str, Member]
"""By name."""


def stacked(members: Members, field: str) -> AnyArray:
    """(T, N, ...) a field of all members; (N,) of what is one for all times."""
    each = [getattr(member, field) for member in members.values()]
    return np.stack(each, axis=min(np.ndim(each[0]), 1))


def samples(rows: Rows, names: Sequence[str], summary: Summary, required: int = 1) -> Signal:
    """Rows of one vehicle as samples (M, C) of some kinds at the times of the first `required` ones; others are on the
    straight lines between their own samples, NaN where there are none.

    Args:
        rows: in SI units.
        names: kinds, the columns of the samples.
        summary: counts samples without the first `required` kinds.
        required: how many of the kinds a sample needs.
    """
    rows, needed = only(rows, *names), list(names[:required])
    table = rows.pivot(index="t", columns="kind", values="value").reindex(columns=list(names))
    whole = table[needed].notna().all(axis=1)
    lost, kinds = only(rows[rows["t"].isin(table.index[~whole])], *needed), ", ".join(needed)
    summary.refuse(f"incomplete rows, without all of {kinds} at one time", lost)
    if len(lost) > max(LEAST_FIXES, UNUSED_SHARE * len(only(rows, *needed))):
        summary.assume(
            f"stamps of {kinds} of {{}} differ, and over {UNUSED_SHARE:.0%} of these are not used: give all numbers of "
            "a sample the same t, rounded if need be",
            rows["vehicle"].iloc[0],
        )
    table = table.fillna(table.iloc[:, required:].interpolate("index", limit_direction="both"))[whole]
    return Signal(table.index.to_numpy(), table.to_numpy(copy=True))


def member(name: str, rows: Rows, steps: Steps, arm: Any) -> Member:
    """A vehicle, or what stands: a road-side unit, in body frames a landmark, has fixes at one instant and no odometry.

    With an arm a, a fix z becomes that of the reference point, z - R(h) a; h is the heading that was measured, else the
    course of what moves until then, turned by the yaw rate; before there is one, the first.

    Args:
        name: its id.
        rows: its own, in SI units and metres.
        steps: of the recording.
        arm: (3,) m forward, left, up to the antenna; None: fixes are those of the reference point.

    Raises:
        InputError: no fix is whole, neither odometry nor two fixes, a speed or an arm without a heading; in
            body frames no speed or yaw rate.
    """
    grid, summary, body = steps.grid, steps.summary, steps.body
    fixes = samples(rows, ("x", "y", "z"), summary, 2)
    if not fixes.size and len(parts := only(rows, "x", "y")):
        raise InputError(
            f"{row_of(parts)}, fixes of {name}",
            "never x, y (and z) at one time",
            "must have equal stamps",
            "Give all numbers of a fix the same t, rounded if need be.",
        )
    if np.isnan(fixes.value).any():
        fixes.value[:, 2] = np.nan_to_num(steps.height)
        if not steps.planar:
            summary.assume(f"heights of {{}} are {steps.height:.4g} m, the usual one: none were logged", name)
    again = pd.DataFrame(fixes.value).diff().eq(0).all(axis=1).to_numpy()
    measured, turn, speed = (samples(rows, kinds, summary) for kinds in (("heading",), ("yaw_rate",), LEVEL))
    speed = Signal(speed.t, np.nan_to_num(speed.value))
    still = np.zeros((len(grid), 3))
    none = np.full(len(grid), nan)
    if fixes.size and again[1:].all() and not in_group(rows, "odometry").any():
        text = f"stands at ({', '.join(f'{v:.1f}' for v in fixes.value[0])}) m{', arm left in' * (arm is not None)}"
        heading = Course(unknown if body else heading_at(measured, None, inf))
        return Member(still + fixes.value[0], still, heading, text, True, still[:, 0], none, still, still[:, 0])
    std = float(only(rows, "x", "y")["std"].median())
    way = Reckoning(fixes, speed, turn, std if std > 0.0 else Sensors().gnss_std[0])
    gyro = float(only(rows, "yaw_rate")["std"].median() * (turn.interval + LASTS) ** 0.5)
    if gyro > 0.0:
        way = way._replace(walk=gyro)
    shown, (derived, factor) = velocity_of_fixes(way, steps), heading_of_rates(way, steps.gap(turn.t))
    if arm is not None:
        off = checked(f"antenna of {name}", arm, "(3,)", (3,)) * [1, 1, 1 - steps.planar]
        world, ever = samples(rows, VELOCITIES[:2], Summary(), 2), steps._replace(max_gap=inf)
        pointing = _heading(measured, world, shown, derived, way, ever)
        if pointing.at is unknown or not np.isfinite(off).all():
            raise InputError(
                f"antenna of {name}",
                f"{arm} m",
                "needs numbers, and a heading of the vehicle",
                f"Log heading or compass_deg, or vx and vy; a course counts above {MOVING:g} m/s.",
            )
        by = f"by {f'the course of the {pointing.source}' if pointing.source else 'its heading'})"
        summary.assume(ARM, f"{name} ({', '.join(map('{:g}'.format, off))} m forward, left, up, {by}")
        fixes = Signal(fixes.t, fixes.value - turned(off, pd.Series(pointing.at(fixes.t)).ffill().bfill().to_numpy()))
        way = way._replace(fixes=fixes)
        shown = velocity_of_fixes(way, steps)
        derived, factor = heading_of_rates(way, steps.gap(turn.t))
    if factor != 1.0:
        mirrored = ", unless x and y of the fixes are swapped, or one of them has the other sign" * (factor < 0.0)
        summary.assume(f"{OTHER_RATES}{summary.scale(name, factor, 'yaw_rate')} mends it{mirrored}", name)
    if body:
        for kind, signal in (("speed", speed), ("yaw_rate", turn)):
            if not signal.size:
                raise InputError(
                    f"vehicle {name}",
                    f"no {kind}",
                    "must have speeds and yaw rates in body frames",
                    'Log both, or pass frame="world".',
                )
        summary.refuse("world velocities in body frames", only(rows, *VELOCITIES[:2]))
        signals, heading = [speed, turn], Course(heading_at(measured, turn, inf))
        along = _heading(measured, None, shown, derived, way, steps)
        velocity, rate = step_means(speed, grid), step_means(turn, grid)[:, 0]
        moves: Floats = turned(velocity, along.at(grid))
    else:
        moved, times, heading = _in_world(name, rows, measured, shown, derived, way, steps)
        signals, rate = [times], none
        velocity = moves = _before(shown.velocity, steps) if moved is None else moved
    there, by_fixes = _present(signals, steps) & np.isfinite(velocity[:, 0]), signals[0] is fixes
    held = _held(fixes, np.nan_to_num(moves), there, steps, again, way.std)
    if held.any():
        own = only(rows, "x")
        summary.refuse(HOLDS, own[own["t"].isin(fixes.t[held])])
        fixes = Signal(*(values[~held] for values in fixes))
        if by_fixes:
            shown, signals = velocity_of_fixes(way._replace(fixes=fixes), steps), [fixes]
            velocity = moves = _before(shown.velocity, steps)
            there, heading = _present(signals, steps), heading._replace(wanders=shown.wanders)
    gnss = _fixes_on_steps(rows, fixes, np.nan_to_num(moves), there, steps)
    fixed = np.maximum.accumulate(np.isfinite(gnss[:, 0]))
    if fixed.any() or not body:
        summary.refuse(f"steps of {name} before its first fix", int((there & ~fixed).sum()))
        there &= fixed
    text = (
        f"{fixes.size} fixes, {signals[0].size * (not by_fixes)} samples of odometry, {measured.size} headings, "
        f"{'throughout' if there.all() else f'{there.mean():.0%} of the time{_longest(there, grid)}'}"
    )
    absent, compass = np.where(there, 0.0, nan), none
    if body:
        kept, step, lag = _nearest_of_each(measured, there, steps)
        compass[step] = wrap(measured.value[kept, 0] - lag * rate[step])
    alone = heading.wanders > 0.0 and (by_fixes or turn.size < 2)
    wander = _wander(heading, moves, steps)
    if by_fixes:  # at first a velocity is less certain than later, all the way to the next fix
        wander = np.maximum(wander, np.ptp(fixes.t) / fixes.size * _before(Signal(fixes.t, shown.std), steps) ** 2)
        at, _ = steps.nearest(fixes.t)
        np.maximum.at(wander, at[at >= 0], shown.moved[at >= 0] / steps.dt)
    climbs = 0.0 if by_fixes or rows["kind"].eq("vz").any() else climbing(fixes)
    velocity, moves = velocity + absent[:, None], moves + absent[:, None]
    return Member(gnss, velocity, heading, text, False, rate + absent, compass, moves, wander, climbs, alone)


def climbing(fixes: Signal) -> float:
    """m^2/s, by which heights wander: how much more they change in a while than from one fix to the next, beyond
    chance; in the shortest of CLIMBS in which that makes more than noise does, else in the longest.

    >>> t = np.arange(60.0)
    >>> climbing(Signal(t, 0.5 * t[:, None] * [1, 1, 1])) > 0.1, climbing(Signal(t, np.zeros((60, 3))))
    (True, 0.0)
    >>> [round(climbing(Signal(t[:count], 0.5 * t[:count, None] * [1, 1, 1])), 2) for count in (4, 5)]
    [0.0, 0.17]
    """
    t, z, wander = fixes.t, fixes.value[:, 2], 0.0
    least = max(1.0, 0.5 * fixes.interval)
    for times in CLIMBS:
        later = np.searchsorted(t, t + times * least)
        now = np.flatnonzero(later < len(t))
        if len(now) < 3:
            break
        near, far = (float(np.quantile(abs(gap), 0.75) / 1.15) ** 2 for gap in (np.diff(z), z[later[now]] - z[now]))
        near *= 1.0 + 2.0 / len(now) ** 0.5
        wander = max(far - near, 0.0) / float(np.mean(t[later[now]] - t[now]))
        if far > 2.0 * near:
            break
    return wander


def _in_world(
    name: str, rows: Rows, measured: Signal, shown: Shown, derived: Course | None, way: Reckoning, steps: Steps
) -> tuple[Floats | None, Signal, Course]:
    """Velocity (T, 3), NaN where its direction is unknown, None where the fixes have to show it; the samples that it is
    of; and the heading, by `measured` ones or derived."""
    summary, speed = steps.summary, way.speed
    world, speeds = samples(rows, VELOCITIES, summary, 2), only(rows, *LEVEL[:2])
    heading = _heading(measured, world, shown, derived, way, steps)
    if len(world.t):
        summary.refuse("speeds where a world velocity is given", speeds)
        moved = step_means(Signal(world.t, np.nan_to_num(world.value)), steps.grid)
        return moved, world, heading._replace(wanders=0.0, of_pace=np.zeros_like)
    if speed.size and (heading.at is not unknown or norm(speed.value.mean(0)) < STANDS):
        if heading.source:
            summary.assume(COURSE.format("{}", heading.source), name)
        at = np.unique(np.concatenate([speed.t, *(speed.t[:-1] + part * np.diff(speed.t) for part in BETWEEN)]))

        def moving(at: Floats) -> Floats:
            """(G, 3) m/s, NaN where something moves, and no heading is known."""
            own, angle = between(speed, at), heading.at(at)
            stands = np.isnan(angle) & ((norm(own, axis=1) < STANDS) | (heading.at is unknown))
            return np.where(stands[:, None], 0.0, turned(own, angle))

        velocity = moving(at)
        kept, own = np.isfinite(velocity[:, 0]), np.isin(at, speed.t)
        summary.refuse("speeds without a heading", speeds[speeds["t"].isin(at[own & ~kept])])
        means = step_means(Signal(at[kept], velocity[kept]), steps.grid) + 0.0 * moving(steps.grid + 0.5 * steps.dt)
        beside = [steps.offset.get(f"{name}.{axis}", steps.offset.get(axis, 0.0)) for axis in VELOCITIES[:2]]
        return means - [*beside, 0.0], Signal(at[own & kept], at), heading
    if speed.size:
        raise InputError(
            f"{row_of(speeds)}, speed",
            f"of {name}, which has no heading",
            "needs heading, compass_deg, or fixes of a moving vehicle",
            "Add one, or give vx and vy.",
        )
    if way.fixes.size < 2:
        raise InputError(
            f"vehicle {name}",
            "no odometry, and less than two fixes",
            "cannot be placed",
            "Log a fix and odometry, or two fixes and more; give a road-side unit one row with x, y, z.",
        )
    summary.assume(NO_ODOMETRY, name)
    summary.refuse("velocities aside or up without the others", only(rows, *LEVEL))
    return None, way.fixes, heading._replace(wanders=shown.wanders)


def _heading(
    measured: Signal, world: Signal | None, shown: Shown, derived: Course | None, way: Reckoning, steps: Steps
) -> Course:
    """Heading that was measured, else by the yaw rate and fixes, else the course of the velocities in the world that
    were measured, else of those that fixes have shown."""
    rate = way.yaw_rate if way.yaw_rate.size > 1 else None
    if measured.size:
        return Course(heading_at(measured, rate, steps.gap(measured.t)))
    if derived is not None:
        return derived
    sources = [("fixes", shown)]
    if world is not None:
        none = np.zeros(len(world.t))
        sources.insert(0, ("odometry", Shown(world, none == 0, 0.0, none, none)))
    for source, (velocity, certain, wanders, unsure, _) in sources:
        pace = np.hypot(*velocity.value[:, :2].T)
        fastest = abs(way.speed.value).max() if way.speed.size else inf
        if (moving := (pace > np.maximum(min(MOVING, OF_FASTEST * fastest), SHOWN_STDS * unsure)) & certain).any():
            t, course = velocity.t[moving], np.arctan2(*velocity.value[moving, 1::-1].T)
            if way.speed.size:
                course = wrap(course - np.arctan2(*between(way.speed, t)[:, 1::-1].T))
            bends = norm(wrap(np.diff(course))) / (norm(pace[moving][1:] * np.diff(t)) + MOVING)
            courses, std = heading_until(Signal(t, course[:, None]), rate), unsure[moving] / pace[moving]
            shown_at = t[: len(t) * (rate is None)]
            usual, turning = float(np.median(std)), float(bends)
            return Course(courses, source, wanders, np.zeros_like, usual, velocity.interval, shown_at, turning)
    return Course()


def _wander(heading: Course, moves: Floats, steps: Steps) -> Floats:
    """(T,) m^2/s, by which a position becomes uncertain: `heading.wanders`, that of its pace, and where a course is
    held for longer than fixes are apart, by d/dt of (k s^2 / 2)^2, with the bends k of the way s since then, of s^2 at
    most."""
    pace = norm(np.nan_to_num(moves), axis=1)
    more: Floats = heading.of_pace(steps.grid) * pace ** (4 / 3)
    if heading.wanders > 0.0 and len(heading.shown) > 1:
        way = np.cumsum(pace) * steps.dt
        last = heading.shown[np.searchsorted(heading.shown, steps.grid).clip(1) - 1] + steps.gap(heading.shown)
        s = (way - np.interp(last, steps.grid, way)).clip(0.0)
        more = np.minimum(heading.bends**2 * s**3, 2.0 * s) * pace
    return heading.wanders + more


def _longest(there: Bools, grid: Floats) -> str:
    """The longest gap between steps of a member, in words; none of less than a second."""
    at = grid[there]
    gaps = np.append(0.0, np.diff(at))
    k = gaps.argmax()
    return f", longest gap {gaps[k]:.1f} s from {at[k - 1] - grid[0]:.1f} s on" if gaps[k] >= 1.0 else ""


def velocity_of_fixes(way: Reckoning, steps: Steps) -> Shown:
    """Velocity by fixes, by a Kalman filter (`kernels.constant_velocity`). It is known by
    four of them at the latest, or as well as by two that are as far apart as nine in ten."""
    (t, x), variance = way.fixes, way.std**2
    if len(t) < 2:
        none = np.zeros(len(t))
        return Shown(Signal(t, np.zeros_like(x)), none > 0, 0.0, none, none)
    apart = np.diff(t)
    interval = float(np.median(apart))
    velocity, growth, spread, proved, moved = constant_velocity(
        t, x, interval, steps.gap(t) + SAME_INSTANT, variance, UNKNOWN_SPEED, BANK
    )
    sure = np.isfinite(growth)
    since = np.arange(len(growth)) - last_true(~sure)
    begun = since > 1  # two fixes show no change
    learned = begun & (t > t[0] + REMEMBERS)
    grown = np.where(begun, growth * np.maximum(proved, variance), 0.0)
    known = grown[learned if learned.any() else begun]
    wanders = float(known.mean() / interval) if len(known) else 0.0
    moved = np.maximum(grown, np.maximum(moved, np.append(0.0, moved[:-1])))  # the next fix decides
    certain = (since > 3) | (sure & (spread * np.quantile(apart, 0.9) ** 2 < 2.0))
    return Shown(Signal(t, velocity), certain, wanders, np.sqrt(proved * spread), moved)


def _before(signal: Signal, steps: Steps) -> Floats:
    """(T, ...) last sample before each step, 0 where there is none."""
    return held(signal, steps.grid - 0.5 * steps.dt - 2.0 * SAME_INSTANT, 0.0)


def _nearest_of_each(signal: Signal, there: Bools, steps: Steps) -> tuple[Ints, Ints, Floats]:
    """Index of the sample nearest in time to each step that has one while the member is there, these steps, and how
    much later the samples are, s."""
    step, lag = steps.nearest(signal.t)
    kept = nearest(abs(lag), np.where(there[step], step, -1), step)
    return kept, step[kept], lag[kept]


def _present(signals: Sequence[Signal], steps: Steps) -> Bools:
    """(T,) whether all signals are there, or bridged."""
    there = np.ones(len(steps.grid), bool)
    for signal in signals:
        there &= covered(signal.t, steps.grid, steps.gap(signal.t), max(steps.dt, 0.6 * signal.interval))
    return there


def _held(fixes: Signal, velocity: Floats, there: Bools, steps: Steps, again: Bools, std: float) -> Bools:
    """(M,) fixes that are as the one before (`again`), though what moves has gone on by their standard deviation."""
    nearest, _ = steps.nearest(fixes.t)
    moves = there & (norm(velocity, axis=1) > STANDS)
    way = np.cumsum(np.where(moves[:, None], velocity, 0.0) * steps.dt, 0)[nearest]
    return np.asarray(again & there[nearest] & (norm(way - way[last_true(~again)], axis=1) > std))


def _fixes_on_steps(rows: Rows, fixes: Signal, velocity: Floats, there: Bools, steps: Steps) -> Floats:
    """(T, 3) fixes, each brought to the nearest step by the velocity; of several at a step the nearest in time."""
    gnss, summary, rows = np.full((len(steps.grid), 3), nan), steps.summary, only(rows, "x")
    nearest, _ = steps.nearest(fixes.t)
    kept, step, lag = _nearest_of_each(fixes, there, steps)
    absent = ~there[nearest]
    beside = ~np.isin(np.arange(len(nearest)), kept) & ~absent
    for why, left in (
        ("fixes in gaps of the odometry", absent),
        ("fixes beside a nearer one of the same step", beside),
    ):
        summary.refuse(why, rows[rows["t"].isin(fixes.t[left])].drop_duplicates("t"))
    after = np.minimum(step + 1, len(gnss) - 1)
    gnss[step] = fixes.value[kept] - lag[:, None] * velocity[np.where((lag > 0) & there[after], after, step)]
    summary.count("fixes", len(kept))
    return gnss
