"""Messages of the members of a star: the fixes behind two estimates, odometers, and whose fixes are believed."""

from __future__ import annotations

import math

from ...arrays import Floats
from ..compiling.compile import part
from ..dead_reckoning import ROUNDING
from .cooperative_state import (
    AGE,
    COUNT,
    ESTIMATE,
    KEPT,
    KEPT_VARIANCE,
    KNOWN,
    LAST,
    MEAN,
    ODOMETER,
    SENT,
    SPEED,
    STEP,
    TRUSTED,
    TYPICAL,
    VARIANCE,
    Filter,
    Guards,
    Model,
    follow,
    late,
    measured_whole,
)
from .gaussian import ABSENT, CLONE, COMMON, ERROR, POSITION, VELOCITY, has, insert, remove, shift, term, update, widen

JITTER = 1e-12
"""m^2 that keeps a clone from being the very number it was cloned of."""
NOTHING_NEW = 1e-9
"""Least weight of new fixes in an estimate."""
PARTS = 50
"""Most parts of the way between two messages that are looked at one by one."""


@part
def fix_terms(f: Filter, k: int) -> None:
    """Position of member k, error of its fixes, and the one that all share."""
    g, n = f.g, 1
    term(f.h, 0, 3 * g.block[k, POSITION], 1.0)
    if has(g, k, ERROR):
        term(f.h, n, 3 * g.block[k, ERROR], 1.0)
        n += 1
    if has(g, 0, COMMON):
        term(f.h, n, 3 * g.block[0, COMMON], 1.0)


@part
def receive(f: Filter, known: Model, guards: Guards, rows: Floats, k: int) -> None:
    """Use the newest message of member k, if it has not been used."""
    g, h, j, row = f.g, f.h, f.vehicle[k], f.row[k]
    age = rows[row, AGE]
    sent = f.clock[0] - age
    if guards.acceleration > 0.0 and late(age) and not has(g, k, VELOCITY):
        follow(f, rows, k)
    if age < 0.0 or sent <= f.status[j, SENT] + ROUNDING or not math.isfinite(rows[row, ESTIMATE]):
        return
    first, incomplete = 3 * g.block[k, POSITION], not measured_whole(rows, row)
    if g.p[first, first] >= KNOWN and (incomplete or f.joined[k] < f.step[0]):
        for c in range(3):  # nothing was known of where it is
            g.x[first + c] = f.at[k, c] = rows[row, ESTIMATE + c] + age * rows[row, SPEED + c]
    velocity, back, changed = has(g, k, VELOCITY), -age, 0.0
    before = known.estimates > 0.0 and f.status[j, SENT] > -math.inf
    clone = before and has(g, k, CLONE)
    if velocity:
        changed = (0.5 * guards.acceleration * back * back) ** 2
        use_velocity(f, known, guards, rows, k)
        if clone:
            use_odometer(f, rows, k, back, changed)
    content(f, known, rows, k, changed, clone, before)
    if before and guards.trust > 0.0 and f.status[j, TRUSTED] > 0.0 and betrayed(f, known, guards, k):
        f.betrayals[j, 0], f.betrayals[j, 1], f.alarm[0] = f.betrayals[j, 0] + 1.0, f.clock[0], 1
    if f.betrayals[j, 0] > 0.0 and f.clock[0] <= f.betrayals[j, 1]:
        h.used[0] = h.used[1] = h.used[2] = False
    update(g.x, g.p, 3 * g.vectors[0], h, guards.fix_gate)
    f.q[k, 3] = max(h.q[0], h.q[1], h.q[2])
    f.status[j, SENT] = sent
    for c in range(3):
        f.status[j, LAST + c] = rows[row, ESTIMATE + c]
        f.status[j, LAST + 3 + c] = rows[row, VARIANCE + c]
        f.status[j, LAST + 6 + c] = rows[row, ODOMETER + c]
        f.status[j, LAST + 9 + c] = rows[row, STEP + c]
    if velocity:
        clone_position(f, k, back, changed)


