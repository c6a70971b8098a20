"""Fixes of a star's vehicles: those behind two solo estimates, odometers, and which receivers are trusted."""

from __future__ import annotations

import math

from ...arrays import Floats
from ..compiling.compile import inside, part
from ..gate import SLIP, count, inflation
from .cooperative_state import (
    AGE,
    COUNT,
    FIXES,
    LAST,
    MEAN,
    ODOMETER,
    SOLO,
    SOLO_VARIANCE,
    SPEED,
    STEP,
    TRUSTED,
    TYPICAL,
    USED,
    Filter,
    Guards,
    Model,
    doubt,
    unused,
)
from .gaussian import (
    ABSENT,
    CLONE,
    COMMON,
    ERROR,
    PLACE,
    TURN,
    VELOCITY,
    correct,
    distance,
    expect,
    has,
    innovate,
    insert,
    remove,
    settle,
    shift,
    term,
    update,
    widen,
)
from .lasting import hold, turned
from .slip import score

JITTER = 1e-12
"""m^2 that keeps a clone from being the very number it was cloned of."""
NOTHING_NEW = 1e-9
"""Least weight of new fixes in an estimate."""
CLIP = 12.0
FIX_SCORE = 16.0
"""Most of a squared Mahalanobis distance of a fix that tells of a slip."""
"""Largest squared Mahalanobis distance of an innovation in a mean."""


@inside
def fix_terms(f: Filter, k: int) -> None:
    """Position of member k, error of its fixes, and the one that all share."""
    g, n = f.g, 1
    term(f.h, 0, g.block[k, PLACE], 1.0)
    if has(g, k, ERROR):
        term(f.h, n, g.block[k, ERROR], 1.0)
        n += 1
    if has(g, 0, COMMON):
        term(f.h, n, g.block[0, COMMON], 1.0)


@inside
def receive(f: Filter, model: Model, guards: Guards, rows: Floats, k: int) -> None:
    """Use the newest message of member k, if it has not been used."""
    g, j, row = f.g, f.vehicle[k], f.row[k]
    age = rows[row, AGE]
    sent = f.clock[0] - age
    if not unused(f, rows, k):
        return
    velocity, back, changed = has(g, k, VELOCITY), -age, 0.0
    before = model.estimates > 0.0 and f.status[j, USED] > -math.inf
    clone = before and has(g, k, CLONE)
    if velocity:
        changed = (0.5 * guards.acceleration * back * back) ** 2
        if clone:
            use_odometer(f, guards, rows, k, back, changed)
    believed = content(f, model, rows, k, changed, clone, before)
    f.q[k, 3] = use_fix(f, model, guards, k, before and believed, innovate(g, f.h))
    f.status[j, USED] = sent
    for c in range(3):
        f.status[j, LAST + c] = rows[row, SOLO + c]
        f.status[j, LAST + 3 + c] = rows[row, SOLO_VARIANCE + c]
        f.status[j, LAST + 6 + c] = rows[row, ODOMETER + c]
        f.status[j, LAST + 9 + c] = rows[row, STEP + c]
    if velocity:
        clone_position(f, k, back, changed)


@inside
def use_fix(f: Filter, model: Model, guards: Guards, k: int, again: bool, q: float) -> float:
    """Update by the rows of a vehicle's fix, unless its receiver errs otherwise than is assumed; the share of its
    information that it keeps.

    Args:
        f: filter.
        model: noise model.
        guards: against what may be wrong.
        k: slot.
        again: whether it is not the vehicle's first one, and one that the vehicle believes.
        q: of `innovate`.
    """
    g, h, j, used = f.g, f.h, f.vehicle[k], 0
    for c in range(3):
        used += h.used[c]
    if f.vague[k] > 0.0 and used == 3:
        settle(g, h, k, f.vague[k])
        f.vague[k] = 0.0
        return 1.0
    if guards.trust > 0.0 and again and used == 3 and q > 0.0 and wrong_on_average(f, model, guards, k, q):
        if f.status[j, TRUSTED] > 0.0:
            f.revoked[j, 0], f.revoked[j, 1] = f.revoked[j, 0] + 1.0, f.clock[0]
        doubt(f, model, guards, j)
        if k == 0:  # so that it counts in retrospect, should its receiver be trusted again
            fix_terms(f, 0)
            innovate(g, h)
            correct(g, h, 1.0)
        return 0.0
    q = min(q, (h.gap[0] * h.gap[0] + h.gap[1] * h.gap[1] + h.gap[2] * h.gap[2]) / SLIP)
    own, noise = 1e-12, 0.0
    for c in range(3):
        if h.used[c]:
            own, noise = own + h.cov[4 * c], noise + h.variance[c]
    share = 1.0
    quiet = math.exp(-min(f.level[0, FIXES], 0.0)) if k == 0 else 1.0
    q *= (own + noise) / (own + quiet * noise)  # fixes that agree better than is assumed are as wrong as any, together
    if guards.fix_gate > 0.0:
        share = 1.0 / inflation(q, guards.fix_gate, f.locked[k])
        f.locked[k] = count(q, guards.fix_gate, f.locked[k], own / (own + noise))
    score(f, h, FIX_SCORE, True)
    correct(g, h, share)
    hold(f, share)
    return share


