"""Methods across gaps: an ego that is absent for a while, or has no fix at first, is followed stretch by stretch."""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any

import numpy as np

from ..arrays import instance
from ..errors import InputError
from ..world.recording import Recording, Vehicles, check_recording
from .track import Method, Track

ESTIMATES = "x", "covariance", "neighbours", "heading", "heading_covariance"
"""Arrays of a Track; None of what a method does not estimate."""


def in_stretches(call: Callable[..., Track]) -> Callable[..., Track]:
    """A method's `__call__` that begins anew after each gap of an ego; its estimate is NaN where there is none.

    A position x0 that is known at first holds for a stretch that begins there.

    >>> from coopoc import Fleet, Kalman, Sensors, observe
    >>> fleet = Fleet(("a",), np.arange(6) / 10, np.zeros((6, 1, 3)), np.zeros((6, 1, 3)))
    >>> seen = observe(fleet, Sensors())
    >>> u = seen.velocity.copy()
    >>> u[:, 2] = np.nan
    >>> Kalman()(replace(seen, velocity=u)).absent.ravel().tolist()
    [False, False, True, False, False, False]
    """

    @wraps(call)
    def across(self: Any, recording: Recording, egos: Vehicles = (0,)) -> Track:
        columns = check_recording(recording).observing(egos)
        whole = (0, len(recording.t))
        cuts = {column: recording.stretches(column, fixed=needs_fix(self)) for column in columns}
        if all(pieces in ((), (whole,)) for pieces in cuts.values()):
            return noted(call(self, recording, egos))
        for column, pieces in cuts.items():
            if not pieces:
                never = "is never present at two successive steps with a fix"
                raise InputError("egos", repr(recording.ids[column]), never, "Choose another ego.")
        parts = {
            (column, cut): call(_from(self, cut[0]), recording.between(*cut), [recording.ids[column]])
            for column in columns
            for cut in cuts[column]
        }
        return noted(_joined(recording, columns, parts))

    return across


def follow(method: Method, recording: Recording, egos: Vehicles) -> Track:
    """Track of any method across gaps, also of one that does not handle gaps itself."""
    instance("method", method, Method, "Give co.Kalman(), or one as in docs/extend.md.")  # type: ignore[type-abstract]
    return in_stretches(type(method).__call__)(method, recording, egos)


def needs_fix(method: Any) -> bool:
    """Whether a method can begin with a fix only."""
    return bool(getattr(method, "needs_fix", True))


def noted(track: Track) -> Track:
    """The track with a note of its gaps; InputError for an ego that has no estimate at all, or for what is no Track."""
    track = instance("what the method returns", track, Track, "docs/extend.md shows one.")
    if track.absent is None:
        return track
    for ego in np.array(track.egos)[track.absent.all(axis=0)].tolist():
        hint = "Choose another ego, or measure ranges and both angles to neighbours that have fixes."
        raise InputError("egos", repr(track.ids[ego]), "has no fix, and no neighbour shows where it is", hint)
    gaps = f"absent, or not placed yet, at {track.absent.sum()} of {track.absent.size} steps: no estimate there"
    return replace(track, notes=tuple(dict.fromkeys((*track.notes, gaps))))


def _from(method: Any, start: int) -> Any:
    """The method at a later start, where a first position is not known."""
    return replace(method, x0=None) if start > 0 and getattr(method, "x0", None) is not None else method


def _joined(recording: Recording, columns: list[int], parts: dict[tuple[int, tuple[int, int]], Track]) -> Track:
    """Tracks of one ego each, in stretches of the recording, as one of all."""
    (runs, steps), links = recording.gnss.shape[:2], recording.links
    own_links = [links.of(column) for column in columns]
    ends = np.cumsum([0, *map(len, own_links)])
    absent, notes, whole = np.ones((steps, len(columns)), bool), dict[str, None](), dict[str, Any]()
    received, sent = np.zeros((2, runs, len(columns)))
    for (column, (start, stop)), track in parts.items():
        e = columns.index(column)
        absent[start:stop, e] = False if track.absent is None else track.absent[:, 0]
        received[:, e] += track.received_bytes[:, 0]
        sent[:, e] += track.sent_bytes[:, 0]
        here = ends[e] + np.flatnonzero((links.step[own_links[e]] >= start) & (links.step[own_links[e]] < stop))
        for name, values in (*((name, getattr(track, name)) for name in ESTIMATES), *track.extras.items()):
            if values is None:
                continue
            by_link = name == "neighbours" or values.ndim == 2
            if name not in whole:
                size = (runs, ends[-1]) if by_link else (runs, steps, len(columns))
                whole[name] = np.full((*size, *values.shape[len(size) :]), np.nan)
            if by_link:
                whole[name][:, here] = values
            else:
                whole[name][:, start:stop, e] = values[:, :, 0]
        notes |= dict.fromkeys(track.notes)
    made = {name: whole.pop(name, None) for name in ESTIMATES}
    return Track(
        recording.t,
        tuple(columns),
        received_bytes=received,
        sent_bytes=sent,
        seconds=sum(track.seconds for track in parts.values()),
        notes=tuple(notes),
        extras=whole,
        ids=recording.ids,
        absent=absent,
        **made,
    )
