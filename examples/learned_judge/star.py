"""A star filter whose noise is judged at every step: `joint`'s equations in covariance form, and a net's features.

The state holds the positions of an ego and of its neighbours. A judge multiplies the assumed variance of every fix,
range, angle and motion by a number of its own; with ones everywhere the filter is `JointFilter(robust=False)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

import coopoc as co
from coopoc.methods.egos import relative_noise
from coopoc.methods.noise_model import resolve

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.float32]
OWN, OTHER, RANGE, ANGLE, MOTION = range(5)
"""Heads of a judge: the ego's fix, a neighbour's fix, a range, an azimuth or inclination, and a motion."""
HEADS, FEATURES, HIDDEN = 5, 28, (20, 12)
SIZE = (FEATURES + 1) * HIDDEN[0] + (HIDDEN[0] + 1) * HIDDEN[1] + HIDDEN[1] + 1
"""Weights of a head."""
FEW, LONG = 7, 4.0
"""Errors, and s, around a step, whose mean square and whose mean say how many times the assumed variance acts."""
BIAS = {3: 0.42, 1: 0.74}
"""By how much the logarithm of that estimate is too low where errors of 3 axes or of one are white."""
LOST = 16.0
"""Squared error over its variance from which on a position is wrong, and a motion's target is to admit it."""
LEAST, SPAN = -3.0, (13.0, 13.0, 13.0, 13.0, 18.0)
"""Logarithms of multipliers are in LEAST..LEAST + SPAN of the head."""
FLAT, UNKNOWN = 1e6, 1e4
"""m^2, variance of a member that joins, and from which on nothing is known of where it is."""
TAUS = np.array([1.0, 4.0, 16.0])
"""s, time constants of the leaky means."""
WF, QF, UF, RF, WD, QD, DF, WR, QR, SR, WO, QO, AO, CO = 0, 1, 2, 5, 6, 7, 8, 11, 14, 17, 20, 21, 22, 23
CHANNELS = 24
"""Leaky sums: weights (W), squares (Q) and signed innovations of fixes (F), of their disagreement with others' (D), of
relative measurements (R), and of motions along and across (O)."""


@dataclass(frozen=True, eq=False)
class Pack:
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

    start: npt.NDArray[np.int64]
    previous: npt.NDArray[np.int64]
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


def alone(stars: Pack) -> Pack:
    """The same without the neighbours."""
    egos, steps = stars.start[:-1], len(stars.start) - 1
    names = ("moved", "process", "position", "variance", "relative", "new", "fixes", "motions", "relatives")
    made = {name: np.ascontiguousarray(getattr(stars, name)[:, egos]) for name in names}
    previous = np.minimum(np.arange(steps) - 1, 0)
    return replace(stars, start=np.arange(steps + 1), previous=previous, true=stars.true[egos], **made)


def pack(recording: co.Recording, ego: int, fleet: co.Fleet) -> Pack:
    """Stars of an ego."""
    known = resolve("nominal", recording)
    std, least = relative_noise(known)
    parts: dict[str, list[Any]] = {name: [] for name in ("moved", "process", "position", "variance", "relative", "new")}
    start, previous, true, before, member, step = [0], [], [], [], [], []
    for star in co.stars(recording, ego, known):
        n = len(star.member)
        for name in ("moved", "process", "position", "variance", "new"):
            parts[name].append(getattr(star, name))
        parts["relative"].append(np.pad(star.relative, ((0, 0), (1, 0), (0, 0)), constant_values=np.nan))
        previous.append(star.previous)
        start.append(start[-1] + n)
        member.append(star.member)
        step.append(np.full(n, star.step))
        true.append(fleet.position[star.step, star.member])
        before.append(fleet.position[max(star.step - 1, 0), star.member])
    made = {name: np.ascontiguousarray(np.concatenate(values, axis=1)) for name, values in parts.items()}
    first, there, then = np.array(start), np.concatenate(true), np.concatenate(before)
    fixes = np.where(made["new"][..., None], (made["position"] - there) / np.sqrt(made["variance"]), np.nan)
    motions = (there - then - made["moved"]) / np.sqrt(made["process"])
    egos = np.repeat(there[first[:-1]], np.diff(first), axis=0)
    relatives = (made["relative"] - _seen(there - egos)) / std
    relatives[..., 1:] -= np.round(relatives[..., 1:] * std[1:] / (2 * np.pi)) * 2 * np.pi / std[1:]
    groups = [np.flatnonzero(np.concatenate(member) == one) for one in np.unique(np.concatenate(member))]
    when = recording.dt * np.concatenate(step)
    found = {
        "fixes": _excess(fixes, groups, when),
        "motions": _excess(np.where(np.concatenate(previous)[:, None] < 0, np.nan, motions), groups, when),
        "relatives": np.stack([_excess(relatives[..., c, None], groups, when) for c in range(3)], axis=-1),
    }
    links = np.concatenate(previous).astype(np.int64)
    return Pack(first, links, **made, **found, std=std, least=least, dt=recording.dt, true=there)


