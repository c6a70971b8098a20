"""Exchange: which vehicles of the whole fleet are in contact at each step, whose messages get through, at what cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .recording import Recording
from .schedules import Nearest, Order, RoundRobin, within_cap
from .v2x import Message


@dataclass(frozen=True, eq=False)
class Exchange:
    """Pairs of vehicles that are in contact, sorted by step; `first` < `second` are columns.

    Two vehicles are in contact at a step if either sees the other: who sees may speak, and who is spoken to may answer.
    What a pair says at a step, all rounds of it, both ways, is one message each way and shares that message's fate:
    it gets through as a whole, `delay` steps late, or not at all. Over a pair where only one sees the other, the answer
    shares the fate of what it answers.

    Args:
        step, first, second: (P,). start: (T+1,) start[t]:start[t+1] are the pairs of step t.
        sight, sight_back: (P,) link in the Recording by which `first` sees `second`, and back; -1 for none.
        to_first, to_second: (R, P) True where the other's message of that step gets through.
        delay: steps from sending to arrival.
        received_bytes, sent_bytes: (R, N) over the drive.
    """

    step: Ints
    first: Ints
    second: Ints
    start: Ints
    sight: Ints
    sight_back: Ints
    to_first: Bools
    to_second: Bools
    delay: int
    received_bytes: Floats
    sent_bytes: Floats


def exchange(recording: Recording, message: Message) -> Exchange:
    """Contacts of all vehicles when each sends `message` to those that it is in contact with.

    A cap on bytes acts on each receiver as in its inbox: nearest first, those that it does not see itself last, or in
    turns.

    Args:
        recording: observed by all vehicles. message: its size counts against `v2x.bytes_per_second`.

    Raises:
        InputError: the links of some vehicles were not recorded; a cap whose schedule is "most informative": what a
            belief is worth depends on what others say in the same round.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> from coopoc.world.v2x import Message
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> exchange(observe(fleet, Sensors(), V2X()), Message("belief", 9, rounds=3, unicast=True)).received_bytes
    array([[216., 216.]])
    """
    silent = sorted(set(range(len(recording.ids))) - set(recording.observers))
    if silent:
        raise InputError("observers", f"without {[recording.ids[c] for c in silent[:4]]}", "must be all vehicles here",
                         "Leave observe(..., observers=...) at its default.")  # fmt: skip
    step, first, second, sight, back = _pairs(recording)
    to_first, to_second = _arrivals(recording, step, first, second, sight, back)
    steps, vehicles = len(recording.t), len(recording.ids)
    contacts = np.zeros((steps, vehicles), dtype=np.int64)
    np.add.at(contacts, (step, first), 1)
    np.add.at(contacts, (step, second), 1)
    size = np.broadcast_to(message.size(recording.v2x.overhead, contacts), contacts.shape)
    received = _receive(recording, (step, first, second, sight, back), (to_first, to_second), size)
    sends = recording.broadcasts * (contacts if message.unicast else recording.v2x.max_neighbours > 0)
    delay = int(np.ceil(recording.v2x.latency / recording.dt - 1e-9))
    in_time = delay * recording.dt <= recording.v2x.max_age + 1e-9
    return Exchange(
        step, first, second, np.searchsorted(step, np.arange(steps + 1)), sight, back,
        (to_first >= 0) & in_time, (to_second >= 0) & in_time, delay,
        received, np.repeat((sends * size).sum(axis=0, dtype=float)[None], recording.runs, axis=0),
    )  # fmt: skip


def _pairs(recording: Recording) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """Step, columns and the two links of each pair, sorted by step, then columns."""
    links, vehicles = recording.links, len(recording.ids)
    forward = links.observer < links.neighbour
    first = np.where(forward, links.observer, links.neighbour)
    second = np.where(forward, links.neighbour, links.observer)
    key, pair = np.unique((links.step * vehicles + first) * vehicles + second, return_inverse=True)
    sight, back = np.full((2, len(key)), -1, dtype=np.int64)
    sight[pair[forward]] = np.flatnonzero(forward)
    back[pair[~forward]] = np.flatnonzero(~forward)
    return key // vehicles**2, key // vehicles % vehicles, key % vehicles, sight, back


def _arrivals(
    recording: Recording, step: Ints, first: Ints, second: Ints, sight: Ints, back: Ints
) -> tuple[Ints, Ints]:  # fmt: skip
    """(R, P) steps at which the pair's messages reach `first` and `second`, -1 for never."""

    def reaching(own: Ints, other: Ints, sender: Ints) -> Ints:
        answer = np.where(recording.broadcasts[step, sender], recording.arrival[:, other], -1)
        return np.where(own >= 0, recording.arrival[:, own], answer)

    if not len(step):
        empty = np.empty((recording.runs, 0), dtype=np.int64)
        return empty, empty.copy()
    return reaching(sight, back, second), reaching(back, sight, first)


def _receive(recording: Recording, pairs: tuple[Ints, ...], arrivals: tuple[Ints, Ints], size: Ints) -> Floats:
    """Apply the cap to what each vehicle receives, in place, and count its bytes (R, N)."""
    step, first, second, sight, back = pairs
    vehicles, count = len(recording.ids), len(step)
    arrival, receiver = np.concatenate(arrivals, axis=1), np.concatenate([first, second])
    sizes = np.concatenate([size[step, second], size[step, first]])
    if np.isfinite(recording.v2x.bytes_per_second) and sizes.any():
        own, other = np.concatenate([sight, back]), np.concatenate([back, sight])
        rank = np.where(own >= 0, own, len(recording.links) + other)
        both, sender = np.tile(step, 2), np.concatenate([second, first])
        order = np.lexsort((rank, both, receiver))
        for mine in np.split(order, np.searchsorted(receiver[order], np.arange(1, vehicles))):
            start = np.searchsorted(both[mine], np.arange(len(recording.t) + 1))
            heard_by = _order(recording, sender[mine])
            arrival[:, mine] = within_cap(arrival[:, mine], sizes[mine], start, recording, heard_by)
        arrivals[0][:], arrivals[1][:] = arrival[:, :count], arrival[:, count:]
    there = (arrival >= 0) & (arrival < len(recording.t))
    return np.stack([np.bincount(receiver, row * sizes, minlength=vehicles) for row in there]).astype(float)


def _order(recording: Recording, sender: Ints) -> Order:
    """The schedule of one receiver of beliefs."""
    if recording.v2x.schedule == "most informative":
        raise InputError("schedule", repr(recording.v2x.schedule), "must be 'nearest' or 'round robin' in an exchange",
                         "Take it with a method of a star, such as the joint filter.")  # fmt: skip
    if recording.v2x.schedule == "nearest":
        return Nearest()
    return RoundRobin(sender, np.full((recording.runs, len(recording.ids)), -1))
