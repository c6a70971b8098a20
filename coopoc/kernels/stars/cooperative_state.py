"""State and noise model of the cooperative filter, and who is in the star: members leave, move and join.

A member is in one of the slots while the ego measures it; slot 0 is the ego's. What is remembered of a vehicle, in the
star or not, is its status.
"""

import math
from typing import NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import inside, part, storage
from ..compiling.small import add, inner_product, load, normalised_square, scale, store, subtract, vector_at
from ..gate import CONFIRMED, FIX_GATE, NOT_REMEMBERED_M2, PATIENCE, Vector, vote
from ..geometry import vector
from .gaussian import (
    ABSENT,
    COMMON,
    COMPASS,
    ERROR,
    PLACE,
    RANGED,
    TURN,
    Gaussian,
    Rows,
    clear,
    insert,
    insert_error,
    new_gaussian,
    remove,
    widen,
)
from .messages import ROW

FIX, FIX_VARIANCE, MOTION, MOTION_VARIANCE, DT, BY_FIXES, MORE, LAST_FIX, OWN = 0, 3, 6, 9, 12, 13, 16, 17, 20
"""Fields of the ego's row: fix m (NaN for none), its variance m^2, motion m and its variance m^2, three numbers each;
dt s; the part m of the motion by which fixes have corrected it, and the variance m^2 that this adds; and, of a drive,
the last fix m that there was."""
RELATIVE, AGE, SOLO, SOLO_VARIANCE, ODOMETER, SPEED, STEP, TYPICAL, WIDTH = 0, 5, 6, 9, 12, 15, 18, 21, 24
"""Fields of a neighbour's row: `geometry.five`, and its newest message: age s (-1 for none), mean of its fixes m and
its variance m^2, odometer (sum of all motions) m, velocity m/s, variance of one step's motion m^2 and of a fix m^2."""
TRUSTED, COUNT, USED, MEAN, LAST, PACE, SINCE, SLIPS = 0, 1, 2, 3, 6, 15, 21, 22
REVOKED, LOUDER, NOISE, CROSS, PACE2, STATUS = 23, 24, 25, 26, 27, 28
"""Fields of a vehicle's status:

- TRUSTED: whether its fixes are assumed to be right.
- COUNT, MEAN, NOISE: number of fixes in the mean innovation, that mean m, and the variance m^2 of a fix's noise in it
  (sum of the axes).
- USED, LAST: when its last used message was sent, s (-inf for none), and SOLO, SOLO_VARIANCE and ODOMETER of it.
- PACE, SINCE, SLIPS: its last plausible velocity m/s with its variance m^2/s^2, when that was s (-inf for never), and
  how many implausible ones have followed.
- REVOKED: how often it lost trust.
- LOUDER: relative increase of the variance of its velocities over the assumed one.
- CROSS, PACE2: sums, with a memory of TURN_MEMORY_S, of the cross products of velocities that follow each other, and of
  the times between them times their squares, m^2/s: over these, the turn rate.
"""
NO_POSITION, NOWHERE = 1e200, (math.nan,) * 3
"""m^2, variance of the mean of no fixes; a position that is not known."""
WILD = 32.0
"""Squared normalised distance from which a velocity is implausible, or an error of fixes is certain."""
ESTABLISHED, MAX_LOCKOUT = 60.0, 0.99 * PATIENCE
"""s of agreement with fixes after which a position is no wrong start, and the largest lock-out count of such a one: it
is kept, and fixes that contradict it count as noisier."""
TAU = 20.0
"""m, prior standard deviation of a receiver's error."""
ACCELERATION = 5.0
"""m/s^2, of a vehicle at most, and of a member since it sent its newest message."""
TURN_MEMORY_S = 2.0
"""s, after which a velocity weighs 1 / e in the turn rate."""
FIXES, MESSAGES, MOTIONS, KINDS_OF_NUMBERS, FOUND = 3, 4, 5, 6, 13
"""Kinds of numbers with a level, after ranges, azimuths and inclinations; number of these kinds, and of errors."""


