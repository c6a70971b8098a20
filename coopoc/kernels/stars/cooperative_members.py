"""Members of the cooperative filter's star leave, move and join; what is remembered of a vehicle is its status."""

import math

from ...arrays import Floats, Ints
from ..compiling.compile import inside, part
from ..compiling.small import add, load, normalised_square, scale, store, subtract, vector_at
from ..geometry import vector
from .cooperative_state import (
    ACCELERATION,
    AGE,
    CLOCK,
    CROSS,
    DT,
    EXTRA_VARIANCE,
    FIVE,
    FIX,
    HITS,
    INPUT,
    JOINED,
    LOCKED,
    LOUDER,
    MOTION,
    MOTION_VARIANCE,
    PACE,
    PACE2,
    REJECTED,
    SINCE,
    SLIPS,
    SPAN,
    SPEED,
    STEPS,
    TRUSTED,
    TURN_MEMORY_S,
    VEHICLE,
    WAY,
    WHEN,
    WILD,
    Filter,
    Model,
    insert_fix_error,
    is_outvoted,
    measured_whole,
    needs_restart,
    set_trust,
    start,
)
from .gaussian import (
    ABSENT,
    COMMON,
    ERROR,
    KINDS,
    PLACE,
    RANGED,
    TURN,
    has,
    insert,
    insert_error,
    remove,
    stretch,
    widen,
)
from .otherwise import drive, slip

PAIR_TIME = 60.0
"""s, in which an offset of a pair's ranges changes."""
CONTRADICTED = 30.0
"""Steps in a row at most after which a member that is contradicted joins anew."""
SLIPPED = 5.0
"""Implausible velocities in a row after which one counts again."""
CHANGES, WIDEST = 20.0, 9.0
"""Velocities in the level of their noise, fewer at first, and the most of a squared normalised change that counts."""


@inside
def leave(f: Filter, model: Model, own: Floats, rows: Floats, vehicles: Ints) -> None:
    """Find each member's row; marginalise out those that have none, and remember the error of their fixes.

    A member that the ego's measurements contradict joins anew; where the ego is lost, it starts anew, and all join.
    """
    who = f.who
    who[:, INPUT] = ABSENT
    for i in range(len(rows)):
        if f.slot[vehicles[i]] >= 0:
            who[f.slot[vehicles[i]], INPUT] = i
    outvoted = model.fix_gate > 0.0 and is_outvoted(f, model, own, rows)
    if outvoted:
        set_trust(f, model, who[0, VEHICLE], True)
    again = model.fix_gate > 0.0 and f.ego[STEPS] > 0 and not math.isnan(own[FIX])
    again = again and (outvoted or needs_restart(f, own)) and start(f, model, own, rows)
    for k in range(1, len(who)):
        j = who[k, VEHICLE]
        if j < 0 or (who[k, INPUT] >= 0 and not again and not contradicted(f, k)):
            continue
        dismiss(f, model, k, outvoted)


@part
def dismiss(f: Filter, model: Model, k: int, doubted: bool) -> None:
    """Remove a member; if it is still measured, the error that its fixes seemed to have beside a wrong position is
    forgotten."""
    j = f.who[k, VEHICLE]
    if f.who[k, INPUT] >= 0 and (doubted or f.status[j, TRUSTED] == 0.0):
        set_trust(f, model, j, False)
    for kind in range(KINDS):
        remove(f.g, k, kind)
    f.slot[j], f.who[k, VEHICLE] = ABSENT, ABSENT


@inside
def contradicted(f: Filter, k: int) -> bool:
    """Whether the ego's measurements of a member have contradicted its position for too long: two components three
    times in a row, or one as often as it agreed before, at most CONTRADICTED times."""
    several, since = 0, f.ego[STEPS] - f.member[k, JOINED]
    for c in range(3):
        hits = f.who[k, HITS + c]
        several += hits >= 3
        if hits >= min(CONTRADICTED, max(2, since - hits)):
            return True
    return several >= 2