@inside
def content(f: Filter, model: Model, rows: Floats, k: int, changed: float, clone: bool, before: bool) -> bool:
    """Rows of what the message of member k says of its position when it was sent.

    The odometer's error of the fixes since the last message is `middle` times that of the whole way, so that they are
    seen as middle y + (1 - middle) c, y the position now and c its clone. True unless the sender disbelieved them.
    """
    believed = True
    g, h, j, row = f.g, f.h, f.vehicle[k], f.row[k]
    velocity, age, steps = has(g, k, VELOCITY), rows[row, AGE], steps_between(f, rows, k)
    back, old, terms = -age, age / f.clock[1], 1 + (1 if has(g, k, ERROR) else 0) + (1 if has(g, 0, COMMON) else 0)
    fix_terms(f, k)
    if velocity:
        term(h, terms, g.block[k, VELOCITY], back)
    if clone:
        term(h, terms + 1, g.block[k, CLONE], 0.0)
    for c in range(3):
        one, used = rows[row, STEP + c], True
        m, r = rows[row, SOLO + c], rows[row, SOLO_VARIANCE + c]
        if before:
            moved = rows[row, ODOMETER + c] - f.status[j, LAST + 6 + c]
            spent = one + 0.5 * (steps - 1.0) * (one + f.status[j, LAST + 9 + c])
            carried, p0 = f.status[j, LAST + c] + moved, f.status[j, LAST + 3 + c]
            m, r, walk, middle = fixes_between(m, r, carried, p0, spent, steps, rows[row, TYPICAL + c])
            used, believed = r > 0.0, believed and r < 4.0 * rows[row, TYPICAL + c]
            r = r * model.white[c] + walk
            if clone:
                m += (middle - 1.0) * moved
                h.weight[4 * c], h.weight[9 * terms + 4 * c] = middle, middle * back
                h.weight[9 * terms + 9 + 4 * c] = 1.0 - middle
            else:
                r += (1.0 - middle) ** 2 * spent
        if not velocity:
            m += age * rows[row, SPEED + c]
            r += old * old * (one + (f.clock[1] * age * model.acceleration) ** 2)
        expect(h, c, m, r + changed)
        h.used[c] = used
    return believed


@inside
def steps_between(f: Filter, rows: Floats, k: int) -> float:
    """Steps between the last two messages of member k."""
    since = f.clock[0] - rows[f.row[k], AGE] - f.status[f.vehicle[k], USED]
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
    p0 = max(p0, 1e-12)
    if steps == 1.0:
        new = 1.0 - p / (p0 + spent)
        return (now, 0.0, 0.0, 1.0) if new < NOTHING_NEW else (carried + (now - carried) / new, p / new, 0.0, 1.0)
    start, mean = p0 + 0.5 * (p - p0) * (1.0 - 1.0 / steps), p0 + 0.5 * (p - p0) * (1.0 + 1.0 / steps)
    taken = max(math.log(p0 / p) + steps * math.log(1.0 + spent / steps / start), 0.0)
    usual = -steps * math.log(max(1.0 - mean / fix, 1e-3))
    if 2.0 * taken > usual:
        taken = usual
    new = 1.0 - math.exp(-taken)
    if new < NOTHING_NEW:
        return now, 0.0, 0.0, 1.0
    keep, k = 1.0 - new, 1.0 - math.exp(-taken / steps)
    white = mean / (2.0 - k) * (1.0 + keep) / new
    middle = 1.0 / new - (1.0 - k) / (k * steps)
    walk = spent * (steps - 1.0 / steps) / (12.0 * steps)
    return carried + (now - carried) / new, white, walk, min(max(middle, 0.5), 1.0)


@part
def use_odometer(f: Filter, guards: Guards, rows: Floats, k: int, back: float, changed: float) -> None:
    """How far member k has moved between its last two messages."""
    g, h, j, row = f.g, f.h, f.vehicle[k], f.row[k]
    steps = steps_between(f, rows, k)
    term(h, 0, g.block[k, PLACE], 1.0)
    term(h, 1, g.block[k, VELOCITY], back)
    term(h, 2, g.block[k, CLONE], -1.0)
    moved = (
        rows[row, ODOMETER] - f.status[j, LAST + 6],
        rows[row, ODOMETER + 1] - f.status[j, LAST + 7],
        rows[row, ODOMETER + 2] - f.status[j, LAST + 8],
    )
    way = odometry_term(f, k, 3, moved)
    for c in range(3):
        spent = 0.5 * steps * (rows[row, STEP + c] + f.status[j, LAST + 9 + c])
        expect(h, c, way[c], spent + changed)
    update(g, h, guards.fix_gate)


