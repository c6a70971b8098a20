"""Members of the cooperative filter's star leave, move and join; what is remembered of a vehicle is its status."""

from __future__ import annotations

import math

from ...arrays import Floats, Ints
from ..compiling.compile import inside, part
from ..dead_reckoning import ROUNDING
from .cooperative_messages import clone_position, odometry_term
from .cooperative_state import (
    AGE,
    DT,
    FIX,
    KEPT,
    KEPT_VARIANCE,
    MOTION,
    MOTION_VARIANCE,
    PACE,
    SINCE,
    SLIPPED,
    SLIPS,
    SOLO,
    SPEED,
    SPEED_VARIANCE,
    STEP,
    TRUSTED,
    USED,
    Filter,
    Guards,
    Model,
    across,
    doubt,
    insert_turn,
    lost,
    measured_whole,
    start,
    unused,
)
from .gaussian import (
    ABSENT,
    CLONE,
    COMMON,
    ERROR,
    KINDS,
    PLACE,
    TURN,
    VELOCITY,
    expect,
    has,
    insert,
    remove,
    shift,
    term,
    update,
    widen,
)
from .lasting import drive
from .slip import slip_variance


@inside
def leave(f: Filter, model: Model, guards: Guards, own: Floats, rows: Floats, vehicles: Ints, count: int) -> None:
    """Find each member's row; marginalise out those that have none, and remember the error of their fixes.

    A member that the ego's measurements contradict joins anew; where the ego is lost, it starts anew, and all join. Of
    fixes of which all but the first contradict that one, either may be wrong: they are not trusted until others agree.
    """
    for k in range(len(f.row)):
        f.row[k] = ABSENT
    for i in range(count):
        if f.slot[vehicles[i]] >= 0:
            f.row[f.slot[vehicles[i]]] = i
    ego = f.vehicle[0]
    young = f.status[ego, TRUSTED] > 0.0
    again = guards.trust > 0.0 and f.step[0] > 0 and not math.isnan(own[FIX]) and lost(f, guards)
    again = again and start(f, model, guards, own, rows, count)
    if again and young:
        f.revoked[ego, 0], f.revoked[ego, 1] = f.revoked[ego, 0] + 1.0, f.clock[0]
        doubt(f, model, guards, ego)
    for k in range(1, len(f.vehicle)):
        j = f.vehicle[k]
        if j < 0 or (f.row[k] >= 0 and not again and not contradicted(f, guards, k)):
            continue
        if f.row[k] >= 0 and f.status[j, TRUSTED] == 0.0:  # the error was estimated beside a wrong position
            doubt(f, model, guards, j)
        if has(f.g, k, ERROR):
            first = 3 * f.g.block[k, ERROR]
            for c in range(3):
                f.status[j, KEPT + c] = f.g.x[first + c]
                f.status[j, KEPT_VARIANCE + c] = max(f.g.p[first + c, first + c], 0.01)
        for kind in range(KINDS):
            remove(f.g, k, kind)
        f.slot[j], f.vehicle[k] = ABSENT, ABSENT


@inside
def contradicted(f: Filter, guards: Guards, k: int) -> bool:
    """Whether the ego's measurements of a member have contradicted its position for too long: two components three
    times in a row, or one as often as it agreed before, at most `patience` times."""
    several, since = 0, f.step[0] - f.joined[k]
    for c in range(3):
        hits = f.hits[k, c]
        several += hits >= 3
        if hits >= min(guards.patience, max(2, since - hits)):
            return True
    return bool(several >= 2)


