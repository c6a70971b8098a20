"""Late cooperation: which step's answer each vehicle holds, and its own steps since then."""

from __future__ import annotations

import numpy as np

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import compiled
from ..compiling.small import load, store
from .fleet_graph import MATRIX, VECTOR, Assumed, Measured, begin_at_fix, correct


@compiled
def newest(first: AnyArray, second: AnyArray, start: AnyArray, arrival: AnyArray, vehicles: int, rounds: int) -> Ints:
    """(R, T, N) newest step whose answer a vehicle holds at each step, -1 for none.

    An answer is ready when those of all vehicles that contribute to it are, and the messages between them have arrived:
    one round reaches the vehicles in contact, the next those in contact with these.

    Args:
        first: (P,) column.
        second: (P,) column.
        start: (T+1,) pairs of each step.
        arrival: (R, P) step at which a pair's messages have arrived, -1 if it takes no part.
        vehicles: N.
        rounds: of messages a step.
    """
    runs, steps = len(arrival), len(start) - 1
    found = np.full((runs, steps, vehicles), -1)
    for run in range(runs):
        ready = np.zeros(vehicles, np.int64)
        for t in range(steps):
            for n in range(vehicles):
                ready[n] = max(ready[n], t)
            for _ in range(rounds):
                before = ready.copy()
                for k in range(start[t], start[t + 1]):
                    i, j = first[k], second[k]
                    if arrival[run, k] >= 0:
                        late = max(arrival[run, k], before[i], before[j])
                        ready[i], ready[j] = max(ready[i], late), max(ready[j], late)
                same = True
                for n in range(vehicles):
                    same = same and ready[n] == before[n]
                if same:
                    break
            for n in range(vehicles):
                if ready[n] < steps:
                    found[run, ready[n], n] = t
        for t in range(1, steps):
            for n in range(vehicles):
                found[run, t, n] = max(found[run, t, n], found[run, t - 1, n])
    return found


@compiled
def bring_forward(
    held: AnyArray, x: AnyArray, cov: AnyArray, measured: Measured, assumed: Assumed
) -> tuple[Floats, Floats]:
    """Positions (R, T, 3 N) m and covariances (R, T, 9 N) m^2: the answer held, and the own filter since its step.

    Without an answer the vehicle's own filter runs from its first fix: own measurements are never late.

    Args:
        held: (R, T, N) as `newest` returns.
        x: (R, T, 3 N) m, the answer of each step.
        cov: (R, T, 9 N) m^2.
        measured: what these vehicles measured; they are present throughout.
        assumed: the noise model.
    """
    now, covariance = np.empty_like(x), np.zeros_like(cov)
    for run in range(x.shape[0]):
        for t in range(x.shape[1]):
            for n in range(held.shape[2]):
                step, last = held[run, t, n], t - 1
                if step < 0 and t == 0:
                    begin_at_fix(now[run, 0], covariance[run, 0], run, 0, n, measured, assumed)
                    continue
                if step >= 0 and (t == 0 or step > held[run, t - 1, n]):
                    last = step
                    store(now[run, t], n, load(x[run, step], n, VECTOR))
                    store(covariance[run, t], n, load(cov[run, step], n, MATRIX))
                else:
                    store(now[run, t], n, load(now[run, t - 1], n, VECTOR))
                    store(covariance[run, t], n, load(covariance[run, t - 1], n, MATRIX))
                for u in range(last + 1, t + 1):
                    correct(now[run, t], covariance[run, t], run, u, n, measured, assumed)
    return now, covariance


@compiled
def dead_reckon(held: AnyArray, x: AnyArray, measured: Measured) -> Floats:
    """Positions (R, T, N, 3) m: the answer held, or the first fix, moved on with the measured velocities."""
    now = np.empty_like(x)
    for run in range(x.shape[0]):
        for n in range(x.shape[2]):
            for t in range(x.shape[1]):
                step, last = held[run, t, n], t - 1
                if step >= 0 and (t == 0 or step > held[run, t - 1, n]):
                    last = step
                    store(now[run, t, n], 0, load(x[run, step, n], 0, VECTOR))
                elif t == 0:
                    store(now[run, 0, n], 0, load(measured.gnss[run, 0, n], 0, VECTOR))
                else:
                    store(now[run, t, n], 0, load(now[run, t - 1, n], 0, VECTOR))
                for u in range(last + 1 if t > 0 else 1, t + 1):
                    for c in range(3):
                        now[run, t, n, c] += measured.dt * measured.velocity[run, u, n, c]
    return now
