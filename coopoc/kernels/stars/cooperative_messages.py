"""What the vehicles of a star send, and what their fixes say: a fading memory of fixes, and whose are trusted."""

import math

import numpy as np

from ...arrays import Floats
from ..compiling.compile import compiled, inner, inside, part
from ..compiling.small import (
    add,
    add_diagonal,
    block_at,
    inner_product,
    normalised_square,
    scale,
    store,
    subtract,
    trace,
    vector_at,
)
from ..dead_reckoning import ROUNDING
from ..gate import FIX_GATE, NOT_REMEMBERED_M2, PATIENCE, SLIP_M2, count, inflation
from ..geometry import submatrix
from .cooperative_members import dismiss, replace_implausible_velocity, stand
from .cooperative_state import (
    AGE,
    AGREED,
    BARE,
    CLOCK,
    COUNT,
    CROSS,
    ESTABLISHED,
    EXTRA_VARIANCE,
    FIXES,
    HITS,
    INPUT,
    LAST,
    LEFT,
    LEVEL,
    LOCKED,
    MAX_LOCKOUT,
    MEAN,
    MESSAGES,
    NO_POSITION,
    NOISE,
    ODOMETER,
    OFFSET,
    OUT,
    PACE,
    PACE2,
    REJECTED,
    REVOKED,
    SLIPS,
    SOLO,
    SOLO_VARIANCE,
    SPAN,
    SPEED,
    STEP,
    TAU,
    TRUSTED,
    TURN_MEMORY_S,
    TYPICAL,
    USED,
    VEHICLE,
    WAY,
    WHEN,
    WILD,
    Filter,
    Model,
    has_fixes,
    heard,
    set_trust,
)
from .gaussian import (
    ABSENT,
    COMMON,
    COV,
    ERROR,
    GAP,
    IDENTITY,
    MEASURED,
    PLACE,
    TURN,
    VARIANCE,
    add_term,
    begin_rows,
    clear,
    correct,
    distance,
    expect,
    has,
    innovate,
    insert_from_measurement,
    remove,
    update,
    widen,
)
from .lasting import usual_error
from .messages import three_of
from .otherwise import JUMPED, LOUDEST_NOISE, SHOWN, drive, learn_fix, score, turned

FADES = 5.0
"""s, after which a fix weighs 1 / e in the mean that is sent."""
LEAST_NEW = 0.01
"""Least weight of new fixes in a sum, in fixes as they are assumed: less are rounded ages, or numbers of 32 bits."""
CLIP = 12.0
"""Largest squared Mahalanobis distance of an innovation in a mean."""
FIX_SCORE = 16.0
"""Most of a squared Mahalanobis distance of a fix that tells of a slip."""
FAULTY_SHARE = 0.1
"""Prior share of vehicles whose receiver errs: of 0.05 to 0.3 no world is told apart."""
TRUST_LOG_ODDS, PENALTY, REVOKE_LOG_ODDS = 2.0, 4.0, 2.0
"""Log odds from which a vehicle's fixes are trusted, what each revocation costs, and from which trust ends."""
MOVES = 0.01
"""Share of the variance of a fix from which the square of a step's motion says that a vehicle does not stand."""
LEAST, WINDOW = 6.0, 30.0
"""Fixes in the mean innovation of a vehicle: from how many it counts, and the most."""


@inside
def fix_terms(f: Filter, k: int) -> None:
    """Position of member k, error of its fixes, and the one that all share."""
    block = f.g.block
    begin_rows(f.h)
    add_term(f.h, block[k, PLACE], IDENTITY)
    add_term(f.h, block[k, ERROR], IDENTITY)
    add_term(f.h, block[0, COMMON], IDENTITY)


