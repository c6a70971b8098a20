"""The star around one ego, step by step: its members, their places before, and their newest messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..kernels.solo import FixNoise, drive
from ..kernels.stars.messages import Assumptions, Measurements
from ..kernels.stars.relative import components
from ..world.inbox import Inbox
from ..world.links import to_vector
from ..world.recording import Recording
from .kalman import drive_of
from .noise_model import NoiseModel
from .stream import process_noise

FORGOTTEN = 1e6
"""m^2, prior variance of a vehicle that has just joined: nothing is known of it."""
ACCELERATION_STD = 1.0
"""m/s^2, how fast a velocity may have changed since the message that carried it."""


POSITION = (0.0,) * 3
"""A state that is a position: its size, for compiled code."""


@dataclass(frozen=True, eq=False)
class StarStep:
    """Information of one ego at one step about the n members of its star, itself first.

    Args:
        step: t.
        previous: (n,) index of each member in the previous star, -1 if it has just joined.
        links: (n-1,) indices into the Recording's links.
        relative: (R, n-1, 3) m, rad, rad.
        vector: (R, n-1, 3) m, converted.
        moved: (R, n, 3) m, dt times the latest velocity held.
        process: (R or 1, n, 3) m^2 of that motion.
        fix: (R, n, 3) m, GNSS brought forward to this step.
        fix_variance: (R or 1, n, 3) m^2.
        new_fix: (R, n) True where that fix is new.
    """

    step: int
    previous: Ints
    links: Ints
    relative: Floats
    vector: Floats
    moved: Floats
    process: Floats
    fix: Floats
    fix_variance: Floats
    new_fix: Bools


def star_steps(
    recording: Recording, ego: int, box: Inbox, noise_model: NoiseModel, steps: range | None = None
) -> Iterator[StarStep]:
    """The ego's star at every step, or as if only `steps` in a row had been, with the newest message of each
    member.

    A fix sent `age` steps ago is brought forward with the velocity that came with it. A velocity that is used for the
    n-th step in a row makes the same error n times, not n independent ones: the variance of the sum is n^2, so this
    step adds (2n - 1) times the variance of one. Nothing is assumed of a member without messages.
    """
    variance, fixes = noise_model.process_variance(recording), noise_model.fix_variance(recording)
    before, before_sent = np.array([], dtype=np.int64), np.empty((recording.runs, 0), dtype=np.int64)
    uses = np.ones((recording.runs, 0), dtype=np.int64)
    for t in range(len(recording.t)) if steps is None else steps:
        span = slice(box.start[t], box.start[t + 1])
        links = box.link[span]
        members = np.concatenate([[ego], recording.links.neighbour[links]])
        previous = np.array([_place(before, m) for m in members])
        own = np.full((recording.runs, 1), t)
        sent = np.concatenate([own, box.newest[:, span]], axis=1)
        again = (previous >= 0) & (np.append(before_sent, own * 0 - 2, axis=1)[:, previous] == sent)
        uses = np.where(again, np.append(uses, own, axis=1)[:, previous] + 1, 1)
        motion = _prompt if (sent == t).all() else held_motion
        moved, process, fix, fix_variance = motion(recording, variance, members, sent, uses, t)
        relative = recording.relative[:, links]
        there: Bools = np.asarray(np.isfinite(fix).all(axis=-1))
        new_fix = np.concatenate([own >= 0, box.fresh[:, span]], axis=1) & there
        fix = np.where(there[..., None], fix, 0.0)
        yield StarStep(
            t,
            previous,
            links,
            relative,
            to_vector(relative),
            moved,
            process,
            fix,
            _when_sent(fixes, members, sent, t) + fix_variance,
            new_fix,
        )
        before, before_sent = members, sent


def measurements(recording: Recording, ego: int, box: Inbox, broadcast: Floats | None = None) -> Measurements:
    """Measurements and messages of one ego, as `coopoc.kernels.stars.messages.Measurements`.

    Args:
        recording: of all vehicles.
        ego: column.
        box: its messages.
        broadcast: (R, T, N, 3) m, position in a message; None for the fix.
    """
    neighbour, start, newest = (
        np.ascontiguousarray(numbers, dtype=np.int64)
        for numbers in (recording.links.neighbour[box.link], box.start, box.newest)
    )
    gnss = recording.gnss
    return Measurements(
        gnss,
        recording.velocity,
        gnss if broadcast is None else broadcast,
        components(recording.relative, box.link),
        neighbour,
        start,
        newest,
        np.ascontiguousarray(box.fresh),
        int(ego),
        recording.dt,
    )


def assumptions(recording: Recording, known: NoiseModel) -> Assumptions:
    """The noise that a filter assumes, as `kernels.stars.messages.Assumptions`: a message holds a fix and a velocity,
    whose error the fix of `age` steps ago has made age times."""
    (process, motion), fixes = process_noise(known, recording), np.ascontiguousarray(known.fix_variance(recording))
    noise = relative_noise(known)
    return Assumptions(process, fixes, fixes, (1.0, 0.0), *noise, FORGOTTEN, ACCELERATION_STD, motion)


def estimates(
    recording: Recording, known: NoiseModel, egos: Sequence[int], growth: tuple[float, float], acceleration: float
) -> tuple[Assumptions, Floats]:
    """Assumptions of a filter whose messages hold estimates, and these: the solo filters (R, T, N, 3) m of all vehicles
    in the stars of some egos.

    Args:
        recording: of all vehicles.
        known: the noise model.
        egos: columns.
        growth: as in `Assumptions`.
        acceleration: m/s^2.
    """
    links, x, p = recording.links, np.empty(recording.gnss.shape), np.empty(recording.gnss.shape)
    members = np.union1d(egos, links.neighbour[np.isin(links.observer, egos)])
    drive(drive_of(recording, known, members), FixNoise(known.gnss_variance), False, members, x, p)
    grown = assumptions(recording, known)._replace(broadcast=p, growth=growth, acceleration=acceleration)
    return grown, x


def relative_noise(known: NoiseModel) -> tuple[Floats, float]:
    """(3,) m, rad, rad and the least range m of relative measurements, or nothing for unit matrices."""
    return (np.empty(0), 0.0) if known.sensors is None else (known.sensors.relative_std, known.sensors.min_range)


def _prompt(
    recording: Recording, variance: Floats, members: Ints, sent: Ints, uses: Ints, t: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Motion, its variance, fix and the variance added to it, when every message was sent at this step."""
    row = variance[:, t if variance.shape[1] > 1 else 0]
    process = row[:, members] if row.shape[1] > 1 else np.repeat(row, len(members), axis=1)
    moved = recording.dt * recording.velocity[:, t, members]
    return moved, process, recording.gnss[:, t, members], np.zeros((1, len(members), 1))


