"""The cooperative filter: sequential EKF of a star, in which any measurement, message or member may be wrong.

The order of a step: members leave, the ego moves, members join, then the ego's fix, the messages, the relative
measurements, and at last who is trusted. A member stands where it
was when it sent its newest message. A drive and a stream call the same `step`.
"""

import math

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled, inner, inside, part
from ..compiling.small import (
    apply,
    inner_product,
    load,
    negate,
    scale,
    store,
    subtract,
    times,
    vector_at,
)
from ..gate import BACK, BEGIN, FIX_GATE, GATE, KEEP, NOT_REMEMBERED_M2, SLIP_M2, remember
from ..geometry import direction, metres, residuals
from .cooperative_members import dismiss, join, leave, predict, replace_implausible_velocity
from .cooperative_messages import fix_terms, follow_majority, goes_on, may_slip, receive, take_fix, trust, use_fix
from .cooperative_state import (
    ACCELERATION,
    AGE,
    AGREED,
    ANSWER,
    AT,
    BARE,
    BY_FIXES,
    CLOCK,
    CORRECTED,
    DT,
    ESTABLISHED,
    EXTRA_VARIANCE,
    FIVE,
    FIX,
    FIX_VARIANCE,
    FIXES,
    FOUND,
    HITS,
    INPUT,
    JOINED,
    LAST_FIX,
    LEFT,
    LEVEL,
    LOCKED,
    MORE,
    MOTION,
    MOTION_VARIANCE,
    OFFSET,
    ORDER,
    OUT,
    OWN,
    REJECTED,
    RELATIVE,
    SINCE_FIX,
    SOLO,
    SPAN,
    SPEED,
    STEP,
    STEPS,
    TOLD,
    TRUSTED,
    TYPICAL,
    VEHICLE,
    WAY,
    WHEN,
    WIDTH,
    Filter,
    Model,
    begin,
    copy,
    copy_filter,
    copy_rows,
    heard,
    is_placed,
    measured_whole,
    new_filter,
    set_trust,
    speak_for,
)
from .gaussian import (
    COMPASS,
    COV,
    CURVE,
    GAP,
    LIMIT,
    MEASURED,
    PLACE,
    RANGED,
    TERMS,
    TURN,
    TURNED,
    VARIANCE,
    Q,
    Z,
    add_term,
    begin_rows,
    clear,
    correct,
    expect,
    has,
    innovate,
    insert_from_measurement,
    weight,
    widen,
)
from .lasting import add_lasting, remember_error
from .messages import Assumptions, Measurements, three_of
from .otherwise import (
    AGAINST,
    ALIKE,
    ALONE,
    ALONE_FOR,
    ALONE_LAST,
    COUNTED,
    EXCESS,
    FIRST_ALONE,
    KNOWN,
    LEAST_COUNTED,
    LIKELY,
    LOUDEST_NOISE,
    MAY_SLIP,
    MOST_EXCESS,
    NOW,
    NUMBERS,
    PENDING,
    SLIP_DURATION_S,
    SLIPPED,
    SPEED_OF_LATE,
    SQUARES,
    STAR_MEMORY_S,
    Tries,
    adapt,
    average,
    chance,
    clock_of,
    corrected,
    corrected_motion,
    ego_variance,
    gap_to_fix,
    hidden,
    learn_fix,
    learn_relative,
    measured_motion,
    moved,
    new_tries,
    remember_speed,
    scale_motion_noise,
    score,
    show,
    surprised,
)


