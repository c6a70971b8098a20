"""A log against a filter of each vehicle alone: innovations of fixes, residuals of relative measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
import scipy  # its statistics take half a second, and are imported where they are used
from numpy import inf, nan

from coopoc import InputError, Kalman, PoseFilter, Recording, Track, pose_start
from coopoc.arrays import AnyArray, Bools, Floats, Ints
from coopoc.evaluate.metrics import dimensions, fix_innovations, normalised_innovations
from coopoc.kernels.constant_velocity import ACCELERATION
from coopoc.world.body_frames import between_origins, in_world
from coopoc.world.links import spherical, stretches, wrap

from .read import Log

TRUE_POSE_STD = (0.05, 0.05, 0.01, 0.05)
"""m and rad, of first poses that the truth gives."""
Row = Mapping[str, Any]
"""Column of a table of results -> what stands there."""
GATE_STDS = 5.0
"""Standard deviations of an innovation beyond which pose filters of real measurements leave one out."""
WILD_STDS, LEAST_NIS = 5.0, 0.04
"""Multiples of the usual innovation of a vehicle's fixes beyond which one is left out; least square of that."""


@dataclass(frozen=True, eq=False)
class Check:
    """What the measurements of a log say about each other.

    Args:
        log: the part that was filtered.
        span: where that is, in words.
        world: its recording, in body frames turned into the world by the filter's headings.
        track: of the filters.
        x: (T, N, 3) m, filter of each vehicle without relative measurements of others, NaN where it is absent.
        variance: (T, N, 3) m^2.
        fix: (T, N, 3) m, innovations of the fixes.
        normalised: (T, N), 1 on average if the assumed noise is right.
        relative: (L, 3) m, rad, rad: measured less computed from the filters.
        expected: (L, 3) standard deviations that these should have.
        lasting: (2, N, 2) scale error of speeds and bias of yaw rates rad/s as the filters end, and their deviations.
        ahead: (N,) s, of clocks, 0 where none is sure.
        unsure: (N,) s, standard errors of these.
        ranges: share by which they are too long, s by which they are late, 0 where not sure; each with its standard
            error.
        wild: (N,) fixes that were left out: beyond WILD_STDS times the vehicle's usual innovation.
        places: members that stand elsewhere -> by how much, m east + i north, and its standard error.
        failing: vehicles whose odometry fixes correct -> when, in words.
        vehicles: table, a row per vehicle.
        measurements: table, a row per kind of relative measurement.
        warnings: sentences.
        unseen: what could not be seen.
    """

    log: Log
    span: str
    world: Recording
    track: Track
    x: Floats
    variance: Floats
    fix: Floats
    normalised: Floats
    relative: Floats
    expected: Floats
    lasting: Floats
    ahead: Floats
    unsure: Floats
    wild: Ints
    ranges: tuple[tuple[float, float], ...] = ()
    places: Mapping[str, tuple[complex, float]] = field(default_factory=dict)
    failing: Mapping[str, str] = field(default_factory=dict)
    vehicles: Sequence[Row] = ()
    measurements: Sequence[Row] = ()
    warnings: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()

    def shown(self, column: int) -> bool:
        """Whether a velocity is of the fixes, whenever they are."""
        return column in self.world.shown

    @property
    def in_body(self) -> bool:
        """Whether the log is in body frames."""
        return self.log.recording.body is not None

    @property
    def still(self) -> Bools:
        """(N,) who never moves."""
        return np.asarray((np.nan_to_num(self.world.velocity[0]) == 0.0).all(axis=(0, 2)))

    @property
    def fix_noise(self) -> float:
        """m, of a fix in the plane."""
        return float(np.hypot(*self.world.sensors.fix_std[:2]))


