"""Checks of a log in body frames: the whole fleet's pose filter against fixes, relative measurements and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coopoc.arrays import Floats, robust_std
from coopoc.errors import InputError
from coopoc.evaluate.metrics import errors, heading_error, pose_nees
from coopoc.methods.pose_filter import PoseFilter
from coopoc.methods.pose_start import pose_start
from coopoc.methods.track import Track
from coopoc.world.recording import Recording
from coopoc.world.spherical import wrap

from .log import Log
from .log_body_clocks import GATE, clocks
from .log_clocks import apart_warnings, truth_warning
from .log_truth import frame_warning

WRONG = 3.0
"""Times the stated standard deviation that residuals of a filter's own estimates are not expected to reach."""
INCONSISTENT = 75.0
"""NEES of a pose, 3 if consistent: errors five times as large as stated."""


@dataclass(frozen=True, eq=False)
class PoseCheck:
    """What a log in body frames looks like from the whole fleet's pose filter.

    Args:
        log: the part that was followed.
        span: where that is, in words.
        track: of all vehicles.
        vehicles: a row each.
        measurements: a row for each component of the relative measurements.
        warnings: sentences on what looks wrong.
    """

    log: Log
    span: str
    track: Track
    vehicles: list[dict[str, Any]]
    measurements: list[dict[str, Any]]
    warnings: list[str]


def check_poses(log: Log) -> PoseCheck:
    """Follow all vehicles by one filter, and compare what was measured with its estimates.

    Args:
        log: in body frames.

    Raises:
        InputError: the vehicles share no two steps, or first poses are not known.
    """
    apart = apart_warnings(log.recording)
    try:
        log, span = together(log)
    except InputError as error:
        raise InputError(error.field, error.value, error.allowed, " ".join([*apart, error.hint])) from None
    rec = log.recording
    who = [k for k in range(len(rec.ids)) if k not in rec.landmarks]
    begin, start = begin_of(log, who, GATE)
    track = PoseFilter("fleet", gate=GATE, begin=begin)(rec, who)
    world, warnings = clocks(rec, begin, who)
    vehicles = []
    for k, column in enumerate(who):
        fix = np.linalg.norm(rec.gnss[0, :, column, :2] - track.x[0, :, k, :2], axis=1)
        row: dict[str, Any] = {"vehicle": rec.ids[column], "fixes": int(np.isfinite(fix).sum())}
        row["fix_residual_m"] = float(np.sqrt(np.nanmean(fix**2))) if row["fixes"] else None
        assert track.covariance is not None
        assert track.heading_covariance is not None
        row["std_m"] = float(np.sqrt(np.trace(track.covariance[0, :, k, :2, :2], axis1=1, axis2=2)).mean())
        row["heading_std_deg"] = float(np.rad2deg(np.sqrt(track.heading_covariance[0, :, k, 3])).mean())
        row |= _errors(log, track, k)
        vehicles.append(row)
        moved = truth_warning(world, log.truth, column) or frame_warning(rec, log.truth, column)
        warnings += moved
        if not moved and row.get("nees", 0.0) > INCONSISTENT:
            larger = np.sqrt(row["nees"] / 3)
            warnings.append(f"{rec.ids[column]}: errors are {larger:.0f} times as large as the filter states.")
    measurements = []
    for name, unit, residual, std in _residuals(rec, track):
        spread = robust_std(residual)
        row = {"measurement": name, "unit": unit, "number": len(residual), "median": float(np.median(residual))}
        measurements.append(row | {"robust_std": spread, "stated_std": std})
        if max(spread, abs(row["median"])) > WRONG * std:
            warnings.append(
                f"{name}s miss the filter's estimates by {row['median']:.3g} +- {spread:.3g} {unit}, {std:.3g} stated: "
                "turned, mirrored, in other units, of another partner, or less certain than stated."
            )
    return PoseCheck(log, f"{span}{start}", track, vehicles, measurements, warnings)