@part
def content(f: Filter, known: Model, rows: Floats, k: int, changed: float, clone: bool, before: bool) -> None:
    """Rows of what the message of member k says of its position when it was sent.

    The odometer's error of the fixes since the last message is `middle` times that of the whole way, so that they are
    seen as middle y + (1 - middle) c, y the position now and c its clone.
    """
    g, h, j, row = f.g, f.h, f.vehicle[k], f.row[k]
    velocity, age, steps = has(g, k, VELOCITY), rows[row, AGE], steps_between(f, rows, k)
    back, old, terms = -age, age / f.clock[1], 1 + (1 if has(g, k, ERROR) else 0) + (1 if has(g, 0, COMMON) else 0)
    fix_terms(f, k)
    if velocity:
        term(h, terms, 3 * g.block[k, VELOCITY], back)
    if clone:
        term(h, terms + 1, 3 * g.block[k, CLONE], 0.0)
    for c in range(3):
        one, h.used[c], h.gated[c] = rows[row, STEP + c], True, before or known.estimates == 0.0
        m, r = rows[row, ESTIMATE + c], rows[row, VARIANCE + c]
        if before:
            moved = rows[row, ODOMETER + c] - f.status[j, LAST + 6 + c]
            spent = one + 0.5 * (steps - 1.0) * (one + f.status[j, LAST + 9 + c])
            carried, p0 = f.status[j, LAST + c] + moved, f.status[j, LAST + 3 + c]
            m, r, walk, middle = fixes_between(m, r, carried, p0, spent, steps, rows[row, TYPICAL + c])
            h.used[c] = r > 0.0
            r = r * known.white[c] + walk
            if clone:
                m += (middle - 1.0) * moved
                h.weight[c, 0], h.weight[c, terms] = middle, middle * back
                h.weight[c, terms + 1] = 1.0 - middle
            else:
                r += (1.0 - middle) ** 2 * spent
        if not velocity:
            m += age * rows[row, SPEED + c]
            r += old * old * (one + (f.clock[1] * age * known.acceleration) ** 2)
        h.z[c], h.variance[c] = m, r + changed


@part
def steps_between(f: Filter, rows: Floats, k: int) -> float:
    """Steps between the last two messages of member k."""
    since = f.clock[0] - rows[f.row[k], AGE] - f.status[f.vehicle[k], SENT]
    return float(max(1.0, math.floor(since / f.clock[1] + 0.5)))


@part
def fixes_between(
    now: float, p: float, carried: float, p0: float, spent: float, steps: float, fix: float
) -> tuple[float, float, float, float]:
    """What the fixes say that a solo filter took between two of its estimates, on one axis.

    An estimate is keep carried + (1 - keep) m, m the weighted mean of the new fixes brought forward, and
    keep = prod(1 - K_i). From p_i = (1 - K_i) (p_{i-1} + q) the gains follow from the variances alone, of those
    between two messages from a line: a fix that was missing or that the sender did not believe has no weight here.

    Args:
        now: m, estimate.
        p: m^2, its variance.
        carried: m, the last estimate moved by the odometer.
        p0: m^2, variance of the last estimate.
        spent: m^2, variance of the odometer since.
        steps: since.

    Returns:
        m; its variance from white noise, 0 if there is nothing new; its variance from the odometer, were the whole way
        known; and the share of the way's error that m has.
    """
    if p > p0 + 2.0 * spent + 1e-9:  # the sender has started anew
        return now, p, 0.0, 1.0
    parts = int(min(steps, PARTS))
    each, taken, all_taken, sizes, before = steps / parts, 0.0, 0.0, 0.0, p0
    for i in range(parts):
        after = p0 + (p - p0) * (i + 1.0) / parts
        taken -= math.log(min(after / (before + spent / parts), 1.0))
        all_taken -= each * math.log(max(1.0 - after / fix, 1e-3))
        sizes += after
        before = after
    if steps > 1.0 and 2.0 * taken > all_taken:
        taken = all_taken
    new = 1.0 - math.exp(-taken)
    if new < NOTHING_NEW:
        return now, 0.0, 0.0, 1.0
    keep, k = 1.0 - new, 1.0 - math.exp(-taken / steps)
    fix = sizes / parts / k
    white = fix * k / (2.0 - k) * (1.0 + keep) / new
    middle = (1.0 / new - (1.0 - k) / (k * steps)) if steps > 1.0 else 1.0
    walk = spent * (steps - 1.0 / steps) / (12.0 * steps)
    return carried + (now - carried) / new, white, walk, min(max(middle, 0.5), 1.0)


@part
def use_velocity(f: Filter, known: Model, guards: Guards, rows: Floats, k: int) -> None:
    """The velocity of the newest message of member k."""
    g, h, row = f.g, f.h, f.row[k]
    term(h, 0, 3 * g.block[k, VELOCITY], 1.0)
    for c in range(3):
        h.z[c], h.used[c], h.gated[c] = rows[row, SPEED + c], True, False
        changed = guards.acceleration * rows[row, AGE]
        h.variance[c] = rows[row, STEP + c] / f.clock[1] ** 2 + changed * changed
    update(g.x, g.p, 3 * g.vectors[0], h, 0.0)


@part
def use_odometer(f: Filter, rows: Floats, k: int, back: float, changed: float) -> None:
    """How far member k has moved between its last two messages."""
    g, h, j, row = f.g, f.h, f.vehicle[k], f.row[k]
    steps = steps_between(f, rows, k)
    term(h, 0, 3 * g.block[k, POSITION], 1.0)
    term(h, 1, 3 * g.block[k, VELOCITY], back)
    term(h, 2, 3 * g.block[k, CLONE], -1.0)
    for c in range(3):
        h.z[c], h.used[c], h.gated[c] = rows[row, ODOMETER + c] - f.status[j, LAST + 6 + c], True, False
        h.variance[c] = 0.5 * steps * (rows[row, STEP + c] + f.status[j, LAST + 9 + c]) + changed
    update(g.x, g.p, 3 * g.vectors[0], h, 0.0)