@part
def odometry_term(f: Filter, k: int, at: int, moved: tuple[float, float, float]) -> tuple[float, float, float]:
    """Let term `at` be the error of a motion by odometry; what was driven, were there none."""
    g, h = f.g, f.h
    way = turned(g, k, moved, h.turn)
    if not has(g, k, TURN):
        return way
    i, w = 3 * g.block[k, TURN], h.turn
    h.block[at], h.terms[0] = g.block[k, TURN], at + 1
    for n in range(9):
        h.weight[9 * at + n] = -w[n]
    b, s = g.x[i], g.x[i + 1]
    return way[0] - w[0] * b - w[1] * s, way[1] - w[3] * b - w[4] * s, way[2]


@part
def clone_position(f: Filter, k: int, back: float, changed: float) -> None:
    """Remember, in the state, where member k was when it sent its newest message."""
    g = f.g
    remove(g, k, CLONE)
    clone, first, v = insert(g, k, CLONE, 0.0), 3 * g.block[k, PLACE], 3 * g.block[k, VELOCITY]
    shift(g, clone, first, 1.0)
    shift(g, clone, v, back)
    widen(g, clone, changed + JITTER)


@inside
def wrong_on_average(f: Filter, model: Model, guards: Guards, k: int, q: float) -> bool:
    """Whether the mean of a vehicle's innovations, each clipped, is likelier with another error of its fixes than is
    assumed; or, where that error is being estimated, with the last one alone."""
    h, status, j = f.h, f.status, f.vehicle[k]
    mean, s = status[j, MEAN : MEAN + 3], h.square
    status[j, COUNT] = count = min(status[j, COUNT] + 1.0, guards.window)
    if status[j, TRUSTED] == 0.0 and q > guards.fix_gate:
        return True
    clip = math.sqrt(CLIP / q) if q > CLIP else 1.0
    for c in range(3):
        mean[c] += (clip * h.gap[c] - mean[c]) / count
        for d in range(3):
            s[c, d] = h.cov[3 * c + d]
        s[c, c] += h.variance[c] / count + (1.0 if model.own > 0.0 else 0.0)
    odds = math.log((1.0 - guards.share) / guards.share)
    near, narrow = distance(s, mean)
    if count < 3.0 or near < 2.0 * (odds + guards.revoke):
        return False
    for c in range(3):
        s[c, c] += guards.tau**2
    far, wide = distance(s, mean)
    return bool(odds + 0.5 * math.log(wide / narrow) + 0.5 * (far - near) < -guards.revoke)


@part
def trust(f: Filter, model: Model, guards: Guards) -> None:
    """Set the error of fixes to zero, or to what drifts, while that is likelier than any other: the surest first.

    The odds p(b = 0 | all) / p(b = 0) of a Gaussian b are by Bayes' rule those of the two hypotheses.
    """
    g, h, s, x = f.g, f.h, f.h.square, f.h.gap
    wide, narrow, unit = guards.tau**2 + model.own, 0.0, guards.tau**2
    if model.own > 0.0:
        narrow = 1.0 / (1.0 / model.own - 1.0 / wide)
        unit = wide / model.own * narrow
    while True:
        best, most = ABSENT, guards.sure
        for k in range(len(f.vehicle)):
            j = f.vehicle[k]
            if j < 0 or f.status[j, TRUSTED] > 0.0 or (k > 0 and f.status[j, USED] == -math.inf):
                continue
            first = 3 * g.block[k, ERROR]
            for c in range(3):
                x[c] = g.x[first + c]
                for d in range(3):
                    s[c, d] = g.p[first + c, first + d] + (narrow if c == d else 0.0)
            q, det = distance(s, x)
            odds = math.log((1.0 - guards.share) / guards.share) - guards.penalty * f.revoked[j, 0]
            odds += 0.5 * math.log(unit**3 / det) - 0.5 * q
            if odds > most:
                best, most = k, odds
        if best < 0:
            return
        j = f.vehicle[best]
        f.status[j, TRUSTED], f.status[j, COUNT] = 1.0, 0.0
        term(h, 0, g.block[best, ERROR], 1.0)
        for c in range(3):
            expect(h, c, 0.0, max(narrow, 1e-6))
            f.status[j, MEAN + c] = 0.0
        update(g, h, 0.0)
        if model.own == 0.0:
            remove(g, best, ERROR)
