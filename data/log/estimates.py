"""Errors of a log's clocks, odometry, antennas and pairs, with standard errors by parts of the drive."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy  # as in `residuals`
from numpy import inf, nan
from numpy.linalg import inv, lstsq, norm
from scipy.sparse import csr_array, hstack

from coopoc.arrays import AnyArray, Bools, Floats, Ints
from coopoc.evaluate.metrics import dimensions
from coopoc.workers import progress_bar
from coopoc.world.links import wrap

from .motion import COURSE, MOVING, OF_FASTEST
from .residuals import Check, distances, filtered, in_space, plane, residual_of

PERHAPS, SURE_ERRORS, SURE_CLOCK_ERRORS = 2.0, 4.0, 5.0
"""Standard errors beyond which an estimate may be more than chance; is significant, of many in a few logs; and one of
clocks and ranges."""
MAY = "may be"
"""Words of a sentence on an error that is beyond PERHAPS of its standard errors, and not beyond SURE_ERRORS."""
LEAST_LAG, LEAST_SCALE, LEAST_TURN, LEAST_DRIFT = 0.02, 0.01, 0.02, 2e-3
"""Least errors that are reported: of a clock, s; of odometry, share of a speed, rad, rad/s."""
BESIDE, BEHIND = 0.1, 0.1
"""m/s, least velocity across that of the odometry, and s, least lag of fixes behind it, that are reported."""
LEAST_FORWARD = 0.1
"""Share of a velocity along which odometry counts, or back, that shows by what it is late."""
UNITS_APART = 0.2
"""Relative error of lengths from which their unit is wrong."""
LEAST_COUNT, MIN_SAMPLES, CONSTANT = 20, 6, 1e-9
"""Measurements from which a statistic is reported, and from which causes are estimated; of a cause that is constant but
for rounding, what its changes are at most."""
FEW_PARTS, SURELY = 10, 3e-5
"""Parts of a drive below which a standard error is itself uncertain; chance of SURE_ERRORS to one side."""
MOVED_STDS = 10.0
"""Standard deviations of a fix that odometry must have moved, so that noise does not look like motion."""
LEAST_CORRELATION = 0.97
"""Correlation of the displacements of fixes and odometry that noise alone does not reach."""
MIN_OWN_SHARE = 0.02
"""Least share of a cause's sum of squares that no other cause explains, so that it can be separated."""
OUTLYING, TENTHS, DRIVE_PARTS = 5.0, 10, 40
"""Multiples of the median residual beyond which one is left out; parts of a drive in which a filter is judged, and
those whose estimates give the standard error."""
CONFIDENT_RATIO = 3.0
"""Ratio of errors to the standard deviations that a filter states, in a part of the drive, from which it is
reported."""
RARE = 1e-6
"""Chance of squared innovations from which they are beyond it."""
SMALL_NIS = 0.5
"""Mean NIS below which errors of fixes are correlated in time, or smaller than stated."""
ERRORS_LAST = 1.5
"""Factor of the standard errors of clocks: errors of two filters may last for most of a short drive."""
LONG_LAG = 2.0
"""s, from which a lag is searched for: shorter ones are estimated linearly."""
LONGEST_LAG, LAG_STEP = 60.0, 0.1
"""s, longest lag of the search, and its step."""
STEADY_SPEED_RATIO, NUDGE_STEP = 0.15, 0.01
"""Standard deviation over mean of a speed below which an arm ahead and a late clock look alike; m and s by which fixes
are moved to see what a filter makes of an arm."""


class Estimate(NamedTuple):
    """Numbers (k,) and their standard errors, infinite where nothing shows them."""

    value: Floats
    error: Floats


def no_estimate(count: int) -> Estimate:
    """Of so many numbers, which nothing shows."""
    return Estimate(np.zeros(count), np.full(count, inf))


