"""State, noise model and guards of the cooperative filter, and who is in the star: members leave, move and join.

A member is in one of the slots while the ego measures it; slot 0 is the ego's. What is remembered of a vehicle, in the
star or not, is its status.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import part, storage
from ..dead_reckoning import ROUNDING
from .gaussian import (
    ABSENT,
    COMMON,
    COMPASS,
    ERROR,
    KINDS,
    POSITION,
    VELOCITY,
    Gaussian,
    Rows,
    has,
    insert,
    new_gaussian,
    new_rows,
    remove,
    shift,
    widen,
)

FIX, FIX_VARIANCE, MOVED, PROCESS, DT, OWN = 0, 3, 6, 9, 12, 13
"""Of the ego's row: fix m (NaN for none), its variance m^2, motion m, its variance m^2, three each, and dt s."""
RELATIVE, AGE, ESTIMATE, VARIANCE, ODOMETER, SPEED, STEP, TYPICAL, WIDTH = 0, 5, 6, 9, 12, 15, 18, 21, 24
"""Of a neighbour's row: `relative.five`, and its newest message: age s (-1 for none held), position m and its
variance m^2, sum of all motions m, velocity m/s, the variance of one step's motion m^2, and that
of a fix as its solo filter assumes it m^2."""
TRUSTED, COUNT, SENT, MEAN, KEPT, KEPT_VARIANCE, LAST, STATUS = 0, 1, 2, 3, 6, 9, 12, 24
"""Of a vehicle's status: whether its fixes count as they are, messages in the mean innovation,
when its last message that was used
was sent s (-inf for none), mean innovation m, error of its fixes when it left m and its
variance m^2, and ESTIMATE, VARIANCE, ODOMETER and STEP of that message."""
KNOWN = 1e4
"""m^2, variance along x above which nothing is known of where a member is."""


class Guards(NamedTuple):
    """What is expected to go wrong, and from when on it is believed; 0 switches a guard off.

    Attributes:
        gate: squared normalised innovation of a component of a relative measurement.
        fix_gate: of a fix.
        patience: a component that exceeds its gate that many times in a row counts again: then it is the filter that
            is wrong.
        trust: 1 if a newcomer's fixes have an unknown error until they are believed.
        tau: m, standard deviation of that error.
        share: prior share of vehicles with such an error.
        sure: log odds from which a member is trusted.
        grudge: log odds that each betrayal costs.
        wander: m, change of the error in a second.
        window: messages in the mean innovation of a trusted member.
        revoke: log odds from which trust ends.
        memory: steps after which a state is kept to go back to.
        acceleration: m/s^2, of a member whose messages are late; 0: it goes on with its last velocity.
    """

    gate: float = 9.0
    fix_gate: float = 16.0
    patience: float = 5.0
    trust: float = 1.0
    tau: float = 20.0
    share: float = 0.1
    sure: float = 1.0
    grudge: float = 10.0
    wander: float = 0.16
    window: float = 30.0
    revoke: float = 3.0
    memory: float = 30.0
    acceleration: float = 4.0


NO_GUARDS = Guards(gate=0.0, fix_gate=0.0, trust=0.0, memory=0.0, acceleration=0.0)


class Model(NamedTuple):
    """Noise model of the filter.

    Attributes:
        std: (3,) m, rad, rad of relative measurements; of no length for unit covariances.
        min_range: m.
        exact: 1 for a second pass on range and angles themselves.
        flat: m^2, prior of a member that joins.
        acceleration: m/s^2, change of a velocity since it was sent, where members have no velocity in the state.
        own: m^2 of the error of a receiver that lasts, 0 for none.
        common: m^2 of the one that all share.
        time: s, their correlation time.
        white: (3,) share of the variance of a fix, as solo filters assume it, that is white.
        bias: rad^2 of the compass.
        heading: rad^2 of the compass's noise.
        estimates: 1 if messages hold a solo filter's estimate, 0 if they hold a fix.
    """

    std: Floats
    min_range: float
    exact: float
    flat: float
    acceleration: float
    own: float
    common: float
    time: float
    white: Floats
    bias: float
    heading: float
    estimates: float