@inside
def predict(f: Filter, model: Model, guards: Guards, own: Floats) -> None:
    """Move the ego; errors that last decay, errors of which nothing is known change."""
    g, first = f.g, 3 * f.g.block[0, PLACE]
    keep = math.exp(-own[DT] / model.time) if model.own + model.common > 0.0 else 1.0
    fades = 1.0 - keep * keep
    drive(f, model, 0, (own[MOTION], own[MOTION + 1], own[MOTION + 2]), own[DT])
    for c in range(3):
        g.p[first + c, first + c] += own[MOTION_VARIANCE + c] + slip_variance(f, model, own[DT])
    for k in range(len(f.vehicle)):
        if f.vehicle[k] >= 0 and has(g, k, ERROR):
            i, trusted = 3 * g.block[k, ERROR], f.status[f.vehicle[k], TRUSTED] > 0.0
            if trusted:
                shift(g, i, i, keep - 1.0)
            widen(g, i, model.own * fades + (0.0 if trusted else guards.walk**2 * own[DT]))
    if model.common > 0.0:
        i = 3 * g.block[0, COMMON]
        shift(g, i, i, keep - 1.0)
        widen(g, i, model.common * fades)


@inside
def steady(f: Filter, guards: Guards, j: int, given: Floats, first: int, variance: int, unit: float) -> None:
    """Put vehicle j's last velocity in place of one that no vehicle can have reached since.

    Args:
        f: filter.
        guards: against what may be wrong.
        j: vehicle.
        given: row of the input.
        first: of its velocity or motion in the row.
        variance: of one step's motion in the row.
        unit: m/s of what the row holds.
    """
    dt, status, q = f.clock[1], f.status[j], 0.0
    changed = (guards.acceleration * max(f.clock[0] - status[SINCE], dt)) ** 2
    for c in range(3):
        gap = unit * given[first + c] - status[PACE + c]
        q += gap * gap / ((given[variance + c] + status[PACE + 3 + c]) / (dt * dt) + changed)
    if 0.0 < 2.0 * guards.fix_gate < q and status[SLIPS] < SLIPPED:
        status[SLIPS] += 1.0
        for c in range(3):
            given[first + c], given[variance + c] = status[PACE + c] / unit, status[PACE + 3 + c] + changed * dt * dt
        return
    status[SINCE], status[SLIPS] = f.clock[0], 0.0
    for c in range(3):
        status[PACE + c], status[PACE + 3 + c] = unit * given[first + c], given[variance + c]


@inside
def predict_member(f: Filter, model: Model, guards: Guards, rows: Floats, k: int) -> None:
    """Move a member by the velocity in the state, if its messages are late, else by that of its newest message; two in
    time, and the velocity leaves the state.

    A velocity that has served for L s and serves for dt more makes an error of (L + dt)^2 - L^2 times its own variance.
    """
    g, row, dt = f.g, f.row[k], f.clock[1]
    age, sent = rows[row, AGE], f.clock[0] - rows[row, AGE]
    if has(g, k, VELOCITY) and 0.0 <= age <= ROUNDING and f.status[f.vehicle[k], USED] > sent - 1.5 * dt:
        remove(g, k, VELOCITY)
        remove(g, k, CLONE)
    if late(f, guards, rows, k):
        update_velocity(f, guards, rows, k)
    first = 3 * g.block[k, PLACE]
    if has(g, k, VELOCITY):
        v = 3 * g.block[k, VELOCITY]
        widen(g, v, (guards.acceleration * dt) ** 2)
        shift(g, first, v, dt)
        return
    if age < 0.0:
        f.sent[k], f.serves[k] = -math.inf, 0.0
        f.vague[k] += model.flat
        return
    if age <= ROUNDING:
        steady(f, guards, f.vehicle[k], rows[row], SPEED, STEP, 1.0)
    if abs(f.sent[k] - sent) > ROUNDING:
        f.serves[k] = 0.0
    often, changed = 1.0 + 2.0 * f.serves[k] / dt, (dt * age * model.acceleration) ** 2
    f.sent[k], f.serves[k] = sent, f.serves[k] + dt
    drive(f, model, k, (dt * rows[row, SPEED], dt * rows[row, SPEED + 1], dt * rows[row, SPEED + 2]), dt)
    for c in range(3):
        g.p[first + c, first + c] += often * (rows[row, STEP + c] + changed)


