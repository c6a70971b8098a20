"""Inbox: which messages one vehicle holds at each step, after loss, delay and the cap on its bytes."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .recording import Recording
from .v2x import Message


@dataclass(frozen=True, eq=False)
class Inbox:
    """Messages of one observer's neighbours, aligned with its links.

    Args:
        link: (M,) indices of its links in the Recording, in time order.
        start: (T+1,) link[start[t]:start[t+1]] are the links of step t.
        arrival: (R, M) step at which the message sent at the link's step arrives, -1 if it is lost, rejected by the
            cap, or still on its way at the end.
        newest: (R, M) step at which the newest message held was sent, -1 for none.
        fresh: (R, M) True where that message is new since the pair was last linked: a fix may be used once only.
        received_bytes: (R,) over the drive.
        sent_bytes: bytes that this vehicle broadcasts over the drive.
    """

    link: Ints
    start: Ints
    arrival: Ints
    newest: Ints
    fresh: Bools
    received_bytes: Floats
    sent_bytes: float


def inbox(recording: Recording, ego: int, message: Message) -> Inbox:
    """Messages that `ego` has received when each neighbour broadcasts `message`.

    Args:
        recording: the links, the sending schedule and the arrivals.
        ego: column.
        message: what its rounds take on air counts against `v2x.bytes_per_second`.

    Raises:
        InputError: a message as long as the neighbourhood, which only a centre takes.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> from coopoc.world.v2x import FIX_AND_VELOCITY
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> inbox(observe(fleet, Sensors(), V2X()), 0, FIX_AND_VELOCITY).received_bytes
    array([64.])
    """
    if message.per_neighbour:
        raise InputError("message", message.name, "must be a broadcast of one size", "Give Message(name, numbers).")
    steps = len(recording.t)
    link = recording.links.of(ego)
    at = recording.links.step[link]
    start, size = np.searchsorted(at, np.arange(steps + 1)), message.size(recording.v2x.overhead)
    sender = recording.links.neighbour[link]
    arrival = within_cap(recording.arrival.take(link, axis=1), size, start, sender, recording)
    arrival = np.where(arrival < steps, arrival, -1)
    newest, fresh = _newest(arrival, at, sender, steps)
    too_old = at - newest > recording.v2x.max_age / recording.dt + 1e-9
    newest[too_old] = -1
    broadcasts = recording.broadcasts[:, ego].sum() if recording.v2x.max_neighbours else 0
    return Inbox(
        link,
        start,
        arrival,
        newest,
        fresh & ~too_old,
        received_bytes=(arrival >= 0).sum(axis=1) * float(size),
        sent_bytes=float(broadcasts * size),
    )


def _newest(arrival: Ints, sent: Ints, neighbour: Ints, steps: int) -> tuple[Ints, Bools]:
    """Newest sending step held and whether that is new, (R, M) both, of messages of several neighbours."""
    if (arrival == sent).all():
        return np.broadcast_to(sent, arrival.shape).copy(), np.ones(arrival.shape, bool)
    newest, fresh = np.empty(arrival.shape, int), np.empty(arrival.shape, bool)
    for one in np.unique(neighbour):
        pair = np.flatnonzero(neighbour == one)
        run, k = np.nonzero(arrival[:, pair] >= 0)
        held = np.full((len(arrival), steps), -1, int)
        np.maximum.at(held, (run, arrival[run, pair[k]]), sent[pair[k]])
        newest[:, pair] = held = np.maximum.accumulate(held, axis=1)[:, sent[pair]]
        fresh[:, pair] = np.diff(held, axis=1, prepend=-1) > 0
    return newest, fresh


def within_cap(arrival: Ints, size: int, start: Ints, sender: Ints, recording: Recording) -> Ints:
    """Arrivals (R, M) with -1 for messages that a token bucket rejects.

    The bucket holds what one second brings, or a message if that is more; it is full at the first step, as in
    RFC 2697 (section 3), and it fills by `bytes_per_second` times dt a step. A message that arrives is accepted if
    there are tokens for all of it. Of those that arrive together the nearest sender's is first, or in round robin that
    of the sender whose last accepted message is oldest.

    Args:
        arrival: (R, M) steps at one receiver, by sending step and then nearest first; those of one sending step arrive
            together.
        size: bytes of each on air.
        start: (T+1,) start[t]:start[t+1] are sent at step t.
        sender: (M,) columns.
        recording: its V2X has the cap and the schedule.
    """
    cap = recording.v2x.bytes_per_second
    if not np.isfinite(cap) or not size:
        return arrival
    depth = float(max(cap, size)) if cap else 0.0
    accepted, last_accepted = np.full_like(arrival, -1), np.full((len(arrival), len(recording.ids)), -1)
    tokens, last = np.full(len(arrival), depth), 0
    for t, span in enumerate(map(slice, start[:-1].tolist(), start[1:].tolist())):
        left = arrival[:, span] >= 0
        if not left.any():
            continue
        now = int(arrival[:, span].max())
        tokens, last = np.minimum(tokens + cap * recording.dt * (now - last), depth), now
        while (fits := left & (size <= tokens[:, None] + 1e-9)).any():
            run = np.flatnonzero(fits.any(axis=1))
            waited = 0 if recording.v2x.schedule == "nearest" else t - last_accepted[:, sender[span]]
            best = np.where(fits, waited, -1)[run].argmax(axis=1)
            message = span.start + best
            last_accepted[run, sender[message]] = t
            left[run, best] = False
            accepted[run, message] = arrival[run, message]
            tokens[run] -= size
    return accepted