@inside
def predict(f: Filter, model: Model, own: Floats) -> None:
    """Move the ego; errors that last decay, errors of which nothing is known change."""
    g = f.g
    keep = math.exp(-own[DT] / model.time) if model.own + model.common > 0.0 else 1.0
    fades = 1.0 - keep * keep
    drive(f, model, 0, vector_at(own, MOTION // 3), own[DT])
    for c in range(3):
        g.p[c, c] += own[MOTION_VARIANCE + c]
    slip(f, model, own)
    for k in range(len(f.who)):
        if has(g, k, ERROR):
            i, trusted = 3 * g.block[k, ERROR], f.status[f.who[k, VEHICLE], TRUSTED] > 0.0
            if trusted:
                stretch(g, i, keep)
            widen(g, i, model.own * fades)
        if k > 0 and has(g, k, RANGED):
            i, holds = 3 * g.block[k, RANGED], math.exp(-own[DT] / PAIR_TIME)
            stretch(g, i, holds)
            g.p[i, i] += (1.0 - holds * holds) * model.ranged[1]
    if model.common > 0.0:
        i = 3 * g.block[0, COMMON]
        stretch(g, i, keep)
        widen(g, i, model.common * fades)


@inside
def replace_implausible_velocity(
    f: Filter, model: Model, j: int, row: Floats, first: int, variance: int, unit: float
) -> None:
    """Learn the level of vehicle j's motion from how its velocity changed, beyond what a vehicle can accelerate; where
    odometers may slip, put its last velocity in place of one that it cannot have reached since.

    Args:
        f: filter.
        model: noise model.
        j: vehicle.
        row: row of the input.
        first: of its velocity or motion in the row.
        variance: of one step's motion in the row.
        unit: m/s of what the row holds.
    """
    dt, status = f.ego[SPAN], f.status[j]
    since = max(f.ego[CLOCK] - status[SINCE], dt)
    changed = (ACCELERATION * since) ** 2
    velocity, noise = scale(vector_at(row, first // 3), unit), scale(vector_at(row, variance // 3), 1.0 / dt**2)
    before, wide = vector_at(status, PACE // 3), add(vector_at(status, PACE // 3 + 1), (changed, changed, changed))
    q = normalised_square(subtract(velocity, before), add(noise, wide))
    if model.forget > 0.0:
        more = (min(q, WIDEST) / 3.0 - 1.0) / min(f.ego[STEPS] + 1.0, CHANGES)
        status[LOUDER] = max(status[LOUDER] + (1.0 + status[LOUDER]) * more, 0.0)
    if model.slip > 0.0 and model.fix_gate > 0.0 and q > WILD and status[SLIPS] < SLIPPED:
        status[SLIPS] += 1.0
        store(row, first // 3, scale(before, 1.0 / unit))
        store(row, variance // 3, scale(wide, dt * dt))
        return
    if model.fix_gate > 0.0 and since < math.inf:
        x, y, keep = velocity[0], velocity[1], math.exp(-since / TURN_MEMORY_S)
        status[CROSS] = keep * status[CROSS] + before[0] * y - before[1] * x
        status[PACE2] = keep * status[PACE2] + since * (x * x + y * y)
    status[SINCE], status[SLIPS] = f.ego[CLOCK], 0.0
    store(status, PACE // 3, velocity)
    store(status, PACE // 3 + 1, noise)


@part
def stand(f: Filter, rows: Floats, k: int) -> None:
    """Move a member of whose position nothing is known to where the ego measures it, or, where a component is missing,
    somewhere near: its measurement is linear there."""
    g, row = f.g, f.who[k, INPUT]
    near, gap = 1.0 + max(rows[row, 0], 0.0), vector(load(rows[row], 0, FIVE))
    gap = gap if measured_whole(rows, row) else (near, near, 0.1 * near)
    store(g.x, g.block[k, PLACE], add(vector_at(g.x, 0), gap))


@part
def join(f: Filter, model: Model, rows: Floats, vehicle: int, row: int) -> None:
    """Insert a member where the ego measures it."""
    member = f.member
    who = f.who
    g, k = f.g, 1
    while who[k, VEHICLE] >= 0:
        k += 1
    who[k, VEHICLE], f.slot[vehicle], who[k, INPUT] = vehicle, k, row
    member[k, LOCKED] = 0.0
    member[k, JOINED], member[k, EXTRA_VARIANCE], age = f.ego[STEPS], model.flat, max(rows[row, AGE], 0.0)
    member[k, WHEN] = f.ego[CLOCK] - age
    for c in range(3):
        who[k, HITS + c], member[k, WAY + c] = 0, 0.0
    who[k, REJECTED] = 0
    first = insert(g, k, PLACE)
    stand(f, rows, k)
    if age > 0.0:
        for c in range(3):
            g.x[first + c] -= age * rows[row, SPEED + c]
    insert_error(g, k, TURN, vector_at(model.turn, 0))
    insert_error(g, k, RANGED, (model.ranged[1], 0.0, 0.0))
    insert_fix_error(f, model, k)