@compiled
def run_filter(
    measurements: Measurements, assumed: Assumptions, sent: Floats, odometry: Floats, model: Model
) -> tuple[Floats, Floats]:
    """Filter a whole drive.

    Returns two arrays. Of the ego, (R, T, 1 + FOUND + 12): the weight of its fix, estimated errors, position m and
    covariance m^2. By link, (R, M, 9): the neighbour's position m; the weights of range, azimuth, inclination and
    message, NaN for none; whether it is trusted; by how many s its clock is ahead. All are NaN until a fix, or a
    neighbour's message and a measurement of it, shows where the ego is.

    Args:
        measurements: measurements and messages of the ego.
        assumed: process noise, and the variance of fixes.
        sent: of `fading_memory`.
        odometry: (R, T, 4) m and m^2, by how much fixes correct the ego's motion, and its variance is larger then.
        model: noise model.
    """
    runs, steps, vehicles = measurements.gnss.shape[0], len(measurements.start) - 1, measurements.gnss.shape[2]
    most, of_ego = measurements.most, np.full((runs, steps, FOUND + 13), math.nan)
    by_link = np.full((runs, measurements.relative.shape[1], 9), math.nan)
    own, memory = np.zeros(OWN), np.zeros((most, WIDTH))
    for run in range(runs):
        f, tries = new_filter(most, vehicles), new_tries(most, vehicles)
        own[LAST_FIX:] = math.nan
        for t in range(steps):
            who = measurements.neighbour[measurements.start[t] : measurements.start[t + 1]]
            rows = memory[: len(who)]
            gather(own, rows, who, measurements, assumed, sent, odometry, model.white, run, t)
            if f.g.vectors[0] == 0:
                if not is_placed(own, rows):
                    continue
                begin(f, model, own, rows, measurements.ego)
            step(f, tries, model, own, rows, who)
            of_ego[run, t, 0] = f.member[0, OUT + 3]
            of_ego[run, t, 1:] = f.ego[TOLD:BARE]
            for i in range(len(who)):
                k, answer = f.slot[who[i]], by_link[run, measurements.start[t] + i]
                if k < 0:  # the star was left
                    continue
                for c in range(3):
                    answer[c], answer[3 + c] = f.member[k, AT + c], weight(f.member[k, OUT + c], model.gate)
                answer[6], answer[7] = f.member[k, OUT + 3], f.status[who[i], TRUSTED]
                answer[8] = clock_of(f, model, k)
    return of_ego, by_link


