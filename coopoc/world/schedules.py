"""Schedules: which message a receiver takes first when its token bucket does not hold enough for all that arrive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..arrays import Floats, Ints
from ..kernels.bucket import nearest_first
from .informative import MostInformative
from .recording import Recording
from .v2x import Message


class Order(Protocol):
    """The order in which one receiver takes the messages (R, M) that are sent to it."""

    def measure(self, step: int, span: slice) -> None:
        """Use the relative measurements of a step, before any message of it; `span` are the messages sent at it."""

    def utility(self, step: int, span: slice) -> Floats:
        """(R, n) of the messages of a step: the largest is received next, of equals the first."""

    def receive(self, step: int, run: Ints, message: Ints) -> None:
        """Use `message[i]` of this step, received in `run[i]`."""


@dataclass(frozen=True)
class Nearest:
    """In the order in which messages are given: nearest first."""

    def measure(self, step: int, span: slice) -> None:
        """Nothing changes."""

    def utility(self, step: int, span: slice) -> Floats:
        """The first has the largest utility."""
        return -np.arange(span.stop - span.start, dtype=float)[None]

    def receive(self, step: int, run: Ints, message: Ints) -> None:
        """Nothing changes."""


@dataclass(frozen=True, eq=False)
class RoundRobin:
    """In turns: the sender that has waited longest is next; one that was never received comes first.

    Args:
        sender: (M,) columns.
        last: (R, N) step at which a message of each was last received, -1 for never.
    """

    sender: Ints
    last: Ints

    def measure(self, step: int, span: slice) -> None:
        """Nothing changes."""

    def utility(self, step: int, span: slice) -> Floats:
        """Steps since the last message of each."""
        return (step - self.last[:, self.sender[span]]).astype(float)

    def receive(self, step: int, run: Ints, message: Ints) -> None:
        """Move the senders to the end of the queue."""
        self.last[run, self.sender[message]] = step


def order(recording: Recording, ego: int, link: Ints, message: Message) -> Order:
    """The schedule of one receiver before any message.

    Args:
        recording: the links, and the schedule by name.
        ego: column of the receiver.
        link: (M,) links of the recording over which messages come, by step, nearest first.
        message: their kind.
    """
    if recording.v2x.schedule == "nearest":
        return Nearest()
    runs, vehicles = recording.runs, len(recording.ids)
    last = np.full((runs, vehicles), -1)
    if recording.v2x.schedule == "round robin":
        return RoundRobin(recording.links.neighbour[link], last)
    return MostInformative.at_first(recording, ego, link, message.cumulative)


def within_cap(arrival: Ints, size: Ints, start: Ints, recording: Recording, schedule: Order) -> Ints:
    """Arrivals (R, M) with -1 for messages that a token bucket rejects.

    The bucket holds what one second brings, or the largest message if that is more; it is full at the first step, as in
    RFC 2697 (section 3), and it fills by `bytes_per_second` times dt a step. A message that arrives is accepted if
    there are tokens for all of it; of those that arrive together the schedule takes one after the other.

    Args:
        arrival: (R, M) steps at one receiver, by sending step and then nearest first; those of one sending step arrive
            together.
        size: (M,) bytes on air.
        start: (T+1,) start[t]:start[t+1] are sent at step t.
        recording: its V2X has the cap.
        schedule: of this receiver.
    """
    cap = recording.v2x.bytes_per_second
    if not np.isfinite(cap) or not size.any():
        return arrival
    depth = float(max(cap, int(size.max()))) if cap else 0.0
    if isinstance(schedule, Nearest):
        there, bytes_, first = (np.ascontiguousarray(values, dtype=np.int64) for values in (arrival, size, start))
        return nearest_first(there, bytes_, first, cap * recording.dt, depth)
    accepted = np.full_like(arrival, -1)
    tokens, last = np.full(len(arrival), depth), 0
    for t, span in enumerate(map(slice, start[:-1].tolist(), start[1:].tolist())):
        schedule.measure(t, span)
        left = arrival[:, span] >= 0
        if not left.any():
            continue
        now = int(arrival[:, span].max())
        tokens, last = np.minimum(tokens + cap * recording.dt * (now - last), depth), now
        while (fits := left & (size[span] <= tokens[:, None] + 1e-9)).any():
            run = np.flatnonzero(fits.any(axis=1))
            best = np.where(fits, schedule.utility(t, span), -np.inf)[run].argmax(axis=1)
            schedule.receive(t, run, span.start + best)
            left[run, best] = False
            accepted[run, span.start + best] = arrival[run, span.start + best]
            tokens[run] -= size[span.start + best]
    return accepted
