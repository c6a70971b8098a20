"""Conventions of a table, found from its numbers: row order, sampling interval, frame and unit of yaw."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet

INTERVALS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
"""s, candidates for dt; 0.1 (the paper) and 0.3 (the authors' public code) are among them."""


def row_order(ids: list[str]) -> str | None:
    """ "time" if the ids repeat as a cycle (row = t N + i), "vehicle" if in blocks (row = i T + t), None if neither.

    >>> row_order(["a", "b", "a", "b"]), row_order(["a", "a", "b", "b"]), row_order(["a", "b", "b", "a"])
    ('time', 'vehicle', None)
    """
    names = list(dict.fromkeys(ids))
    steps, rest = divmod(len(ids), len(names))
    if rest or steps < 2:
        return None
    if ids == names * steps:
        return "time"
    return "vehicle" if ids == [name for name in names for _ in range(steps)] else None


def disagreement(position: Floats, velocity: Floats, dt: float) -> float:
    """rms |dx/dt - v| / rms |v| over (T, N, 3) arrays, v being the mean over the step; inf if nothing moves.

    >>> disagreement(np.arange(3.0).reshape(3, 1, 1), np.full((3, 1, 1), 10.0), 0.1)
    0.0
    """
    quotient = np.diff(position, axis=0) / dt
    middle = (velocity[1:] + velocity[:-1]) / 2
    size = np.sqrt(np.nanmean(middle**2))
    return float(np.sqrt(np.nanmean((quotient - middle) ** 2)) / size) if size > 0 else float("inf")


def interval(position: Floats, velocity: Floats, dt: float | None = None) -> tuple[float, float]:
    """(dt s, disagreement) of the candidate that agrees best, or of the dt that is given.

    The candidates differ by factors of 1.5 and more, so a disagreement below 0.3 leaves no second one.

    >>> interval(np.arange(3.0).reshape(3, 1, 1), np.full((3, 1, 1), 10.0))
    (0.1, 0.0)
    """
    size, best = min((disagreement(position, velocity, d), d) for d in (INTERVALS if dt is None else (dt,)))
    return best, size


def yaw_reading(yaw: Floats, velocity: Floats) -> tuple[str, int] | None:
    """(unit, sign) with yaw = sign atan2(vy, vx), from the moving rows; None if no reading stands out.

    Args:
        yaw: (...,) in an unknown unit.
        velocity: (..., 3) m/s.

    >>> course = np.linspace(-3.0, 3.0, 9)
    >>> yaw_reading(np.degrees(course), 5 * np.column_stack([np.cos(course), np.sin(course), 0 * course]))
    ('degrees', 1)
    """
    moving = np.hypot(velocity[..., 0], velocity[..., 1]) > 1.0
    if not moving.any():
        return None
    course = np.arctan2(velocity[..., 1], velocity[..., 0])[moving]
    readings = {
        (unit, sign): float(np.mean(np.cos(sign * scale * yaw[moving] - course)))
        for unit, scale in (("degrees", np.pi / 180), ("radians", 1.0))
        for sign in (1, -1)
    }
    best, second = sorted(readings, key=lambda reading: -readings[reading])[:2]
    return best if readings[best] > 0.9 and readings[second] < 0.8 else None


def oncoming_on_left(position: Floats, velocity: Floats) -> tuple[int, int]:
    """(left, all) instants at which an oncoming vehicle passes within 12 m; left as in a right-handed frame.

    CARLA's towns drive on the right: oncoming traffic is on the left, unless the frame is mirrored.

    >>> oncoming_on_left(np.array([[[0.0, 0, 0], [0, 4, 0]]]), np.array([[[9.0, 0, 0], [-9, 0, 0]]]))
    (2, 2)
    """
    left = total = 0
    for x, u in zip(position[..., :2], velocity[..., :2], strict=True):
        speed = np.linalg.norm(u, axis=1)
        ahead = u / np.maximum(speed, 1e-9)[:, None]
        gap = x[None] - x[:, None]
        along = np.einsum("ijk,ik->ij", gap, ahead)
        across = ahead[:, None, 0] * gap[..., 1] - ahead[:, None, 1] * gap[..., 0]
        both = (speed > 1.0)[:, None] & (speed > 1.0)[None]
        beside = (np.abs(along) < 8.0) & (np.abs(across) > 1.5) & (np.abs(across) < 12.0)
        passing = both & beside & (ahead @ ahead.T < -0.95)
        left, total = left + int((across[passing] > 0).sum()), total + int(passing.sum())
    return left, total


def frame(yaw: Floats | None, velocity: Floats, fleet: Fleet) -> tuple[str, str]:
    """("left" or "right", why): handedness of the frame of positions and velocities.

    CARLA's yaw turns clockwise seen from above. If yaw = -atan2(vy, vx), the positions have been flipped to a
    right-handed frame and the yaw has not. If yaw = atan2(vy, vx), both are in one frame, which the traffic's side
    gives.

    Args:
        yaw: (L,) in degrees or radians, or None.
        velocity: (L, 3) m/s of the same rows.
        fleet: the rows in their frame.

    Raises:
        InputError: neither yaw nor traffic determines it.
    """
    reading = None if yaw is None else yaw_reading(yaw, velocity)
    if reading is not None and reading[1] < 0:
        return "right", f"yaw in {reading[0]} is -atan2(vy, vx)"
    left, total = oncoming_on_left(fleet.position, fleet.velocity)
    share = left / total if total else 0.5
    if total >= 20 and abs(share - 0.5) > 0.3:
        unit = "" if reading is None else f"yaw in {reading[0]} is atan2(vy, vx) and "
        return "right" if share > 0.5 else "left", f"{unit}{share:.0%} of {total} oncoming vehicles are on the left"
    raise InputError(
        "handedness",
        f"unknown: {share:.0%} of {total} oncoming vehicles on the left",
        'must be "left" (CARLA\'s own export) or "right" (y flipped already)',
        'Pass handedness="left" or "right".',
    )