@inside
def late(f: Filter, guards: Guards, rows: Floats, k: int) -> bool:
    """Whether a member has a velocity in the state, or its newest message is not of now."""
    age = rows[f.row[k], AGE]
    return bool(guards.acceleration > 0.0 and age >= 0.0 and (age > ROUNDING or has(f.g, k, VELOCITY)))


@part
def update_velocity(f: Filter, guards: Guards, rows: Floats, k: int) -> None:
    """Give a member whose newest message is not of now a velocity in the state, and use that of a new message, unless
    its odometer, used from a clone on, will say the same: one step's error is that of both."""
    row, g, h = f.row[k], f.g, f.h
    age = rows[row, AGE]
    sent, changed = f.clock[0] - age, 0.5 * guards.acceleration * age * age
    if not has(g, k, VELOCITY):
        insert(g, k, VELOCITY, SPEED_VARIANCE)
        if age < 1.5 * f.clock[1] and f.joined[k] < f.step[0] and abs(f.status[f.vehicle[k], USED] - sent) <= ROUNDING:
            clone_position(f, k, 0.0, 0.0)
    elif abs(f.sent[k] - sent) <= ROUNDING or (
        has(g, k, CLONE) and 3.0 * changed**2 < rows[row, STEP : STEP + 3].sum()
    ):
        return
    f.sent[k] = sent
    way = odometry_term(f, k, 1, (rows[row, SPEED], rows[row, SPEED + 1], rows[row, SPEED + 2]))
    term(h, 0, g.block[k, VELOCITY], 1.0)
    h.terms[0] = 2 if has(g, k, TURN) else 1
    for c in range(3):
        expect(h, c, way[c], rows[row, STEP + c] / f.clock[1] ** 2 + (guards.acceleration * age) ** 2)
    update(g, h, guards.fix_gate)


@part
def join(f: Filter, model: Model, guards: Guards, rows: Floats, vehicle: int, row: int) -> None:
    """Insert a member where the ego measures it, or, where a component is missing, somewhere near."""
    g, k = f.g, 1
    while f.vehicle[k] >= 0:
        k += 1
    f.vehicle[k], f.slot[vehicle], f.row[k] = vehicle, k, row
    f.locked[k] = 0.0
    f.joined[k], f.serves[k], f.vague[k] = f.step[0], f.clock[1], model.flat
    f.sent[k] = f.clock[0] - rows[row, AGE] if rows[row, AGE] >= 0.0 else -math.inf
    for c in range(3):
        f.hits[k, c] = 0
    ego, first = 3 * g.block[0, PLACE], insert(g, k, PLACE, 0.0)
    near, whole = 1.0 + max(rows[row, 0], 0.0), measured_whole(rows, row)
    for c in range(3):
        g.x[first + c] = g.x[ego + c] + (across(rows, row, c) if whole else near * (1.0 if c < 2 else 0.1))
    if late(f, guards, rows, k):
        update_velocity(f, guards, rows, k)
    insert_turn(g, model, k)
    if f.status[vehicle, TRUSTED] == 0.0:
        error = insert(g, k, ERROR, 0.0)
        for c in range(3):
            g.x[error + c] = f.status[vehicle, KEPT + c]
            g.p[error + c, error + c] = f.status[vehicle, KEPT_VARIANCE + c] + model.own
    elif model.own > 0.0:
        insert(g, k, ERROR, model.own)


@inside
def place(f: Filter, rows: Floats, k: int) -> None:
    """Put a vague member where its first message does: what is measured of it is linear there, not where it was assumed
    to be until now."""
    row, first = f.row[k], 3 * f.g.block[k, PLACE]
    if f.vague[k] > 0.0 and unused(f, rows, k) and (f.joined[k] < f.step[0] or not measured_whole(rows, row)):
        for c in range(3):
            f.g.x[first + c] = rows[row, SOLO + c] + rows[row, AGE] * rows[row, SPEED + c]
