"""A star filter whose noise is judged at every step: `joint`'s equations in covariance form, and features of a judge.

The state holds the positions of an ego and of its neighbours. A judge multiplies the assumed variance of every fix,
range, angle and motion by a number of its own; with ones everywhere the filter is `JointFilter(robust=False)`. Features
have no units; their time constants are in seconds.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

import coopoc as co
from coopoc.methods.egos import relative_noise
from coopoc.methods.noise_model import resolve

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Rows = npt.NDArray[np.float32]
OWN, OTHER, RANGE, ANGLE, MOTION = range(5)
"""Heads of a judge: the ego's fix, a neighbour's fix, a range, an azimuth or inclination, and a motion."""
HEADS, FEATURES, HIDDEN = 5, 28, (20, 12)
SIZE = (FEATURES + 1) * HIDDEN[0] + (HIDDEN[0] + 1) * HIDDEN[1] + HIDDEN[1] + 1
"""Weights of a head."""
NONE, NET, TRUTH = range(3)
"""Who judges; TRUTH knows the true errors, also the next ones: no judge of variances knows more."""
LEAST, SPAN = -3.0, (13.0, 13.0, 13.0, 13.0, 18.0)
"""Logarithms of multipliers are in LEAST..LEAST + SPAN of the head."""
FLAT, UNKNOWN = 1e6, 1e4
"""m^2, variance of a member that joins, and from which on nothing is known of where it is."""
TAUS = np.array([1.0, 4.0, 16.0])
"""s, time constants of the leaky means."""
WF, QF, UF, RF, WD, QD, DF, WR, QR, SR, WO, QO, AO, CO, CHANNELS = 0, 1, 2, 5, 6, 7, 8, 11, 14, 17, 20, 21, 22, 23, 24
"""Leaky sums: weights (W), squares (Q) and signed innovations of fixes (F), of their disagreement with others' (D), of
relative measurements (R), and of motions along and across (O)."""
FEW, LONG = 7, 4.0
"""Errors, and s, around a step, whose mean square and whose mean say how many times the assumed variance acts."""
BIAS = {3: 0.42, 1: 0.76}
"""By how much the logarithm of that estimate is too low where errors of 3 axes or of one are white."""
OUTLIER, LOST = 9.0, 16.0
"""Mean normalised square of an error from which on it counts for itself, and squared error over variance from which on
a position is wrong, and a motion's target is to admit it."""


class Pack(NamedTuple):
    """Stars of an ego in R runs of T steps, members one after the other: M in all; with the truth, for training.

    Attributes:
        start: (T+1,) first member of each step, the ego.
        previous: (M,) index in the last star, -1 if it joins.
        moved, process, position, variance, relative: (R, M, 3), as in `coopoc.stars`.
        new: (R, M) whether a position counts.
        std: (3,) m, rad, rad of relative measurements.
        least: m, least range for which angles count as lengths.
        dt: s.
        true: (M, 3) m, where the members are.
        fixes, motions, relatives: (R, M), (R, M) and (R, M, 3) logarithms of how many times the assumed variance acts.
    """

    start: Ints
    previous: Ints
    moved: Floats
    process: Floats
    position: Floats
    variance: Floats
    relative: Floats
    new: npt.NDArray[np.bool_]
    std: Floats
    least: float
    dt: float
    true: Floats
    fixes: Floats
    motions: Floats
    relatives: Floats


class Judge(NamedTuple):
    """Who judges, weights (HEADS, SIZE) of a net, and (HEADS, FEATURES) 0 for features that it does not see."""

    mode: int
    weights: Floats = np.zeros((HEADS, SIZE))
    shown: Floats = np.ones((HEADS, FEATURES))


class State(NamedTuple):
    """State x and covariance p of the members, what is remembered of each, and scratch memory."""

    x: Floats
    p: Floats
    leaky: Floats  # (n, CHANNELS, 3)
    logs: Floats  # (n, 5) of motion, fix, range, azimuth, inclination
    age: Floats  # (n,) s
    x_old: Floats
    p_old: Floats
    leaky_old: Floats
    logs_old: Floats
    age_old: Floats
    axes: Floats  # (n, 3, 3) along which range and angles grow
    polar: Floats  # (n, 4) range, azimuth, sine and cosine of the inclination
    slope: Floats  # (n, 3)
    residual: Floats  # (n, 3)
    gap: Floats  # (n, 3) m, measured less predicted vector
    spread: Floats  # (n, 3) m^2, its variance
    whole: npt.NDArray[np.bool_]
    counted: npt.NDArray[np.bool_]
    now: Floats  # (n, 12) of this step
    dx: Floats
    row: Floats
    f: Floats
    a: Floats
    b: Floats