class Model(NamedTuple):
    """Noise model of the filter.

    Attributes:
        std: (3,) m, rad, rad of relative measurements; of no length for unit covariances.
        min_range: m.
        flat: m^2, prior of a member that joins.
        own: m^2 of the error of a receiver that lasts, 0 for none.
        common: m^2 of the one that all share.
        time: s, their correlation time.
        white: (3,) share of the variance of a fix, as solo filters assume it, that is white.
        bias: rad^2 of the compass.
        heading: rad^2 of the compass's noise.
        offset: m^2, of what all the ego's ranges are too long by.
        turn: (3,) rad^2, 1 and s^2, of errors of heading and scale of an odometry and of a clock; zeros for none.
        lasts: s, their correlation time, where the level of motions is 1.
        ranged: (2,) of the scale of ranges, and m^2 of the offset of those of a pair; zeros for none.
        absent: (6,) log odds that an error of heading, scale, clock, compass, range or its scale is not there.
        exact: log odds a vehicle that no odometry errs, where each error of heading and scale is there otherwise.
        slip: share of the late speed.
        gate: squared normalised innovation of a component of a relative measurement, 0 for none.
        fix_gate: squared Mahalanobis distance of a fix, of the fixes in a message, and of its odometer and velocity; 0
            where nothing is doubted.
        forget: s, in which what innovations have shown of levels is forgotten; 0 for levels that stay.
        quietest: least logarithm of the level of motions.
    """

    std: Floats
    min_range: float
    flat: float
    own: float
    common: float
    time: float
    white: Floats
    bias: float
    heading: float
    offset: float
    turn: Floats
    lasts: float
    ranged: Floats
    absent: Floats
    exact: float
    slip: float
    gate: float
    fix_gate: float
    forget: float
    quietest: float


VEHICLE, INPUT, ORDER, HITS, REJECTED, WHO = 0, 1, 2, 3, 6, 7
"""Of a slot: its vehicle, ABSENT for none, its row of the step's input, ABSENT for none, and how often in a row each of
three components, and its fixes, exceeded their gate. ORDER lists the slots of the members, nearest first: a gate
depends on what was used before, not on how members are numbered."""
WAY, AT, WHEN, JOINED, EXTRA_VARIANCE, LOCKED, OUT, MEMBER = 0, 3, 6, 7, 8, 9, 10, 14
"""Of a member: the way m that it has moved since it was at its position; where relative measurements are linear m; when
it was there, s, which is when it sent its newest message; the step at which it joined; variance of its position beyond
that in P m^2, next to nothing being known of it, 0 once it is; `gate.count` of its fixes; and, out, the squared
normalised innovations of range, azimuth and inclination and the share of its message that was used, NaN where nothing
was: the ego's are those of its fix."""
FIVE, NO_VOTES = (0.0,) * 5, (0.0,) * 9
STEPS, CLOCK, SPAN, MADE, WHOLE, SLIPPING = range(6)
LEVEL, SLOPE, INFORMATION, TOLD, ANSWER, COVARIANCE, BARE, LEFT = 20, 26, 32, 38, 51, 54, 63, 66
AGREED, SINCE_FIX, CORRECTED, ERRORS, VOTES, OFFSET, UNSAID, OFF, EGO = 73, 74, 75, 76, 84, 93, 96, 97, 98
"""Fields of the ego:

- STEPS, CLOCK, SPAN: number of the step; time s, and time since the last step s.
- MADE, WHOLE: of its variance m^2 (sum of the axes) the part that the level of motion makes, and all of it.
- SLIPPING: fifteen numbers of `otherwise` on slips.
- LEVEL, SLOPE, INFORMATION: by kind of number, the logarithm of its level, this step's sum of its derivatives, and its
  information.
- TOLD, ANSWER, COVARIANCE: output. FOUND numbers of `otherwise.average`, position m and covariance m^2.
- BARE: variances m^2 of ANSWER before `lasting` adds to them, and after the motion since then.
- LEFT: the remembered position m that fixes led away from, its variance m^2 (NOT_REMEMBERED_M2 for none), the two
  numbers of `gate.remember`, and the distance driven since, m.
- AGREED: s for which fixes have agreed with the position, a step's at most 1, less s for which they have not.
- SINCE_FIX: s since the last fix.
- CORRECTED: m^2 that fixes add to the variance of this step's motion where they correct it, else 0.
- ERRORS, VOTES: eight numbers of `lasting`; nine of `gate.vote`.
- UNSAID: m^2 (sum of the axes) by which the position is more uncertain than its covariance says.
- OFFSET, OFF: ANSWER less the position, m; distance of the last fix from the position, m.
"""


