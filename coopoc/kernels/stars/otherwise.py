"""What is otherwise than assumed: errors that last and may not be there, an ego that slips, and levels of noise.

*Errors* of heading and scale of an odometry, of a compass, of ranges are states with a wide prior N(0, W), and the
estimate is the average over whether each is there, or, of odometries of real vehicles, whether all are or none. Of a
scalar error b with the posterior N(m, p) the odds of b = 0 are, by Bayes' rule, those of the prior times
sqrt(W / p) exp(-m^2 / 2 p), and what is conditional on b = 0 is the filter without that state. So one filter stands for
all hypotheses, as long as an error stays what it is.

*Slips*: a step is tried once more, with a motion that is not known, and the likelier of both is kept; how probable a
slip is fades between two fixes. Numbers beyond
their gate count with no more than it, a fix as one: a range that is too long, or a receiver that jumps, is no slip.
Wheels slip along the way.

*The star*: beside the filter runs that of the ego alone. Where the star's estimate is far from the ego's fixes, those
of the other near, and no noise explains what is measured of neighbours, or what they send speaks for the latter,
something is wrong with them all, as an angle of another sign or odometries that err alike: the filter begins anew from
the lone one, which counts for a while, twice as long each time.

*Levels*: by how much the variance of each kind of number differs from what is assumed, as its innovations show. The
log-likelihood of an innovation v ~ N(0, S) has the derivative s (v^2 / S - 1) / 2 by the logarithm of a level, with s
the share of S that the level makes, and the information s^2 / 2. Each step moves a level by the sum of its derivatives
over their information, which is forgotten in `Model.forget` s. Of the ego's motion the share is D = dP / d log level,
which a step of prediction makes D + q, and an update D (P+ / P-)^2, and so the variance U by which the estimate errs
more than P says: what it was made of was weighed by other levels. The answer's covariance is P (1 + U / P), the
weights are those of P. Changes of velocity show the level of each
vehicle's motion earlier, if it is more than is assumed. Of fixes beyond doubt counts how they differ from one another:
those that are all displaced by as much are no noisier.

References:
    Friedland, Treatment of bias in recursive filtering, IEEE TAC 14(4), 1969; Mitchell, Beauchamp, Bayesian variable
    selection in linear regression, JASA 83, 1988 (spike and slab); Ljung, Soderstrom, Theory and Practice of Recursive
    Identification, MIT Press, 1983, chapter 3.
"""

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import part, storage
from ..compiling.small import add, inner_product, scale, store, trace, vector_at
from ..geometry import Numbers, submatrix
from ..odometry_fault import DECISIVE, SPEED_MEMORY_S
from .cooperative_state import (
    AGREED,
    ANSWER,
    BARE,
    BY_FIXES,
    CORRECTED,
    COUNT,
    COVARIANCE,
    DT,
    ESTABLISHED,
    FIX,
    FIX_VARIANCE,
    FIXES,
    INFORMATION,
    KINDS_OF_NUMBERS,
    LEFT,
    LEVEL,
    LOCKED,
    LOUDER,
    MADE,
    MAX_LOCKOUT,
    MESSAGES,
    MOTION,
    MOTION_VARIANCE,
    MOTIONS,
    OFF,
    OFFSET,
    OWN,
    SINCE_FIX,
    SLIPPING,
    SLOPE,
    SPAN,
    STEP,
    TOLD,
    TRUSTED,
    UNSAID,
    USED,
    VEHICLE,
    WHOLE,
    WIDTH,
    Filter,
    Model,
    heard,
    new_filter,
)
from .gaussian import (
    COMMON,
    COMPASS,
    COV,
    ERROR,
    GAP,
    MEASURED,
    PLACE,
    RANGED,
    SCHUR,
    TURN,
    TURNED,
    VARIANCE,
    Q,
    has,
    stretch,
    widen,
)

HEADING, SCALE, OF_COMPASS, OF_RANGE, OF_SCALE, SLIPS, ALONE, LEVELS = range(8)
"""Indices in TOLD: the ego's errors (rad, 1, rad, m, 1), whether it slips, whether it has left its star, and the
factors of standard deviations."""


