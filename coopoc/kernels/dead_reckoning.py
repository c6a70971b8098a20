"""Dead reckoning of one vehicle: its newest motions, which bring a late fix forward."""

from math import isfinite, isinf, isnan

from ..arrays import Floats
from .compiling.compile import compiled, part
from .motion import MotionNoise, keep_pace, process_variance
from .odometry_fault import correct, judge

ROUNDING = 1e-9
"""s, rounding error of a sum of time steps; no step is shorter."""
ESTIMATE, NO_FIX_YET, BAD_INPUT = 0, 1, 2
"""What a step of a stream returns."""
VELOCITY, DT, FIX_AGE = slice(3, 6), 6, 7
"""Where the input of a stream's step stands in its array, behind the fix."""
SQUARE = slice(4, 7)
"""Where the square of the pace stands in row 0 of a history."""


# A history is one array (1 + capacity, 7), a ring. Row 0: first row in use, rows in use, seconds they span, seconds
# asked for, square of the pace. Each other row is a step: dt s, motion (3,) m, its variance (3,) m^2.


@compiled
def push(history: Floats, dt: float, moved: Floats, variance: Floats) -> None:
    """Add the newest step, and drop the oldest ones that are not needed to reach back as far as is asked for."""
    capacity = len(history) - 1
    first, count, age = int(history[0, 0]), int(history[0, 1]), history[0, 2] + dt
    row = 1 + (first + count) % capacity
    history[row, 0] = dt
    for c in range(3):
        history[row, 1 + c], history[row, 4 + c] = moved[c], variance[c]
    count += 1
    while count > 1 and age - history[1 + first, 0] >= history[0, 3]:
        age -= history[1 + first, 0]
        first, count = (first + 1) % capacity, count - 1
    history[0, 0], history[0, 1], history[0, 2] = first, count, age


@compiled
def since(history: Floats, age: float, moved: Floats, variance: Floats) -> None:
    """Motion (3,) m in the last `age` seconds and its variance (3,) m^2; of a step that is cut, its share."""
    capacity, left = len(history) - 1, age
    moved[:3], variance[:3] = 0.0, 0.0
    for k in range(int(history[0, 1]) - 1, -1, -1):
        if left <= 0.0:
            break
        row = 1 + (int(history[0, 0]) + k) % capacity
        share = min(left / history[row, 0], 1.0)
        for c in range(3):
            moved[c] += share * history[row, 1 + c]
            variance[c] += share * history[row, 4 + c]
        left -= history[row, 0]


@part
def dead_reckon(
    row: Floats,
    history: Floats,
    motion: MotionNoise,
    fix: Floats,
    odometry: Floats,
    moved: Floats,
    q: Floats,
    since_fix: Floats,
    late: Floats,
    by_fixes: Floats,
) -> int:
    """Add a step to the history: its motion and the variance of that; what a fix of some age has missed since.

    Nothing is changed where the input is bad. NO_FIX_YET: there is no fix.

    Args:
        row: the step's numbers; a velocity of odometry that fails is corrected.
        history: of the motions.
        motion: noise.
        fix: (3,) m^2, variance of a fix.
        odometry: state of `kernels.odometry_fault`, of no length where odometry is believed.
        moved: (3,) m, out, the motion.
        q: (3,) m^2, out, its variance.
        since_fix: (3,) m, out, the motion since the fix.
        late: (3,) m^2, out, its variance.
        by_fixes: (4,) m and m^2, out, what of the motion and of its variance is of a correction.
    """
    dt, age, missing = row[DT], row[FIX_AGE], 0
    for c in range(3):
        missing += isnan(row[c])
        if isinf(row[c]) or not isfinite(row[3 + c]):
            return BAD_INPUT
    if not (dt > ROUNDING and isfinite(dt)) or missing % 3 != 0:
        return BAD_INPUT
    if missing == 0 and not -ROUNDING <= age <= min(history[0, 2] + dt, history[0, 3]) + ROUNDING:
        return BAD_INPUT
    square = history[0, SQUARE]
    for c in range(3):
        by_fixes[c] = -dt * row[3 + c]
    by_fixes[3] = correct(odometry, row[VELOCITY], dt)
    process_variance(motion, square, row[VELOCITY], dt, q)
    for c in range(3):
        moved[c] = dt * row[3 + c]
        by_fixes[c] += moved[c]
        q[c] += by_fixes[3]
    push(history, dt, moved[:3], q)
    keep_pace(square, row[VELOCITY], dt)
    if missing > 0:
        return NO_FIX_YET
    since(history, age, since_fix, late)
    r = 0.5 * (fix[0] + late[0] + fix[1] + late[1])
    lost = judge(odometry, row[0] + since_fix[0], row[1] + since_fix[1], r, dt)
    by_fixes[3] += lost
    for c in range(3):
        q[c] += lost
    return ESTIMATE
