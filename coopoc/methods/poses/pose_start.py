"""First poses of vehicles that do not know theirs: several headings are tried, and the most likely one is kept."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import nan, pi
from numpy.linalg import matrix_rank, norm, pinv

from ...arrays import Floats, Ints
from ...errors import InputError
from ...world.body_frames import turned
from ...world.links import to_vector, wrap
from ...world.recording import Recording
from ...world.sensors import Sensors
from .pose_inputs import body_of, to_landmarks

HEADINGS, SEEN_PLACES = 24, 3
"""Headings that are tried, around the circle and then around the best of them; most places that each is tried with."""
HEADING_STEP = 2 * pi / HEADINGS  # rad


def likely_poses(recording: Recording, filter_: Any, members: Sequence[int]) -> Floats:
    """Poses (R, N, 4) of some vehicles at the first step, as `pose_start` says, by a solo PoseFilter."""
    begin = np.full((recording.runs, len(recording.ids), 4), nan)
    for run in range(recording.runs):
        one = recording.of_runs(slice(run, run + 1))
        positions = np.full((len(recording.t), len(recording.ids), 3), nan)
        positions[:, list(recording.landmarks)] = one.gnss[0][:, list(recording.landmarks)]
        waiting = list(members)
        while waiting:
            column, links = _next(one, waiting, positions)
            begin[run, column], positions[:, column] = _most_likely(one, column, links, positions, filter_)
            waiting.remove(column)
    return begin


def _next(recording: Recording, waiting: list[int], places: Floats) -> tuple[int, Ints]:
    """The vehicle whose pose is found next, and its links that count: those to landmarks of one that has a fix or sees
    two of them; else, of the one with most, those to all whose `places` (T, N, 3) m are
    finite."""
    every = []
    for column in waiting:
        links = recording.links.of(column)
        marks = to_landmarks(recording, links)
        whole = np.unique(recording.links.neighbour[marks[np.isfinite(recording.relative[0, marks, :2]).all(1)]])
        if len(whole) > 1 or np.isfinite(recording.gnss[0, :, column, 0]).any():
            return column, marks
        every.append(links[np.isfinite(places[recording.links.step[links], recording.links.neighbour[links], 0])])
    most = int(np.argmax([np.isfinite(recording.relative[0, links, :2]).all(1).sum() for links in every]))
    return waiting[most], every[most]


def _most_likely(recording: Recording, column: int, links: Ints, places: Floats, filter_: Any) -> tuple[Floats, Floats]:
    """First pose (4,) of a vehicle, and its positions (T, 3) m from there on, by the solo filter of most likelihood: of
    headings around the circle, then around the best of them."""
    landmarks = places[recording.links.step[links], recording.links.neighbour[links]]
    noise, angles = recording.sensors, HEADING_STEP * np.arange(HEADINGS)
    if len(to_landmarks(recording, links)) < len(links):
        apart, ranges = norm(landmarks - landmarks.mean(0), axis=1), recording.relative[0, links, 0]
        filter_ = replace(filter_, assumed=_of_vehicles(noise, np.where(np.isnan(ranges), apart, ranges)))

    def filtered(poses: Floats, turn: float) -> tuple[Floats, Floats, Floats]:
        """States (H, T, d), their covariances, and costs (H,), from poses (H, 4) whose headings err by that."""
        tried = np.full((len(poses), len(recording.ids), 4), nan)
        tried[:, column] = poses
        spread = [2 * max(std, noise.range_std) for std in noise.fix_std]  # of one fix or one landmark, m
        own = replace(filter_, spread=(*spread, turn))
        copies = recording.of_runs(np.zeros(len(poses), int))
        x, cov, cost = own._run_filter(copies, [column], links, tried, landmark=landmarks)
        return x[:, :, 0], cov[:, :, 0], cost[:, 0] + _cost_of_bearings(recording, column, poses[:, 3], noise)

    for turn in (HEADING_STEP / 2, 2 * HEADING_STEP / HEADINGS):
        poses = _hypotheses(recording, column, links, landmarks, angles)
        best = poses[[np.argmin(filtered(poses, turn)[2])]]
        angles = best[0, 3] + HEADING_STEP * np.linspace(-1.0, 1.0, HEADINGS)
    (x,), (cov,), _ = filtered(best, HEADING_STEP / 2)
    return _back(recording, column, x, cov), x[:, :3]


def _back(recording: Recording, column: int, x: Floats, cov: Floats) -> Floats:
    """Pose (4,) at the first step: its heading, and then its place, from the state of x (T, d), of covariance
    (T, d, d), from which odometry, less the errors that the filter has found of it, leads back most surely."""
    count = int(np.argmin(np.isfinite(x[:, 0]))) or len(x)  # before it is absent
    scale, bias = x[count - 1, 4:6] if x.shape[1] > 4 else (0.0, 0.0)
    turns, way = _reckoned(recording, column, scale, bias)
    noise, since = recording.sensors, recording.dt * recording.dt * np.arange(count)
    white = noise.yaw_rate_std**2 * since
    sure = cov[:count, 3, 3] + white
    best = int(np.argmin(sure))
    heading = wrap(x[best, 3] - turns[best])
    drift = np.square(noise.velocity_std(recording.velocity[0, :count, column, :2], noise.velocity_floor)).sum(-1)
    off = np.trace(cov[:count, :2, :2], axis1=1, axis2=2) + recording.dt**2 * np.cumsum(drift)
    off += np.square(way[:count]).sum(1) * (sure[best] + white / 3.0)
    near = int(np.argmin(off))
    return np.append(x[near, :3] - turned(way[near], heading), heading)


def _reckoned(recording: Recording, column: int, scale: float = 0.0, bias: float = 0.0) -> tuple[Floats, Floats]:
    """How far a vehicle has turned (T,) rad and moved (T, 3) m in its first body frame, by its odometry less a scale
    error and a bias of yaw rates, rad/s."""
    dt, rate = recording.dt, body_of(recording).yaw_rate[0, :, column] - bias
    rate[0] = 0.0
    turns = np.cumsum(dt * rate)
    moved = turned(dt / (1.0 + scale) * recording.velocity[0, :, column], turns - 0.5 * dt * rate)
    moved[0] = 0.0
    return turns, np.cumsum(moved, 0)


def _of_vehicles(noise: Sensors, ranges: Floats) -> Sensors:
    """Noise of measurements of vehicles whose places are as uncertain as a fix, at these ranges (L,) m."""
    fix = max(noise.fix_std[:2])
    return replace(
        noise,
        range_std=float(np.hypot(noise.range_std, fix)),
        azimuth_std=float(np.hypot(noise.azimuth_std, fix / max(float(np.median(ranges)), fix))),
    )


def _cost_of_bearings(recording: Recording, column: int, angles: Floats, noise: Sensors) -> Floats:
    """(hypotheses,) sum of r^2 / s of bearings against the azimuths between both fixes of their step, per heading: what
    shows that of a vehicle that stands."""
    links = recording.links.of(column)
    links = links[~np.isin(recording.links.neighbour[links], recording.landmarks)]
    step, other = recording.links.step[links], recording.links.neighbour[links]
    gap = recording.gnss[0, step, other] - recording.gnss[0, step, column]
    azimuth = np.arctan2(gap[:, 1], gap[:, 0]) - _reckoned(recording, column)[0][step]
    residual = wrap(recording.relative[0, links, 1] + angles[:, None] - azimuth)
    fixes = 2.0 * max(noise.fix_std[:2]) ** 2 / np.maximum(np.square(gap[:, :2]).sum(1), 1.0)
    cost: Floats = np.nansum(residual**2 / (noise.azimuth_std**2 + fixes), axis=1)
    return cost


LINE_WIDTH, RANGE_SECONDS = 0.1, 5.0
"""m: ranges to places this near to one line do not show on which side of it the vehicle is; s for which ranges count
after the first one to the last place."""


def _hypotheses(recording: Recording, column: int, links: Ints, places: Floats, angles: Floats) -> Floats:
    """(hypotheses, 4) poses at the first step that agree with the first fix, or else with the first measurements of
    SEEN_PLACES places, one for each heading, with `places` (L, 3) m of what the links measure."""
    body, relative = body_of(recording), recording.relative[0, links]
    fixes = np.flatnonzero(np.isfinite(recording.gnss[0, :, column, 0]))
    complete = np.flatnonzero(np.isfinite(relative[:, :2]).all(1))
    turns, way = _reckoned(recording, column)
    compass = body.heading[0, 0, column]
    angles = angles if np.isnan(compass) else np.full(len(angles), compass)
    if not len(fixes) and not len(complete):
        return _of_ranges(recording, column, links, places, angles, way + turned(recording.tags[column], turns))
    if (
        not len(fixes)
        and np.isnan(body.heading[0, :, column]).all()
        and (places[complete] == places[complete[0]]).all()
    ):
        actual = f"{recording.ids[column]} sees one landmark alone, and has neither fix nor compass"
        raise InputError(
            "seconds", actual, "must include a second landmark or a fix", "Take more seconds, or give its pose."
        )
    if len(fixes):
        step = fixes[:1]
        at, offset = recording.gnss[0, step, column], way[step]
    else:
        first = complete[np.sort(np.unique(places[complete], axis=0, return_index=True)[1])[:SEEN_PLACES]]
        step, at = recording.links.step[links[first]], places[first]
        polar = np.where(np.isfinite(relative[first]), relative[first], pi / 2)
        offset = way[step] + turned(to_vector(polar), turns[step])
    position = at - turned(np.broadcast_to(offset, (len(angles), *offset.shape)), angles[:, None])
    return np.column_stack([position.reshape(-1, 3), np.repeat(angles, len(step))])


def _of_ranges(recording: Recording, column: int, links: Ints, places: Floats, angles: Floats, way: Floats) -> Floats:
    """(hypotheses, 4) poses that ranges alone, whose squares differ linearly, leave for each heading, by the way
    (T, 3) m of the tag by odometry."""
    rows = np.flatnonzero(np.isfinite(recording.relative[0, links, 0]))
    at, first = np.unique(places[rows], axis=0, return_index=True)
    if not len(at) or matrix_rank(at[:, :2] - at[:, :2].mean(0), LINE_WIDTH) < 2:
        actual = f"{recording.ids[column]} has no fix and sees too little in {recording.t[-1] - recording.t[0]:g} s"
        allowed = "a fix, or a range and bearing or three ranges, of landmarks or vehicles whose poses are found"
        raise InputError("seconds", actual, f"must hold {allowed}", "Take more seconds, or give its pose.")
    steps = recording.links.step[links[rows]]
    early = steps <= steps[first.max()] + RANGE_SECONDS / recording.dt
    rows, steps = rows[early], steps[early]
    centres = places[rows] - turned(np.broadcast_to(way[steps], (len(angles), len(steps), 3)), angles[:, None])
    right = np.square(centres[..., :2]).sum(-1) - recording.relative[0, links[rows], 0] ** 2
    matrix = np.concatenate([2.0 * centres[..., :2], np.ones((*right.shape, 1))], axis=-1)
    return np.column_stack([(pinv(matrix) @ right[..., None])[:, :2, 0], centres[..., 2].mean(1), angles])