@part
def turned(f: Filter, k: int, moved: Numbers) -> Numbers:
    """(1 + s) R(b) m, and its derivatives by b and s in TURNED; m itself where odometry does not err, or fixes correct
    it."""
    g, w = f.g, f.h.matrix[TURNED:]
    for i in range(6):
        w[i] = 0.0
    if not has(g, k, TURN) or (k == 0 and f.ego[CORRECTED] > 0.0):
        return moved
    i = 3 * g.block[k, TURN]
    c, s, scale = math.cos(g.x[i]), math.sin(g.x[i]), 1.0 + g.x[i + 1]
    east, north = c * moved[0] - s * moved[1], s * moved[0] + c * moved[1]
    w[0], w[3], w[1], w[4] = -scale * north, scale * east, east, north
    return scale * east, scale * north, moved[2]


MOST_SURE, TINY = 300.0, 1e-12
"""Times that errors of the ego's odometry change faster at most, as their squares are of their variances, since what is
there drifts; least variance."""


@part
def drive(f: Filter, model: Model, k: int, moved: Numbers, dt: float) -> None:
    """Move a member by its odometry, whose errors decay."""
    g, w = f.g, f.h.matrix[TURNED:]
    first, way = 3 * g.block[k, PLACE], turned(f, k, moved)
    for c in range(3):
        g.x[first + c] += way[c]
        f.ego[LEFT + c] += way[c] if k == 0 else 0.0
    f.ego[LEFT + 6] += math.sqrt(way[0] ** 2 + way[1] ** 2) if k == 0 else 0.0
    if not has(g, k, TURN):
        return
    i, n, level = 3 * g.block[k, TURN], 3 * g.vectors[0], math.exp(f.ego[LEVEL + MOTIONS])
    sure = g.x[i] ** 2 / (g.p[i, i] + TINY) + g.x[i + 1] ** 2 / (g.p[i + 1, i + 1] + TINY)
    most = MOST_SURE if k == 0 and model.fix_gate > 0.0 else 1.0
    keep = math.exp(-level * level * min(max(sure, 1.0), most) * dt / model.lasts)
    for c in range(2):
        for j in range(n):
            g.p[first + c, j] += w[3 * c] * g.p[i, j] + w[3 * c + 1] * g.p[i + 1, j]
    for j in range(n):
        for c in range(2):
            g.p[j, first + c] += w[3 * c] * g.p[j, i] + w[3 * c + 1] * g.p[j, i + 1]
    stretch(g, i, keep)
    for c in range(3):
        g.p[i + c, i + c] += (1.0 - keep * keep) * model.turn[c]