def together(log: Log) -> tuple[Log, str]:
    """The longest part of a log in which all its vehicles are there, and where that is in words.

    Raises:
        InputError: the vehicles share no two steps.
    """
    rec = log.recording
    there = np.asarray(rec.present[:, rec.vehicles].all(1))
    first, last = max(stretches(there), key=lambda edge: edge[1] - edge[0], default=(0, 0))
    if last - first < 2 or not rec.vehicles:
        raise InputError(
            "log",
            log.summary.name,
            "must hold steps at which all vehicles are there",
            "Raise max_gap, give clock= where stamps differ, or leave out files of vehicles that are hardly there.",
        )
    t = rec.t - rec.t[0]
    span = "throughout" if there.all() else f"from {t[first]:.1f} to {t[last - 1]:.1f} s, where all are there"
    return replace(log, recording=rec.between(first, last), truth=log.truth and log.truth.between(first, last)), span


def begin_of(log: Log) -> tuple[Floats | None, tuple[float, ...] | None, str]:
    """First poses: those of fixes and compasses (None), those found in the first seconds, or the truth's; their
    standard deviations, None as the filter states them; and which, where it is the last.

    Args:
        log: in body frames, all vehicles there at its first step.

    Raises:
        InputError: a vehicle that has neither a fix nor sees a landmark in the first seconds, nor a true pose.
    """
    rec, truth, moving = log.recording, log.truth, log.recording.vehicles
    if np.isfinite(np.column_stack([rec.gnss[0, 0], rec.body.heading[0, 0]])[moving]).all():  # type: ignore[union-attr]
        return None, None, ""
    try:
        return pose_start(rec, gate=GATE_STDS), None, ""
    except InputError:
        if truth is None or truth.heading is None:
            raise
        poses = np.column_stack([truth.position[0], truth.heading[0]])
        if not np.isfinite(poses[moving]).all():
            raise
        return poses, TRUE_POSE_STD, ", from the truth's first poses"


def wandered(recording: Recording, column: int) -> Floats:
    """(T,) m^2, by which its motions are uncertain until each step, as velocities are that fixes have shown."""
    least = (recording.dt * recording.sensors.velocity_floor) ** 2
    return np.cumsum(recording.motion_extra[:, column, 0] + least)


def without_wild(c: Check) -> Check:
    """The same, less the fixes that are wild, of vehicles whose odometry does not fail."""
    size, rec = dimensions(c.world), c.log.recording
    square = pd.DataFrame(size * c.normalised)
    square[[*map(rec.ids.index, c.failing)]] = nan
    wild = np.array(square > WILD_STDS**2 * (square.median() / scipy.stats.chi2.median(size)).clip(LEAST_NIS))
    for column in range(wild.shape[1]):  # where the next fix is off alike, the filter is
        at = np.flatnonzero(np.isfinite(c.fix[:, column, 0]))
        gap, off = plane(c.fix[at, column]), wild[at, column]
        wild[at[:-1], column] &= ~(off[1:] & ((gap[:-1] * gap[1:].conj()).real > 0))
        unsure = np.diff(wandered(rec, column)[at]) + c.shown(column) * (ACCELERATION * np.diff(rec.t[at]) ** 2) ** 2
        wild[at[:-1], column] &= unsure < 0.5 * abs(gap[:-1]) ** 2
    if not wild.any():
        return c
    less = replace(rec, gnss=np.where(wild[..., None], nan, rec.gnss))
    return replace(filtered(replace(c.log, recording=less)), wild=wild.sum(0), failing=c.failing)