class Filter(NamedTuple):
    """The state of the filter; slot 0 is the ego's, each neighbour has one of the others.

    Attributes:
        g: Gaussian.
        h: rows of an update.
        vehicle: (slots,) in each slot, ABSENT for none.
        slot: (vehicles,) of each vehicle, ABSENT for none.
        row: (slots,) of the step's input, ABSENT for none.
        joined: (slots,) step at which the member joined.
        serves: (slots,) s for which a message's velocity has served.
        heard: (slots,) s when that message was sent.
        hits: (slots, 3) how often in a row a component exceeded its gate.
        status: (vehicles, STATUS).
        at: (slots, 3) m, where relative measurements are linear.
        work: positions and compass alone, for the first pass of the relative measurements.
        q: (slots, 4) out: squared normalised innovations of range, azimuth and inclination and the largest one of
            the message, NaN where nothing was used; the ego's are those of its fix.
        step: (1,) number of the step.
        clock: (2,) s, now, and since the last step.
        betrayals: (vehicles, 2) how often a vehicle lost trust, and when it last did s: until then its fixes do not
            count; not part of what is restored.
        alarm: (1,) out: whether a vehicle lost it now.
    """

    g: Gaussian
    h: Rows
    vehicle: Ints
    slot: Ints
    row: Ints
    joined: Ints
    serves: Floats
    heard: Floats
    hits: Ints
    status: Floats
    at: Floats
    work: Gaussian
    q: Floats
    step: Ints
    clock: Floats
    betrayals: Floats
    alarm: Ints


@storage
def new_filter(slots: int, vehicles: int) -> Filter:
    """A filter before its first step; vehicle 0 .. vehicles - 1."""
    g = new_gaussian(slots)
    return Filter(
        g,
        new_rows(slots),
        np.full(slots, ABSENT),
        np.full(vehicles, ABSENT),
        np.full(slots, ABSENT),
        np.zeros(slots, np.int64),
        np.zeros(slots),
        np.full(slots, -1.0),
        np.zeros((slots, 3), np.int64),
        np.zeros((vehicles, STATUS)),
        np.zeros((slots, 3)),
        new_gaussian(slots),
        np.zeros((slots, 4)),
        np.zeros(1, np.int64),
        np.zeros(2),
        np.zeros((vehicles, 2)),
        np.zeros(1, np.int64),
    )


@part
def copy_filter(source: Filter, target: Filter) -> None:
    """What was known at a step, without the betrayals noticed since."""
    n, new, old = 3 * source.g.vectors[0], target.g, source.g
    for i in range(n):
        new.x[i] = old.x[i]
        for j in range(n):
            new.p[i, j] = old.p[i, j]
    new.vectors[0], target.step[0], target.clock[0] = old.vectors[0], source.step[0], source.clock[0]
    for i in range(len(old.owner)):
        new.owner[i] = old.owner[i]
    for k in range(len(source.vehicle)):
        target.vehicle[k], target.row[k], target.joined[k] = source.vehicle[k], source.row[k], source.joined[k]
        target.serves[k], target.heard[k] = source.serves[k], source.heard[k]
        for kind in range(KINDS):
            new.block[k, kind] = old.block[k, kind]
        for c in range(3):
            target.hits[k, c] = source.hits[k, c]
    for j in range(len(source.slot)):
        target.slot[j] = source.slot[j]
        for i in range(STATUS):
            target.status[j, i] = source.status[j, i]


@part
def begin(f: Filter, known: Model, guards: Guards, own: Floats, ego: int) -> None:
    """The ego stands somewhere near its first fix; no vehicle has been met."""
    for j in range(len(f.slot)):
        f.status[j, TRUSTED] = 1.0 if guards.trust == 0.0 or j == ego else 0.0
        f.status[j, SENT] = -math.inf
        for c in range(3):
            f.status[j, KEPT_VARIANCE + c] = guards.tau**2
    f.vehicle[0], f.slot[ego] = ego, 0
    first = insert(f.g, 0, POSITION, known.flat)
    for c in range(3):
        f.g.x[first + c] = own[FIX + c]
    if known.own > 0.0:
        insert(f.g, 0, ERROR, known.own)
    if known.common > 0.0:
        insert(f.g, 0, COMMON, known.common)
    if known.bias + known.heading > 0.0:
        first = insert(f.g, 0, COMPASS, known.bias)
        f.g.p[first + 2, first + 2] = 0.0


@part
def leave(f: Filter, vehicles: Ints, count: int) -> None:
    """Find each member's row; marginalise out those that have none, and remember the error of their fixes."""
    for k in range(len(f.row)):
        f.row[k] = ABSENT
    for i in range(count):
        if f.slot[vehicles[i]] >= 0:
            f.row[f.slot[vehicles[i]]] = i
    for k in range(1, len(f.vehicle)):
        j = f.vehicle[k]
        if j < 0 or f.row[k] >= 0:
            continue
        if has(f.g, k, ERROR):
            first = 3 * f.g.block[k, ERROR]
            for c in range(3):
                f.status[j, KEPT + c] = f.g.x[first + c]
                f.status[j, KEPT_VARIANCE + c] = max(f.g.p[first + c, first + c], 0.01)
        for kind in range(4):
            remove(f.g, k, kind)
        f.slot[j], f.vehicle[k] = ABSENT, ABSENT