@inside
def gather(
    own: Floats,
    rows: Floats,
    who: Ints,
    measurements: Measurements,
    assumed: Assumptions,
    sent: Floats,
    odometry: Floats,
    white: Floats,
    run: int,
    t: int,
) -> None:
    """Fill the ego's row of a step, and those of neighbours, with the newest message of each."""
    ego, dt, first = measurements.ego, measurements.dt, measurements.start[t]
    u, r = three_of(measurements.velocity, run, t, ego), three_of(assumed.fixes, run, t, ego)
    q, own[DT] = three_of(assumed.process, run, t, ego), dt
    store(own, FIX_VARIANCE // 3, times(r, vector_at(white, 0)))
    store(own, MOTION // 3, scale(u, dt))
    store(own, MOTION_VARIANCE // 3, q)
    take_fix(measurements.gnss[run, t, ego], own[MOTION:], r[0], own[LAST_FIX:], own)
    for i in range(4):
        own[BY_FIXES + i] = odometry[run, t, i]
    measured_motion(own)
    for i in range(len(who)):
        link = first + i
        for c in range(5):
            rows[i, c] = measurements.relative[run, link, c]
        when = measurements.newest[run, link]
        rows[i, AGE] = (t - when) * dt if when >= 0 else -1.0
        if when < 0:
            continue
        u, q = three_of(measurements.velocity, run, when, who[i]), three_of(assumed.process, run, when, who[i])
        fix = three_of(assumed.fixes, run, when, who[i])
        for c in range(9):
            rows[i, SOLO + c] = sent[who[i], run, when, c]
        store(rows[i], SPEED // 3, u)
        store(rows[i], STEP // 3, q)
        store(rows[i], TYPICAL // 3, fix)


@inner
def step(f: Filter, tries: Tries, model: Model, own: Floats, rows: Floats, vehicles: Ints) -> None:
    """One step. Where its innovations are unlikely, it is also tried for an ego that slips, or whose odometry fails as
    its fixes show, and the likelier result is kept. Once the ego has met a neighbour, a filter of the ego alone runs
    beside this one.

    Args:
        f: filter, after `begin`.
        tries: memory.
        model: noise model.
        own: (OWN,) the ego's row; the motion of the first step is not used.
        rows: (k, WIDTH) of the neighbours that are measured now.
        vehicles: (k,) which they are.
    """
    ego = f.ego
    doubts = tries.doubts
    slips, other, failure_known = model.slip > 0.0, tries.other, own[MORE] > 0.0 and doubts[PENDING] == KNOWN
    if not failure_known:
        doubts[PENDING] = doubts[PENDING] + own[MORE] if own[MORE] > 0.0 else 0.0
    ego[NOW] = ego[CORRECTED] = 0.0
    if model.forget > 0.0 and len(rows) > 0 and tries.alone.g.vectors[0] == 0:
        copy_filter(f, tries.alone)
    copy(own, tries.first)
    remember_speed(f, own)
    if slips:
        copy_filter(f, other)
        copy(own, tries.own)
        copy_rows(rows, tries.rows)
    attempt(f, model, own, rows, vehicles)
    fails = doubts[PENDING] > 0.0
    if slips and surprised(f, fails or failure_known):
        other.ego[NOW] = 1.0
        if other.ego[LEFT + 3] >= NOT_REMEMBERED_M2 or other.ego[SLIPPED] <= MAY_SLIP:
            remember_place(other, hidden(other, tries.own))
        if fails or failure_known:
            corrected_motion(other, tries.own, tries.own[MORE] if failure_known else doubts[PENDING])
        attempt(other, model, tries.own, tries.rows[: len(rows)], vehicles)
        probably = chance(other, f, own[DT], fails, failure_known)
        if probably >= 0.5:
            copy_filter(other, f)
            doubts[PENDING] = KNOWN if fails else doubts[PENDING]
        elif failure_known and not heard(f, True):
            doubts[PENDING] = own[MORE]
        ego[SLIPPED] = probably
    elif ego[NUMBERS] > 0.0:
        ego[SLIPPED] = 0.0
    else:
        ego[SLIPPED] *= math.exp(-own[DT] / SLIP_DURATION_S)
    remember_error(f, tries.first)
    average(f, model)
    if tries.alone.g.vectors[0] > 0:
        compare(f, tries, model, rows, vehicles)
    add_lasting(f, model, tries.first)


@inner
def compare(f: Filter, tries: Tries, model: Model, rows: Floats, vehicles: Ints) -> None:
    """A step of the ego alone, whose answer counts where something is wrong with its star."""
    ego = f.ego
    alone, doubts, own = tries.alone, tries.doubts, tries.first
    alone.ego[NOW] = alone.ego[CORRECTED] = 0.0
    remember_speed(alone, own)
    if doubts[PENDING] == KNOWN:
        corrected_motion(alone, own, own[MORE])
    attempt(alone, model, own, rows[:0], vehicles)
    average(alone, model)
    doubts[ALONE_FOR] -= own[DT]
    if not math.isnan(own[FIX]):
        keep = math.exp(-own[DT] / STAR_MEMORY_S)
        doubts[EXCESS] = keep * doubts[EXCESS] + gap_to_fix(f, model, own) - gap_to_fix(alone, model, own)
        doubts[COUNTED] = keep * doubts[COUNTED] + 1.0
        answers = vector_at(alone.ego, ANSWER // 3), vector_at(ego, ANSWER // 3)
        doubts[ALIKE] = keep * doubts[ALIKE] + speak_for(f, model, own, rows, *answers)
        loudest = max(ego[LEVEL], ego[LEVEL + 1], ego[LEVEL + 2])
        if (
            (loudest > LOUDEST_NOISE or doubts[ALIKE] > AGAINST)
            and doubts[COUNTED] > LEAST_COUNTED
            and doubts[EXCESS] > MOST_EXCESS * doubts[COUNTED]
        ):
            copy_filter(alone, f)
            doubts[EXCESS] = doubts[COUNTED] = doubts[ALIKE] = 0.0
            doubts[ALONE_FOR] = doubts[ALONE_LAST] = max(2.0 * doubts[ALONE_LAST], FIRST_ALONE)
    ego[TOLD + ALONE] = 1.0 if doubts[ALONE_FOR] > 0.0 else 0.0
    if doubts[ALONE_FOR] > 0.0:
        copy(alone.ego[ANSWER:BARE], ego[ANSWER:])


@inner
def attempt(f: Filter, model: Model, own: Floats, rows: Floats, vehicles: Ints) -> None:
    """Predict and update, and count what that says of a slip."""
    who = f.who
    ego = f.ego
    ego[LIKELY] = ego[NUMBERS] = ego[SQUARES] = 0.0
    leave(f, model, own, rows, vehicles)
    scale_motion_noise(f, own, rows, vehicles)
    ego[SPAN] = own[DT]
    ego[SINCE_FIX] += own[DT]
    trusted = f.status[who[0, VEHICLE], TRUSTED] > 0.0
    if who[0, REJECTED] == 0 and trusted:
        ego[AGREED] += min(own[DT], 1.0)  # a long step shows no more than a fix
    elif ego[AGREED] < ESTABLISHED or not trusted:
        # faster, so that a start of 10 s that was wrong is left 10 s later
        ego[AGREED] = max(min(ego[AGREED], ESTABLISHED) - 1.5 * own[DT], 0.0)
    if ego[STEPS] > 0:
        ego[CLOCK] += own[DT]
    replace_implausible_velocity(f, model, who[0, VEHICLE], own, MOTION, MOTION_VARIANCE, 1.0 / own[DT])
    if ego[STEPS] > f.member[0, JOINED]:
        predict(f, model, own)
    moved(f, own)
    for i in range(len(rows)):
        if f.slot[vehicles[i]] < 0:
            join(f, model, rows, vehicles[i], i)
    f.member[:, OUT:] = math.nan
    add_fix(f, model, own, rows)
    members = locate(f)
    for i in range(members):
        k = who[i, ORDER]
        row = who[k, INPUT]
        new = f.member[k, EXTRA_VARIANCE] > 0.0 and rows[row, AGE] >= 0.0
        if not (new and model.fix_gate > 0.0 and measured_whole(rows, row)):
            receive(f, model, rows, k)
            if new and model.fix_gate > 0.0 and (rows[row, RELATIVE + 1] != 0.0 or rows[row, RELATIVE + 2] != 0.0):
                trust(f, model)  # or it may be so far from its fix that an azimuth says nothing
        goes_on(f, rows, k)
    locate(f)
    measure(f, model, rows, members)
    for i in range(members):
        receive(f, model, rows, who[i, ORDER])
        goes_on(f, rows, who[i, ORDER])
    if model.fix_gate > 0.0:
        trust(f, model)
        follow_majority(f, model)
    locate(f)
    ego[STEPS] += 1
    corrected(f)
    adapt(f, model)


@part
def locate(f: Filter) -> int:
    """Where the members are now, and, nearest first, which there are; how many."""
    who = f.who
    g, members = f.g, 0
    for k in range(len(who)):
        if who[k, VEHICLE] < 0:
            continue
        for c in range(3):
            f.member[k, AT + c] = g.x[3 * g.block[k, PLACE] + c] + f.member[k, WAY + c]
        i = members
        while i > 0 and gap2(f, who[i - 1, ORDER]) > gap2(f, k):
            who[i, ORDER] = who[i - 1, ORDER]
            i -= 1
        if k > 0:
            who[i, ORDER] = k
            members += 1
    return members


@inside
def gap2(f: Filter, k: int) -> float:
    """Squared distance of a member, m^2."""
    gap = subtract(vector_at(f.member[k], AT // 3), vector_at(f.member[0], AT // 3))
    return float(inner_product(gap, gap))


@inside
def add_fix(f: Filter, model: Model, own: Floats, rows: Floats) -> None:
    """The ego's fix: its position, the error of its receiver, and the one that all share."""
    level = math.exp(f.ego[LEVEL + FIXES])
    if math.isnan(own[FIX]):
        return
    fix_terms(f, 0)
    way = f.ego[SPEED_OF_LATE] * f.ego[SINCE_FIX]
    for c in range(3):
        expect(f.h, c, own[FIX + c], level * own[FIX_VARIANCE + c])
    q = innovate(f.g, f.h)
    if f.member[0, EXTRA_VARIANCE] == 0.0:
        learn_fix(f, model, FIXES)
        show(f, own)
        if model.fix_gate > 0.0 and goes_back(f, model, own, rows, q):
            fix_terms(f, 0)
            q = innovate(f.g, f.h)
    spoken = speak_for(f, model, own, rows, vector_at(f.g.x, 0), vector_at(own, FIX // 3))
    use_fix(f, model, 0, True, q, spoken >= 0.0, may_slip(own, FIX_VARIANCE, way * way))
    corrected(f)


@part
def remember_place(f: Filter, more: float) -> None:
    """Remember where the ego is, before fixes lead it away; they may have done so already, with that variance m^2."""
    ego = f.ego
    for c in range(3):
        ego[LEFT + c] = f.g.x[c]
    ego[LEFT + 3] = (ego_variance(f) + more) / 3.0
    ego[LEFT + 4] = ego[LEFT + 5] = ego[LEFT + 6] = 0.0


@inside
def goes_back(f: Filter, model: Model, own: Floats, rows: Floats, q: float) -> bool:
    """Whether an ego is where it was before fixes contradicted it (`gate.remember`), and no neighbours say otherwise:
    then it goes back, and they join anew."""
    g, h, left = f.g, f.h, f.ego[LEFT:]
    other, apart, gain, spread = 0.0, 0.0, 0.0, left[3]
    if has(g, 0, TURN) and model.absent[0] == -math.inf:  # an error that is surely there errs farther and farther
        i = 3 * g.block[0, TURN]
        spread += left[6] ** 2 * (g.p[i, i] + g.p[i + 1, i + 1]) / 3.0
    for c in range(3):
        p, r = h.matrix[COV + 4 * c], h.three[VARIANCE + c]
        other += (own[FIX + c] - left[c]) ** 2 / (spread + r + SLIP_M2)
        gain += p / (3.0 * (p + r)) if f.ego[NOW] == 0.0 else 0.0  # what follows a slip confirms none
        apart += (g.x[c] - left[c] + p / (p + r) * h.three[GAP + c]) ** 2  # where this fix would put it
    gate = max(model.fix_gate, FIX_GATE)
    what, left[4], left[5] = remember(q, other, gate, gain, apart, 3.0 * spread, left[4], left[5])
    if what == BEGIN:
        remember_place(f, 0.0)
        return False
    if what == BACK and speak_for(f, model, own, rows, vector_at(g.x, 0), vector_at(left, 0)) > 0.0:
        return False
    if what == BACK:
        for k in range(1, len(f.who)):
            if f.who[k, VEHICLE] >= 0:
                dismiss(f, model, k, False)
        set_trust(f, model, f.who[0, VEHICLE], True)
        clear(g, 0)
        for c in range(3):
            g.x[c], f.ego[BARE + c], f.ego[OFFSET + c] = left[c], spread, 0.0
        widen(g, 0, spread)
        f.member[0, LOCKED] = 0.0
    if what != KEEP:
        left[3] = NOT_REMEMBERED_M2
    return what == BACK


@inside
def measure(f: Filter, model: Model, rows: Floats, members: int) -> None:
    """Update by the relative measurements, linear at the prediction."""
    g, h, member = f.g, f.h, f.member
    if members > 0 and has(g, 0, COMPASS):  # the compass's noise is new at every step
        i = 3 * g.block[0, COMPASS] + 1
        for j in range(3 * g.vectors[0]):
            g.p[i, j] = g.p[j, i] = 0.0
        g.x[i], g.p[i, i] = 0.0, model.heading
    for m in range(members):
        k = f.who[m, ORDER]
        if not relate(f, model, rows, k):
            continue
        if member[k, EXTRA_VARIANCE] > 0.0:
            insert_from_measurement(g, h, k, member[k, EXTRA_VARIANCE])
            member[k, EXTRA_VARIANCE] = member[k, OUT] = member[k, OUT + 1] = member[k, OUT + 2] = 0.0
            continue
        innovate(g, h)
        score(f, GATE, False)
        correct(g, h, 1.0)
        for c in range(3):
            if h.block[MEASURED + c]:
                member[k, OUT + c] = h.three[Q + c]
                learn_relative(f, c)
                f.who[k, HITS + c] = f.who[k, HITS + c] + 1 if 0.0 < model.gate < h.three[Q + c] else 0


@inside
def relate(f: Filter, model: Model, rows: Floats, k: int) -> bool:
    """Rows of range, azimuth and inclination of member k in metres, linear at AT; False if its geometry is not
    known."""
    g, h, row = f.g, f.h, f.who[k, INPUT]
    if not measured_whole(rows, row) and f.member[k, EXTRA_VARIANCE] > 0.0:
        return False
    x, y, z = gap = subtract(vector_at(f.member[k], AT // 3), vector_at(f.member[0], AT // 3))
    d, sa, ca, si, ci = measured = load(rows[row], 0, FIVE)
    polar, unit = direction(gap), (1.0, 1.0, 1.0)
    far, (_, turned, raised) = polar[0], residuals(measured, polar)
    _, flat, reach = metres(polar, unit, model.min_range)
    h.block[MEASURED], h.block[MEASURED + 1] = d >= 0.0, sa != 0.0 or ca != 0.0
    h.block[MEASURED + 2] = si != 0.0 or ci != 0.0
    w = (
        x / far,
        y / far,
        z / far,
        -y / flat,
        x / flat,
        0.0,
        x * z / (flat * reach),
        y * z / (flat * reach),
        -flat / reach,
    )
    _, b, c = apply(w, gap)
    store(h.three, Z // 3, (d, turned * flat + b, raised * reach + c))
    std = metres(polar, model.std, model.min_range) if len(model.std) else unit
    store(h.three, VARIANCE // 3, times(std, std))
    for c in range(3):
        h.three[VARIANCE + c] *= math.exp(f.ego[LEVEL + c])
        h.three[LIMIT + c] = model.gate
    begin_rows(h)
    add_term(h, g.block[k, PLACE], w)
    add_term(h, g.block[0, PLACE], negate(w))
    add_term(h, g.block[0, COMPASS], (0.0, 0.0, 1.0, flat, flat, 0.0, 0.0, 0.0, 0.0))
    add_term(h, g.block[0, RANGED], (far, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    add_term(h, g.block[k, RANGED], (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    h.three[CURVE] = 1.0 / (reach * reach) if model.gate > 0.0 else 0.0
    if goes_on(f, rows, k):
        add_way(f, rows, k)
    return True


@part
def add_way(f: Filter, rows: Floats, k: int) -> None:
    """Rows of a member that has moved since its message."""
    g, h, w, n, age = f.g, f.h, f.h.matrix, f.h.block[TERMS], f.ego[CLOCK] - f.member[k, WHEN]
    often, changed = (age / f.ego[SPAN]) ** 2, (0.5 * ACCELERATION * age * age) ** 2
    first = 3 * g.block[k, TURN]
    h.block[n], h.block[TERMS] = g.block[k, TURN], n + 1 if has(g, k, TURN) else n
    for c in range(3):
        for d in range(3):
            a = w[3 * c + d]
            h.three[Z + c] -= a * f.member[k, WAY + d]
            h.three[VARIANCE + c] += a * a * (often * rows[f.who[k, INPUT], STEP + d] + changed)
            by = w[3 * c] * w[TURNED + d] + w[3 * c + 1] * w[TURNED + 3 + d]
            w[9 * n + 3 * c + d] = by
            h.three[Z + c] += by * g.x[first + d] if h.block[TERMS] > n else 0.0