def together(log: Log) -> tuple[Log, str]:
    """The longest part of a log in which all its vehicles are there, and where that is in words.

    Raises:
        InputError: the vehicles share no two steps.
    """
    rec = log.recording
    moving = [k for k in range(len(rec.ids)) if k not in rec.landmarks]
    there = np.isfinite(rec.velocity[0, :, moving, 0]).all(axis=0)
    edges = np.flatnonzero(np.diff(there.astype(int), prepend=0, append=0)).reshape(-1, 2)
    first, last = max(edges.tolist(), key=lambda edge: edge[1] - edge[0], default=(0, 0))
    if last - first < 2 or not moving:
        hint = "Raise max_gap, or leave out files of vehicles that are hardly there."
        raise InputError("log", log.summary.name, "must hold steps at which all vehicles are there", hint)
    t = rec.t - rec.t[0]
    span = "throughout" if there.all() else f"from {t[first]:.1f} to {t[last - 1]:.1f} s, where all are there"
    truth = None if log.truth is None else log.truth.between(first, last)
    return replace(log, recording=rec.between(first, last), truth=truth), span


def begin_of(log: Log, who: Sequence[int], gate: float) -> tuple[Floats | None, str]:
    """First poses: those of fixes and compasses (None), those found in the first seconds, or the truth's; and which,
    where it is the last.

    Args:
        log: in body frames, all vehicles there at its first step.
        who: columns of the vehicles.
        gate: of the filters that find them.

    Raises:
        InputError: a vehicle that has neither a fix nor sees a landmark in the first seconds, nor a true pose.
    """
    rec, truth = log.recording, log.truth
    assert rec.body is not None
    first = np.concatenate([rec.gnss[0, 0], rec.body.heading[0, 0, :, None]], axis=1)
    if np.isfinite(first[who]).all():
        return None, ""
    try:
        return pose_start(rec, gate=gate), ""
    except InputError:
        if truth is None or truth.heading is None:
            raise
        given = np.column_stack([truth.position[0], truth.heading[0]])
        if not np.isfinite(given[who]).all():
            raise
        return given, ", from the truth's first poses"


def _errors(log: Log, track: Track, k: int) -> dict[str, float]:
    """Errors of an ego of the track, as far as the truth is known."""
    if log.truth is None or not log.truth.present[:, track.egos[k]].any():
        return {}
    found = {"error_m": float(np.nanmean(errors(track, log.truth)[0, :, k]))}
    if log.truth.heading is not None and np.isfinite(log.truth.heading[:, track.egos[k]]).any():
        off = np.rad2deg(np.abs(heading_error(track, log.truth)[0, :, k]))
        found |= {"heading_error_deg": float(np.nanmean(off))}
        found |= {"nees": float(np.nanmean(pose_nees(track, log.truth)[0, :, k]))}
    return found


def _residuals(rec: Recording, track: Track) -> list[tuple[str, str, Floats, float]]:
    """Name, unit, residuals and standard deviation of ranges and bearings between those that the track knows."""
    x: Floats = np.full((len(rec.t), len(rec.ids), 3), np.nan)
    heading: Floats = np.full((len(rec.t), len(rec.ids)), np.nan)
    x[:, list(rec.landmarks)] = rec.gnss[0][:, list(rec.landmarks)]
    x[:, list(track.egos)] = track.x[0]
    assert track.heading is not None
    heading[:, list(track.egos)] = track.heading[0]
    step, observer, neighbour = rec.links.step, rec.links.observer, rec.links.neighbour
    apart = x[step, neighbour] - x[step, observer]
    distance = rec.relative[0, :, 0] - np.linalg.norm(apart, axis=1)
    bearing = rec.relative[0, :, 1] - np.arctan2(apart[:, 1], apart[:, 0]) + heading[step, observer]
    both = (
        ("range", "m", distance, rec.sensors.range_std),
        ("bearing", "rad", np.asarray(wrap(bearing)), rec.sensors.azimuth_std),
    )
    return [(name, unit, r[np.isfinite(r)], std) for name, unit, r, std in both if np.isfinite(r).any()]