def pack(recording: co.Recording, ego: int, fleet: co.Fleet, outlier: float = OUTLIER) -> Pack:
    """Stars of an ego; an error whose mean normalised square is below `outlier` does not count for its own target."""
    known = resolve("nominal", recording)
    std: Any
    std, least = relative_noise(known)
    every = [*co.stars(recording, ego, known)]
    names = ("moved", "process", "position", "variance", "new")
    made: Any = {
        name: np.ascontiguousarray(np.concatenate([getattr(star, name) for star in every], axis=1)) for name in names
    }
    padded = [np.pad(star.relative, ((0, 0), (1, 0), (0, 0)), constant_values=np.nan) for star in every]
    made["relative"] = np.ascontiguousarray(np.concatenate(padded, axis=1))
    count = np.array([len(star.member) for star in every])
    start, step = np.append(0, np.cumsum(count)), np.repeat(np.arange(len(count)), count)
    member, previous = (np.concatenate([getattr(star, name) for star in every]) for name in ("member", "previous"))
    true, before = fleet.position[step, member], fleet.position[np.maximum(step - 1, 0), member]
    fixes = np.where(made["new"][..., None], (made["position"] - true) / np.sqrt(made["variance"]), np.nan)
    motions = np.where(previous[:, None] < 0, np.nan, (true - before - made["moved"]) / np.sqrt(made["process"]))
    gap = true - np.repeat(true[start[:-1]], count, axis=0)
    flat = np.hypot(gap[:, 0], gap[:, 1])
    seen = np.column_stack([np.hypot(flat, gap[:, 2]), np.arctan2(gap[:, 1], gap[:, 0]), np.arctan2(flat, gap[:, 2])])
    relatives = (made["relative"] - seen) / std
    relatives[..., 1:] -= np.round(relatives[..., 1:] * std[1:] / (2 * np.pi)) * 2 * np.pi / std[1:]
    groups, when = [np.flatnonzero(member == one) for one in np.unique(member)], recording.dt * step
    excess = [
        _excess(errors, groups, when, outlier) for errors in (fixes, motions, *(relatives[..., [c]] for c in range(3)))
    ]
    targets = {"fixes": excess[0], "motions": excess[1], "relatives": np.stack(excess[2:], axis=-1)}
    previous = previous.astype(np.int64)
    return Pack(start, previous, **made, **targets, std=std, least=least, dt=recording.dt, true=true)


def alone(stars: Pack) -> Pack:
    """The same without the neighbours."""
    egos, steps = stars.start[:-1], len(stars.start) - 1
    names = ("moved", "process", "position", "variance", "relative", "new", "fixes", "motions", "relatives")
    made: Any = {name: np.ascontiguousarray(getattr(stars, name)[:, egos]) for name in names}
    previous = np.minimum(np.arange(steps) - 1, 0)
    return stars._replace(start=np.arange(steps + 1), previous=previous, true=stars.true[egos], **made)