class Filter(NamedTuple):
    """The state of the filter; slot 0 is the ego's, whose position is the first vector; each neighbour has one of the
    others.

    Each array that a function gets takes time to compile: what is of one thing is in one.

    Attributes:
        g: Gaussian.
        h: rows of an update.
        who: (slots, WHO).
        member: (slots, MEMBER).
        slot: (vehicles,) of each vehicle, ABSENT for none.
        status: (vehicles, STATUS).
        ego: (EGO,).
        few: (3 slots + 6, 3 slots + 5) memory.
    """

    g: Gaussian
    h: Rows
    who: Ints
    member: Floats
    slot: Ints
    status: Floats
    ego: Floats
    few: Floats


@storage
def new_filter(slots: int, vehicles: int) -> Filter:
    """A filter before its first step; vehicle 0 .. vehicles - 1."""
    g, h = new_gaussian(slots)
    return Filter(
        g,
        h,
        np.full((slots, WHO), ABSENT),
        np.zeros((slots, MEMBER)),
        np.full(vehicles, ABSENT),
        np.zeros((vehicles, STATUS)),
        np.zeros(EGO),
        np.zeros((3 * slots + 6, 3 * slots + 5)),
    )


@part
def copy_filter(source: Filter, target: Filter) -> None:
    """Copy the state; the target has room for as many members and vehicles or more."""
    n = 3 * max(source.g.vectors[0], target.g.vectors[0])
    for i in range(n):
        target.g.x[i] = source.g.x[i]
        for j in range(n):
            target.g.p[i, j] = source.g.p[i, j]
    copy(source.g.vectors, target.g.vectors)
    copy(source.ego, target.ego)
    copy(source.slot, target.slot)
    copy_rows(source.who, target.who)
    copy_rows(source.member, target.member)
    copy_rows(source.g.block, target.g.block)
    copy_rows(source.status, target.status)


@part
def copy(source: AnyArray, target: AnyArray) -> None:
    """Copy numbers to the first ones of another array."""
    for i in range(len(source)):
        target[i] = source[i]


@part
def copy_rows(source: AnyArray, target: AnyArray) -> None:
    """Copy rows to the first ones of another array."""
    for k in range(len(source)):
        copy(source[k], target[k])


@part
def begin(f: Filter, model: Model, own: Floats, rows: Floats, ego: int) -> None:
    """The first step: no vehicle has been met."""
    g = f.g
    for j in range(len(f.slot)):
        f.status[j] = 0.0
        f.status[j, TRUSTED] = 1.0 if model.fix_gate == 0.0 or j == ego else 0.0
        f.status[j, USED] = f.status[j, SINCE] = -math.inf
    f.ego[LEFT + 3] = NOT_REMEMBERED_M2
    f.who[0, VEHICLE], f.slot[ego] = ego, 0
    insert(g, 0, PLACE)
    insert_error(g, 0, COMMON, (model.common, model.common, model.common))
    insert_error(g, 0, COMPASS, (model.bias, model.heading, model.offset))
    insert_error(g, 0, RANGED, (model.ranged[0], 0.0, 0.0))
    insert_error(g, 0, TURN, vector_at(model.turn, 0))
    start(f, model, own, rows)