@compiled
def fading_memory(gnss: Floats, velocity: Floats, variance: Floats, dt: float) -> Floats:
    """What vehicles send: (N, R, T, 9) mean of fixes m, its variance m^2, and odometer m, as `remember` writes them.

    Args:
        gnss: (R, T, N, 3) m, NaN for none.
        velocity: (R, T, N, 3) m/s, NaN where a vehicle is absent: it begins anew.
        variance: m^2, broadcastable, as is assumed of a fix.
        dt: s.
    """
    runs, steps, vehicles = gnss.shape[:3]
    sent, memory, moved, r = np.zeros((vehicles, runs, steps, 9)), np.zeros(9), np.zeros(3), np.zeros(3)
    fix, last = np.zeros(3), np.zeros(3)
    for j in range(vehicles):
        for run in range(runs):
            memory[:], last[:] = 0.0, math.nan
            for t in range(steps):
                for c in range(3):
                    moved[c], r[c] = dt * velocity[run, t, j, c], three_of(variance, run, t, j)[c]
                if math.isnan(moved[0]):
                    memory[3:6], moved[:] = 0.0, 0.0
                take_fix(gnss[run, t, j], moved, r[0], last, fix)
                remember(memory, moved, fix, r, dt)
                for i in range(9):
                    sent[j, run, t, i] = 1.0 / max(memory[i], 1e-300) if i // 3 == 1 else memory[i]
    return sent


@inside
def take_fix(fix: Floats, moved: Floats, variance: float, last: Floats, out: Floats) -> None:
    """Write a fix, m, of a variance m^2 and remember it; none where a receiver repeats its last one to all digits
    although the vehicle has moved, m."""
    way = vector_at(moved, 0)
    repeated = fix[0] == last[0] and fix[1] == last[1] and fix[2] == last[2]
    repeated = repeated and inner_product(way, way) > MOVES * variance
    for c in range(3):
        out[c] = math.nan if repeated else fix[c]
        last[c] = last[c] if math.isnan(fix[c]) else fix[c]


@inside
def remember(memory: Floats, moved: Floats, fix: Floats, variance: Floats, dt: float) -> None:
    """Move the mean of a vehicle's fixes, each of which weighs exp(-age / FADES) / variance, and take a new one.

    Args:
        memory: (9,) mean m, sum of the weights 1/m^2, odometer m.
        moved: (3,) m, in this step.
        fix: (3,) m, NaN for none.
        variance: (3,) m^2, of the fix.
        dt: s.
    """
    for c in range(3):
        memory[c] += moved[c]
        memory[3 + c] *= math.exp(-dt / FADES)
        memory[6 + c] += moved[c]
        if not math.isnan(fix[c]):
            memory[3 + c] += 1.0 / variance[c]
            memory[c] += (fix[c] - memory[c]) / (variance[c] * memory[3 + c])