def _excess(errors: Any, groups: list[npt.NDArray[np.intp]], when: Any, outlier: float) -> Floats:
    """(R, M) logarithms of how many times the assumed variance acts, of normalised errors (R, M, axes), NaN for none.

    The mean square of the FEW errors around one, plus n times the squared mean of the n within LONG s, less one: one
    where errors are white and as assumed, n times as much where they last. An error that is no outlier does not count
    for itself: its innovation, which the judge sees, is used by the filter, too.
    """
    found = np.full(errors.shape[:2], np.nan)
    axes = errors.shape[2]
    for run, group in ((run, group) for run in range(len(errors)) for group in groups):
        here = group[np.isfinite(errors[run, group]).all(axis=-1)]
        if not len(here):
            continue
        e, t, at = errors[run, here], when[here], np.arange(len(here))
        low, high = np.maximum(at - FEW // 2, 0), np.minimum(at + FEW // 2 + 1, len(here))
        own = np.square(e).mean(axis=1)
        left = (own < outlier) & (len(here) > FEW)
        squares, sums = np.append(0.0, np.cumsum(own)), np.concatenate([np.zeros((1, axes)), np.cumsum(e, axis=0)])
        near = (squares[high] - squares[low] - left * own) / (high - low - left)
        low, high = np.searchsorted(t, t - LONG / 2 - 1e-6), np.searchsorted(t, t + LONG / 2 + 1e-6)
        left &= high - low > 1
        lasts = np.square(sums[high] - sums[low] - left[:, None] * e).mean(axis=1) / (high - low - left)
        found[run, here] = np.log(np.maximum(near + lasts - 1.0, 0.1)) + BIAS[axes]
    return found


def follow(
    stars: Pack, judge: Judge = Judge(NONE), share: float = 0.0, seed: int = 0
) -> tuple[Floats, Floats, list[Rows]]:
    """Positions (R, T, 3) m of the ego, their covariance (R, T, 3, 3) m^2, and rows for training of each head.

    Args:
        stars: of the ego.
        judge: of its measurements.
        share: of steps that give rows (n, FEATURES + 1): features and the logarithm that they should give.
        seed: of the draw of these steps.
    """
    runs, steps = stars.moved.shape[0], len(stars.start) - 1
    keep = np.random.default_rng(seed).uniform(size=(runs, steps)) < share
    most = int(np.diff(stars.start).max())
    rows = np.zeros((HEADS, int(keep.sum()) * most * 2, FEATURES + 1), np.float32)
    x, cov, counts = _follow(stars, judge, keep, rows, most)
    return x, cov, [rows[head, : counts[head]] for head in range(HEADS)]


@njit(cache=True)
def _follow(s: Any, judge: Any, keep: Any, rows: Any, most: int) -> Any:
    runs, steps, size = s.moved.shape[0], len(s.start) - 1, 3 * most
    x, cov, counts = np.zeros((runs, steps, 3)), np.zeros((runs, steps, 3, 3)), np.zeros(HEADS, np.int64)
    v, w, n3 = np.zeros((6, size)), np.zeros((2, size, size)), np.zeros((8, most, 3))
    leaky, logs, flags = np.zeros((2, most, CHANNELS, 3)), np.zeros((2, most, 5)), np.zeros((2, most), np.bool_)
    st = State(
        v[0], w[0], leaky[0], logs[0], v[1], v[2], w[1], leaky[1], logs[1], v[3], np.zeros((most, 3, 3)),
        np.zeros((most, 4)), n3[0], n3[1], n3[2], n3[3], flags[0], flags[1], np.zeros((most, 12)), v[4], v[5],
        np.zeros(FEATURES), np.zeros(HIDDEN[0]), np.zeros(HIDDEN[1]),
    )  # fmt: skip
    for run in range(runs):
        n = 0
        for t in range(steps):
            at, old = s.start[t], n
            n = s.start[t + 1] - at
            _predict(s, st, run, at, n, old)
            _look(s, st, run, at, n)
            asked = judge.mode != NONE or keep[run, t]
            if asked:
                _motions(s, st, judge, run, at, n, keep[run, t], rows, counts)
            for k in range(n):
                if s.previous[at + k] >= 0:
                    by = math.exp(st.logs[k, 0]) if judge.mode != NONE else 1.0
                    for i in range(3):
                        st.p[3 * k + i, 3 * k + i] += by * s.process[run, at + k, i]
            if asked:
                _fixes(s, st, judge, run, at, n, keep[run, t], rows, counts)
                _relatives(s, st, judge, run, at, n, keep[run, t], rows, counts)
            _update(s, st, judge.mode != NONE, run, at, n)
            x[run, t], cov[run, t] = st.x[:3], st.p[:3, :3]
    return x, cov, counts


@njit(cache=True)
def _predict(s: Any, st: Any, run: int, at: int, n: int, old: int) -> None:
    """Members that stay move, others begin where they are measured, else where they say, else near the ego."""
    x, p, m = st.x, st.p, 3 * old
    st.x_old[:m], st.p_old[:m, :m] = x[:m], p[:m, :m]
    st.leaky_old[:old], st.logs_old[:old], st.age_old[:old] = st.leaky[:old], st.logs[:old], st.age[:old]
    fade = np.exp(-s.dt / TAUS)
    for k in range(n):
        was, seen = s.previous[at + k], s.relative[run, at + k]
        for j in range(n):
            other = s.previous[at + j]
            for a in range(3):
                for b in range(3):
                    if was >= 0 and other >= 0:
                        p[3 * k + a, 3 * j + b] = st.p_old[3 * was + a, 3 * other + b]
                    else:
                        p[3 * k + a, 3 * j + b] = FLAT if k == j and a == b else 0.0
        if was >= 0:
            st.leaky[k], st.logs[k], st.age[k] = st.leaky_old[was] * fade, st.logs_old[was], st.age_old[was] + s.dt
            x[3 * k : 3 * k + 3] = st.x_old[3 * was : 3 * was + 3] + s.moved[run, at + k]
            if k > 0 and s.new[run, at + k] and p[3 * k, 3 * k] + s.process[run, at + k, 0] > UNKNOWN:
                x[3 * k : 3 * k + 3] = s.position[run, at + k]
            continue
        st.leaky[k], st.logs[k], st.age[k] = 0.0, 0.0, 0.0
        if k > 0 and math.isfinite(seen[0] + seen[1] + seen[2]):
            x[3 * k : 3 * k + 3] = x[:3] + _vector(seen)
        elif k == 0 or s.new[run, at + k]:
            x[3 * k : 3 * k + 3] = s.position[run, at + k]
        else:
            near = (seen[0] if math.isfinite(seen[0]) else 0.0) + 1.0
            x[3 * k : 3 * k + 3] = x[:3] + near * np.array([1.0, 1.0, 0.1])


@njit(cache=True)
def _vector(polar: Any) -> Any:
    """m, of range, azimuth and inclination."""
    flat = polar[0] * math.sin(polar[2])
    return np.array([flat * math.cos(polar[1]), flat * math.sin(polar[1]), polar[0] * math.cos(polar[2])])


@njit(cache=True)
def _polar(v: Any, axes: Any, polar: Any, slope: Any, least: float) -> None:
    """Range, azimuth, sine and cosine of the inclination of a vector; unit vectors along which they grow, and by how
    much a metre."""
    flat = math.sqrt(v[0] * v[0] + v[1] * v[1])
    d = math.sqrt(flat * flat + v[2] * v[2])
    ca, sa = (v[0] / flat, v[1] / flat) if flat > 0 else (1.0, 0.0)
    si, ci = (flat / d, v[2] / d) if d > 0 else (0.0, 1.0)
    axes[0, 0], axes[0, 1], axes[0, 2] = si * ca, si * sa, ci
    axes[1, 0], axes[1, 1], axes[1, 2] = -sa, ca, 0.0
    axes[2, 0], axes[2, 1], axes[2, 2] = ci * ca, ci * sa, -si
    polar[0], polar[1], polar[2], polar[3] = d, math.atan2(sa, ca), si, ci
    reach = max(d, least)
    slope[0], slope[1], slope[2] = 1.0, 1.0 / max(d * si, 1e-3 * reach), d / (reach * reach)


@njit(cache=True)
def _residuals(seen: Any, polar: Any, out: Any) -> None:
    """Measured less predicted range, azimuth and inclination."""
    turned, raised = seen[1] - polar[1], seen[2] - math.atan2(polar[2], polar[3])
    out[0], out[1] = seen[0] - polar[0], math.atan2(math.sin(turned), math.cos(turned))
    out[2] = math.atan2(math.sin(raised), math.cos(raised))


@njit(cache=True)
def _metres(s: Any, polar: Any) -> Any:
    """Deviations m of range and angles."""
    reach = max(polar[0], s.least)
    return s.std * np.array([1.0, max(abs(polar[2]), 1e-3) * reach, reach])


@njit(cache=True)
def _look(s: Any, st: Any, run: int, at: int, n: int) -> None:
    """What was measured, at the prediction; a component that is missing is the predicted one."""
    for k in range(1, n):
        seen, polar, ahead = s.relative[run, at + k].copy(), st.polar[k], st.x[3 * k : 3 * k + 3] - st.x[:3]
        _polar(ahead, st.axes[k], polar, st.slope[k], s.least)
        _residuals(seen, polar, st.residual[k])
        st.whole[k] = math.isfinite(seen[0] + seen[1] + seen[2])
        for c in range(3):
            if not math.isfinite(seen[c]):
                seen[c] = math.atan2(polar[2], polar[3]) if c == 2 else polar[c]
        st.gap[k] = _vector(seen) - ahead
        st.spread[k] = np.square(_metres(s, polar)) @ np.square(st.axes[k])


@njit(cache=True)
def _half_log(value: float) -> float:
    """Half the logarithm of a square, which has a floor."""
    return min(max(0.5 * math.log(value + 0.02), -2.0), 6.0)


@njit(cache=True)
def _clip(value: float, most: float) -> float:
    return min(max(value, -most), most)


@njit(cache=True)
def _leak(st: Any, k: int, channel: int, value: float) -> None:
    for tau in range(3):
        st.leaky[k, channel, tau] += value


@njit(cache=True)
def _mean(st: Any, k: int, channel: int, weight: int, tau: int) -> float:
    """A leaky mean; 0 before there was anything."""
    w = st.leaky[k, weight, tau]
    return st.leaky[k, channel, tau] / w if w > 1e-9 else 0.0


@njit(cache=True)
def _level(st: Any, k: int, channel: int, weight: int, tau: int) -> float:
    return _half_log(_mean(st, k, channel, weight, tau))


@njit(cache=True)
def _dot(st: Any, j: int, k: int, channel: int, weight: int, tau: int) -> float:
    """Product of leaky mean vectors of two members, a mean over the axes."""
    found = 0.0
    for a in range(3):
        found += _mean(st, j, channel + a, weight, tau) * _mean(st, k, channel + a, weight, tau)
    return found / 3.0


@njit(cache=True)
def _offset(st: Any, k: int, channel: int, weight: int, tau: int) -> float:
    """Half the logarithm of the square of a leaky mean vector."""
    return _half_log(_dot(st, k, k, channel, weight, tau))


@njit(cache=True)
def _ask(st: Any, judge: Any, head: int, target: float, collect: bool, rows: Any, counts: Any) -> float:
    """The judge's logarithm for the features in `f`, which make a row for training, too."""
    f, a, b = st.f, st.a, st.b
    for i in range(FEATURES):
        f[i] *= judge.shown[head, i]
    if collect and math.isfinite(target) and counts[head] < rows.shape[1]:
        rows[head, counts[head], :FEATURES] = f
        rows[head, counts[head], FEATURES] = target
        counts[head] += 1
    if judge.mode == NONE:
        return 0.0
    if judge.mode == TRUTH:
        return min(max(target, LEAST), LEAST + SPAN[MOTION])
    w = judge.weights[head]
    at = _layer(w, 0, f, a)
    at = _layer(w, at, a, b)
    total = w[at + len(b)]
    for i in range(len(b)):
        total += w[at + i] * b[i]
    return LEAST + SPAN[head] / (1.0 + math.exp(-total))


@njit(cache=True)
def _layer(w: Any, at: int, inputs: Any, out: Any) -> int:
    """Rectified sums; where the next layer's weights begin."""
    wide = len(inputs)
    for i in range(len(out)):
        total = w[at + wide]
        for j in range(wide):
            total += w[at + j] * inputs[j]
        out[i] = max(total, 0.0)
        at += wide + 1
    return at


@njit(cache=True)
def _motions(s: Any, st: Any, judge: Any, run: int, at: int, n: int, collect: bool, rows: Any, counts: Any) -> None:
    """Judge motions: by what all measurements together say of where a member is, without its step in p."""
    f, x, p, logs, dt, log_dt = st.f, st.x, st.p, st.logs, s.dt, math.log10(s.dt)
    top, bottom = np.zeros(3), np.zeros(3)
    for k in range(n):
        step, moved = s.process[run, at + k], s.moved[run, at + k]
        if s.previous[at + k] < 0 or step[0] > 1e3:
            continue
        top[:], bottom[:] = 0.0, 0.0
        sources, spread, own = 0, 0.0, 0.0
        if s.new[run, at + k]:
            sources += 1
            for a in range(3):
                v, w = s.variance[run, at + k, a] * math.exp(logs[k, 1]), s.position[run, at + k, a] - x[3 * k + a]
                top[a] += w / v
                bottom[a] += 1.0 / v
                spread += w * w / v
                own += w * w / (v + p[3 * k + a, 3 * k + a] + step[a]) / 3.0
        for j in range(1, n):
            if (k > 0 and j != k) or not st.whole[j] or s.previous[at + j] < 0:
                continue
            sources += 1
            up, other = math.exp((logs[j, 2] + logs[j, 3] + logs[j, 4]) / 3.0), j if k == 0 else 0
            for a in range(3):
                v = st.spread[j, a] * up + p[3 * other + a, 3 * other + a] + s.process[run, at + other, a]
                w = st.gap[j, a] * (1.0 if k > 0 else -1.0)
                top[a] += w / v
                bottom[a] += 1.0 / v
                spread += w * w / v
        if sources == 0:
            continue
        gap, now, before, known, apart = top / bottom, 0.0, 0.0, 0.0, 0.0
        for a in range(3):
            own_p = p[3 * k + a, 3 * k + a]
            spread -= gap[a] * gap[a] * bottom[a]
            now += gap[a] ** 2 / (1.0 / bottom[a] + own_p + step[a]) / 3.0
            known += 1.0 / bottom[a] + own_p
            before += own_p
            apart += (s.true[at + k, a] - x[3 * k + a]) ** 2
        total = step.sum()
        pace, along, across = math.sqrt(moved[0] ** 2 + moved[1] ** 2), 0.0, 0.0
        if pace > 1e-9:
            along, across = (
                (gap[0] * moved[0] + gap[1] * moved[1]) / pace,
                (gap[1] * moved[0] - gap[0] * moved[1]) / pace,
            )
        unit = 1.0 / math.sqrt((known + total) / 3.0)
        _leak(st, k, WO, dt)
        _leak(st, k, QO, dt * now)
        _leak(st, k, AO, dt * along * unit)
        _leak(st, k, CO, dt * across * unit)
        f[0], f[4], f[5] = _half_log(now), _half_log((along * unit) ** 2), _half_log((across * unit) ** 2)
        for tau in range(3):
            f[1 + tau] = _level(st, k, QO, WO, tau)
            f[6 + tau] = _half_log(_mean(st, k, AO, WO, tau) ** 2)
            f[9 + tau] = _half_log(_mean(st, k, CO, WO, tau) ** 2)
        f[12] = _clip(along / (pace + 1e-9), 2.0) if pace > 1e-9 else 0.0
        f[13], f[14], f[15] = _clip(0.5 * math.log(known / total), 4.0), log_dt, 0.5 * math.log(st.age[k] + 0.1)
        f[16], f[17], f[18], f[19] = n / 5.0, (1.0 if k == 0 else 0.0), logs[k, 0] / 3.0, logs[k, 1] / 3.0
        f[20], f[21] = _level(st, k, QF, WF, 0), _half_log(own)
        f[22] = _clip(0.5 * math.log((pace * pace + 1e-9) / (total / 3.0)), 4.0)
        f[23], f[24] = _half_log(max(spread, 0.0) / max(3.0 * (sources - 1), 1.0)), math.log(1.0 + sources)
        f[25] = _clip(0.5 * math.log(before / total), 6.0) / 2.0
        f[26] = (logs[k, 2] + logs[k, 3] + logs[k, 4]) / 9.0
        f[27] = _clip(0.5 * math.log(total / (s.process[run, at, 0] * 3.0)), 4.0)
        target = s.motions[run, at + k]
        if apart > LOST * (before + total):
            target = max(target, math.log(apart / total))
        logs[k, 0] = _ask(st, judge, MOTION, target, collect, rows, counts)


@njit(cache=True)
def _fixes(s: Any, st: Any, judge: Any, run: int, at: int, n: int, collect: bool, rows: Any, counts: Any) -> None:
    """Judge fixes: where each puts the ego, beside the prediction and beside what the others say."""
    f, now, logs, dt, counted, log_dt = st.f, st.now, st.logs, s.dt, st.counted, math.log10(s.dt)
    top, bottom, delta, var = np.zeros(3), np.zeros(3), np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        counted[k] = s.new[run, at + k] and (k == 0 or st.whole[k])
        if not s.new[run, at + k]:
            continue
        now[k, 0], weight = 0.0, math.exp(-max(logs[k, 1], 0.0))
        for a in range(3):
            r, gap = s.variance[run, at + k, a], s.position[run, at + k, a] - st.x[3 * k + a]
            own, raw = r + st.p[3 * k + a, 3 * k + a], gap * gap / r
            if k > 0 and counted[k]:
                gap -= st.gap[k, a]
                r += st.spread[k, a]
                own = r + st.p[a, a]
            delta[k, a], var[k, a] = gap, r
            if counted[k]:
                top[a] += weight * gap / r
                bottom[a] += weight / r
            now[k, 0] += gap * gap / own / 3.0
            _leak(st, k, UF + a, dt * gap / math.sqrt(own))
            _leak(st, k, RF, dt * raw / 3.0)
        _leak(st, k, WF, dt)
        _leak(st, k, QF, dt * now[k, 0])
    for k in range(n):
        now[k, 1], now[k, 2] = 0.0, 1e9
        weight = math.exp(-max(logs[k, 1], 0.0))
        if not counted[k] or (bottom - weight / var[k] < np.maximum(1e-6 * bottom, 1e-9)).any():
            continue
        now[k, 2] = 0.0
        for a in range(3):
            rest = bottom[a] - weight / var[k, a]
            d = delta[k, a] - (top[a] - weight * delta[k, a] / var[k, a]) / rest
            d /= math.sqrt(var[k, a] + 1.0 / rest)
            now[k, 1] += d * d / 3.0
            now[k, 2] += 1.0 / rest
            _leak(st, k, DF + a, dt * d)
        _leak(st, k, WD, dt)
        _leak(st, k, QD, dt * now[k, 1])
    for k in range(n):
        if not s.new[run, at + k]:
            continue
        before, total = st.p[3 * k, 3 * k] + st.p[3 * k + 1, 3 * k + 1] + st.p[3 * k + 2, 3 * k + 2], 0.0
        for a in range(3):
            total += s.variance[run, at + k, a]
        f[0] = _half_log(now[k, 0])
        for tau in range(3):
            f[1 + tau], f[4 + tau] = _level(st, k, QF, WF, tau), _offset(st, k, UF, WF, tau)
        f[7], f[8], f[9] = _level(st, k, RF, WF, 0), _level(st, k, RF, WF, 2), _half_log(now[k, 1])
        f[10], f[11] = _level(st, k, QD, WD, 1), _level(st, k, QD, WD, 2)
        f[12], f[13] = _offset(st, k, DF, WD, 1), _offset(st, k, DF, WD, 2)
        f[14], f[15] = _clip(0.5 * math.log(before / total), 4.0), _clip(0.5 * math.log(now[k, 2] / total), 4.0)
        f[16], f[17] = log_dt, 0.5 * math.log(st.age[k] + 0.1)
        f[18] = _clip(0.5 * math.log(total / (3.0 * s.variance[run, at, 0])), 4.0) if s.new[run, at] else 0.0
        f[19], f[20], f[21] = n / 5.0, logs[k, 1] / 3.0, logs[k, 0] / 3.0
        f[22], f[23], f[24], f[25], some = _level(st, 0, QF, WF, 1), _offset(st, 0, UF, WF, 2), 0.0, 0.0, 0
        for j in range(1, n):
            if j != k and st.leaky[j, WF, 1] >= 1e-9:
                some += 1
                f[24] += _level(st, j, QF, WF, 1)
                sizes = 3.0 * math.sqrt(_dot(st, j, j, UF, WF, 2) * _dot(st, k, k, UF, WF, 2)) + 1e-3
                f[25] += 3.0 * _dot(st, j, k, UF, WF, 2) / sizes
        f[24], f[25] = f[24] / max(some, 1), f[25] / max(some, 1)
        f[26], f[27] = (logs[k, 2] / 3.0, _level(st, k, QR, WR, 1)) if k > 0 else (0.0, 0.0)
        head = OWN if k == 0 else OTHER
        logs[k, 1] = _ask(st, judge, head, s.fixes[run, at + k], collect, rows, counts)


@njit(cache=True)
def _relatives(s: Any, st: Any, judge: Any, run: int, at: int, n: int, collect: bool, rows: Any, counts: Any) -> None:
    """Judge ranges and angles, each by its own innovations and those of the other neighbours."""
    f, now, logs, p, log_dt = st.f, st.now, st.logs, st.p, math.log10(s.dt)
    for k in range(1, n):
        for c in range(3):
            now[k, 3 + c], now[k, 6 + c], before = 0.0, 0.0, 0.0
            if not math.isfinite(s.relative[run, at + k, c]):
                continue
            for a in range(3):
                for b in range(3):
                    i, j = 3 * k + a, 3 * k + b
                    before += st.axes[k, c, a] * st.axes[k, c, b] * (p[i, j] - p[i, b] - p[a, j] + p[a, b])
            now[k, 9 + c] = st.slope[k, c] ** 2 * before
            u = st.residual[k, c] / math.sqrt(s.std[c] ** 2 + now[k, 9 + c])
            now[k, 3 + c], now[k, 6 + c] = u * u, _clip(u / 3.0, 3.0)
            _leak(st, k, WR + c, s.dt)
            _leak(st, k, QR + c, s.dt * u * u)
            _leak(st, k, SR + c, s.dt * _clip(u, 30.0))
    for k in range(1, n):
        for c in range(3):
            if not math.isfinite(s.relative[run, at + k, c]):
                continue
            f[0], f[1] = _half_log(now[k, 3 + c]), now[k, 6 + c]
            for tau in range(3):
                f[2 + tau] = _level(st, k, QR + c, WR + c, tau)
                f[5 + tau] = _clip(_mean(st, k, SR + c, WR + c, tau), 5.0)
            f[8], f[9], f[25], some = 0.0, 0.0, 0.0, 0
            for j in range(1, n):
                if j != k and st.leaky[j, WR + c, 1] >= 1e-9:
                    some += 1
                    f[8] += _clip(_mean(st, j, SR + c, WR + c, 1), 5.0)
                    f[9] += _level(st, j, QR + c, WR + c, 1)
                    f[25] += now[j, 6 + c]
            f[8], f[9], f[25] = f[8] / max(some, 1), f[9] / max(some, 1), f[25] / max(some, 1)
            c1, c2 = (c + 1) % 3, (c + 2) % 3
            f[10] = 0.5 * (_half_log(now[k, 3 + c1]) + _half_log(now[k, 3 + c2]))
            f[11] = _level(st, k, QR + c1, WR + c1, 1) + _level(st, k, QR + c2, WR + c2, 1)
            f[12], f[13], f[14] = _level(st, k, QF, WF, 1), _offset(st, k, UF, WF, 2), _level(st, k, QD, WD, 1)
            f[15] = _clip(0.5 * math.log(max(now[k, 9 + c], 1e-12) / s.std[c] ** 2), 4.0)
            f[16], f[17], f[18], f[19] = log_dt, 0.5 * math.log(st.age[k] + 0.1), 0.0, n / 5.0
            f[20], f[21], f[22], f[23] = logs[k, 2 + c] / 3.0, logs[k, 1] / 3.0, logs[0, 0] / 3.0, logs[k, 0] / 3.0
            f[24] = 1.0 if c == 2 else 0.0
            f[26] = _clip(math.log(s.std[1] * max(st.polar[k, 0], s.least) / s.std[0]), 4.0)
            f[27] = _level(st, 0, QF, WF, 1)
            head = RANGE if c == 0 else ANGLE
            logs[k, 2 + c] = _ask(st, judge, head, s.relatives[run, at + k, c], collect, rows, counts)


@njit(cache=True)
def _add(p: Any, dx: Any, row: Any, m: int, k: int, h: Any, gap: float, variance: float, pair: bool) -> None:
    """Kalman update by h times the position of member k, or if `pair` times the vector to it from the ego."""
    i, s, left = 3 * k, variance, gap
    for r in range(m):
        row[r] = h[0] * p[r, i] + h[1] * p[r, i + 1] + h[2] * p[r, i + 2]
        if pair:
            row[r] -= h[0] * p[r, 0] + h[1] * p[r, 1] + h[2] * p[r, 2]
    for a in range(3):
        s += h[a] * (row[i + a] - (row[a] if pair else 0.0))
        left -= h[a] * (dx[i + a] - (dx[a] if pair else 0.0))
    for r in range(m):
        dx[r] += row[r] * left / s
        share = row[r] / s
        for c in range(m):
            p[r, c] -= share * row[c]


@njit(cache=True)
def _update(s: Any, st: Any, judged: bool, run: int, at: int, n: int) -> None:
    """Fixes, and relative measurements converted at the prediction; from there the latter once more, as measured."""
    m, unit, axes, polar, slope, residual = 3 * n, np.eye(3), np.zeros((3, 3)), np.zeros(4), np.zeros(3), np.zeros(3)
    x, p, far, q, dx = st.x, st.p, st.x_old, st.p_old, st.dx
    dx[:m] = 0.0
    for k in range(n):
        if s.new[run, at + k]:
            by = math.exp(st.logs[k, 1]) if judged else 1.0
            for a in range(3):
                gap, variance = s.position[run, at + k, a] - x[3 * k + a], by * s.variance[run, at + k, a]
                _add(p, dx, st.row, m, k, unit[a], gap, variance, False)
    far[:m], q[:m, :m] = dx[:m], p[:m, :m]
    for k in range(1, n):
        st.counted[k] = st.whole[k] or p[3 * k, 3 * k] < UNKNOWN
    for k in range(1, n):
        std = _metres(s, st.polar[k])
        for c in range(3):
            if st.counted[k] and math.isfinite(s.relative[run, at + k, c]):
                by, axis = math.exp(st.logs[k, 2 + c]) if judged else 1.0, st.axes[k, c]
                gap = axis[0] * st.gap[k, 0] + axis[1] * st.gap[k, 1] + axis[2] * st.gap[k, 2]
                _add(q, far, st.row, m, k, axis, gap, by * std[c] ** 2, True)
    for k in range(1, n):
        if not st.counted[k]:
            continue
        ahead = far[3 * k : 3 * k + 3] - far[:3]
        _polar(x[3 * k : 3 * k + 3] - x[:3] + ahead, axes, polar, slope, s.least)
        _residuals(s.relative[run, at + k], polar, residual)
        for c in range(3):
            if math.isfinite(s.relative[run, at + k, c]):
                by, h = math.exp(st.logs[k, 2 + c]) if judged else 1.0, slope[c] * axes[c]
                gap = residual[c] + h[0] * ahead[0] + h[1] * ahead[1] + h[2] * ahead[2]
                _add(p, dx, st.row, m, k, h, gap, by * s.std[c] ** 2, True)
    x[:m] += dx[:m]
    for i in range(m):
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])