@part
def start(f: Filter, model: Model, own: Floats, rows: Floats) -> bool:
    """The ego stands somewhere near its fix, which is trusted, or, without one, where most neighbours see it.

    Where no other position, of a message less its vector, agrees with the fix, but two or more do with one another, the
    fix is not used. Of an ego that is not trusted all must agree with the fix: two that multipath displaced do so by
    chance; else nothing is changed, and False returned.
    """
    blind, best, heard, own_votes, g, ego = math.isnan(own[FIX]), ABSENT, 0, 0, f.g, f.who[0, VEHICLE]
    most, count = 0 if blind else 1, len(rows)
    for i in range(-1, count if model.fix_gate > 0.0 or blind else -1):
        agree = 0
        for j in range(-1, count):
            agree += mahalanobis2(own, rows, i, j) <= model.fix_gate
        heard += agree > 0
        if i < 0:
            own_votes = agree
        if agree > most:
            best, most = i, agree
    if own_votes < max(heard, 2) and f.status[ego, TRUSTED] == 0.0:
        return False
    f.member[0, EXTRA_VARIANCE], f.member[0, JOINED], f.who[0, REJECTED] = model.flat, f.ego[STEPS], 0
    f.ego[AGREED] = f.member[0, LOCKED] = 0.0
    clear(g, 0)
    set_trust(f, model, ego, True)
    for c in range(3):
        g.x[c] = own[FIX + c]
        f.ego[LEFT + c] += own[MOTION + c]
    if own_votes <= 1 and best >= 0:
        f.member[0, EXTRA_VARIANCE] = 0.0
        store(g.x, 0, seen_from(rows, best))
        store(own, FIX // 3, NOWHERE)
        widen(g, 0, model.flat)
    return True


@part
def is_outvoted(f: Filter, model: Model, own: Floats, rows: Floats) -> bool:
    """Whether fixes outvote the one that the ego started at, this one among them, and no neighbours speak for that."""
    if f.ego[VOTES + 7] >= CONFIRMED:
        return False
    moved, process = vector_at(own, MOTION // 3), vector_at(own, MOTION_VARIANCE // 3)
    before, fix, noise = load(f.ego[VOTES:], 0, NO_VOTES), vector_at(own, FIX // 3), vector_at(own, FIX_VARIANCE // 3)
    votes, left = vote(before, moved, process, fix, noise)
    store(f.ego[VOTES:], 0, votes)
    return left > 0.0 and speak_for(f, model, own, rows, add(vector_at(f.g.x, 0), moved), fix) <= 0.0


@part
def speak_for(f: Filter, model: Model, own: Floats, rows: Floats, here: Vector, there: Vector) -> float:
    """How much nearer neighbours, as they send their positions and the ego measures them, put it to one place than to
    another, as squared normalised distances: what the star has made of them does not count."""
    more = 0.0
    for i in range(len(rows)):
        more += off(f, model, own, rows, i, there) - off(f, model, own, rows, i, here)
    return more


@part
def off(f: Filter, model: Model, own: Floats, rows: Floats, i: int, at: Vector) -> float:
    """Squared normalised distance of a place from where a neighbour that is measured whole, or its range, puts the ego,
    FIX_GATE at most and where nothing does."""
    far, near = subtract(sent_place(rows, i), at), subtract(seen_from(rows, i), at)
    far2, near2 = inner_product(far, far), inner_product(near, near)
    ranged, turned = model.std[0] ** 2 * math.exp(f.ego[LEVEL]), model.std[1] ** 2 * math.exp(f.ego[LEVEL + 1])
    both = add(vector_at(rows[i], SOLO_VARIANCE // 3), vector_at(own, FIX_VARIANCE // 3))
    variance = model.own + model.common + 1.0 + sum(both) / 3.0
    if measured_whole(rows, i):
        total = near2 / (variance + ranged + turned * far2)
    else:
        total = (math.sqrt(far2) - rows[i, RELATIVE]) ** 2 / (variance + ranged)
    return total if rows[i, AGE] >= 0.0 and rows[i, RELATIVE] >= 0.0 and total < FIX_GATE else FIX_GATE


@part
def heard(f: Filter, trusted: bool) -> int:
    """How many neighbours are in the star that have sent a message, and perhaps are trusted; others stand where the
    ego measures them."""
    count = 0
    for k in range(1, len(f.who)):
        count += has_fixes(f, k) and (not trusted or f.status[f.who[k, VEHICLE], TRUSTED] > 0.0)
    return count


@inside
def has_fixes(f: Filter, k: int) -> bool:
    """Whether slot k holds the ego, or a neighbour that has sent a message."""
    j = f.who[k, VEHICLE]
    return bool(j >= 0 and (k == 0 or f.status[j, USED] > -math.inf))


@part
def needs_restart(f: Filter, own: Floats) -> bool:
    """Whether the ego's position rests on nothing that is trusted: no neighbour is, and either fixes have contradicted
    it for so long that they would be used again (and turn its odometry towards them), or its receiver is not trusted
    beside others that are not. One other suffices where the error of the ego's fixes would be beyond all doubt, or is
    the other's, too: it is the ego's."""
    who = f.who
    others, last = heard(f, False), 0
    if heard(f, True):
        return False
    if f.status[who[0, VEHICLE], TRUSTED] > 0.0:
        return bool(who[0, REJECTED] > 0 and f.member[0, LOCKED] >= PATIENCE)
    if f.ego[AGREED] > 0.0:
        return False
    for k in range(1, len(who)):
        last = k if has_fixes(f, k) else last
    error, noise = vector_at(f.g.x, f.g.block[0, ERROR]), sum(vector_at(own, FIX_VARIANCE // 3)) / 3.0
    gap = subtract(error, vector_at(f.g.x, f.g.block[last, ERROR]))
    far = inner_product(error, error)
    agree = far > FIX_GATE * noise and inner_product(gap, gap) < FIX_GATE * noise
    return others >= 2 or (others == 1 and bool(far > WILD * noise or agree))


@part
def is_placed(own: Floats, rows: Floats) -> bool:
    """Whether a fix, or what a neighbour sends and the ego measures of it, shows where the ego is."""
    placed = False
    for i in range(-1, len(rows)):
        placed |= math.isfinite(position(own, rows, i)[0][0])
    return placed


@part
def set_trust(f: Filter, model: Model, j: int, trusted: bool) -> None:
    """Trust the fixes of vehicle j from now on, or not: what error they have begins anew."""
    f.status[j, TRUSTED], f.status[j, COUNT] = trusted, 0.0
    store(f.status[j], MEAN // 3, ROW)
    if f.slot[j] >= 0:
        remove(f.g, f.slot[j], ERROR)
        insert_fix_error(f, model, f.slot[j])


@part
def insert_fix_error(f: Filter, model: Model, k: int) -> None:
    """Insert the error of the fixes of member k, next to nothing being known of that of one that is not trusted."""
    variance = model.own + (0.0 if f.status[f.who[k, VEHICLE], TRUSTED] > 0.0 else TAU**2)
    insert_error(f.g, k, ERROR, (variance, variance, variance))


@part
def mahalanobis2(own: Floats, rows: Floats, i: int, j: int) -> float:
    """Squared Mahalanobis distance of two positions of the ego; infinite if one is missing."""
    (x, p), (y, q) = position(own, rows, i), position(own, rows, j)
    total = normalised_square(subtract(x, y), add(p, q))
    return total if math.isfinite(total) else math.inf


@part
def position(own: Floats, rows: Floats, i: int) -> tuple[Vector, Vector]:
    """Where the ego is, m, and the variance m^2 of that: by a neighbour's message less the measured vector, or, -1, by
    its own fix; NaN if that is missing."""
    if i < 0:
        return vector_at(own, FIX // 3), vector_at(own, FIX_VARIANCE // 3)
    there = rows[i, AGE] >= 0.0 and measured_whole(rows, i)
    return seen_from(rows, i) if there else NOWHERE, add(vector_at(rows[i], SOLO_VARIANCE // 3), (1.0, 1.0, 1.0))


@part
def seen_from(rows: Floats, row: int) -> Vector:
    """Where the ego is by a neighbour's message, m; NaN if that has no position."""
    there = subtract(sent_place(rows, row), vector(load(rows[row], 0, FIVE)))
    return there if rows[row, SOLO_VARIANCE] < NO_POSITION else NOWHERE


@part
def sent_place(rows: Floats, row: int) -> Vector:
    """Where a neighbour is by its message, m."""
    return add(vector_at(rows[row], SOLO // 3), scale(vector_at(rows[row], SPEED // 3), rows[row, AGE]))  # type: ignore[no-any-return]


@inside
def measured_whole(rows: Floats, row: int) -> bool:
    """Whether range and both angles were measured."""
    d, sa, ca, si, ci = load(rows[row], 0, FIVE)
    return bool(d >= 0.0 and (sa != 0.0 or ca != 0.0) and (si != 0.0 or ci != 0.0))
