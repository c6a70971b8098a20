"""Relative measurements between two steps, brought to the nearest one by how both members move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coopoc.arrays import Floats, Ints
from coopoc.world.links import spherical, to_vector, wrap

from .log_vehicle import Vehicle

NEAR = 10.0
"""Distances, over what the two move until the step, below which the direction is not known well enough."""


class Measured(NamedTuple):
    """M relative measurements of pairs that are there.

    Attributes:
        value: (M,) range m, azimuth (in body frames bearing) rad, or inclination rad.
        component: (M,) which of the three.
        step: (M,) nearest to its time.
        lag: (M,) s from the step to its time.
        observer: (M,) column of the vehicle that measured.
        partner: (M,) column of what was measured.
    """

    value: Floats
    component: Ints
    step: Ints
    lag: Floats
    observer: Ints
    partner: Ints


def brought(rows: Measured, vehicles: Sequence[Vehicle], dt: float) -> Floats:
    """Values (M,) at their steps: z + f(g) - f(g + lag du), with the vector g from the observer to the partner at the
    step, from the last fixes and the odometry since, the difference du of their velocities, and f the range, azimuth or
    inclination of a vector."""
    place = np.stack([_carried(one, dt) for one in vehicles], axis=1)
    velocity = np.stack([one.velocity for one in vehicles], axis=1)
    gap = place[rows.step, rows.partner] - place[rows.step, rows.observer]
    moved = rows.lag[:, None] * (_during(velocity, rows, rows.partner) - _during(velocity, rows, rows.observer))
    return rows.value + _change(rows, gap + moved, gap)


def brought_in_body(rows: Measured, vehicles: Sequence[Vehicle]) -> Floats:
    """Values (M,) at their steps in body frames: a bearing grows by lag w, with the observer's yaw rate w. What stands,
    and was measured by range and bearing at one time, moves by lag v, with the observer's velocity v; how a vehicle
    moves in the observer's frame is not known."""
    stands = np.array([one.station for one in vehicles])[rows.partner]
    polar: dict[tuple[float, ...], Floats] = {}
    keys = list(zip(rows.step.tolist(), rows.lag.tolist(), rows.observer.tolist(), rows.partner.tolist(), strict=True))
    for key, component, value in zip(keys, rows.component, rows.value, strict=True):
        polar.setdefault(key, np.array([np.nan, np.nan, np.pi / 2]))[component] = value
    gap = to_vector(np.array([polar[key] for key in keys]).reshape(-1, 3))
    gap[~stands] = np.nan
    velocity = np.stack([one.velocity for one in vehicles], axis=1)
    rate = np.stack([np.asarray(one.yaw_rate) for one in vehicles], axis=1)
    turned = np.where(rows.component == 1, rows.lag * _during(rate, rows, rows.observer), 0.0)
    return rows.value + turned + _change(rows, gap, gap + rows.lag[:, None] * _during(velocity, rows, rows.observer))


def _change(rows: Measured, then: Floats, now: Floats) -> Floats:
    """(M,) f(now) - f(then), zero where that is unknown, and where the vectors (M, 3) m or the range are not far longer
    than what lies between."""
    change = np.column_stack(spherical(*now.T)) - np.column_stack(spherical(*then.T))
    change[:, 1:] = wrap(change[:, 1:])
    distance = np.where(rows.component == 0, rows.value, np.inf)
    far = np.minimum(np.linalg.norm(now, axis=1), distance) > NEAR * np.linalg.norm(now - then, axis=1)
    found: Floats = np.where(far, change[np.arange(len(change)), rows.component], 0.0)
    return found


def _during(of_step: Floats, rows: Measured, column: Ints) -> Floats:
    """Means (M, ...) over the step in which each time lies, of means (T, N, ...) over the step that ends at each
    instant; of the step before where the member is absent then."""
    after = np.minimum(rows.step + (rows.lag > 0), len(of_step) - 1)
    absent = np.isnan(of_step[after, column].T)
    found: Floats = of_step[np.where(absent if absent.ndim == 1 else absent[0], rows.step, after), column]
    return found


def _carried(one: Vehicle, dt: float) -> Floats:
    """(T, 3) m, the last fix and the odometry since, NaN before the first."""
    path = np.cumsum(np.nan_to_num(one.velocity) * dt, axis=0)
    last = np.maximum.accumulate(np.where(np.isfinite(one.gnss[:, 0]), np.arange(len(path)), -1))
    found: Floats = np.where(last[:, None] >= 0, (one.gnss - path)[last] + path, np.nan)
    return found