@part
def clone_position(f: Filter, k: int, back: float, changed: float) -> None:
    """Remember, in the state, where member k was when it sent its newest message."""
    g = f.g
    remove(g, k, CLONE)
    clone, first, v = insert(g, k, CLONE, 0.0), 3 * g.block[k, POSITION], 3 * g.block[k, VELOCITY]
    shift(g, clone, first, 1.0)
    shift(g, clone, v, back)
    widen(g, clone, changed + JITTER)


@part
def betrayed(f: Filter, known: Model, guards: Guards, k: int) -> bool:
    """Whether the mean innovation of a trusted member, each clipped, says that its fixes have an error."""
    g, h, status = f.g, f.h, f.status
    j, first = f.vehicle[k], 3 * g.block[k, POSITION]
    status[j, COUNT] = count = min(status[j, COUNT] + 1.0, guards.window)
    odds = math.log((1.0 - guards.share) / guards.share)
    for c in range(3):
        if not h.used[c]:
            continue
        gap, mean, p = h.z[c], MEAN + c, g.p[first + c, first + c]
        for i in range(h.terms[0]):
            gap -= h.weight[c, i] * g.x[h.column[c, i]]
        far = 3.0 * math.sqrt(p + h.variance[c])
        status[j, mean] += (min(max(gap, -far), far) - status[j, mean]) / count
        v = p + h.variance[c] / count + (1.0 if known.own > 0.0 else 0.0)
        odds += log_odds(status[j, mean], v, v + guards.tau**2)
    return odds < -guards.revoke and count >= 3.0


@part
def log_odds(x: float, narrow: float, wide: float) -> float:
    """log N(x; 0, narrow) - log N(x; 0, wide)."""
    return 0.5 * math.log(wide / narrow) - 0.5 * x * x * (1.0 / narrow - 1.0 / wide)


@part
def distrust(f: Filter, known: Model, guards: Guards) -> None:
    """In a state of before, take trust from those who have lost it since: their fixes have an unknown error again."""
    for j in range(len(f.slot)):
        if f.betrayals[j, 0] == 0.0 or f.betrayals[j, 1] < f.clock[0] or f.status[j, TRUSTED] == 0.0:
            continue
        f.status[j, TRUSTED] = f.status[j, COUNT] = 0.0
        for c in range(3):
            f.status[j, MEAN + c] = f.status[j, KEPT + c] = 0.0
            f.status[j, KEPT_VARIANCE + c] = guards.tau**2
        if f.slot[j] >= 0:
            remove(f.g, f.slot[j], ERROR)
            insert(f.g, f.slot[j], ERROR, guards.tau**2 + known.own)


@part
def trust(f: Filter, known: Model, guards: Guards) -> None:
    """Set the error of fixes to zero, or to what drifts, while that is likelier than any other: the surest first."""
    g, h = f.g, f.h
    wide = guards.tau**2 + known.own
    narrow = 1.0 / (1.0 / known.own - 1.0 / wide) if known.own > 0.0 else 1e-6
    while True:
        best, most = ABSENT, guards.sure
        for k in range(1, len(f.vehicle)):
            if f.vehicle[k] < 0 or f.status[f.vehicle[k], TRUSTED] > 0.0 or f.status[f.vehicle[k], SENT] == -math.inf:
                continue
            odds = math.log((1.0 - guards.share) / guards.share) - guards.grudge * f.betrayals[f.vehicle[k], 0]
            for c in range(3):
                i = 3 * g.block[k, ERROR] + c
                if known.own > 0.0:
                    v = narrow + g.p[i, i]
                    odds += 0.5 * math.log(wide / known.own * narrow / v) - 0.5 * g.x[i] ** 2 / v
                else:
                    odds += 0.5 * math.log(wide / g.p[i, i]) - 0.5 * g.x[i] ** 2 / g.p[i, i]
            if odds > most:
                best, most = k, odds
        if best < 0:
            return
        j = f.vehicle[best]
        f.status[j, TRUSTED], f.status[j, COUNT] = 1.0, 0.0
        term(h, 0, 3 * g.block[best, ERROR], 1.0)
        for c in range(3):
            h.z[c], h.variance[c], h.used[c], h.gated[c] = 0.0, narrow, True, False
            f.status[j, MEAN + c] = 0.0
        update(g.x, g.p, 3 * g.vectors[0], h, 0.0)
        if known.own == 0.0:
            remove(g, best, ERROR)