def filtered(log: Log) -> Check:
    """The log with a Kalman filter of each vehicle alone, in body frames a pose filter; and the residuals of relative
    measurements against these filters, with the deviations that they should have."""
    span, start = "", ""
    if log.recording.body is not None:
        log, span = together(log)
    rec = log.recording.of_runs(slice(0, 1))
    steps, vehicles, links = len(rec.t), len(rec.ids), rec.links
    x, variance, fix = (np.full((steps, vehicles, 3), nan) for _ in range(3))
    normalised, heading, heading_variance = np.full((steps, vehicles), nan), *np.zeros((2, steps, vehicles))
    marks, lasting = list(rec.landmarks), np.full((2, vehicles, 2), inf)
    x[:, marks], variance[:, marks] = rec.gnss[0][:, marks], 0.0
    if rec.body is None:
        followed = [column for column in range(vehicles) if rec.stretches(column)]
        if not followed:
            raise InputError(
                "log",
                log.summary.name,
                "must hold a vehicle that is there at two steps in a row from a fix on",
                "Log fixes and odometry of the same time.",
            )
        track = Kalman(robust=False)(rec, followed)
    else:
        begin, spread, start = begin_of(log)
        track = PoseFilter("solo", gate=GATE_STDS, begin=begin, spread=spread)(rec, rec.vehicles)
    squares: Any = normalised_innovations(track, rec)
    columns, covariance = list(track.egos), track.covariance[0]  # type: ignore[index]
    x[:, columns], variance[:, columns] = track.x[0], np.diagonal(covariance, axis1=-2, axis2=-1)
    fix[:, columns], normalised[:, columns] = fix_innovations(track, rec)[0], squares[0]
    for k, name in enumerate(("speed_scale", "yaw_rate_bias") if track.extras else ()):
        lasting[:, columns, k] = track.extras[name][0, -1], track.extras[f"{name}_std"][0, -1]
    if track.heading is not None and track.heading_covariance is not None:
        heading[:, columns], heading_variance[:, columns] = track.heading[0], track.heading_covariance[0, ..., 3]
    world, noise = rec, rec.sensors
    if rec.body is not None:
        world = in_world(replace(rec, body=replace(rec.body, heading=heading[None])))
        world = between_origins(world, x[None], heading[None])
    gap, residual = residual_of(world, x, log.summary.reversed_pairs)
    both = (variance[links.step, links.neighbour] + variance[links.step, links.observer])[:, :2].mean(1)
    flat, distance = distances(gap)
    expected = np.column_stack([both, both / flat**2, both / distance**2])
    expected[:, 1] += heading_variance[links.step, links.observer]
    expected += np.square([noise.range_std, noise.world_azimuth_std, noise.inclination_std])
    log = replace(log, recording=rec)
    stats = x, variance, fix, normalised, residual, np.sqrt(expected), lasting, np.zeros(vehicles)
    return Check(log, span + start, world, track, *stats, np.full(vehicles, inf), np.zeros(vehicles, int))


def without(c: Check, columns: Sequence[int]) -> Check:
    """The same without relative measurements of these vehicles."""
    links = c.world.links
    ends = np.isin(links.observer, columns) | np.isin(links.neighbour, columns)
    return replace(c, relative=np.where(ends[:, None], nan, c.relative))


def plane(vectors: Floats) -> AnyArray:
    """East and north of vectors (..., 3) as x + iy."""
    return vectors[..., :2] @ [1, 1j]


def in_space(plane: AnyArray) -> Floats:
    """Vectors (..., 3) of x + iy, with the height 0, NaN where there is none."""
    return np.stack([plane.real, plane.imag, 0.0 * plane.real], -1)


def distances(gap: Floats) -> list[Floats]:
    """Of vectors (L, 3) m: in the plane and in space, (L,) m, 1 at least."""
    return [np.maximum(np.linalg.norm(gap[:, :axes], axis=1), 1.0) for axes in (2, 3)]


def residual_of(world: Recording, x: Floats, reversed_pairs: Sequence[int] = ()) -> tuple[Floats, Floats]:
    """(L, 3) m, from observers to neighbours at positions x (T, N, 3), and measured less computed from these, NaN of
    pairs that are `reversed_pairs` (`Summary`): they are of another's clock."""
    links = world.links
    gap = x[links.step, links.neighbour] - x[links.step, links.observer]
    residual = world.relative[0] - np.column_stack(spherical(*gap.T))
    residual[:, 1:] = wrap(residual[:, 1:])
    residual[np.isin(links.observer * len(world.ids) + links.neighbour, reversed_pairs)] = nan
    return gap, residual