def held_motion(
    recording: Recording, variance: Floats, members: Ints, sent: Ints, uses: Ints, t: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """The same four from the newest message of each run and member, as old as it may be."""
    held = (sent >= 0)[..., None]
    at, age = np.where(sent >= 0, sent, t), (t - sent)[..., None]
    runs = np.arange(recording.runs)[:, None]
    velocity = recording.velocity[runs, at, members]
    one_step = np.broadcast_to(variance, recording.velocity.shape)[runs, at, members]
    one_step = one_step + (recording.dt**2 * age * ACCELERATION_STD) ** 2
    moved = np.where(held, recording.dt * velocity, 0.0)
    process = np.where(held, (2 * uses[..., None] - 1) * one_step, FORGOTTEN)
    fix = recording.gnss[runs, at, members] + np.where(held, age * moved, 0.0)
    return moved, process, fix, np.where(held, age**2 * one_step, 0.0)


def _when_sent(variance: Floats, members: Ints, sent: Ints, t: int) -> Floats:
    """(R or 1, n or 1, 3) assumed variance of each fix, broadcastable to (R, T, N, 3), when it was sent."""
    if variance.shape[:3] == (1, 1, 1):
        return np.asarray(variance[0])
    runs = np.arange(len(sent))[:, None]
    whole = np.broadcast_to(variance, (len(sent), *variance.shape[1:]))
    return np.asarray(whole[runs, np.where(sent >= 0, sent, t), members])


def rows(members: Ints) -> Ints:
    """Rows of the members' three components in a stacked state.

    >>> rows(np.array([0, 2])).tolist()
    [0, 1, 2, 6, 7, 8]
    """
    return np.asarray(3 * members[:, None] + np.arange(3)).ravel()


def _place(members: Ints, member: int) -> int:
    where = np.flatnonzero(members == member)
    return int(where[0]) if len(where) else -1
