"""CL-Bench's convoys: errors of one real drive, cut into pieces, of vehicles that drive together; ranges are drawn."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from coopoc import V2X, Fleet, Method, Recording, observe
from coopoc.arrays import AnyArray, Floats, last_true
from coopoc.study.study import Row
from coopoc.world.recording import NOTHING_SIMULATED

from .pose_drives import BLOCK_SECONDS, MIN_BLOCKS, hashed
from .roads import ROADS, thinned
from .tasks import blocks_of, costs, located, planar, rounded

CONVOYS = {f"convoy-{road}": road for road in ROADS}
"""Task -> road whose drive is cut."""
PIECES, SHORTEST_PIECE, START_SPREAD, RUNS, SEED = 4, 25.0, 25.0, 4, 2026
"""Vehicles at most; s of a piece at least; m within which they start; draws of ranges and angles, and their seed."""
MIN_COURSE_SPEED = 1.0
"""m/s, below which a course is noise: the odometry errs as it did before."""


@lru_cache(maxsize=4)
def convoy(task: str, data: Path | None, neighbours: int = 6) -> tuple[Recording, Fleet]:
    """Measurements and truth of vehicles on the route of the first piece, side by side, as far apart as they start.

    A vehicle's fixes err by as many metres east and north as those of its piece, its odometry by the same factor and
    turn of the motion, $u' = (u_{measured} / u_{true}) u_{route}$ in complex numbers. All runs have the same fixes and
    odometry; ranges and angles are drawn.

    Args:
        task: one of CONVOYS.
        data: folder of the data, None for those that were fetched.
        neighbours: that a vehicle measures at most.

    Raises:
        InputError: a file that is missing.
    """
    recording, truth = thinned(CONVOYS[task], data)
    column, dt = recording.observers[0], recording.dt
    starts, length = _pieces(recording, column)
    there = np.isfinite(truth.position[:, column, 0])
    now = np.arange(len(there))
    path = np.interp(now, now[there], truth.position[there, column] @ [1, 1j, 0])
    motion = np.diff(path, prepend=path[0])
    measured = recording.velocity[0, :, column] @ np.array([1, 1j, 0]) * dt
    fast = (np.abs(motion) > MIN_COURSE_SPEED * dt) & np.isfinite(measured)
    last = np.maximum(last_true(fast), np.argmax(fast))  # where the vehicle is slow, the ratio is as before
    times = (np.where(fast, measured, 1.0) / np.where(fast, motion, 1.0))[last]
    ratio = np.clip(np.abs(times), 0.5, 2.0) * np.exp(1j * np.clip(np.angle(times), -0.5, 0.5))
    error = recording.gnss[0, :, column] @ np.array([1, 1j, 0]) - path
    route, rows = slice(starts[0], starts[0] + length), np.array(starts) + np.arange(length)[:, None]
    offset = START_SPREAD * np.random.default_rng(SEED).uniform(-1, 1, (len(starts), 2)) @ [1, 1j] / np.sqrt(2)
    true = (path[route] - path[starts[0]])[:, None] + offset
    driven = np.repeat(motion[route, None], len(starts), axis=1)
    ids, t = tuple(f"v{k}" for k in range(len(starts))), recording.t[:length] - recording.t[0]
    fleet = Fleet(ids, t, _plane(true), _plane(driven) / dt, name=task)
    v2x = V2X(max_neighbours=neighbours, radius=150.0)
    drawn = observe(fleet, recording.sensors, v2x, runs=RUNS, seed=SEED)
    gnss, velocity = (
        np.tile(each, (RUNS, 1, 1, 1)) for each in (_plane(true + error[rows]), _plane(ratio[rows] * driven) / dt)
    )
    return replace(
        drawn, gnss=gnss, velocity=velocity, notes=(f"errors of fixes and odometry: {NOTHING_SIMULATED}",)
    ), fleet


def _pieces(recording: Recording, column: int) -> tuple[list[int], int]:
    """First steps of pieces, each with a fix, and their length in steps: PIECES of SHORTEST_PIECE s, or fewer."""
    fixes = np.flatnonzero(np.isfinite(recording.gnss[0, :, column, 0]))
    count = int(np.clip((len(recording.t) - fixes[0]) * recording.dt / SHORTEST_PIECE, 1, PIECES))
    wanted = np.linspace(fixes[0], len(recording.t), count + 1)[:-1]
    starts = [int(fixes[np.searchsorted(fixes, np.ceil(first))]) for first in wanted]
    ends = [*starts[1:], len(recording.t)]
    return starts, min(end - start for start, end in zip(starts, ends, strict=True))


def _plane(values: AnyArray) -> Floats:
    """(..., 3) of complex numbers east + i north, NaN in the height, too, where there is none."""
    return np.stack([values.real, values.imag, 0.0 * values.real], axis=-1)


def convoy_row(task: str, data: Path | None, method: Method) -> Row:
    """RT-LE m in the plane with its interval over vehicles and blocks of time, NEES of (x, y), bytes and us of a step.

    Args:
        task: that is run.
        data: folder of the data, None for those that were fetched.
        method: any of positions, alone or cooperative.
    """
    recording, fleet = convoy(task, data)
    egos = list(range(len(recording.ids)))
    method(recording.between(0, 3), egos)  # compiles
    track = method(recording, egos)
    gap, nees = planar(track, fleet)
    size = min(BLOCK_SECONDS, len(recording.t) * recording.dt / MIN_BLOCKS) / recording.dt
    blocks = blocks_of(np.sqrt(np.square(gap).sum(axis=-1).mean(axis=0)), 0, size)
    row: Row = {"task": task, "data": hashed(*(located(data, name) for name in ROADS[CONVOYS[task]]))}
    row |= {"rt_le_m": rounded(blocks.T), "blocks_m": blocks.ravel().round(4).tolist()}
    if track.covariance is not None:
        row["nees"] = round(np.nanmean(nees), 2)
    return row | costs(track, recording, method)