def _seen(gap: Floats) -> Floats:
    """Range, azimuth and inclination of vectors."""
    flat = np.hypot(gap[..., 0], gap[..., 1])
    return np.stack([np.hypot(flat, gap[..., 2]), np.arctan2(gap[..., 1], gap[..., 0]), np.arctan2(flat, gap[..., 2])], -1)


def _excess(errors: Floats, groups: list[npt.NDArray[np.int64]], when: Floats) -> Floats:
    """(R, M) logarithms of how many times the assumed variance acts, of normalised errors (R, M, axes), NaN for none.

    The mean square of the FEW errors around one, plus n times the squared mean of the n within LONG s, less one: one
    where errors are white and as assumed, n times as much where they last.
    """
    found = np.full(errors.shape[:2], np.nan)
    axes = errors.shape[2]
    for run in range(len(errors)):
        for group in groups:
            here = group[np.isfinite(errors[run, group]).all(axis=-1)]
            if not len(here):
                continue
            e, t, at = errors[run, here], when[here], np.arange(len(here))
            low, high = np.maximum(at - FEW // 2, 0), np.minimum(at + FEW // 2 + 1, len(here))
            squares = np.append(0.0, np.cumsum(np.square(e).mean(axis=1)))
            sums = np.concatenate([np.zeros((1, axes)), np.cumsum(e, axis=0)])
            near = (squares[high] - squares[low]) / (high - low)
            low, high = np.searchsorted(t, t - LONG / 2 - 1e-6), np.searchsorted(t, t + LONG / 2 + 1e-6)
            lasts = np.square(sums[high] - sums[low]).mean(axis=1) / (high - low)
            found[run, here] = np.log(np.maximum(near + lasts - 1.0, 0.1)) + BIAS[axes]
    return found


@dataclass(frozen=True, eq=False)
class Forest:
    """Regression trees of each head in the place of a net, nodes one after the other.

    Attributes:
        roots: (HEADS + 1,) first of the trees of each head in `first`.
        first: root of each tree.
        feature, left, right: of each node, a leaf with feature -1.
        value: threshold of a node, or the leaf's logarithm.
    """

    roots: npt.NDArray[np.int64]
    first: npt.NDArray[np.int64]
    feature: npt.NDArray[np.int64]
    left: npt.NDArray[np.int64]
    right: npt.NDArray[np.int64]
    value: Floats


NO_FOREST = Forest(*(np.zeros(HEADS + 1, np.int64) for _ in range(5)), np.zeros(1))
NONE, NET, TREES, TRUTH = range(4)
"""Who judges."""


def follow(
    stars: Pack, judge: Floats | Forest | str | None = None, shown: Floats | None = None, share: float = 0.0, seed: int = 0
) -> tuple[Floats, Floats, list[Rows]]:
    """Positions (R, T, 3) m of the ego, their covariance (R, T, 3, 3) m^2, and rows for training of each head.

    Args:
        stars: of the ego.
        judge: (HEADS, SIZE) weights of a net; a forest; "truth" for the true multipliers, a bound for all judges; None
            for multipliers of one.
        shown: (HEADS, FEATURES) 0 for features that are hidden.
        share: of steps that give rows.
        seed: of the draw of these steps.
    """
    runs, steps = stars.moved.shape[0], len(stars.start) - 1
    keep = np.random.default_rng(seed).uniform(size=(runs, steps)) < share
    most = int(np.diff(stars.start).max())
    room = int(keep.sum()) * most * 2 + 1
    rows = np.zeros((HEADS, room, FEATURES + 1), np.float32)
    mode = NONE if judge is None else TRUTH if isinstance(judge, str) else TREES if isinstance(judge, Forest) else NET
    trees = judge if isinstance(judge, Forest) else NO_FOREST
    found = _follow(
        stars.start, stars.previous, stars.moved, stars.process, stars.position, stars.variance, stars.relative,
        stars.new, stars.std, stars.least, stars.dt, stars.true, stars.fixes, stars.motions, stars.relatives,
        judge if isinstance(judge, np.ndarray) else np.zeros((HEADS, SIZE)),
        np.ones((HEADS, FEATURES)) if shown is None else shown,
        trees.roots, trees.first, trees.feature, trees.left, trees.right, trees.value, mode, keep, rows, most,
    )  # fmt: skip
    x, cov, counts = found
    return x, cov, [rows[head, : counts[head]] for head in range(HEADS)]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _half_log(value: float) -> float:
    """Half the logarithm of a square, which has a floor."""
    return min(max(0.5 * math.log(value + 0.02), -2.0), 6.0)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _clip(value: float, most: float) -> float:
    return min(max(value, -most), most)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _net(w: Floats, f: Floats, a: Floats, b: Floats, span: float) -> float:
    """Logarithm of a variance's multiplier."""
    at, n, m, features = 0, len(a), len(b), len(f)
    for i in range(n):
        s = w[at + features]
        for j in range(features):
            s += w[at + j] * f[j]
        a[i] = max(s, 0.0)
        at += features + 1
    for i in range(m):
        s = w[at + n]
        for j in range(n):
            s += w[at + j] * a[j]
        b[i] = max(s, 0.0)
        at += n + 1
    s = w[at + m]
    for j in range(m):
        s += w[at + j] * b[j]
    return LEAST + span / (1.0 + math.exp(-s))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _judged(
    head: int, weights: Floats, f: Floats, a: Floats, b: Floats, roots: Any, firsts: Any, feature: Any, left: Any,
    right: Any, value: Any, mode: int,
) -> float:  # fmt: skip
    """Logarithm of a multiplier, of the net or the mean of the trees."""
    if mode == NET:
        return _net(weights[head], f, a, b, SPAN[head])
    total = 0.0
    for tree in range(roots[head], roots[head + 1]):
        node = firsts[tree]
        while feature[node] >= 0:
            node = left[node] if f[feature[node]] <= value[node] else right[node]
        total += value[node]
    return total / max(roots[head + 1] - roots[head], 1)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _polar(v: Floats, e: Floats, polar: Floats) -> None:
    """Range, azimuth, sine and cosine of the inclination of a vector, and the unit vectors along which they grow."""
    flat = math.sqrt(v[0] * v[0] + v[1] * v[1])
    d = math.sqrt(flat * flat + v[2] * v[2])
    ca, sa = (v[0] / flat, v[1] / flat) if flat > 0 else (1.0, 0.0)
    si, ci = (flat / d, v[2] / d) if d > 0 else (0.0, 1.0)
    e[0, 0], e[0, 1], e[0, 2] = si * ca, si * sa, ci
    e[1, 0], e[1, 1], e[1, 2] = -sa, ca, 0.0
    e[2, 0], e[2, 1], e[2, 2] = ci * ca, ci * sa, -si
    polar[0], polar[1], polar[2], polar[3] = d, math.atan2(sa, ca), si, ci


@njit(cache=True)  # type: ignore[untyped-decorator]
def _wrapped(a: float) -> float:
    return math.atan2(math.sin(a), math.cos(a))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _residuals(seen: Floats, polar: Floats, out: Floats) -> None:
    """Measured less predicted range, azimuth and inclination."""
    out[0] = seen[0] - polar[0]
    out[1] = _wrapped(seen[1] - polar[1])
    out[2] = _wrapped(seen[2] - math.atan2(polar[2], polar[3]))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slopes(polar: Floats, least: float, g: Floats) -> None:
    """By how much a component grows a metre."""
    reach = max(polar[0], least)
    g[0], g[1], g[2] = 1.0, 1.0 / max(polar[0] * polar[2], 1e-3 * reach), polar[0] / (reach * reach)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _add_fix(p: Floats, dx: Floats, i: int, gap: float, variance: float, n: int, ph: Floats) -> None:
    """Kalman update by one number of the state."""
    for r in range(n):
        ph[r] = p[r, i]
    s = ph[i] + variance
    left = (gap - dx[i]) / s
    for r in range(n):
        dx[r] += ph[r] * left
        k = ph[r] / s
        for c in range(n):
            p[r, c] -= k * ph[c]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _add_gap(p: Floats, dx: Floats, k: int, h: Floats, gap: float, variance: float, n: int, ph: Floats) -> None:
    """Kalman update by h times the vector from the ego to member k."""
    i = 3 * k
    for r in range(n):
        ph[r] = h[0] * (p[r, i] - p[r, 0]) + h[1] * (p[r, i + 1] - p[r, 1]) + h[2] * (p[r, i + 2] - p[r, 2])
    s, left = variance, gap
    for a in range(3):
        s += h[a] * (ph[i + a] - ph[a])
        left -= h[a] * (dx[i + a] - dx[a])
    left /= s
    for r in range(n):
        dx[r] += ph[r] * left
        share = ph[r] / s
        for c in range(n):
            p[r, c] -= share * ph[c]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _mean(mem: Floats, k: int, channel: int, weight: int, tau: int) -> float:
    """A leaky mean; 0 before there was anything."""
    w = mem[k, weight, tau]
    return mem[k, channel, tau] / w if w > 1e-9 else 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _norm2(mem: Floats, k: int, channel: int, weight: int, tau: int) -> float:
    """Squared length of a leaky mean vector."""
    s = 0.0
    for a in range(3):
        s += _mean(mem, k, channel + a, weight, tau) ** 2
    return s / 3.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _pick(rows: Rows, count: int, f: Floats, target: float) -> int:
    """Write a row for training."""
    if count >= len(rows) or not math.isfinite(target):
        return count
    rows[count, :FEATURES] = f
    rows[count, FEATURES] = target
    return count + 1


@njit(cache=True)  # type: ignore[untyped-decorator]
def _follow(
    start: Any, previous: Any, moved: Any, process: Any, position: Any, variance: Any, relative: Any, new: Any,
    std: Any, least: float, dt: float, true: Any, fixes: Any, motions: Any,
    relatives: Any, weights: Any, shown: Any, roots: Any, firsts: Any, feature: Any, left: Any, right: Any, value: Any,
    mode: int, keep: Any, rows: Any, most: int,
) -> Any:  # fmt: skip
    judge, oracle = mode != NONE, mode == TRUTH
    runs, steps = moved.shape[0], len(start) - 1
    out_x, out_cov = np.zeros((runs, steps, 3)), np.zeros((runs, steps, 3, 3))
    counts = np.zeros(HEADS, np.int64)
    size = 3 * most
    x, dx, ph, far = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    p, q = np.zeros((size, size)), np.zeros((size, size))
    old = np.zeros(size)
    mem, mem_old = np.zeros((most, CHANNELS, 3)), np.zeros((most, CHANNELS, 3))
    logs, logs_old = np.zeros((most, 5)), np.zeros((most, 5))  # motion, fix, range, azimuth, inclination
    age, age_old = np.zeros(most), np.zeros(most)
    e, polar, g, one = np.zeros((most, 3, 3)), np.zeros((most, 4)), np.zeros((most, 3)), np.zeros(3)
    res, rho, cdiag, whole = np.zeros((most, 3)), np.zeros((most, 3)), np.zeros((most, 3)), np.zeros(most, np.bool_)
    et, pt, gt = np.zeros((3, 3)), np.zeros(4), np.zeros(3)
    tops, bottoms, delta, vdelta, counted = np.zeros(3), np.zeros(3), np.zeros((most, 3)), np.zeros((most, 3)), np.zeros(most, np.bool_)
    f, a1, a2 = np.zeros(FEATURES), np.zeros(HIDDEN[0]), np.zeros(HIDDEN[1])
    err, gap3, p3, r3, v3 = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    dd, now = np.zeros((most, 3)), np.zeros((most, 12))  # now: q fix, q disagreement, others' share, q and sign of components
    log_dt = math.log10(dt)
    fade = np.exp(-dt / TAUS)
    for run in range(runs):
        count = 0
        for t in range(steps):
            s0 = start[t]
            n = start[t + 1] - s0
            m = 3 * n
            # predict: members that stay move, others begin anew
            for i in range(3 * count):
                old[i] = x[i]
                for j in range(3 * count):
                    q[i, j] = p[i, j]
            for k in range(count):
                mem_old[k], logs_old[k], age_old[k] = mem[k], logs[k], age[k]
            for k in range(n):
                was = previous[s0 + k]
                for a in range(3):
                    if was >= 0:
                        x[3 * k + a] = old[3 * was + a] + moved[run, s0 + k, a]
                    for j in range(n):
                        wj = previous[s0 + j]
                        for b in range(3):
                            if was >= 0 and wj >= 0:
                                p[3 * k + a, 3 * j + b] = q[3 * was + a, 3 * wj + b]
                            else:
                                p[3 * k + a, 3 * j + b] = FLAT if k == j and a == b else 0.0
                if was >= 0:
                    for c in range(CHANNELS):
                        for tau in range(3):
                            mem[k, c, tau] = mem_old[was, c, tau] * fade[tau]
                    logs[k], age[k] = logs_old[was], age_old[was] + dt
                else:
                    mem[k], logs[k], age[k] = 0.0, 0.0, 0.0
                    seen = relative[run, s0 + k]
                    for a in range(3):
                        if k == 0:
                            x[a] = position[run, s0, a]
                        elif math.isfinite(seen[0] + seen[1] + seen[2]):
                            flat = seen[0] * math.sin(seen[2])
                            v = (flat * math.cos(seen[1]), flat * math.sin(seen[1]), seen[0] * math.cos(seen[2]))
                            x[3 * k + a] = x[a] + v[a]
                        elif new[run, s0 + k]:
                            x[3 * k + a] = position[run, s0 + k, a]
                        else:
                            near = (seen[0] if math.isfinite(seen[0]) else 0.0) + 1.0
                            x[3 * k + a] = x[a] + near * (0.1 if a == 2 else 1.0)
            count = n
            for k in range(1, n):
                if previous[s0 + k] >= 0 and new[run, s0 + k] and p[3 * k, 3 * k] + process[run, s0 + k, 0] > UNKNOWN:
                    for a in range(3):
                        x[3 * k + a] = position[run, s0 + k, a]
            # what was measured, at the prediction
            for k in range(1, n):
                seen = relative[run, s0 + k]
                for a in range(3):
                    one[a] = x[3 * k + a] - x[a]
                _polar(one, e[k], polar[k])
                _slopes(polar[k], least, g[k])
                _residuals(seen, polar[k], res[k])
                whole[k] = math.isfinite(seen[0] + seen[1] + seen[2])
                d = seen[0] if math.isfinite(seen[0]) else polar[k, 0]
                az = seen[1] if math.isfinite(seen[1]) else polar[k, 1]
                inc = seen[2] if math.isfinite(seen[2]) else math.atan2(polar[k, 2], polar[k, 3])
                v3[0], v3[1], v3[2] = d * math.sin(inc) * math.cos(az), d * math.sin(inc) * math.sin(az), d * math.cos(inc)
                reach, level = max(polar[k, 0], least), max(abs(polar[k, 2]), 1e-3)
                r3[0], r3[1], r3[2] = std[0], std[1] * level * reach, std[2] * reach
                for a in range(3):
                    rho[k, a] = v3[a] - one[a]
                    cdiag[k, a] = (e[k, 0, a] * r3[0]) ** 2 + (e[k, 1, a] * r3[1]) ** 2 + (e[k, 2, a] * r3[2]) ** 2
            collect = keep[run, t]
            if judge or collect:
                # motions: what all measurements say of where a member is, without its step
                for k in range(n):
                    if previous[s0 + k] < 0 or process[run, s0 + k, 0] > 1e3:
                        continue
                    tops[:], bottoms[:] = 0.0, 0.0
                    sources, spread, own_q = 0, 0.0, 0.0
                    if new[run, s0 + k]:
                        sources += 1
                        for a in range(3):
                            v = variance[run, s0 + k, a] * math.exp(logs[k, 1])
                            w = position[run, s0 + k, a] - x[3 * k + a]
                            tops[a] += w / v
                            bottoms[a] += 1.0 / v
                            spread += w * w / v
                            own_q += w * w / (v + p[3 * k + a, 3 * k + a] + process[run, s0 + k, a]) / 3.0
                    for j in range(1, n):
                        if (k > 0 and j != k) or not whole[j] or previous[s0 + j] < 0:
                            continue
                        sources += 1
                        up, other = math.exp((logs[j, 2] + logs[j, 3] + logs[j, 4]) / 3.0), j if k == 0 else 0
                        for a in range(3):
                            v = cdiag[j, a] * up + p[3 * other + a, 3 * other + a] + process[run, s0 + other, a]
                            w = rho[j, a] * (1.0 if k > 0 else -1.0)
                            tops[a] += w / v
                            bottoms[a] += 1.0 / v
                            spread += w * w / v
                    if sources == 0:
                        continue
                    q_now, trv, trq, along, across, pace = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                    for a in range(3):
                        gap3[a], p3[a], r3[a] = tops[a] / bottoms[a], 1.0 / bottoms[a], process[run, s0 + k, a]
                        v3[a] = p[3 * k + a, 3 * k + a]
                        spread -= gap3[a] * gap3[a] / p3[a]
                        q_now += gap3[a] ** 2 / (p3[a] + v3[a] + r3[a]) / 3.0
                        trv += p3[a] + v3[a]
                        trq += r3[a]
                        err[a] = true[s0 + k, a] - x[3 * k + a]
                    mx, my = moved[run, s0 + k, 0], moved[run, s0 + k, 1]
                    pace = math.sqrt(mx * mx + my * my)
                    unit = 1.0 / math.sqrt((trv + trq) / 3.0)
                    if pace > 1e-9:
                        along, across = (gap3[0] * mx + gap3[1] * my) / pace, (gap3[1] * mx - gap3[0] * my) / pace
                    for tau in range(3):
                        mem[k, WO, tau] += dt
                        mem[k, QO, tau] += dt * q_now
                        mem[k, AO, tau] += dt * along * unit
                        mem[k, CO, tau] += dt * across * unit
                    f[0] = _half_log(q_now)
                    for tau in range(3):
                        f[1 + tau] = _half_log(_mean(mem, k, QO, WO, tau))
                        f[6 + tau] = _half_log(_mean(mem, k, AO, WO, tau) ** 2)
                        f[9 + tau] = _half_log(_mean(mem, k, CO, WO, tau) ** 2)
                    f[4], f[5] = _half_log((along * unit) ** 2), _half_log((across * unit) ** 2)
                    f[12] = _clip(along / (pace + 1e-9), 2.0) if pace > 1e-9 else 0.0
                    f[13] = _clip(0.5 * math.log(trv / trq), 4.0)
                    f[14], f[15] = log_dt, 0.5 * math.log(age[k] + 0.1)
                    f[16], f[17] = n / 5.0, (1.0 if k == 0 else 0.0)
                    f[18], f[19] = logs[k, 0] / 3.0, logs[k, 1] / 3.0
                    f[20] = _half_log(_mean(mem, k, QF, WF, 0))
                    f[21] = _half_log(own_q)
                    f[22] = _clip(0.5 * math.log((pace * pace + 1e-9) / (trq / 3.0)), 4.0)
                    f[23] = _half_log(max(spread, 0.0) / max(3.0 * (sources - 1), 1.0))
                    f[24] = math.log(1.0 + sources)
                    f[25] = _clip(0.5 * math.log((v3[0] + v3[1] + v3[2]) / trq), 6.0) / 2.0
                    f[26] = (logs[k, 2] + logs[k, 3] + logs[k, 4]) / 9.0
                    f[27] = _clip(0.5 * math.log(trq / (process[run, s0, 0] * 3.0)), 4.0)
                    for j in range(FEATURES):
                        f[j] *= shown[MOTION, j]
                    if judge and not oracle:
                        logs[k, 0] = _judged(MOTION, weights, f, a1, a2, roots, firsts, feature, left, right, value, mode)
                    if collect or oracle:
                        target, apart, known = motions[run, s0 + k], 0.0, 0.0
                        for a in range(3):
                            apart += err[a] ** 2
                            known += v3[a] + r3[a]
                        if apart > LOST * known:
                            target = max(target, math.log(apart / trq))
                        if oracle:
                            logs[k, 0] = min(max(target, LEAST), LEAST + SPAN[MOTION])
                        else:
                            counts[MOTION] = _pick(rows[MOTION], counts[MOTION], f, target)
            for k in range(n):
                if previous[s0 + k] < 0:
                    continue
                for a in range(3):
                    p[3 * k + a, 3 * k + a] += process[run, s0 + k, a] * (math.exp(logs[k, 0]) if judge else 1.0)
            if judge or collect:
                # fixes: innovations, and what others say of the ego
                tops[:], bottoms[:] = 0.0, 0.0
                for k in range(n):
                    counted[k] = new[run, s0 + k] and (k == 0 or whole[k])
                    if not new[run, s0 + k]:
                        continue
                    now[k, 0] = 0.0
                    weight = math.exp(-max(logs[k, 1], 0.0))
                    for a in range(3):
                        r, gap = variance[run, s0 + k, a], position[run, s0 + k, a] - x[3 * k + a]
                        s = r + p[3 * k + a, 3 * k + a]
                        raw = gap * gap / r
                        if k > 0 and counted[k]:
                            gap -= rho[k, a]
                            r += cdiag[k, a]
                            s = r + p[a, a]
                        delta[k, a], vdelta[k, a] = gap, r
                        if counted[k]:
                            tops[a] += weight * gap / r
                            bottoms[a] += weight / r
                        u = gap / math.sqrt(s)
                        now[k, 0] += u * u / 3.0
                        for tau in range(3):
                            mem[k, UF + a, tau] += dt * u
                            mem[k, RF, tau] += dt * raw / 3.0
                    for tau in range(3):
                        mem[k, WF, tau] += dt
                        mem[k, QF, tau] += dt * now[k, 0]
                for k in range(n):
                    now[k, 1], now[k, 2] = 0.0, 1e9
                    if not counted[k]:
                        continue
                    weight, least_known, others = math.exp(-max(logs[k, 1], 0.0)), True, 0.0
                    for a in range(3):
                        bottom = bottoms[a] - weight / vdelta[k, a]
                        if bottom < 1e-6 * bottoms[a] or bottom < 1e-9:
                            least_known = False
                            break
                        d = delta[k, a] - (tops[a] - weight * delta[k, a] / vdelta[k, a]) / bottom
                        dd[k, a] = d / math.sqrt(vdelta[k, a] + 1.0 / bottom)
                        others += 1.0 / bottom
                    if least_known:
                        now[k, 2] = others
                        for a in range(3):
                            now[k, 1] += dd[k, a] ** 2 / 3.0
                            for tau in range(3):
                                mem[k, DF + a, tau] += dt * dd[k, a]
                        for tau in range(3):
                            mem[k, WD, tau] += dt
                            mem[k, QD, tau] += dt * now[k, 1]
                for k in range(n):
                    if not new[run, s0 + k]:
                        continue
                    head = OWN if k == 0 else OTHER
                    trp, trr = 0.0, 0.0
                    for a in range(3):
                        trp += p[3 * k + a, 3 * k + a]
                        trr += variance[run, s0 + k, a]
                    f[0] = _half_log(now[k, 0])
                    for tau in range(3):
                        f[1 + tau] = _half_log(_mean(mem, k, QF, WF, tau))
                        f[4 + tau] = _half_log(_norm2(mem, k, UF, WF, tau))
                    f[7], f[8] = _half_log(_mean(mem, k, RF, WF, 0)), _half_log(_mean(mem, k, RF, WF, 2))
                    f[9] = _half_log(now[k, 1])
                    f[10], f[11] = _half_log(_mean(mem, k, QD, WD, 1)), _half_log(_mean(mem, k, QD, WD, 2))
                    f[12], f[13] = _half_log(_norm2(mem, k, DF, WD, 1)), _half_log(_norm2(mem, k, DF, WD, 2))
                    f[14] = _clip(0.5 * math.log(trp / trr), 4.0)
                    f[15] = _clip(0.5 * math.log(now[k, 2] / trr), 4.0)
                    f[16], f[17] = log_dt, 0.5 * math.log(age[k] + 0.1)
                    f[18] = _clip(0.5 * math.log(trr / (3.0 * variance[run, s0, 0])), 4.0) if new[run, s0] else 0.0
                    f[19], f[20], f[21] = n / 5.0, logs[k, 1] / 3.0, logs[k, 0] / 3.0
                    f[22], f[23] = _half_log(_mean(mem, 0, QF, WF, 1)), _half_log(_norm2(mem, 0, UF, WF, 2))
                    same, level, some = 0.0, 0.0, 0
                    for j in range(1, n):
                        if j == k or mem[j, WF, 1] < 1e-9:
                            continue
                        some += 1
                        level += _half_log(_mean(mem, j, QF, WF, 1))
                        dot, sizes = 0.0, _norm2(mem, j, UF, WF, 2) * _norm2(mem, k, UF, WF, 2)
                        for a in range(3):
                            dot += _mean(mem, j, UF + a, WF, 2) * _mean(mem, k, UF + a, WF, 2)
                        same += dot / (3.0 * math.sqrt(sizes) + 1e-3)
                    f[24], f[25] = (level / some, same / some) if some > 0 else (0.0, 0.0)
                    f[26], f[27] = logs[k, 2] / 3.0, _half_log(_mean(mem, k, QR, WR, 1))
                    if k == 0:
                        f[26], f[27] = 0.0, 0.0
                    for j in range(FEATURES):
                        f[j] *= shown[head, j]
                    if judge:
                        dd[k, 0] = fixes[run, s0 + k] if oracle else _judged(head, weights, f, a1, a2, roots, firsts, feature, left, right, value, mode)
                    if collect:
                        counts[head] = _pick(rows[head], counts[head], f, fixes[run, s0 + k])
                if judge:
                    for k in range(n):
                        if new[run, s0 + k]:
                            logs[k, 1] = dd[k, 0]
                # relative measurements
                for k in range(1, n):
                    for c in range(3):
                        now[k, 3 + c], now[k, 6 + c] = 0.0, 0.0
                        if not math.isfinite(relative[run, s0 + k, c]):
                            continue
                        s = 0.0
                        for a in range(3):
                            for b in range(3):
                                cov = p[3 * k + a, 3 * k + b] - p[3 * k + a, b] - p[a, 3 * k + b] + p[a, b]
                                s += e[k, c, a] * e[k, c, b] * cov
                        now[k, 9 + c] = g[k, c] ** 2 * s
                        u = res[k, c] / math.sqrt(std[c] ** 2 + now[k, 9 + c])
                        now[k, 3 + c], now[k, 6 + c] = u * u, _clip(u / 3.0, 3.0)
                        for tau in range(3):
                            mem[k, WR + c, tau] += dt
                            mem[k, QR + c, tau] += dt * u * u
                            mem[k, SR + c, tau] += dt * _clip(u, 30.0)
                for k in range(1, n):
                    for c in range(3):
                        if not math.isfinite(relative[run, s0 + k, c]):
                            continue
                        head = RANGE if c == 0 else ANGLE
                        f[0], f[1] = _half_log(now[k, 3 + c]), now[k, 6 + c]
                        for tau in range(3):
                            f[2 + tau] = _half_log(_mean(mem, k, QR + c, WR + c, tau))
                            f[5 + tau] = _clip(_mean(mem, k, SR + c, WR + c, tau), 5.0)
                        signed, level, present, some = 0.0, 0.0, 0.0, 0
                        for j in range(1, n):
                            if j == k or mem[j, WR + c, 1] < 1e-9:
                                continue
                            some += 1
                            signed += _clip(_mean(mem, j, SR + c, WR + c, 1), 5.0)
                            level += _half_log(_mean(mem, j, QR + c, WR + c, 1))
                            present += now[j, 6 + c]
                        f[8], f[9], f[25] = (signed / some, level / some, present / some) if some else (0.0, 0.0, 0.0)
                        c1, c2 = (c + 1) % 3, (c + 2) % 3
                        f[10] = 0.5 * (_half_log(now[k, 3 + c1]) + _half_log(now[k, 3 + c2]))
                        f[11] = _half_log(_mean(mem, k, QR + c1, WR + c1, 1)) + _half_log(_mean(mem, k, QR + c2, WR + c2, 1))
                        f[12], f[13] = _half_log(_mean(mem, k, QF, WF, 1)), _half_log(_norm2(mem, k, UF, WF, 2))
                        f[14] = _half_log(_mean(mem, k, QD, WD, 1))
                        f[15] = _clip(0.5 * math.log(max(now[k, 9 + c], 1e-12) / std[c] ** 2), 4.0)
                        f[16], f[17], f[18], f[19] = log_dt, 0.5 * math.log(age[k] + 0.1), 0.0, n / 5.0
                        f[20], f[21], f[22], f[23] = logs[k, 2 + c] / 3.0, logs[k, 1] / 3.0, logs[0, 0] / 3.0, logs[k, 0] / 3.0
                        f[24] = 1.0 if c == 2 else 0.0
                        f[26] = _clip(math.log(std[1] * max(polar[k, 0], least) / std[0]), 4.0)
                        f[27] = _half_log(_mean(mem, 0, QF, WF, 1))
                        for j in range(FEATURES):
                            f[j] *= shown[head, j]
                        if judge:
                            v3[c] = relatives[run, s0 + k, c] if oracle else _judged(head, weights, f, a1, a2, roots, firsts, feature, left, right, value, mode)
                        if collect:
                            counts[head] = _pick(rows[head], counts[head], f, relatives[run, s0 + k, c])
                    if judge:
                        for c in range(3):
                            if math.isfinite(relative[run, s0 + k, c]):
                                logs[k, 2 + c] = v3[c]
            # update: fixes, relative measurements converted at the prediction, and from there once more as measured
            dx[:m] = 0.0
            for k in range(n):
                if new[run, s0 + k]:
                    by = math.exp(logs[k, 1]) if judge else 1.0
                    for a in range(3):
                        i = 3 * k + a
                        _add_fix(p, dx, i, position[run, s0 + k, a] - x[i], by * variance[run, s0 + k, a], m, ph)
            if n > 1:
                for k in range(1, n):
                    counted[k] = whole[k] or p[3 * k, 3 * k] < UNKNOWN
                for i in range(m):
                    far[i] = dx[i]
                    for j in range(m):
                        q[i, j] = p[i, j]
                for k in range(1, n):
                    if not counted[k]:
                        continue
                    reach, level = max(polar[k, 0], least), max(abs(polar[k, 2]), 1e-3)
                    r3[0], r3[1], r3[2] = std[0], std[1] * level * reach, std[2] * reach
                    for c in range(3):
                        if math.isfinite(relative[run, s0 + k, c]):
                            gap = e[k, c, 0] * rho[k, 0] + e[k, c, 1] * rho[k, 1] + e[k, c, 2] * rho[k, 2]
                            by = math.exp(logs[k, 2 + c]) if judge else 1.0
                            _add_gap(q, far, k, e[k, c], gap, by * r3[c] ** 2, m, ph)
                for k in range(1, n):
                    if not counted[k]:
                        continue
                    for a in range(3):
                        v3[a] = far[3 * k + a] - far[a]
                        one[a] = x[3 * k + a] - x[a] + v3[a]
                    _polar(one, et, pt)
                    _slopes(pt, least, gt)
                    _residuals(relative[run, s0 + k], pt, err)
                    for c in range(3):
                        if math.isfinite(relative[run, s0 + k, c]):
                            for a in range(3):
                                one[a] = gt[c] * et[c, a]
                            gap = err[c] + one[0] * v3[0] + one[1] * v3[1] + one[2] * v3[2]
                            by = math.exp(logs[k, 2 + c]) if judge else 1.0
                            _add_gap(p, dx, k, one, gap, by * std[c] ** 2, m, ph)
            for i in range(m):
                x[i] += dx[i]
                for j in range(i):
                    p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])
            for a in range(3):
                out_x[run, t, a] = x[a]
                for b in range(3):
                    out_cov[run, t, a, b] = p[a, b]
    return out_x, out_cov, counts
