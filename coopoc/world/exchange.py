"""Exchange: which vehicles of the whole fleet are in contact at each step, which messages arrive, and their bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from .inbox import within_cap
from .recording import Recording
from .v2x import Message


@dataclass(frozen=True, eq=False)
class Exchange:
    """Pairs of vehicles in contact, sorted by step.

    Two vehicles are in contact at a step if at least one measures the other. All that a pair exchanges at a step, every
    round of it, is one message each way: it arrives as a whole, late or never. Where only one vehicle measures the
    other, the answer has the fate of the message that it answers.

    Args:
        step: (P,) of the pair.
        first: (P,) column, less than `second`.
        second: (P,) column.
        start: (T+1,) start[t]:start[t+1] are the pairs of step t.
        link: (P,) link of the Recording by which `first` measures `second`, -1 for none.
        link_back: (P,) link by which `second` measures `first`, -1 for none.
        at_first: (R, P) step at which the message of `second` arrives at `first`, -1 for never.
        at_second: (R, P) step at which the message of `first` arrives at `second`, -1 for never.
        received_bytes: (R, N) over the drive.
        sent_bytes: (R, N) over the drive.
    """

    step: Ints
    first: Ints
    second: Ints
    start: Ints
    link: Ints
    link_back: Ints
    at_first: Ints
    at_second: Ints
    received_bytes: Floats
    sent_bytes: Floats

    @property
    def both(self) -> Ints:
        """(R, P) step by which the messages of both ways have arrived, -1 for never."""
        lost = np.minimum(self.at_first, self.at_second) < 0
        return np.where(lost, -1, np.maximum(self.at_first, self.at_second))

    @property
    def either(self) -> Ints:
        """(R, P) step at which the first message of the two ways arrives, -1 for never."""
        one, other = self.at_first, self.at_second
        return np.where(np.minimum(one, other) < 0, np.maximum(one, other), np.minimum(one, other))


def exchange(recording: Recording, message: Message) -> Exchange:
    """Contacts of all vehicles when each sends `message` to those in contact with it.

    A cap on bytes applies to each receiver as in its inbox: nearest first and vehicles that it does not measure last,
    in their order, or in turns.

    Args:
        recording: observed by all vehicles.
        message: its size counts against `v2x.bytes_per_second`.

    Raises:
        InputError: the links of some vehicles were not recorded.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> from coopoc.world.v2x import Message
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> exchange(observe(fleet, Sensors(), V2X()), Message("belief", 9, rounds=3, unicast=True)).received_bytes
    array([[216., 216.]])
    """
    silent = sorted(set(range(len(recording.ids))) - set(recording.observers))
    if silent:
        raise InputError(
            "observers",
            f"without {[recording.ids[c] for c in silent[:4]]}",
            "must be all vehicles here",
            "Leave observe(..., observers=...) at its default.",
        )
    step, first, second, link, link_back = pairs = _pairs(recording)
    arrivals = _arrivals(recording, *pairs)
    steps, vehicles = len(recording.t), len(recording.ids)
    contacts = np.zeros((steps, vehicles), dtype=np.int64)
    np.add.at(contacts, (step, first), 1)
    np.add.at(contacts, (step, second), 1)
    size = np.broadcast_to(message.size(recording.v2x.overhead, contacts), contacts.shape)
    received = _receive(recording, pairs, arrivals, size)
    sends = recording.broadcasts * (contacts if message.unicast else recording.v2x.max_neighbours > 0)
    oldest = recording.v2x.max_age / recording.dt + 1e-9
    at_first, at_second = (np.where(arrival - step <= oldest, arrival, -1) for arrival in arrivals)
    start, sent = np.searchsorted(step, np.arange(steps + 1)), (sends * size).sum(axis=0, dtype=float)
    return Exchange(
        step, first, second, start, link, link_back, at_first, at_second, received, np.tile(sent, (recording.runs, 1))
    )


def _pairs(recording: Recording) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """Step, columns and the two links of each pair, sorted by step, then columns."""
    links, vehicles = recording.links, len(recording.ids)
    forward = links.observer < links.neighbour
    first = np.where(forward, links.observer, links.neighbour)
    second = np.where(forward, links.neighbour, links.observer)
    key, pair = np.unique((links.step * vehicles + first) * vehicles + second, return_inverse=True)
    link, back = np.full((2, len(key)), -1, dtype=np.int64)
    link[pair[forward]] = np.flatnonzero(forward)
    back[pair[~forward]] = np.flatnonzero(~forward)
    return key // vehicles**2, key // vehicles % vehicles, key % vehicles, link, back


def _arrivals(recording: Recording, step: Ints, first: Ints, second: Ints, link: Ints, back: Ints) -> tuple[Ints, Ints]:
    """(R, P) steps at which the pair's messages reach `first` and `second`, -1 for never."""

    def reaching(own: Ints, other: Ints, sender: Ints) -> Ints:
        answer = np.where(recording.broadcasts[step, sender], recording.arrival[:, other], -1)
        return np.where(own >= 0, recording.arrival[:, own], answer)

    if not len(step):
        empty = np.empty((recording.runs, 0), dtype=np.int64)
        return empty, empty.copy()
    return reaching(link, back, second), reaching(back, link, first)


def _receive(recording: Recording, pairs: tuple[Ints, ...], arrivals: tuple[Ints, Ints], size: Ints) -> Floats:
    """Apply the cap to what each vehicle receives, in place, and count its bytes (R, N)."""
    step, first, second, link, back = pairs
    vehicles, count = len(recording.ids), len(step)
    arrival, receiver = np.concatenate(arrivals, axis=1), np.concatenate([first, second])
    sizes = np.concatenate([size[step, second], size[step, first]])
    if np.isfinite(recording.v2x.bytes_per_second) and sizes.any():
        own, other = np.concatenate([link, back]), np.concatenate([back, link])
        rank = np.where(own >= 0, own, len(recording.links) + other)
        both, sender = np.tile(step, 2), np.concatenate([second, first])
        order = np.lexsort((rank, both, receiver))
        for mine in np.split(order, np.searchsorted(receiver[order], np.arange(1, vehicles))):
            start = np.searchsorted(both[mine], np.arange(len(recording.t) + 1))
            arrival[:, mine] = within_cap(arrival[:, mine], sizes[mine], start, sender[mine], recording)
        arrivals[0][:], arrivals[1][:] = arrival[:, :count], arrival[:, count:]
    there = (arrival >= 0) & (arrival < len(recording.t))
    return np.stack([np.bincount(receiver, row * sizes, minlength=vehicles) for row in there]).astype(float)
