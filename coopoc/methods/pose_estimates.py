"""Estimates of a pose filter over a recording: of vehicles alone, of stars, of the whole fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from ..arrays import Floats, Ints
from ..world.inbox import inbox
from ..world.recording import Recording
from ..world.v2x import Message
from . import pose_unit
from .pose_begin import check_compass
from .whole_fleet import centre

Follow: TypeAlias = Callable[..., tuple[Floats, Floats, Floats]]


class Found(NamedTuple):
    """Ego, its places among the members, all members' states and covariances, its links, and bytes (R,)."""

    ego: int
    place: Ints
    x: Floats
    covariance: Floats
    neighbours: Floats
    received: Floats
    sent: Floats


def each(
    follow: Follow, message: Message, star: bool, recording: Recording, columns: Sequence[int], begin: Floats
) -> Iterator[Found]:
    """Egos one after the other, each alone or with its star.

    Args:
        follow: states, covariances and costs of a unit's members.
        message: that each vehicle sends.
        star: whether neighbours take part.
        recording: in body frames.
        columns: of the egos.
        begin: (R, N, 4) first poses.
    """
    links = recording.links
    none: Floats = np.zeros(recording.runs)
    marks = np.isin(links.neighbour, recording.landmarks)
    for ego in columns:
        mine = links.of(ego)
        if not star:
            members = pose_unit.alone(recording, ego)
            received = sent = none
            x, cov, _ = follow(recording, members, mine[marks[mine]], begin)
        else:
            box = inbox(recording, ego, message)
            members, received = pose_unit.star(recording, ego, box), box.received_bytes
            check_compass(recording, np.unique(links.neighbour[mine[~marks[mine]]]))
            x, cov, _ = follow(recording, members, mine, begin)
            sent = none + box.sent_bytes
        place = pose_unit.places_of(members, ego)
        neighbours = np.full((recording.runs, len(mine), 3), np.nan)
        if star:
            others = np.setdiff1d(np.arange(len(members.column)), place)
            neighbours[:, ~marks[mine]] = x[:, others, :3]
        yield Found(ego, place, x, cov, neighbours, received, sent)


def whole(
    follow: Follow, message: Message, joint: bool, recording: Recording, columns: Sequence[int], begin: Floats
) -> Iterator[Found]:
    """All vehicles at once; a relative measurement counts if the message that it needs arrives at its step.

    Args:
        follow: states, covariances and costs of a unit's members.
        message: that each vehicle sends.
        joint: whether a centre receives all that is measured.
        recording: in body frames.
        columns: of the egos.
        begin: (R, N, 4) first poses.
    """
    links, members = recording.links, pose_unit.fleet(recording)
    mine = np.flatnonzero(~np.isin(links.observer, recording.landmarks))
    kept = (recording.arrival == links.step) | np.isin(links.neighbour, recording.landmarks)
    x, cov, _ = follow(recording, members, mine, begin, kept[:, mine])
    ones: Floats = np.ones(recording.runs)
    met = centre(recording, message) if joint else None
    for ego in columns:
        neighbours = np.full((recording.runs, len(links.of(ego)), 3), np.nan)
        if met is None:
            box = inbox(recording, ego, message)
            received, sent = box.received_bytes, ones * box.sent_bytes
        else:
            received, sent = met.received_bytes[:, ego], met.sent_bytes[:, ego]
        yield Found(ego, pose_unit.places_of(members, ego), x, cov, neighbours, received, sent)