@part
def predict(f: Filter, known: Model, own: Floats) -> None:
    """Move the ego; errors that last decay."""
    g, keep = f.g, math.exp(-own[DT] / known.time)
    fades, first = 1.0 - keep * keep, 3 * g.block[0, POSITION]
    for c in range(3):
        g.x[first + c] += own[MOVED + c]
        g.p[first + c, first + c] += own[PROCESS + c]
    if known.own > 0.0:
        for k in range(len(f.vehicle)):
            if f.vehicle[k] >= 0 and has(g, k, ERROR):
                i = 3 * g.block[k, ERROR]
                if f.status[f.vehicle[k], TRUSTED] > 0.0:
                    shift(g, i, i, keep - 1.0)
                widen(g, i, known.own * fades)
    if known.common > 0.0:
        i = 3 * g.block[0, COMMON]
        shift(g, i, i, keep - 1.0)
        widen(g, i, known.common * fades)


@part
def predict_member(f: Filter, known: Model, guards: Guards, rows: Floats, k: int) -> None:
    """Move a member by the velocity in the state, if its messages are late, else by that of its newest message.

    A velocity that has served for L s and serves for dt more makes an error of (L + dt)^2 - L^2 times its own variance.
    """
    g, row, dt = f.g, f.row[k], f.clock[1]
    first, age, sent = 3 * g.block[k, POSITION], rows[row, AGE], f.clock[0] - rows[row, AGE]
    if f.status[f.vehicle[k], TRUSTED] == 0.0:
        widen(g, 3 * g.block[k, ERROR], guards.wander**2 * dt)
    if guards.acceleration > 0.0 and late(age) and not has(g, k, VELOCITY):
        follow(f, rows, k)
    if has(g, k, VELOCITY):
        v = 3 * g.block[k, VELOCITY]
        widen(g, v, (guards.acceleration * dt) ** 2)
        shift(g, first, v, dt)
        return
    if age < 0.0:
        f.heard[k], f.serves[k] = -math.inf, 0.0
        widen(g, first, known.flat)
        return
    if abs(f.heard[k] - sent) > ROUNDING:
        f.serves[k] = 0.0
    often, changed = 1.0 + 2.0 * f.serves[k] / dt, (dt * age * known.acceleration) ** 2
    f.heard[k], f.serves[k] = sent, f.serves[k] + dt
    for c in range(3):
        g.x[first + c] += dt * rows[row, SPEED + c]
        g.p[first + c, first + c] += often * (rows[row, STEP + c] + changed)


@part
def late(age: float) -> bool:
    """Whether the newest message is not of now."""
    return age > ROUNDING or age < 0.0


@part
def follow(f: Filter, rows: Floats, k: int) -> None:
    """Give a member a velocity in the state: that of its newest message, or one like the ego's neighbours may have."""
    row, g = f.row[k], f.g
    first = insert(g, k, VELOCITY, 100.0)
    for c in range(3):
        if rows[row, AGE] >= 0.0:
            g.x[first + c] = rows[row, SPEED + c]


@part
def join(f: Filter, known: Model, rows: Floats, vehicle: int, row: int) -> None:
    """A newcomer is where the ego measures it; if a component lacks, its message will tell, else somewhere near."""
    g, k = f.g, 1
    while f.vehicle[k] >= 0:
        k += 1
    f.vehicle[k], f.slot[vehicle], f.row[k] = vehicle, k, row
    f.joined[k], f.serves[k] = f.step[0], f.clock[1]
    f.heard[k] = f.clock[0] - rows[row, AGE] if rows[row, AGE] >= 0.0 else -math.inf
    for c in range(3):
        f.hits[k, c] = 0
    ego, first = 3 * g.block[0, POSITION], insert(g, k, POSITION, known.flat)
    d, sa, ca, si, ci = rows[row, 0], rows[row, 1], rows[row, 2], rows[row, 3], rows[row, 4]
    if measured_whole(rows, row):
        g.x[first], g.x[first + 1], g.x[first + 2] = d * si * ca, d * si * sa, d * ci
    else:
        near = 1.0 + max(d, 0.0)
        g.x[first], g.x[first + 1], g.x[first + 2] = near, near, 0.1 * near
    for c in range(3):
        g.x[first + c] += g.x[ego + c]
    if f.status[vehicle, TRUSTED] == 0.0:
        error = insert(g, k, ERROR, 0.0)
        for c in range(3):
            g.x[error + c] = f.status[vehicle, KEPT + c]
            g.p[error + c, error + c] = f.status[vehicle, KEPT_VARIANCE + c] + known.own
    elif known.own > 0.0:
        insert(g, k, ERROR, known.own)


@part
def measured_whole(rows: Floats, row: int) -> bool:
    """Whether range and both angles were measured."""
    angles = (rows[row, 1] != 0.0 or rows[row, 2] != 0.0) and (rows[row, 3] != 0.0 or rows[row, 4] != 0.0)
    return bool(rows[row, 0] >= 0.0 and angles)