def factors(
    y: AnyArray, x: Any, noise: float, groups: Ints | None = None, z: Any = None, parts: int = DRIVE_PARTS
) -> Estimate:
    """Factors (z^T x)^-1 z^T y of causes x (M, k) that explain y (M,), outliers aside, less the means of groups (M,);
    and standard errors, as leaving out each of some parts of the drive changes them. None is known where half of y
    stays, and that is OUTLYING times its noise: something else is wrong.

    The instruments z (M, k), x itself if not given, are causes without the noise that is in both x and y. Both may be
    sparse.

    >>> time = np.arange(40.0)
    >>> factors(3 * time + 7, time[:, None], 0.1, np.zeros(40, int)).value.round(6).tolist()
    [3.0]
    """
    none, count, size = no_estimate(x.shape[1]), x.shape[1] + 1, len(y)
    every = hstack([csr_array(each) for each in (y[:, None], x, x if z is None else z)], "csr")
    if groups is not None:
        every = less_means(every, groups)
    whole, varying = (np.asarray(abs(each).sum(0)) for each in (x, every[:, 1:count]))
    seen = varying > CONSTANT * whole
    causes, k = 1 + np.flatnonzero(seen), int(seen.sum())
    if size < MIN_SAMPLES or not k:
        return none
    yx, z = every[:, np.r_[0, causes]], every[:, count - 1 + causes]
    row, cause = z.nonzero()
    other = yx[row].tocoo()  # what a row adds to the sums: of many causes it has a few
    row, cause = row[other.row], cause[other.row]
    products = (z[row, cause].conj() * other.data).real, (row, cause * (k + 1) + other.col)
    terms = csr_array(products, (size, k * (k + 1)))

    def gap_of(factor: Floats) -> Floats:
        return np.asarray(abs(yx @ np.r_[1.0, -factor]))

    def fitted(used: Bools) -> Floats:
        factor = np.zeros(k)
        for _ in range(3):
            sums = (used @ terms).reshape(k, k + 1)
            factor = lstsq(sums[:, 1:], sums[:, 0])[0]
            gap = gap_of(factor)
            used = used & (gap <= OUTLYING * np.median(gap[used]))
        return factor

    at = np.arange(size)
    value = fitted(at >= 0)
    before, left = (float(np.median(gap_of(factor))) for factor in (0.0 * value, value))
    if left > max(OUTLYING * noise, 0.5 * before):
        return none
    count = min(parts, max(size // 2, min(size, FEW_PARTS)))
    changes = value - np.stack(
        [fitted(at * count // size != part) for part in progress_bar(range(count), "check", delay=2.0)]
    )
    none.value[seen], none.error[seen] = value, lasting(changes)
    return none


def less_means(x: Any, groups: Ints) -> Any:
    """Sparse x (M, k) less the means of its groups (M,)."""
    here, size = np.arange(len(groups)), len(groups)
    of = csr_array((np.ones(size), (np.unique(groups, return_inverse=True)[1], here)), (size, size))
    return x - of.T @ (of @ x).multiply(1.0 / np.maximum(of.sum(1), 1.0)[:, None])


def lasting(parts: Floats) -> Floats:
    """Standard error (k,) of a sum of errors in parts (P, k) of a drive, each of which is correlated with the next, as
    of an autoregression of first order; the correlation of few is too small by chance (Kendall, Biometrika 41, 1954).
    Of parts that are worth less than FEW_PARTS independent ones it is larger, as Student's t is, so that SURE_ERRORS of
    it are as sure.

    >>> wander = np.cumsum(np.random.default_rng(0).normal(size=(40, 1)), axis=0)
    >>> bool(lasting(wander)[0] > 20.0 * 40**0.5 * wander.std())
    True
    """
    errors, count = parts - parts.mean(0), len(parts)
    square = np.square(errors).sum(0)
    next_to = (errors[1:] * errors[:-1]).sum(0) / np.maximum(square, 1e-300)
    correlation = ((count * next_to + 1.0) / (count - 4.0)).clip(0.0, 0.95)
    longer = (1.0 + correlation) / (1.0 - correlation)
    few = scipy.stats.t.isf(SURELY, (count / longer).clip(2.0, FEW_PARTS) - 1.0)
    error: Floats = few / scipy.stats.t.isf(SURELY, FEW_PARTS - 1.0) * np.sqrt(square * longer)
    return error


def causes(c: Check) -> tuple[AnyArray, AnyArray, AnyArray]:
    """What fixes are off by, x + iy m (T, N), and what an arm of 1 m ahead, one to the left, a clock, and speeds alone
    that are 1 s late make of it (4, T, N): against the truth, else against a filter, which is linear in what is added
    to fixes; and instruments, by a later velocity: the filter errs by the noise of those until then. Headings that are
    late are a clock without the speeds."""
    rec, truth = c.world, c.log.truth
    velocity = plane(rec.velocity[0] if truth is None else truth.velocity)
    speed = pd.DataFrame(abs(velocity)).where(lambda v: v > MOVING)
    course = pd.DataFrame(np.angle(velocity)).where(speed > 0).ffill().bfill().to_numpy()
    ahead = np.nan_to_num(np.exp(1j * course)) * np.array(speed.std() > STEADY_SPEED_RATIO * speed.mean())
    gained = np.diff(abs(np.nan_to_num(velocity)), axis=0, prepend=0.0) * np.nan_to_num(np.exp(1j * course))
    made = np.stack([ahead, 1j * ahead, velocity, np.cumsum(gained, axis=0)])
    if truth is not None:
        return plane(rec.gnss[0] - truth.position), made, made
    then = np.nan_to_num(following(c, made, axis=1))
    for k, cause in enumerate(np.nan_to_num(NUDGE_STEP * made)):
        moved = replace(c.log.recording, gnss=c.log.recording.gnss + in_space(cause))
        made[k] = plane(filtered(replace(c.log, recording=moved)).fix - c.fix) / NUDGE_STEP
    return plane(c.fix), made, then


def following(c: Check, of_step: AnyArray, axis: int = 0) -> AnyArray:
    """What is of each step, of the one two samples of the odometry later, as two steps may share one; the last at the
    end."""
    at = np.arange(of_step.shape[axis]) + 2 * max(round(c.log.summary.odometry / c.world.dt), 1)
    return of_step.take(at, axis, mode="clip")


def moves(c: Check, column: int, means: int = 1) -> AnyArray:
    """(5, M) displacements m, x + iy, of the fixes and of the odometry over the same spans, in which the odometry (if
    that stands still, the fixes) moves far; by what velocity and acceleration change over a span, as fixes are off that
    are late, or smoothed; and how long it is, s. M = 0 where too little moves. On a short way the means of several
    fixes are less noisy. In body frames true headings direct the odometry: a filter turns its own until fixes agree."""
    rec = c.world
    fixes, velocity = plane(rec.gnss[0, :, column]), plane(rec.velocity[0, :, column])
    heading = getattr(c.log.truth, "heading", None)
    if c.in_body and heading is not None and np.isfinite(heading[:, column]).any():
        velocity = plane(c.log.recording.velocity[0, :, column]) * np.exp(1j * heading[:, column])
    path, gaps = np.cumsum(np.nan_to_num(velocity) * rec.dt), np.cumsum(np.isnan(velocity))
    walk = rec.dt * np.mean(rec.sensors.velocity_std(np.nan_to_num(rec.velocity), rec.sensors.velocity_floor))
    at = np.flatnonzero(np.isfinite(fixes))
    parts = at[: len(at) // means * means].reshape(-1, means)
    parts = parts[gaps[parts[:, 0]] == gaps[parts[:, -1]]]
    pace = np.gradient(path, rec.dt)
    numbers = np.stack([fixes, path, pace, np.gradient(pace, rec.dt), rec.t])[:, parts].mean(2)
    (fixes, path), at = numbers[:2], parts[:, 0]
    gaps = gaps[at]
    least = (MOVED_STDS if means == 1 else MOVED_STDS / 3) * c.fix_noise / means**0.5
    for places, far in ((path, least), (fixes, 2 * least)):
        pairs, last = [], 0
        for k in range(1, len(at)):
            if gaps[k] != gaps[last]:
                last = k
            elif abs(places[k] - places[last]) > max(far, OUTLYING * walk * (at[k] - at[last]) ** 0.5):
                pairs.append((last, k))
                last = k
        if len(pairs) >= 3:
            a, b = np.array(pairs).T
            return np.asarray(numbers[:, b] - numbers[:, a])
    return np.empty((5, 0))


def ratio_of_moves(c: Check, column: int) -> complex | None:
    """Displacements of a vehicle's fixes over those of its odometry, if one factor and their noise explain them."""
    moved, driven, *_ = moves(c, column)
    ratio = np.vdot(driven, moved) / max(float(norm(driven)) ** 2, 1e-12)
    most = max(2 * c.fix_noise * (2 * len(moved)) ** 0.5, (1 - LEAST_CORRELATION**2) ** 0.5 * norm(moved))
    return ratio if len(moved) and norm(moved - ratio * driven) < most else None


def odometry(c: Check, column: int) -> Estimate:
    """Errors of a vehicle's odometry against the truth, else the fixes, in body frames else the filter.

    By what share speeds are too large; by what directions are turned, rad, or in body frames yaw rates too large,
    rad/s; by what it is later than a truth, or fixes later than it, s; with which velocity the vehicle moves beside it,
    m/s east and north.
    """
    rec, truth, body = c.world, c.log.truth, c.log.recording.body
    none = no_estimate(5)
    if c.shown(column):
        return none
    velocity = rec.velocity[0, :, column, :2]
    noise = np.nan_to_num(rec.sensors.velocity_std(velocity, rec.sensors.velocity_floor))
    if truth is None and body is not None:
        none.value[:2], none.error[:2] = c.lasting[:, column]
        none.error[0] = np.hypot(none.error[0], np.square(noise).sum() / max(np.nansum(np.square(velocity)), 1e-12))
        return none
    if truth is None:
        each = moves(c, column)
        if each.shape[1] < LEAST_COUNT:
            each = moves(c, column, max(int(np.isfinite(rec.gnss[0, :, column, 0]).sum()) // (3 * LEAST_COUNT // 2), 1))
        moved, driven, turns, bends, span = each
        causes = np.stack([driven, 1j * driven, turns, bends])
        y = moved - driven
        if rec.ids[column] in c.log.summary.assumed.get(COURSE.format("{}", "fixes"), ()):
            along = driven.conj() / abs(driven)  # across, a heading that is derived follows the fixes
            shares = (causes * along).real * [[1.0], [0.0], [1.0], [1.0]]  # what rounding leaves of a turn is none
            y, causes, span = (y * along).real + 0j, shares + 0j, 0.0 * span
        value, error = _of_motion(y, causes, span, 2**0.5 * c.fix_noise)
        attenuation = np.square(norm(noise) * rec.dt / (norm(driven) or 1.0))  # by noise of the cause
        turned = (1 + complex(*value[:2])) * (1 + attenuation)
        if abs(turned.real) < LEAST_FORWARD:
            return none
        value[:2], value[2] = _polar(1 / turned), -value[2] / turned.real
        error[2] /= abs(turned.real)
        error[:2] = np.hypot(error[:2], attenuation) / abs(turned) ** 2
        if abs(value[2]) > max(5.0 * BEHIND, SURE_ERRORS * error[2]):  # smoothed fixes cut bends: all else seems wrong
            error[[0, 1, 3, 4]] = inf
        return Estimate(value, error)
    true = np.diff(plane(truth.position[:, column]), prepend=nan) / rec.dt  # as odometry, the mean over a step
    odometer = velocity @ [1, 1j]
    if body is not None:
        odometer = c.log.recording.velocity[0, :, column, 0].astype(complex)
        along = abs(true) if truth.heading is None else (true * np.exp(-1j * truth.heading[:, column])).real
        true = along.astype(complex)
    x = np.stack([true, 1j * true, np.gradient(true, rec.dt)])
    used = np.isfinite(odometer + x.sum(0))
    pace = np.maximum(abs(true), abs(odometer))
    used &= pace > min(MOVING, OF_FASTEST * np.nanmax(pace, initial=0.0))  # standing, nothing errs
    constant, usual = np.full(used.sum(), -1.0 if body is None else 0.0), norm(noise) / len(noise) ** 0.5
    value, error = _of_motion((odometer - true)[used], x[:, used], constant, usual)
    forward = 1 + value[0]
    late = -value[2] / forward if abs(forward) > LEAST_FORWARD else inf
    value[:3] = *_polar(1 + complex(*value[:2])), late
    error[2] = error[2] / abs(forward) if abs(late) < LONG_LAG else inf  # what is linear in a lag holds for small ones
    if body is not None:
        error[1] = inf
        if truth.heading is not None:
            gap = body.yaw_rate[0, 1:, column] - wrap(np.diff(truth.heading[:, column])) / rec.dt
            value[1], error[1] = median(gap[np.isfinite(gap)])
    return Estimate(value, error)


def _of_motion(y: AnyArray, x: AnyArray, constant: AnyArray, noise: float) -> Estimate:
    """Factors (5,) by which causes x (K, M), a size, a turn, a lag and what else may be, explain y (M,), and a constant
    velocity that is made of `constant` (M,). What is within two standard errors is left out, the constant first, and
    what looks like another cause, which make up all but MIN_OWN_SHARE of it, as a lag does on a bend at one speed."""
    made = no_estimate(5)
    for causes, extra in ((np.r_[x, [constant, 1j * constant]], [-2, -1]), (x, [2]), (x[:2], [])):
        unit = np.hstack([causes.real, causes.imag])
        unit /= np.maximum(norm(unit, axis=1, keepdims=True), 1e-12)
        alone = 1.0 / np.diag(inv(unit @ unit.T + 1e-9 * np.eye(len(unit))))
        if extra and ((alone < MIN_OWN_SHARE) & unit.any(1)).any():
            continue
        explained = factors(y, causes.T, noise)
        if norm(explained.value[extra]) >= 2.0 * norm(explained.error[extra]):
            break
    of_causes = min(len(causes), 3)
    for whole, part in zip(made, explained, strict=True):
        whole[:of_causes] = part[:of_causes]
        if len(extra) == 2:
            whole[3:] = part[extra]
    return made


def _polar(turned: complex) -> Floats:
    """Excess of its size over 1, and its angle, rad."""
    return np.array([abs(turned) - 1.0, np.angle(turned)]) if turned else np.zeros(2)


def clocks(c: Check, alike: bool, reference: int | None = None) -> tuple[Estimate, list[Any], Ints]:
    """By what each vehicle's clock is ahead of that of a reference, or of one that most agree with, s; if `alike`, by
    what share all ranges are too long, and by what they are late, s: (N + 2,), what a range and what a direction
    misses for 1 of each (L, K) that may be other than 0, and which these are: the clock of what stands shows nowhere.

    Where i measures j, whose stamps are d s ahead of i's, it is u v_j d longer than between the filters, u being the
    unit vector from i to j; where ranges are d s late, u (v_i - v_j) d.
    """
    world = c.world
    links, size = world.links, len(world.ids)
    gap, _ = residual_of(world, c.x)
    flat, far = distances(gap)
    which = np.append(np.flatnonzero(~c.still), [size, size + 1])
    used = (which < size + 2 * alike) & (which != reference)
    eye = csr_array(np.eye(size)[:, which[:-2]])
    ends = eye[links.neighbour] - eye[links.observer]

    def made_by(velocity: Floats) -> list[Any]:
        moves = velocity[links.step, links.neighbour]
        along = np.vecdot(gap, moves) / far
        across = (gap[:, 0] * moves[:, 1] - gap[:, 1] * moves[:, 0]) / flat**2
        rate = np.vecdot(gap, velocity[links.step, links.observer] - moves) / far
        of_all = (along, np.column_stack([far, rate])), (across, np.zeros((len(far), 2)))
        return [hstack([ends * each[:, None], csr_array(alike)], "csr")[:, used] for each, alike in of_all]

    velocity = np.nan_to_num(world.velocity[0])
    made, then = made_by(velocity), made_by(following(c, velocity))
    which = which[used]
    there = np.isfinite(c.relative[:, 0] + gap[:, 0])
    pairs = np.sort([links.observer, links.neighbour], 0)
    noise = np.median(c.expected[there, 0]) if there.any() else 0.0
    x, z, groups = made[0][there], then[0][there], (pairs[0] * size + pairs[1])[there]
    value, error = no_estimate(size + 2)
    parts = 2 if reference is None else DRIVE_PARTS  # to find one takes no errors
    value[which], error[which] = factors(c.relative[there, 0], x, noise, groups, z, parts)
    measured = np.unique(pairs[:, there])
    stay = max(noise**2 - world.sensors.range_std**2, 0.0) * share(c) / np.where(which < size, 2, len(measured) or 1)
    varied = np.maximum(less_means(x, groups).power(2).sum(0), 1e-12) / np.maximum((x != 0.0).sum(0), 1)
    error[which] = np.fmax(error[which], (stay / varied) ** 0.5)  # the filters' errors may last for the drive
    error[measured[measured == reference]] = 0.0
    if reference is None and len(measured):
        apart = abs(np.subtract.outer(value[measured], value[measured]))
        return clocks(c, alike, measured[np.argmin((np.minimum(apart, LEAST_LAG) + 1e-3 * apart).sum(1))])
    return Estimate(value, ERRORS_LAST * error), made, which


def share(c: Check) -> float:
    """Share of the variance of filters that the mean over the drive keeps: their errors last for some time, and what
    fixes err by beyond their innovations, where these are small, may be there throughout."""
    variance, nis = pd.DataFrame(c.variance[..., :2].mean(2)).mean(), pd.DataFrame(c.normalised).mean()
    ratio = variance + (fixes := np.square(c.world.sensors.fix_std[:2]).mean())
    ratio /= (variance * np.isfinite(c.normalised).sum(0)).clip(1e-12)
    share = min(2.0 * float(ratio.where(variance > 0.0, 0.0).max()), 1.0)
    return max(share, float(((1.0 - nis) * fixes / variance)[nis < SMALL_NIS].max()))


def median(values: Floats) -> tuple[float, float]:
    """Median, and its standard error by the medians of parts of the drive; infinite of too few."""
    if len(values) < LEAST_COUNT:
        return 0.0, inf
    parts = np.array([np.median(part) for part in np.array_split(values, min(DRIVE_PARTS, len(values) // 2))])
    return float(np.median(values)), float(lasting(parts[:, None])[0] / len(parts))


def pairs(c: Check, k: int, directed: bool) -> "pd.Series[str]":
    """Who measured whom, or between which two if not `directed`: of the links that have a residual of one kind."""
    links, ids = c.world.links, np.array(c.world.ids, object)
    there = np.flatnonzero(np.isfinite(c.relative[:, k]))
    ends = np.column_stack([links.observer, links.neighbour])[there]
    one, other = ids[ends if directed else np.sort(ends)].T
    return pd.Series(one + (" to " if directed else " and ") + other, there)


def lag_of_fixes(c: Check, column: int) -> float:
    """s, by which fixes are late beside the odometry, or a truth, if a lag alone explains how they move from one to
    that LEAST_COUNT later, else 0; of a way that repeats the least."""
    rec, truth = c.world, c.log.truth
    if truth is None and c.shown(column):
        return 0.0
    velocity, fixes = plane(rec.velocity[0, :, column]), plane(rec.gnss[0, :, column])
    path = np.cumsum(np.nan_to_num(velocity) * rec.dt) + 0.0 * velocity  # unknown where it is absent
    path = path if truth is None else plane(truth.position[:, column])
    there = np.isfinite(fixes)
    lags = np.arange(-LONGEST_LAG, LONGEST_LAG, LAG_STEP)
    later = (np.interp(rec.t[there] - lag, rec.t, path, nan, nan) for lag in [0.0, *lags])
    places = np.stack([fixes[there], *later])
    moved = places[:, LEAST_COUNT:] - places[:, :-LEAST_COUNT]
    off = abs(moved[0] - moved[1:])
    misses = np.where(np.isfinite(off).sum(1) > off.shape[1] / 2, pd.DataFrame(off.T).median(), inf)
    now, least, misses = misses[0], misses.min(), misses[1:]
    if least > min(OUTLYING * c.fix_noise, now / 2):
        return 0.0
    near = abs(lags - min(lags[misses < 1.2 * least], key=abs)) < LONG_LAG
    return float(lags[near][misses[near].argmin()])


def _beside(off: AnyArray, velocity: AnyArray) -> float:
    """By what fixes that are off by (T,) m lie beside the truth, m, however late they are; 0 where there are none. At
    one velocity a lag is no explanation."""
    finite = np.isfinite(off + velocity)
    beside = abs(lstsq(np.column_stack([np.ones(finite.sum()), velocity[finite]]), off[finite])[0][0])
    return float(min(beside, abs(off[finite].mean())) if finite.any() else 0.0)


def against_truth(c: Check, late: Sequence[str]) -> Check:
    """The same, with ranges, and directions by headings that are known, against the truth where both ends have one that
    their fixes fit, or one stands without a truth; without those of vehicles whose fixes do not fit, and as they are of
    those that are `late`. Positions are those of the truth, where it counts."""
    truth, rec, noise = c.log.truth, c.world, c.world.sensors
    if truth is None:
        return c
    marks = np.isin(np.arange(len(rec.ids)), rec.landmarks) | (c.still & ~truth.present.any(0))
    off, (_, _, velocity, _), _ = causes(c)
    fits = np.array([_beside(*one) < 3 * c.fix_noise for one in zip(off.T, velocity.T, strict=True)])
    x = np.where(marks[:, None], c.x, np.where((fits & ~np.isin(rec.ids, late))[:, None], truth.position, nan))
    residual, stated = residual_of(rec, x, c.log.summary.reversed_pairs)[1], np.array(noise.relative_std)
    if not c.in_body:
        stated[1] = noise.world_azimuth_std
    else:
        turned = rec.relative[0, :, 1] - c.log.recording.relative[0, :, 1]
        known = nan * c.variance[..., 0] if truth.heading is None else truth.heading
        residual[:, 1] = wrap(residual[:, 1] - turned + known[rec.links.step, rec.links.observer])
    used, x = np.isfinite(residual), np.where(np.isfinite(x), x, c.x)
    return replace(c, x=x, relative=np.where(used, residual, c.relative), expected=np.where(used, stated, c.expected))


def on_time(c: Check, alike: bool, true: Check) -> Check:
    """The same with what its relative measurements say about clocks and, if `alike`, about what all ranges share (by
    `true` positions, if there are some), and less what wrong ones explain."""
    (value, error), made, which = clocks(c, alike)
    size = len(c.world.ids)
    if alike and c.log.truth is not None:
        value[size:], error[size:] = (part[size:] for part in clocks(true, True)[0])
    maybe = abs(value) > 2.0 * error
    if alike and not (maybe[size:].any() and abs(value[size]) < UNITS_APART):  # clocks look like it, or undo it
        return on_time(c, False, true)
    least = np.where(np.arange(size + 2) == size, LEAST_SCALE, LEAST_LAG)
    error[:size][abs(value[:size]) > LONG_LAG] = inf  # what is linear in a lag holds for small ones
    off = np.where(abs(value) > np.maximum(SURE_CLOCK_ERRORS * error, least), value, 0.0)
    relative = c.relative.copy()
    relative[:, :2] -= np.nan_to_num(np.column_stack([each @ off[which] for each in made]))
    return replace(
        c,
        relative=relative,
        ahead=off[:size],
        unsure=error[:size],
        ranges=tuple(zip(off[size:], error[size:], strict=True)),
    )


def worst(c: Check, column: int) -> tuple[str, float, Floats]:
    """What a vehicle's filter misses by over CONFIDENT_RATIO of the deviations that it states: positions of a truth in
    a tenth of the drive, else fixes, or these the truth, in one or alone, where that is beyond chance; by how many at
    most; and when, s."""
    rec, truth = c.world, c.log.truth
    size, t, squares = dimensions(rec), rec.t - rec.t[0], pd.Series(c.normalised[:, column]).dropna()
    tenths, fixes = np.arange(len(t)) * TENTHS // len(t), (rec.gnss[0], np.square(rec.fix_scale * rec.sensors.fix_std))
    if truth is not None:
        for what, x, variance in (("filter errs", c.x, c.variance), ("fixes are off", *fixes)):
            square, stated = np.square(x - truth.position)[:, column, :size], variance[:, column, :size]
            off, usual = (
                pd.DataFrame(each + 0.0 * square).groupby(tenths).sum().sum(axis=1) for each in (square, stated)
            )
            ratios = (off / usual)[usual > 0.0] ** 0.5
            if ratios.max() > CONFIDENT_RATIO:
                return what, float(ratios.max()), t[np.isin(tenths, ratios.index[ratios > CONFIDENT_RATIO])]
    parts = squares.groupby(tenths[squares.index])
    square = pd.concat([squares, parts.transform("mean")])
    count = np.r_[np.ones(len(squares)), parts.transform("size")]
    beyond = square[size * count * square > scipy.stats.chi2.isf(RARE, size * count)]
    return ("fixes are off", float(beyond.max() ** 0.5), t[beyond.index]) if len(beyond) else ("", 0.0, t)
