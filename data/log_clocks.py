"""Clocks that disagree, as the measurements of a log show it: between vehicles, with the truth, by whole hours."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Bools, Floats
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

SIGMAS = 6.0
"""Standard errors of an offset beyond which it is no chance."""
ROUNDS = 5
"""Reweighted least squares, so that outliers do not pull a clock."""
EXPLAINS, REST = 0.7, 2.0
"""An offset is named if it shrinks the residuals to this share, and to this many of their expected deviations."""


def clock_warnings(recording: Recording, x: Floats, residual: Floats, expected: Floats) -> list[str]:
    """A sentence for each vehicle whose clock explains what relative measurements and positions disagree about.

    Vehicle k writes stamps that are delta_k too late. What i measures of j then misses their logged positions by
    u v_j (delta_j - delta_i) in its direction u: linear in the offsets, which are fitted with an offset of each kind.

    Args:
        recording: in the world frame.
        x: (T, N, 3) m, filter of each vehicle.
        residual: (L, 3) m, rad, rad: measured less computed.
        expected: (L, 3) their standard deviations.
    """
    links, vehicles = recording.links, len(recording.ids)
    gap = (x[links.step, links.neighbour] - x[links.step, links.observer])[:, :2]
    flat = np.maximum(np.linalg.norm(gap, axis=1), 1.0)
    ahead = gap / flat[:, None]
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / flat[:, None]
    moves = recording.velocity[0, links.step, links.neighbour, :2]
    rows, values = [], []
    for kind, direction in enumerate((ahead, aside)):
        row = np.zeros((len(gap), vehicles + 2))
        row[np.arange(len(gap)), links.neighbour] = rate = (moves * direction).sum(axis=1)
        row[np.arange(len(gap)), links.observer] -= rate
        row[:, vehicles + kind] = 1.0
        seen = np.isfinite(residual[:, kind]) & np.isfinite(row).all(axis=1)
        rows.append(row[seen] / expected[seen, kind, None])
        values.append(residual[seen, kind] / expected[seen, kind])
    A, b = np.concatenate(rows), np.concatenate(values)
    if len(b) < 10 * vehicles:
        return []
    offset, std, left = _offsets(A, b, vehicles)
    before = float(np.median(np.abs(b)))
    if left > min(EXPLAINS * before, REST * 0.6745):
        return []
    apart = offset - np.median(offset)
    if vehicles == 2:  # only their difference is known
        apart = np.array([0.0, offset[1] - offset[0]]) if offset[1] > offset[0] else np.array([apart[0] * 2, 0.0])
    late = np.flatnonzero(np.abs(apart) > np.maximum(SIGMAS * std, 0.5 * recording.dt))
    return [
        f"{(name := recording.ids[k])}: its stamps are about {apart[k]:.2f} s ahead of the others', as its motion and "
        f"the relative measurements say. Give clock={{{name!r}: {apart[k]:.2f}}} (--clock {name}={apart[k]:.2f})."
        for k in late
    ]


def _offsets(A: Floats, b: Floats, vehicles: int) -> tuple[Floats, Floats, float]:
    """Offsets (N,) s of least squares with Huber's weights, their standard errors, and the median absolute residual."""
    weight = np.ones(len(b))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * A, root[:, 0] * b, rcond=1e-9)[0]
        rest = b - A @ found
        scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-9)
        weight = np.minimum(1.0, 2.0 * scale / np.maximum(np.abs(rest), 1e-12))
    cov = scale**2 * np.linalg.pinv(A.T @ (weight[:, None] * A), rcond=1e-9, hermitian=True)
    return found[:vehicles], np.sqrt(np.maximum(np.diagonal(cov)[:vehicles], 0.0)), scale / 1.4826


def apart_warnings(recording: Recording) -> list[str]:
    """A sentence for each vehicle that drives while no other is there, as after stamps of another time zone."""
    there: Bools = np.isfinite(recording.velocity[0, :, :, 0])
    moving = [k for k in range(there.shape[1]) if k not in recording.landmarks and there[:, k].any()]
    found = []
    for k in moving:
        others = there[:, [j for j in moving if j != k]].any(axis=1)
        if len(moving) > 1 and not (there[:, k] & others).any():
            mine, theirs = (recording.t[np.argmax(steps)] - recording.t[0] for steps in (there[:, k], others))
            found.append(
                f"{(name := recording.ids[k])}: is there while no other vehicle is, its log begins {mine - theirs:.6g} "
                f"s after theirs. If that is another time zone or clock, give clock={{{name!r}: {mine - theirs:.6g}}}."
            )
    return found[-1:] if len(moving) == 2 else found


def truth_warning(recording: Recording, truth: Fleet | None, column: int) -> list[str]:
    """A sentence where the fixes of a vehicle lie behind its truth along its way, by the same time at any speed."""
    if truth is None:
        return []
    gap = (recording.gnss[0, :, column] - truth.position[:, column])[:, :2]
    moves = recording.velocity[0, :, column, :2]
    seen = np.isfinite(gap).all(axis=1) & np.isfinite(moves).all(axis=1)
    if seen.sum() < 20:
        return []
    gap, moves = gap[seen] - np.median(gap[seen], axis=0), moves[seen] - moves[seen].mean(axis=0)
    power = float((moves**2).sum())
    late = float((gap * moves).sum()) / power if power > 0 else 0.0
    rest = gap - late * moves
    std = float(np.sqrt((rest**2).mean() / power)) if power > 0 else np.inf
    if abs(late) < max(SIGMAS * std, 0.5 * recording.dt):
        return []
    word = "ahead of" if late > 0 else "behind"
    return [
        f"{recording.ids[column]}: its fixes are {abs(late):.2f} s {word} the truth along its way: the clock of the "
        "truth differs, or fixes carry the time at which they arrived."
    ]