@part
def average(f: Filter, model: Model) -> None:
    """Write the ego's position and covariance, averaged over which errors are there, to ANSWER, and these to TOLD.

    `few` has a row for each number of the position and each error, and a column for each error: their covariances; the
    last two hold their means, and where they are in the state.
    """
    ego = f.ego
    g, few, n, where = f.g, f.few, 3, len(f.few[0]) - 1
    for c in range(3):
        few[c, where], ego[ANSWER + c] = c, g.x[c]
    store(ego, COVARIANCE // 9, submatrix(g.p, 0, 0))
    for k in range(len(f.who) - 1, -1, -1):
        if has(g, k, TURN):
            for c in range(3):
                few[n + c, where] = 3 * g.block[k, TURN] + c
            n += 3
    own = n
    if has(g, 0, COMPASS):
        few[n, where], few[n + 1, where] = 3 * g.block[0, COMPASS], 3 * g.block[0, COMPASS] + 2
        n += 2
    scaled = n
    if has(g, 0, RANGED):
        few[n, where] = 3 * g.block[0, RANGED]
        n += 1
    for i in range(n):
        at = int(few[i, where])
        few[i, where - 1] = g.x[at]
        for j in range(3, n):
            few[i, j - 3] = g.p[at, int(few[j, where])]
    for i in range(3, n):
        kind = 5 if i >= scaled else 3 + i - own if i >= own else (i - 3) % 3
        if model.absent[kind] > -math.inf:
            of_ego = model.bias if kind == 3 else model.offset if kind == 4 else model.ranged[0]
            prior = model.turn[kind] if kind < 3 else of_ego
            there = chance_of(-model.absent[kind] - evidence(few[i, i - 3], few[i, where - 1], prior))
            collapse(f, i, n, there, 3 if model.absent[0] == -math.inf else i + 1)
    if own > 3 and model.absent[0] == -math.inf and model.exact > -math.inf:
        average_over_all(f, model, own)
    for c in range(3):
        ego[BARE + c] = ego[COVARIANCE + 4 * c]
        ego[OFFSET + c] = ego[ANSWER + c] - g.x[c]
    for kind in range(5):
        i = scaled if kind == 4 else own + kind - (3 if kind < 2 else 2)
        there = n > scaled if kind == 4 else scaled > own if kind >= 2 else own > 3
        ego[TOLD + kind] = few[i, where - 1] if there else 0.0
    ego[TOLD + SLIPS] = ego[SLIPPED]
    for kind in range(KINDS_OF_NUMBERS):
        ego[TOLD + LEVELS + kind] = math.exp(0.5 * ego[LEVEL + kind])
    ego[TOLD + LEVELS + MOTIONS] *= math.sqrt(1.0 + f.status[f.who[0, VEHICLE], LOUDER])


@part
def chance_of(odds: float) -> float:
    """Probability by its log odds."""
    return 1.0 / (1.0 + math.exp(min(-odds, 700.0)))


@part
def evidence(p: float, m: float, prior: float) -> float:
    """Log odds that an error is 0, by the variance p and the mean m of its posterior."""
    return 0.5 * math.log(prior / p) - 0.5 * m * m / p if p > 0.0 else 0.0


@part
def clock_of(f: Filter, model: Model, k: int) -> float:
    """s, by which the clock of member k is ahead, averaged over whether it is."""
    if not has(f.g, k, TURN):
        return 0.0
    i = 3 * f.g.block[k, TURN] + 2
    m = f.g.x[i]
    return float(m * chance_of(-model.absent[2] - evidence(f.g.p[i, i], m, model.turn[2])))


@part
def collapse(f: Filter, i: int, n: int, there: float, first: int) -> None:
    """Average over whether the error of row i is there, by that probability: moments are matched, those of the errors
    from row `first` on, which are still to be averaged over."""
    few, ego, width = f.few, f.ego, len(f.few[0]) - 2
    p, m = few[i, i - 3], few[i, width]
    if not p > 0.0:
        return
    mean, change = (there - 1.0) * m / p, (there * p + there * (1.0 - there) * m * m - p) / (p * p)
    for c in range(3):
        ego[ANSWER + c] += mean * few[c, i - 3]
        for d in range(3):
            ego[COVARIANCE + 3 * c + d] += change * few[c, i - 3] * few[d, i - 3]
    for j in range(n):
        if j != i:
            few[j, width] += mean * few[j, i - 3]
            for k in range(first, n):
                if k != i:
                    few[j, k - 3] += change * few[j, i - 3] * few[i, k - 3]
    few[i, width] = there * m
    for k in range(first, n):
        few[i, k - 3] *= 1.0 + change * p


@part
def average_over_all(f: Filter, model: Model, own: int) -> None:
    """Average over whether the errors of all odometries are there, or none: evidence that none errs adds up,
    and its prior odds, too: noise that is not white makes either look surer. One vehicle counts as two."""
    few = f.few
    ego, width, kept, odds = f.ego, len(few[0]) - 2, f.h.matrix, max((own - 3) // 3, 2) * model.exact
    for c in range(12):
        kept[c] = ego[ANSWER + c]
    heading, scale = few[own - 3, width], few[own - 2, width]
    for i in range(3, own):
        if i % 3 < 2:
            odds += evidence(few[i, i - 3], few[i, width], model.turn[i % 3])
            collapse(f, i, own, 0.0, i + 1)
    none = chance_of(odds)
    for c in range(12):
        gap = ego[ANSWER + c] - kept[c]
        ego[ANSWER + c], kept[c] = kept[c] + none * gap, gap
    for c in range(3):
        for d in range(3):
            ego[COVARIANCE + 3 * c + d] += none * (1.0 - none) * kept[c] * kept[d]
    few[own - 3, width], few[own - 2, width] = (1.0 - none) * heading, (1.0 - none) * scale


SLIPPED, SPEED_OF_LATE, NOW, LIKELY, NUMBERS, SQUARES, SHOWN, JUMPED, BLIND, COURSE, _, _, BEFORE = range(
    SLIPPING, SLIPPING + 13
)
"""Of the ego: probability that the ego slips, its late speed m/s, whether this try assumes so, of the step's numbers
the logarithm of their likelihood, how many there are, and their squared normalised innovations; `show` m, whether
fixes have jumped; for how long s it has not measured its direction, and that; and the innovation of the last fix m."""
SIDEWAYS, TURNS, LEFT_OPEN = 0.03, 0.3, 5.0
"""Share of a slip's variance across the way, which is some ten degrees; rad/s by which a slipping vehicle may turn;
largest variance of a slip over that of a motion which fixes correct."""
SLIP_DURATION_S, SLIP_INTERVAL_S, SLIP_HIDDEN_S = 3.0, 3000.0, 1.0
"""Mean s of a slip and from one to the next; s until fixes show one."""
MAY_SLIP = 0.1
"""Probability from which the ego may be slipping."""


class Tries(NamedTuple):
    """The filter before a step, for the second try, and the step's rows; the filter of the ego alone, its row, and
    the doubts of the star."""

    other: Filter
    own: Floats
    rows: Floats
    alone: Filter
    first: Floats
    doubts: Floats


EXCESS, COUNTED, ALONE_FOR, ALONE_LAST, PENDING, ALIKE, STAR_DOUBTS = range(7)
"""Evidence against the star as a whole:

- EXCESS, COUNTED: sums over the ego's fixes, fading in STAR_MEMORY_S, of the squared normalised distance from the
  star's estimate less that from the estimate of the ego alone, and of 1.
- ALONE_FOR, ALONE_LAST: s for which the estimate alone counts from now on, and for which it counted last.
- PENDING: sum of MORE, m^2, since the odometry failed; KNOWN once that is certain.
- ALIKE: fading as well, how much nearer neighbours put the ego to the estimate alone than to the star's, as squared
  normalised distances.
"""
KNOWN = -1.0
STAR_MEMORY_S, LEAST_COUNTED, MOST_EXCESS, LARGEST_GAP = 10.0, 3.0, 4.0, 25.0
"""Time constant s; number of fixes and mean excess from which the ego leaves its star; largest distance that counts."""
LOUDEST_NOISE, AGAINST, FIRST_ALONE = 2.9, 20.0, 20.0
"""Logarithm of a level that no noise reaches, 4.3 times the assumed deviation; ALIKE from which neighbours contradict
the star; s alone for the first time."""


@storage
def new_tries(slots: int, vehicles: int) -> Tries:
    """Memory for as many members and vehicles."""
    other, alone = new_filter(slots, vehicles), new_filter(slots, vehicles)
    return Tries(other, np.zeros(OWN), np.zeros((slots, WIDTH)), alone, np.zeros(OWN), np.zeros(STAR_DOUBTS))


@part
def gap_to_fix(f: Filter, model: Model, own: Floats) -> float:
    """Squared normalised distance of the answer from the fix, whose error may last, clipped."""
    square, lasts = 0.0, model.own + model.common
    for c in range(3):
        gap = own[FIX + c] - f.ego[ANSWER + c]
        square += gap * gap / (own[FIX_VARIANCE + c] + lasts + f.ego[COVARIANCE + 4 * c])
    return min(square, LARGEST_GAP)


@part
def measured_motion(own: Floats) -> None:
    """Take back what fixes have corrected of a motion."""
    for c in range(3):
        own[MOTION + c] -= own[BY_FIXES + c]


@part
def corrected_motion(f: Filter, own: Floats, more: float) -> None:
    """Take the motion as fixes correct it, whose variance is larger by `more` m^2."""
    f.ego[CORRECTED] = more
    for c in range(3):
        own[MOTION + c] += own[BY_FIXES + c]
        own[MOTION_VARIANCE + c] += more


@part
def remember_speed(f: Filter, own: Floats) -> None:
    """Remember the largest recent speed and its direction: locked wheels measure none."""
    ego = f.ego
    u = scale(add(vector_at(own, MOTION // 3), vector_at(own[BY_FIXES:], 0)), 1.0 / own[DT])
    speed, late = math.sqrt(inner_product(u, u)), ego[SPEED_OF_LATE] * math.exp(-own[DT] / SPEED_MEMORY_S)
    ego[BLIND] += own[DT]
    if speed > 0.5 * late:
        ego[BLIND] = 0.0
        store(ego[COURSE:], 0, scale(u, 1.0 / speed))
    ego[SPEED_OF_LATE] = max(speed, late)


@part
def show(f: Filter, own: Floats) -> None:
    """After `innovate`: how far the ego may have slipped unmeasured. That is the distance of its fix, if it grew no
    faster than the ego drives and fixes err. If it grew faster, and no known error of its receiver explains that, the
    fixes have jumped, which is no slip, until they are near again."""
    ego = f.ego
    far, noise, before, off = 0.0, 0.0, 0.0, 0.0
    for c in range(3):
        before += ego[BEFORE + c] ** 2
        ego[BEFORE + c] = f.h.three[GAP + c]
        far += f.h.three[GAP + c] ** 2
        noise += f.h.three[VARIANCE + c]
        off += (own[FIX + c] - f.g.x[c]) ** 2
    far, off, most = math.sqrt(far), math.sqrt(off), ego[SPEED_OF_LATE] * ego[SINCE_FIX] + 2.0 * math.sqrt(noise)
    more, ego[SHOWN] = far - math.sqrt(before), max(ego[SHOWN] + min(off - ego[OFF], most), 0.0)
    ego[OFF], ego[SINCE_FIX] = off, 0.0
    if more > most or far < 2.0 * math.sqrt(noise):
        ego[JUMPED] = 1.0 if more > most else 0.0


@part
def hidden(f: Filter, own: Floats) -> float:
    """m^2, by how much fixes show at most that the ego has slipped unnoticed."""
    return float(sum(vector_at(own, FIX_VARIANCE // 3)) + f.ego[SHOWN] ** 2)


@part
def slip(f: Filter, model: Model, own: Floats) -> None:
    """Add variance along the ego's way if this try assumes that it slips. A slip that begins now may have lasted for
    SLIP_HIDDEN_S already, but not farther than fixes err and have shown; where fixes correct the motion, not farther
    than these leave open."""
    ego = f.ego
    if ego[NOW] == 0.0:
        return
    rate = (model.slip * ego[SPEED_OF_LATE]) ** 2
    variance = rate * own[DT] ** 2
    if ego[SLIPPED] <= 0.5 and own[DT] < SLIP_HIDDEN_S:
        variance += min(rate * SLIP_HIDDEN_S**2, hidden(f, own))
    if ego[CORRECTED] > 0.0:
        variance = min(variance, LEFT_OPEN * ego[CORRECTED])
    widen(f.g, 0, min(SIDEWAYS + (TURNS * ego[BLIND]) ** 2, 1.0) * variance)
    for c in range(3):
        for d in range(3):
            f.g.p[c, d] += variance * ego[COURSE + c] * ego[COURSE + d]


@part
def score(f: Filter, gate: float, whole: bool) -> None:
    """Count the rows of an update, each, or as the fix that they are; beyond the gate no more."""
    h, square = f.h, 0.0
    for c in range(3):
        if h.block[MEASURED + c] and h.three[SCHUR + c] > 0.0:
            q = h.three[Q + c]
            square += q if whole else min(q, gate)
            f.ego[LIKELY] -= 0.5 * math.log(h.three[SCHUR + c])
            f.ego[NUMBERS] += 1.0
    square = min(square, gate) if whole else square
    f.ego[LIKELY] -= 0.5 * square
    f.ego[SQUARES] += square


@part
def surprised(f: Filter, fails: bool) -> bool:
    """Whether the first try's innovations are larger than usual by a standard deviation, or the ego may be slipping.
    Fixes that jumped do not count while odometry does not fail."""
    n = f.ego[NUMBERS]
    strange = f.ego[SLIPPED] > MAY_SLIP or f.ego[SQUARES] > n + math.sqrt(2.0 * n)
    return strange and (f.ego[JUMPED] == 0.0 or fails)


@part
def chance(f: Filter, first: Filter, dt: float, fails: bool, failure_known: bool) -> float:
    """Probability of a slip after both tries of a step, from that before the step, or from the evidence that odometry
    `fails`. Once a failure is known, it does not end by itself."""
    stays = 1.0 if failure_known else math.exp(-dt / SLIP_DURATION_S)
    begins = min(dt / (SLIP_DURATION_S if failure_known else SLIP_INTERVAL_S), 0.5)
    before = first.ego[SLIPPED] * stays + (1.0 - first.ego[SLIPPED]) * begins
    odds = f.ego[LIKELY] - first.ego[LIKELY] + (DECISIVE if fails else math.log(before / (1.0 - before)))
    return chance_of(odds)


SUDDEN, USUAL_SQUARE = 5.0, 0.95
"""Largest squared normalised innovation that counts, and the mean of so clipped ones where the noise is as assumed."""
MIN_LEVEL, MAX_LEVEL, MAX_LEVEL_CHANGE = -2.0, 3.5, 0.5
"""Least and most logarithm of a level, and the most that it changes in a step."""
PRIOR = 10.0
"""Information of the prior of a level at its assumed value: that of twenty innovations."""
UNTRUSTED, AGREEING = 30.0, 10.0
"""Factor of the motion variance of a vehicle whose fixes are not trusted, and the number of its messages that must
agree with the estimated error of these fixes to end it: all that it sends may be wrong."""


@part
def scale_motion_noise(f: Filter, own: Floats, rows: Floats, vehicles: Ints) -> None:
    """Multiply the variances of a step's motions by their level, that of each vehicle's velocities, and UNTRUSTED."""
    level = math.exp(f.ego[LEVEL + MOTIONS])
    for c in range(3):
        own[MOTION_VARIANCE + c] *= level * (1.0 + f.status[f.who[0, VEHICLE], LOUDER])
    for i in range(len(rows)):
        status = f.status[vehicles[i]]
        doubted = status[TRUSTED] == 0.0 and status[COUNT] < AGREEING and status[USED] > -math.inf
        for c in range(3):
            rows[i, STEP + c] *= level * (1.0 + status[LOUDER]) * (UNTRUSTED if doubted else 1.0)


@part
def moved(f: Filter, own: Floats) -> None:
    """After the ego's prediction: D + q, both of the three axes together, so that no axis of the world counts; and
    where it would be, had it not left."""
    ego = f.ego
    q = sum(vector_at(own, MOTION_VARIANCE // 3))
    ego[MADE] += q
    p, before = ego_variance(f), ego[WHOLE]
    ego[UNSAID] *= p / before if p < before else 1.0  # errors of a heading cancel on a circle
    more, ego[WHOLE] = max(p - before, q), p
    for c in range(3):
        ego[BARE + c] += more / 3.0 if ego[NOW] > 0.0 else own[MOTION_VARIANCE + c]
    if ego[NOW] > 0.0:  # where odometry alone leads
        level = math.exp(ego[LEVEL + MOTIONS]) * (1.0 + f.status[f.who[0, VEHICLE], LOUDER])
        more = max(q - 3.0 * level * ego[CORRECTED], 0.0)
        for c in range(3):
            ego[LEFT + c] -= own[BY_FIXES + c] if ego[CORRECTED] > 0.0 else 0.0
    ego[LEFT + 3] += more / 3.0


@part
def corrected(f: Filter) -> None:
    """After an update of the ego: D (P+ / P-)^2, and so what it is more uncertain by than P, unless it began anew."""
    ego = f.ego
    p, before = ego_variance(f), ego[WHOLE]
    left = (p / before) ** 2 if before > 0.0 else 0.0
    ego[MADE], ego[UNSAID] = min(ego[MADE] * left, p), ego[UNSAID] * min(left, 1.0)
    ego[WHOLE] = p


@part
def ego_variance(f: Filter) -> float:
    """m^2, of the three axes together."""
    return float(trace(submatrix(f.g.p, 0, 0)))


@part
def learn(f: Filter, kind: int, more: float, share: float, numbers: float) -> None:
    """Count by how much squared normalised innovations are more than usual, of which a level makes that share."""
    f.ego[SLOPE + kind] += 0.5 * numbers * share * more
    f.ego[INFORMATION + kind] += 0.5 * numbers * share * share


@part
def learn_fix(f: Filter, model: Model, kind: int) -> None:
    """Count the innovation of a fix: of one that has jumped, only how it differs from the one before is noise, and
    nothing is motion's."""
    h, innovation2, change2, r, s = f.h, 0.0, 0.0, 0.0, 0.0
    for c in range(3):
        innovation2 += h.three[GAP + c] * h.three[GAP + c]
        change2 += (h.three[GAP + c] - f.ego[BEFORE + c]) ** 2
        r += h.three[VARIANCE + c]
        s += h.three[VARIANCE + c] + h.matrix[COV + 4 * c]
    more, wild = min(innovation2 / s, SUDDEN) - 1.0, innovation2 > SUDDEN * s
    displaced = wild and (f.ego[AGREED] < ESTABLISHED or f.member[0, LOCKED] < MAX_LOCKOUT)
    noise = 0.5 * change2 if kind == FIXES and displaced else innovation2
    learn(f, kind, min(noise / s, SUDDEN) - 1.0, r / s, 3.0)
    jumped = wild and (f.ego[JUMPED] > 0.0 or change2 > 2.0 * SUDDEN * s)
    if kind == FIXES and not jumped:
        learn(f, MOTIONS, more, f.ego[MADE] / s, 3.0)


@part
def learn_relative(f: Filter, c: int) -> None:
    """Count the innovation of a component of a relative measurement."""
    h = f.h
    s, more = h.three[VARIANCE + c] + h.matrix[COV + 4 * c], min(h.three[Q + c], SUDDEN) - USUAL_SQUARE
    learn(f, c, more, h.three[VARIANCE + c] / s, 1.0)


@part
def adapt(f: Filter, model: Model) -> None:
    """Move the levels by what this step has shown, and count by how much the ego's variance would differ, had they
    been the same ever since: what is not made by motion, by fixes and messages alike. What errors of fixes that are
    states make follows no level."""
    ego = f.ego
    if model.forget == 0.0:
        return
    keep, changes = math.exp(-ego[SPAN] / model.forget), f.few[0]
    for kind in range(KINDS_OF_NUMBERS):
        change = ego[SLOPE + kind] / (ego[INFORMATION + kind] + PRIOR)
        level = ego[LEVEL + kind] + min(max(change, -MAX_LEVEL_CHANGE), MAX_LEVEL_CHANGE)
        level = min(max(level, model.quietest if kind == MOTIONS else MIN_LEVEL), MAX_LEVEL)
        changes[kind], ego[LEVEL + kind] = math.exp(level - ego[LEVEL + kind]) - 1.0, level
        ego[SLOPE + kind] = 0.0
        ego[INFORMATION + kind] *= keep
    if has(f.g, 0, ERROR) or has(f.g, 0, COMMON):
        return
    others, whole = heard(f, True), ego[WHOLE] + ego[UNSAID]
    made, change = min(ego[MADE], whole), (changes[FIXES] + others * changes[MESSAGES]) / (1.0 + others)
    ego[UNSAID] += made * changes[MOTIONS] + (whole - made) * change
