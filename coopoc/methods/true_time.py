"""Messages at their true time: what has arrived by now about the star of some steps ago."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats, Ints
from ..world.inbox import Inbox
from ..world.recording import Recording
from .knowledge import Knowledge
from .star import StarStep, held_motion, star_steps


@dataclass(frozen=True, eq=False)
class Seen:
    """One step of a star and the messages of its n members, the ego's own being there at once.

    Args:
        star: as known by now. members: (n,) columns. joined: (n,) step since which each has been in the star.
        arrival: (R, n) step at which the message of this step arrives, -1 never.
        sent: (R, n) step of the message whose velocity moved each member here, -1 none.
    """

    star: StarStep
    members: Ints
    joined: Ints
    arrival: Ints
    sent: Ints


def seen_steps(recording: Recording, ego: int, box: Inbox, arrival: Ints, known: Knowledge) -> Iterator[Seen]:
    """The ego's star at every step, as what was held then says it."""
    joined = np.empty(0, np.int64)
    for star in star_steps(recording, ego, box, known):
        span = slice(box.start[star.step], box.start[star.step + 1])
        members = np.concatenate([[ego], recording.links.neighbour[star.links]])
        joined = np.where(star.kept >= 0, np.append(joined, 0)[star.kept], star.step)
        own = np.full((recording.runs, 1), star.step)
        yield Seen(star, members, joined, np.concatenate([own, arrival[:, span]], axis=1),
                   np.concatenate([own, box.newest[:, span]], axis=1))  # fmt: skip


def known_by(
    now: int, part: Seen, before: Seen | None, recording: Recording, known: Knowledge, variance: Floats
) -> Seen:
    """The step with the messages that have arrived by step `now`.

    A fix stands at the step at which it was sent. A member moves with the velocity of the step itself, or with the last
    one before that has arrived and is no older than `max_age`; used for the n-th step in a row it makes the same error
    n times, which adds (2n - 1) times the variance of one (see star_steps).

    Args:
        before: the step before as known by now, None for the first.
    """
    star = part.star
    come = (part.arrival >= 0) & (part.arrival <= now)
    sent = np.where(come, star.step, part.sent)
    if before is not None:
        carried = np.where(star.kept >= 0, before.sent[:, star.kept], -1)
        fresh = star.step - carried <= recording.v2x.max_age / recording.dt + 1e-9
        sent = np.maximum(sent, np.where(fresh, carried, -1))
    if now > star.step and np.array_equal(come, star.heard) and np.array_equal(sent, part.sent):
        return part
    uses = star.step - np.maximum(sent, part.joined) + 1
    moved, process, _, _ = held_motion(recording, variance, part.members, sent, uses, star.step)
    fix_variance = np.broadcast_to(known.gnss_variance, (1, len(part.members), 3))
    fix = recording.gnss[:, star.step, part.members]
    star = replace(star, moved=moved, process=process, fix=fix, fix_variance=fix_variance, heard=come)
    return replace(part, star=star, sent=sent)
