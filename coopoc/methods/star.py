"""The star around one ego, step by step: who is in it, who stayed, and what arrived from whom."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.spherical import to_vector
from .knowledge import Knowledge

FORGOTTEN = 1e6
"""m^2, prior variance of a vehicle that has just joined: nothing is known of it."""
ACCELERATION_STD = 1.0
"""m/s^2, how fast a velocity that was not received may have changed since the last one that was."""


@dataclass(frozen=True, eq=False)
class StarStep:
    """What one ego knows at one step of the n members of its star, itself first.

    Args:
        step: t. kept: (n,) index of each member in the previous star, -1 if it has just joined.
        links: (n-1,) indices into the Recording's links.
        relative: (R, n-1, 3) m, rad, rad. vector: (R, n-1, 3) m, converted.
        moved: (R, n, 3) m, dt times the latest velocity held. process: (R or 1, n, 3) m^2 of that motion.
        fix: (R, n, 3) m, GNSS brought forward to this step. fix_variance: (R or 1, n, 3) m^2.
        heard: (R, n) True where that fix is new.
    """

    step: int
    kept: Ints
    links: Ints
    relative: Floats
    vector: Floats
    moved: Floats
    process: Floats
    fix: Floats
    fix_variance: Floats
    heard: Bools


def star_steps(recording: Recording, ego: int, box: Inbox, knowledge: Knowledge) -> Iterator[StarStep]:
    """The ego's star at every step. A fix sent `age` steps ago is brought forward with the velocity that came with it.

    A late velocity adds (dt age ACCELERATION_STD)^2 to the variance of the velocity, per step that it is used for.
    """
    variance = knowledge.process_variance(recording)
    runs = np.arange(recording.runs)[:, None]
    before = np.array([], dtype=np.int64)
    for t in range(len(recording.t)):
        span = slice(box.start[t], box.start[t + 1])
        links = box.link[span]
        members = np.concatenate([[ego], recording.links.neighbour[links]])
        sent = np.concatenate([np.full((recording.runs, 1), t), box.newest[:, span]], axis=1)
        held = sent >= 0
        at = np.where(held, sent, t)
        late = bool((at != t).any()) or not held.all()
        if late:
            moved, process = _late_motion(recording, variance, runs, at, members, held, t)
        else:
            moved, process = recording.dt * recording.velocity[:, t, members], _at(variance, t, members)
        heard = np.concatenate([np.ones((recording.runs, 1), dtype=bool), box.fresh[:, span]], axis=1)
        age = (t - at)[..., None]
        fix = recording.gnss[runs, at, members] + age * moved if late else recording.gnss[:, t, members]
        yield StarStep(
            t, np.array([_place(before, m) for m in members]), links, recording.relative[:, links],
            to_vector(recording.relative[:, links]), moved, process, fix,
            knowledge.gnss_variance + age**2 * process if late else np.broadcast_to(
                knowledge.gnss_variance, (1, len(members), 3)), heard,
        )  # fmt: skip
        before = members


def rows(members: Ints) -> Ints:
    """Rows of the members' three components in a stacked state.

    >>> rows(np.array([0, 2])).tolist()
    [0, 1, 2, 6, 7, 8]
    """
    return np.asarray(3 * members[:, None] + np.arange(3)).ravel()


def _place(members: Ints, member: int) -> int:
    where = np.flatnonzero(members == member)
    return int(where[0]) if len(where) else -1


def _at(variance: Floats, t: int, members: Ints) -> Floats:
    """(R or 1, n, 3) of an array broadcastable to (R, T, N, 3)."""
    row = variance[:, t if variance.shape[1] > 1 else 0]
    return row[:, members] if row.shape[1] > 1 else np.repeat(row, len(members), axis=1)


def _late_motion(
    recording: Recording, variance: Floats, runs: Ints, at: Ints, members: Ints, held: Bools, t: int
) -> tuple[Floats, Floats]:
    """Motion of the members from the newest velocity held; a member never heard may stand still or drive at 10 m/s."""
    velocity = np.where(held[..., None], recording.velocity[runs, at, members], 0.0)
    full = np.broadcast_to(variance, recording.velocity.shape)
    drift = (recording.dt**2 * (t - at) * ACCELERATION_STD) ** 2
    process = full[runs, at, members] + np.where(held, drift, (10.0 * recording.dt) ** 2)[..., None]
    return recording.dt * velocity, process
