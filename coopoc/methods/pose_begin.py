"""Where pose filters begin, and which egos they follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import Floats, Ints, checked, listed
from ..errors import InputError
from ..world.recording import Body, Recording
from . import pose_unit


def pose_egos(recording: Recording, egos: Sequence[int | str]) -> list[int]:
    """Columns of egos that are there throughout; InputError for one that is not, and for a landmark."""
    egos = listed("egos", egos, "Give [0] for the first.")
    columns = recording.observing(egos)
    for ego, column in zip(egos, columns, strict=True):
        if column in recording.landmarks:
            raise InputError("egos", repr(ego), "is a landmark", "Its position is known.")
        if np.isnan(recording.velocity[0, :, column, 0]).any():
            raise InputError("egos", repr(ego), "is absent at some steps", "Cut it with recording.between(...).")
    return columns


def body_of(recording: Recording) -> Body:
    """Yaw rates and headings of a recording in body frames."""
    assert recording.body is not None
    return recording.body


def check_compass(recording: Recording, neighbours: Ints) -> None:
    """InputError for a neighbour that never sends a compass heading."""
    for column in neighbours:
        if np.isnan(body_of(recording).heading[:, :, column]).all():
            hint = 'Take unit="fleet", whose relative measurements give it.'
            raise InputError("heading", f"none of {recording.ids[column]}", "must be in a neighbour's messages", hint)


def first_poses(recording: Recording, begin: Floats | None, columns: Sequence[int] | None) -> Floats:
    """Poses (R, N, 4) m and rad at the first step that were given, NaN where a fix and a compass take their place.

    Args:
        recording: in body frames.
        begin: (N, 4) or (R, N, 4), or None.
        columns: of vehicles whose pose must be known by one of the two; None for all that are there.

    Raises:
        InputError: another shape, or an unknown pose.
    """
    shape = (recording.runs, len(recording.ids), 4)
    given = np.full(shape[1:], np.nan) if begin is None else checked("begin", begin)
    if given.shape not in (shape, shape[1:]):
        raise InputError("begin", f"shape {given.shape}", f"must have shape {shape[1:]} or {shape}", "One pose each.")
    found = np.ascontiguousarray(np.broadcast_to(given, shape))
    first = np.concatenate([recording.gnss[:, 0], body_of(recording).heading[:, 0, :, None]], axis=2)
    lacking = np.isnan(first) & np.isnan(found) & np.isfinite(recording.velocity[:, 0, :, :1])
    for column in np.unique(pose_unit.fleet(recording).column) if columns is None else columns:
        if lacking[:, column].any():
            what = "position" if lacking[:, column, :3].any() else "heading"
            lacks, hint = f"no {what} of {recording.ids[column]}", "Give begin=, or that of co.pose_start(recording)."
            raise InputError("begin", lacks, "must be known at the start", hint)
    return found
