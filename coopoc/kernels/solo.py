"""The solo Kalman filter on position, axis by axis.

The state of an axis is (x, variance, hits, before, spread, evidence, since, start, apart, and three votes): its
position m and variance m^2; `hits` are those of fixes beyond the gate, then comes the position that `gate.remember` is
about, m, its variance m^2, and the memory of that, and what `gate.vote` is about; positions and variances are of the
axis, the rest is the same on all.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, inside, part
from .compiling.small import load, store
from .dead_reckoning import BAD_INPUT, ESTIMATE, NO_FIX_YET, dead_reckon
from .gate import ANEW, BACK, BEGIN, CONFIRMED, KEEP, NOT_REMEMBERED_M2, SLIP_M2, count, inflation, remember, vote
from .motion import MotionNoise

AxisState: TypeAlias = tuple[float, ...]
START, APART, VOTES = 7, 8, 9
STATE: AxisState = (0.0, 0.0, 0.0, 0.0, NOT_REMEMBERED_M2, 0.0, 0.0, 0.0, 0.0, 0.0, CONFIRMED, 0.0)
"""At a position that is known; its length is the count that `load` takes."""
Vector: TypeAlias = tuple[float, float, float]
Gated: TypeAlias = tuple[float, float, float, float, float]


class FixNoise(NamedTuple):
    """The noise of fixes.

    Attributes:
        variance: (3,) m^2.
        gate: squared normalised innovation of a fix from which it weighs less; 0 for none.
    """

    variance: Floats
    gate: float = 0.0


class SoloMeasurements(NamedTuple):
    """Measurements of all N vehicles, and which of them have a solo filter.

    Attributes:
        gnss: (R, T, N, 3) m, NaN for no fix and for an absent vehicle.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle.
        process: (R, T, E, 3) m^2, variance of a step's motion.
        fixes: (T, E, 3) m^2, variance of a fix.
        columns: (E,) of the vehicles.
        dt: s.
    """

    gnss: Floats
    velocity: Floats
    process: Floats
    fixes: Floats
    columns: Ints
    dt: float


@inside
def start_state(x: float, variance: float, votes: float) -> AxisState:
    """State at a position."""
    return x, variance, 0.0, 0.0, NOT_REMEMBERED_M2, 0.0, 0.0, x, 0.0, 0.0, votes, 0.0


@inside
def is_outvoted(states: Floats, moved: Vector, process: Vector, fix: Vector, noise: Vector) -> bool:
    """Whether a start is left, after this fix (`gate.vote`)."""
    if states[0, VOTES + 1] >= CONFIRMED:
        return False
    start = states[0, START], states[1, START], states[2, START]
    apart = states[0, APART], states[1, APART], states[2, APART]
    spread, ours, theirs = states[0, VOTES], states[0, VOTES + 1], states[0, VOTES + 2]
    votes, left = vote((*start, *apart, spread, ours, theirs), moved, process, fix, noise)
    for c in range(3):
        states[c, START], states[c, APART] = votes[c], votes[3 + c]
        states[c, VOTES], states[c, VOTES + 1], states[c, VOTES + 2] = votes[6], votes[7], votes[8]
    return left > 0.0


@inside
def gate_fix(states: Floats, moved: Vector, process: Vector, fix: Vector, noise: Vector, gate: float) -> Gated:
    """Squared normalised innovation of the axes' fix, of variance `noise`, its factor of that, and the hits that
    follow; what becomes of the position that is remembered, and its evidence and time."""
    q, other, gain, apart, spread, hits = 0.0, 0.0, 0.0, 0.0, 0.0, states[0, 2]
    if gate == 0.0:
        return 1.0, hits, KEEP, 0.0, 0.0
    if is_outvoted(states, moved, process, fix, noise):
        return math.inf, 0.0, ANEW, 0.0, 0.0
    for c in range(3):
        innovation = fix[c] - states[c, 0] - moved[c]
        if not math.isnan(innovation):
            q += innovation * innovation / (states[c, 1] + process[c] + noise[c] + SLIP_M2)
    if q <= gate and hits == 0.0 and states[0, 4] >= NOT_REMEMBERED_M2:
        return 1.0, 0.0, KEEP, 0.0, 0.0
    for c in range(3):
        gap, p = states[c, 3] - states[c, 0], states[c, 4] + process[c]
        apart, spread = apart + gap * gap, spread + p
        if not math.isnan(fix[c]):
            innovation = fix[c] - states[c, 3] - moved[c]
            other += innovation * innovation / (p + noise[c] + SLIP_M2)
            p = states[c, 1] + process[c]
            gain += p / (3.0 * (p + noise[c]))
    what, evidence, since = remember(q, other, gate, gain, apart, spread, states[0, 5], states[0, 6])
    if what == BACK:
        return 1.0, 0.0, what, 0.0, 0.0
    return inflation(q, gate, hits), count(q, gate, hits, gain), what, evidence, since


@inside
def step(state: AxisState, moved: float, process: float, fix: float, noise: float, gated: Gated) -> AxisState:
    """Predict x += dt u, p += q; where there is a fix z of variance r, update in Joseph's form.

    x += k (z - x), k = p / (p + f r), p = (1 - k)^2 p + k^2 f r.
    """
    (x, p, _, before, spread), (f, hits, what, evidence, since) = state[:5], gated
    x, p, before, spread = x + moved, p + process, before + moved, spread + process
    if what == ANEW:
        x, p = fix, noise
    elif what == BEGIN:
        before, spread = x, p
    elif what != KEEP:
        if what == BACK:
            x, p = before, spread
        spread = NOT_REMEMBERED_M2
    if not (math.isnan(fix) or math.isinf(f)):
        k = p / (p + f * noise)
        x, p = x + k * (fix - x), (1.0 - k) * (1.0 - k) * p + k * k * f * noise
    return x, p, hits, before, spread, evidence, since, *state[START:]


@compiled
def run_filter(measurements: SoloMeasurements, gate: float, exact: bool, index: Ints, x: Floats, p: Floats) -> Floats:
    """Fill x m and p m^2 of the vehicles, and return the variance of each fix, where it is gated.

    A vehicle that was absent starts at its first fix.

    Args:
        measurements: the vehicles and their measurements.
        gate: of the fixes, as of FixNoise.
        exact: whether x[:, 0] is given and exact; if not, it is a fix.
        index: (E,) of the vehicles in x and p.
        x: (R, T, E or N, 3).
        p: the same.
    """
    noise = np.empty(x.shape if gate > 0.0 else (0, 0, 0, 3))
    states = np.empty((len(measurements.columns), 3, len(STATE)))
    filter_runs(measurements, gate, exact, index, states, x, p, noise)
    return noise


@part
def filter_runs(
    measurements: SoloMeasurements,
    gate: float,
    exact: bool,
    index: Ints,
    states: Floats,
    x: Floats,
    p: Floats,
    noise: Floats,
) -> None:
    """`run_filter` in given memory."""
    for run in range(measurements.gnss.shape[0]):
        for t in range(measurements.gnss.shape[1]):
            for e in range(len(measurements.columns)):
                n, at = measurements.columns[e], index[e]
                u, q = measurements.velocity[run, t, n], three(measurements.process[run, t, e])
                fix, r = three(measurements.gnss[run, t, n]), three(measurements.fixes[t, e])
                moved = measurements.dt * u[0], measurements.dt * u[1], measurements.dt * u[2]
                gated = gate_fix(states[e], moved, q, fix, r, gate if t > 0 else 0.0)
                for c in range(3):
                    if t == 0 and exact:
                        state = start_state(x[run, 0, at, c], 0.0, CONFIRMED)
                    elif t == 0 or math.isnan(states[e, c, 0] + moved[c]):
                        state = start_state(fix[c], r[c], 1.0)
                    else:
                        state = step(load(states[e, c], 0, STATE), moved[c], q[c], fix[c], r[c], gated)
                    store(states[e, c], 0, state)
                    x[run, t, at, c], p[run, t, at, c] = state[0], state[1]
                    if len(noise):
                        noise[run, t, at, c] = r[c] * gated[0]


@compiled
def stream_step(row: Floats, state: Floats, history: Floats, odometry: Floats, noise: Floats, answer: Floats) -> int:
    """One step of a stream: dead reckoning, the fix brought forward, `step` on every axis.

    Nothing is changed where the input is bad. A state of NaN has not started yet.

    Args:
        row: (8,) fix m, velocity m/s, dt s, age of the fix s.
        state: (3, 12).
        history: of `motion`.
        odometry: of `dead_reckon`.
        noise: (13,) the numbers of a MotionNoise and a FixNoise: to hand over tuples takes longer than the step.
        answer: (12,) position m, covariance m^2.
    """
    motion = MotionNoise(noise[:3], noise[3:6], noise[6], noise[7], noise[8])
    q, late, moved, by_fixes = np.empty(3), np.zeros(3), np.zeros(3), np.zeros(4)
    outcome = dead_reckon(row, history, motion, noise[9:12], odometry, answer, q, moved, late, by_fixes)
    starts = math.isnan(state[0, 0])
    if outcome == BAD_INPUT or (starts and outcome == NO_FIX_YET):
        return outcome
    fix = row[0] + moved[0], row[1] + moved[1], row[2] + moved[2]
    r = noise[9] + late[0], noise[10] + late[1], noise[11] + late[2]
    gated = gate_fix(state, three(answer), three(q), fix, r, noise[12])
    for c in range(3):
        if starts:
            store(state[c], 0, start_state(fix[c], r[c], 1.0))
        else:
            store(state[c], 0, step(load(state[c], 0, STATE), answer[c], q[c], fix[c], r[c], gated))
    answer[:] = 0.0
    for c in range(3):
        answer[c], answer[3 + 4 * c] = state[c, 0], state[c, 1]
    return ESTIMATE


@inside
def three(values: Floats) -> Vector:
    """The first numbers of an array."""
    return values[0], values[1], values[2]
