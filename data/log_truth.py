"""The truth of a log, on the steps of its recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.links import wrap
from coopoc.world.recording import Recording

from .log_rows import Rows
from .log_summary import Tally
from .log_vehicle import samples
from .rows import backward_difference, interpolate

FEW = 5
"""Fixes with a truth, from which a difference of frames shows."""
APART = 3.0
"""Standard deviations of a fix by which fixes and truth in one frame do not differ on average."""


def frame_warning(recording: Recording, truth: Fleet | None, column: int) -> list[str]:
    """A sentence where the fixes of a vehicle lie beside its truth by more than their noise explains, as they do where
    the truth has another origin."""
    if truth is None:
        return []
    gap = (recording.gnss[0, :, column] - truth.position[:, column])[:, :2]
    gap = gap[np.isfinite(gap).all(axis=1)]
    if len(gap) < FEW:
        return []
    east, north = np.median(gap, axis=0)
    if np.hypot(east, north) < APART * np.hypot(*recording.sensors.fix_std[:2]):
        return []
    return [
        f"{recording.ids[column]}: fixes lie {east:.3g} m east and {north:.3g} m north of the truth in the median. "
        "Fixes in degrees are local at the first one: give origin= of the frame of the truth, or the truth in degrees."
    ]


def truth_of(rows: Rows, recording: Recording, max_gap: float | None, name: str, file: Path | None) -> Fleet:
    """Truth of the members that have one, on the steps of the recording."""
    position = np.full((len(recording.t), len(recording.ids), 3), np.nan)
    known = set(rows.vehicle.tolist())
    if not known & set(recording.ids):
        where = f"{file.name if file else 'truth'}: column vehicle"
        allowed = f"must name vehicles of the log: {', '.join(recording.ids)}"
        raise InputError(where, ", ".join(sorted(known)), allowed, "Rename them, or leave the truth out.")
    planar = not (rows.kind == "z").any()
    heading, start = np.full(position.shape[:2], np.nan), recording.t[0]
    for column, one in enumerate(recording.ids):
        true, _ = samples(rows.take(rows.vehicle == one), ("x", "y", "z"), Tally(), 2 if planar else 3)
        if len(true.t) > 1:
            value = np.nan_to_num(true.value)
            gap = max_gap or max(5 * recording.dt, 0.5, 1.5 * true.interval)
            position[:, column] = interpolate(true.t - start, value, recording.t - start, gap)
        elif len(true.t) == 1:
            position[:, column] = np.nan_to_num(true.value[0])
        headings, _ = samples(rows.take(rows.vehicle == one), ("heading",), Tally(), 1)
        if len(headings.t) > 1:
            value = np.unwrap(headings.value, axis=0)
            gap = max_gap or max(5 * recording.dt, 0.5, 1.5 * headings.interval)
            heading[:, column] = wrap(interpolate(headings.t - start, value, recording.t - start, gap)[:, 0])
    there = np.isfinite(position[..., 0])
    alone = there.copy()
    alone[1:] &= ~there[:-1]
    alone[:-1] &= ~there[1:]
    position[alone] = np.nan
    velocity = backward_difference(recording.t, position, recording.ids)
    known_heading = heading if np.isfinite(heading).any() else None
    return Fleet(
        recording.ids, recording.t, position, velocity, name=name, source=f"truth of {name}", heading=known_heading
    )