@inner
def receive(f: Filter, model: Model, rows: Floats, k: int) -> None:
    """Move member k to where it was when it sent its newest message, and use what its fixes have said until then.

    The mean error that the odometer makes of n fixes since the last message is that of the middle of the way: they are
    used there.
    """
    member = f.member
    g, j, row, dt = f.g, f.who[k, VEHICLE], f.who[k, INPUT], f.ego[SPAN]
    status, age = f.status[j], rows[row, AGE]
    sent = f.ego[CLOCK] - age
    if age < 0.0 and member[k, WHEN] < f.ego[CLOCK]:  # nothing is known of its motion
        member[k, WHEN] = f.ego[CLOCK]
        member[k, EXTRA_VARIANCE] += model.flat
        stand(f, rows, k)
    if age < 0.0 or sent <= status[USED] + ROUNDING:
        return
    gap, again, first = sent - member[k, WHEN], status[USED] > -math.inf, 3 * g.block[k, PLACE]
    steps = max(1.0, math.floor((sent - status[USED]) / dt + 0.5)) if again else 1.0
    follows = again and abs(member[k, WHEN] - status[USED]) <= ROUNDING
    for c in range(3):
        member[k, WAY + c] = rows[row, ODOMETER + c] - status[LAST + 6 + c]
        status[LAST + 6 + c] = rows[row, ODOMETER + c]
        rows[row, ODOMETER + c] = member[k, WAY + c] / gap if follows and steps > 1.0 else rows[row, SPEED + c]
    replace_implausible_velocity(f, model, j, rows[row], ODOMETER, STEP, 1.0)
    drive(f, model, k, scale(vector_at(rows[row], ODOMETER // 3), gap), gap)
    half, often = 0.5 * (1.0 + 1.0 / steps), steps if follows else (gap / dt) ** 2
    for c in range(3):
        g.p[first + c, first + c] += half * often * rows[row, STEP + c]
    if message_rows(f, model, rows, k, sent, steps, again, follows):
        q = innovate(g, f.h)
        known = again and member[k, EXTRA_VARIANCE] == 0.0
        if known and status[TRUSTED] > 0.0 and sum(f.h.block[MEASURED:]) == 3:
            learn_fix(f, model, MESSAGES)
        way = vector_at(member[k], WAY // 3)
        use_fix(f, model, k, again, q, True, may_slip(rows[row], TYPICAL, inner_product(way, way)))
    for c in range(3):
        g.p[first + c, first + c] += (1.0 - half) * often * rows[row, STEP + c]
        status[LAST + c], status[LAST + 3 + c] = rows[row, SOLO + c], rows[row, SOLO_VARIANCE + c]
    status[USED] = member[k, WHEN] = sent


@inside
def message_rows(
    f: Filter, model: Model, rows: Floats, k: int, sent: float, steps: float, again: bool, follows: bool
) -> bool:
    """Rows of the fixes that member k has taken since its last message; False if there are none.

    Of sums of weighted fixes, that of the new ones is the new sum less what is left of the last one.
    """
    h, status, row, any_new = f.h, f.status[f.who[k, VEHICLE]], f.who[k, INPUT], False
    keep = math.exp((status[USED] - sent) / FADES) if again else 0.0
    fade = math.exp(-f.ego[SPAN] / FADES)
    long = 1.0 / (1.0 - fade * fade)
    way = (steps - 1.0 / steps) / 12.0 if follows else min((steps - 1.0) * (2.0 * steps - 1.0) / (6.0 * steps), long)
    fix_terms(f, k)
    x, y, z = vector_at(rows[row], SPEED // 3)  # of a clock that is ahead
    add_term(h, f.g.block[k, TURN], (0.0, 0.0, -x, 0.0, 0.0, -y, 0.0, 0.0, -z))
    for c in range(3):
        weight, r = 1.0 / rows[row, SOLO_VARIANCE + c], rows[row, TYPICAL + c]
        old = keep / status[LAST + 3 + c] if again else 0.0
        least = LEAST_NEW / r
        if weight < old - least:  # the sender has begun anew
            old = 0.0
        new, z, h.block[MEASURED + c] = weight - old, rows[row, SOLO + c], False
        if (old > 0.0 and new < least) or weight * NO_POSITION < 1.0:
            continue
        white = model.white[c] / new * math.exp(f.ego[LEVEL + MESSAGES])
        if old > 0.0:
            carried = status[LAST + c] + f.member[k, WAY + c]
            z = carried + (z - carried) * weight / new
        else:
            white *= (2.0 - min(weight * r * (1.0 - fade), 1.0)) / (1.0 + fade)
            way = long * max(0.0, 1.0 - 1.0 / (weight * r))
        expect(h, c, z, white + way * rows[row, STEP + c])
        any_new = True
    return any_new


@part
def goes_on(f: Filter, rows: Floats, k: int) -> bool:
    """Motion of member k since its newest message, by the velocity in it if plausible, which turns as far as its turn
    rate exceeds that one's noise, and the derivatives of that motion; False if the message is of this step."""
    age, row, status = f.ego[CLOCK] - f.member[k, WHEN], f.who[k, INPUT], f.status[f.who[k, VEHICLE]]
    u = vector_at(rows[row], SPEED // 3) if status[SLIPS] == 0.0 else vector_at(status, PACE // 3)
    if status[PACE2] > 0.0 and status[SLIPS] == 0.0:
        rate, x, y = status[CROSS] / status[PACE2], u[0], u[1]
        noise = 0.5 * (rows[row, STEP] + rows[row, STEP + 1]) / (f.ego[SPAN] * TURN_MEMORY_S) ** 2
        turn = 0.5 * (age + f.ego[SPAN]) * rate * max(0.0, 1.0 - noise / (rate * rate * (x * x + y * y) + 1e-12))
        u = math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y, u[2]
    store(f.member[k], WAY // 3, turned(f, k, scale(u, age)) if age > ROUNDING else (0.0, 0.0, 0.0))
    return bool(age > ROUNDING)


@part
def may_slip(row: Floats, variance: int, way2: float) -> float:
    """m^2, variance of what slipping may add: that of half a way, squared m^2, since the last fix, SLIP_M2 at most; and
    no less than a fix's own, which stands in the row."""
    return float(max(min(0.25 * way2, SLIP_M2), min(sum(vector_at(row, variance // 3)) / 3.0, SLIP_M2)))


@inner
def use_fix(f: Filter, model: Model, k: int, again: bool, q: float, supported: bool, slip: float) -> None:
    """Update by the rows of a vehicle's fix, unless its receiver errs more than assumed, and count those that are
    rejected in a row. Causes of receiver errors last, so the n-th one beyond the gate counts 1 / n; a neighbour's does
    so where two others are trusted.

    Args:
        f: filter.
        model: noise model.
        k: slot.
        again: whether it is not the vehicle's first one.
        q: of `innovate`.
        supported: whether nothing speaks against the estimate, and for the fix.
        slip: of `may_slip`.
    """
    ego = f.ego
    member, share = f.member, 1.0
    g, h, j, used = f.g, f.h, f.who[k, VEHICLE], sum(f.h.block[MEASURED:])
    judged = k > 0 or heard(f, False) > 0  # alone, errors of the receiver and of the odometer cannot be separated
    if member[k, EXTRA_VARIANCE] > 0.0 and used == 3:
        insert_from_measurement(g, h, k, member[k, EXTRA_VARIANCE])
        member[k, EXTRA_VARIANCE] = 0.0
    elif model.fix_gate > 0.0 and judged and again and used == 3 and q > 0.0 and wrong(f, model, k, q):
        if k == 0 and ego[JUMPED] == 0.0 and f.status[j, TRUSTED] > 0.0:
            ego[AGREED] = 0.0
        if not supported:  # neighbours see the ego where the fix is
            gap = vector_at(h.three, GAP // 3)
            widen(g, 0, inner_product(gap, gap) / 3.0)
        elif f.status[j, TRUSTED] > 0.0:
            f.status[j, REVOKED] += 1.0
        set_trust(f, model, j, not supported)
        if k == 0:  # so that it counts in retrospect, should its receiver be trusted again
            member[0, LOCKED] = 0.0
            fix_terms(f, 0)
            innovate(g, h)
            correct(g, h, 1.0)
        share = 0.0 if supported else 1.0
    else:
        gap = vector_at(h.three, GAP // 3)
        q = min(as_answered(f, q) if k == 0 else q, inner_product(gap, gap) / slip)
        own, noise = 1e-12, 0.0
        for c in range(3):  # alone, the estimate's gain counts: fixes that are rejected make no error likelier
            if h.block[MEASURED + c]:
                own += h.matrix[COV + 4 * c] if judged else ego[BARE + c]
                noise += h.three[VARIANCE + c] * (1.0 if judged else math.exp(-ego[LEVEL + FIXES]))
        if model.fix_gate > 0.0:
            share = 1.0 / inflation(q, model.fix_gate, member[k, LOCKED])
            lasts = share < 1.0 and (k == 0 or heard(f, True) > 2)
            share /= 1.0 + f.who[k, REJECTED] if lasts else 1.0
            member[k, LOCKED] = count(q, model.fix_gate, member[k, LOCKED], own / (own + noise))
            holds = ego[AGREED] >= ESTABLISHED or (ego[AGREED] > 0.0 and ego[JUMPED] > 0.0)
            if not judged and holds and ego[LEVEL + FIXES] <= LOUDEST_NOISE:
                member[0, LOCKED] = min(member[0, LOCKED], MAX_LOCKOUT)
        score(f, FIX_SCORE, True)
        correct(g, h, share)
    member[k, OUT + 3] = share
    f.who[k, REJECTED] = f.who[k, REJECTED] + 1 if share < 1.0 else 0


@part
def as_answered(f: Filter, q: float) -> float:
    """Squared normalised distance of the ego's fix from the answer, where that from the state is `q`: the answer, which
    is averaged over errors that may not be there, is more certain. For fixes whose errors are states it is `q`."""
    g, h = f.g, f.h
    if has(g, 0, ERROR) or has(g, 0, COMMON):
        return q
    gap = subtract(vector_at(h.three, GAP // 3), vector_at(f.ego, OFFSET // 3))
    return float(normalised_square(gap, add(vector_at(f.ego, BARE // 3), vector_at(h.three, VARIANCE // 3))))


@inside
def wrong(f: Filter, model: Model, k: int, q: float) -> bool:
    """Whether the receiver of member k errs: for so long that its fixes would be used again, the ego's only beside a
    trusted neighbour; or on average, if the mean of its clipped innovations is likelier with another error of its fixes
    than the assumed one; where that error is being estimated, if the last innovation alone is."""
    h, status = f.h, f.status[f.who[k, VEHICLE]]
    if q > model.fix_gate and f.member[k, LOCKED] >= PATIENCE and (k > 0 or heard(f, True) > 0):
        return True
    status[COUNT] = count = min(status[COUNT] + 1.0, WINDOW)
    if status[TRUSTED] == 0.0 and q > max(model.fix_gate, FIX_GATE):
        return True
    clip = math.sqrt(CLIP / q) if q > CLIP else 1.0
    for c in range(3):
        status[MEAN + c] += (clip * h.three[GAP + c] - status[MEAN + c]) / count
    mean, (p, q, r) = vector_at(status, MEAN // 3), vector_at(h.three, VARIANCE // 3)
    status[NOISE] += (p + q + r - status[NOISE]) / count
    more = 1.0 if model.own > 0.0 else 0.0
    s = add_diagonal(block_at(h.matrix, COV // 9), (p / count + more, q / count + more, r / count + more))
    odds = math.log((1.0 - FAULTY_SHARE) / FAULTY_SHARE)
    near, narrow = distance(s, mean)
    if count < LEAST or near < 2.0 * (odds + REVOKE_LOG_ODDS):
        return False
    usual = usual_error(f, k) if k > 0 else 0.0  # the ego's receiver is compared with all others
    tau2 = min(TAU**2, inner_product(mean, mean) / 3.0)  # the likeliest
    s = add_diagonal(s, (usual, usual, usual))
    near, narrow = distance(s, mean)
    far, wide = distance(add_diagonal(s, (tau2, tau2, tau2)), mean)
    return odds + 0.5 * math.log(wide / narrow) + 0.5 * (far - near) < -REVOKE_LOG_ODDS


@part
def trust(f: Filter, model: Model) -> None:
    """Set the error of fixes to zero, to what drifts, or to what is usual, while that is likelier than any other: the
    surest first.

    The odds p(b = 0 | all) / p(b = 0) of a Gaussian b are by Bayes' rule those of the two hypotheses.
    """
    status = f.status
    g, h = f.g, f.h
    wide, narrow = TAU**2 + model.own, 0.0
    while True:
        best, most = ABSENT, TRUST_LOG_ODDS
        for k in range(len(f.who)):
            j = f.who[k, VEHICLE]
            if not has_fixes(f, k) or status[j, TRUSTED] > 0.0:
                continue
            b, own = g.block[k, ERROR], min(model.own + usual_error(f, k), 0.5 * wide)
            unit = wide * wide / (wide - own)
            less = own / wide * unit
            q, det = distance(add_diagonal(submatrix(g.p, 3 * b, 3 * b), (less, less, less)), vector_at(g.x, b))
            odds = math.log((1.0 - FAULTY_SHARE) / FAULTY_SHARE) - PENALTY * status[j, REVOKED]
            odds += 0.5 * math.log(unit**3 / det) - 0.5 * q
            if odds > most:
                best, most, narrow = k, odds, less
        if best < 0:
            return
        j = f.who[best, VEHICLE]
        status[j, TRUSTED], status[j, COUNT] = 1.0, 0.0
        begin_rows(h)
        add_term(h, g.block[best, ERROR], IDENTITY)
        for c in range(3):
            expect(h, c, 0.0, max(narrow, 1e-6))
            status[j, MEAN + c] = 0.0
        update(g, h)
        if model.own == 0.0:
            remove(g, best, ERROR)


@part
def follow_majority(f: Filter, model: Model) -> None:
    """Where more receivers err by one and the same vector beyond doubt than are trusted, the star is where they are
    not: the ego goes there, they are trusted, and all join anew. The ego's own must be among them, and the way there no
    longer than it may have slipped; or no neighbour was ever trusted, and most of them agree: it is the ego's that
    errs."""
    who, status = f.who, f.status
    g, ego, best, most, others = f.g, who[0, VEHICLE], ABSENT, 1, heard(f, False)
    own = status[ego, TRUSTED] == 0.0
    for j in range(len(f.slot)):
        if not own and j != ego and (status[j, TRUSTED] > 0.0 or status[j, REVOKED] > 0.0):
            return
    for k in range(1 if own else len(who)):
        alike = 0
        for i in range(len(who)):
            alike += errs(f, k) and errs(f, i) and (i == k or difference(f, k, i) < FIX_GATE)
        if alike > most:
            best, most = k, alike
    if best < 0 or (most <= heard(f, True) + 1 if own else 2 * most <= others):
        return
    e = 3 * g.block[best, ERROR]
    spread = trace(submatrix(g.p, 0, 0)) + trace(submatrix(g.p, e, e)) + 2.0 * trace(submatrix(g.p, 0, e))
    spread, way = spread / 3.0, vector_at(g.x, e // 3)
    if own and inner_product(way, way) > (f.ego[SHOWN] + 2.0 * math.sqrt(3.0 * spread)) ** 2:
        return
    there = add(vector_at(g.x, 0), way)
    for k in range(len(who)):
        who[k, HITS] = errs(f, k) and (k == best or difference(f, best, k) < FIX_GATE)
    for k in range(len(who)):
        j, agrees = who[k, VEHICLE], who[k, HITS] > 0
        if j < 0:
            continue
        if k > 0:
            dismiss(f, model, k, False)
        status[j, REVOKED] += 0.0 if agrees or status[j, TRUSTED] == 0.0 else 1.0
        set_trust(f, model, j, agrees)
    clear(g, 0)
    store(g.x, 0, there)
    widen(g, 0, spread)
    f.ego[LEFT + 3], f.ego[AGREED], f.member[0, LOCKED], who[0, REJECTED] = NOT_REMEMBERED_M2, 0.0, 0.0, 0


@part
def errs(f: Filter, k: int) -> bool:
    """Whether a member's fixes, which are not trusted, err beyond doubt; while fixes agree with the ego's position, of
    a neighbour that never lost trust: what all receivers do at once moves no ego."""
    j = f.who[k, VEHICLE]
    if not has_fixes(f, k) or f.status[j, TRUSTED] > 0.0:
        return False
    return difference(f, k, k) > WILD and (k == 0 or f.ego[AGREED] <= 0.0 or f.status[j, REVOKED] == 0.0)


@part
def difference(f: Filter, k: int, i: int) -> float:
    """Squared normalised difference of the errors of two members' fixes, from 0 where they are the same."""
    g, p, a, b = f.g, f.g.p, 3 * f.g.block[k, ERROR], 3 * f.g.block[i, ERROR]
    gap, cov = vector_at(g.x, a // 3), submatrix(p, a, a)
    if i != k:
        gap = subtract(gap, vector_at(g.x, b // 3))
        cov = subtract(add(cov, submatrix(p, b, b)), add(submatrix(p, a, b), submatrix(p, b, a)))
    return distance(add_diagonal(cov, (1e-6, 1e-6, 1e-6)), gap)[0]
