"""The recursion of the posterior Cramer-Rao bound over the steps of a drive, with members that come and go."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from ..arrays import Floats, Ints
from ..methods.drift_state import Drift
from ..world.fleet import Fleet
from ..world.links import Links
from ..world.sensors import Sensors
from ..world.spherical import spherical, vector_cov


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of n members with d numbers each, at the truth.

    Attributes:
        members: (n,) columns.
        previous: (n,) their places one step before, -1 for a new member.
        motion: (n, d, d) derivatives F of a member's state by the one before.
        process: (n, d, d) covariance Q of the motion.
        prior: (d,) information of what is known of a new member's numbers.
        gained: (dn, dn) information of the step's measurements.
    """

    members: Ints
    previous: Ints
    motion: Floats
    process: Floats
    prior: Floats
    gained: Floats


def stages_of(fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints], *, fixes: bool = True) -> list[Stage]:
    """Every step of the positions of vehicles (columns) that are members of it, with fixes or without."""
    stages: list[Stage] = []
    alone = np.diag(1.0 / np.square(sensors.gnss_std)) * fixes
    for now, previous, edges in steps_of(fleet, links, members):
        t, n = len(stages), len(now)
        process = (fleet.dt * sensors.velocity_std(fleet.velocity[t, now]))[:, :, None] ** 2 * np.eye(3)
        gained = edge_information(edges, (n, 3), sensors.relative_std) + diagonal(np.tile(alone, (n, 1, 1)))
        stages.append(Stage(now, previous, np.tile(np.eye(3), (n, 1, 1)), process, np.zeros(3), gained))
    return stages


Edges = tuple[Floats, Ints, Ints]
"""Vectors (E, 3) m of relative measurements, places of observers and neighbours among the members, -1 if it is none."""


def steps_of(fleet: Fleet, links: Links, members: list[Ints]) -> Iterator[tuple[Ints, Ints, Edges]]:
    """Members of each step, their places one step before (-1 for new ones), and its true vectors."""
    start, before = np.searchsorted(links.step, np.arange(len(fleet.t) + 1)), np.full(len(fleet.ids), -1)
    for t, now in enumerate(members):
        place = np.full(len(fleet.ids), -1)
        place[now] = np.arange(len(now))
        observer, neighbour = (side[start[t] : start[t + 1]] for side in (links.observer, links.neighbour))
        vector = fleet.position[t, neighbour] - fleet.position[t, observer]
        yield now, before[now], (vector, place[observer], place[neighbour])
        before = place


def edge_information(edges: Edges, sizes: tuple[int, int], std: Floats) -> Floats:
    """Information (dn, dn) of relative measurements about n members of d numbers, the fourth, if any, the heading.

    A measured vector v moves by dp_j - dp_i, and with the observer's heading by -dth (-v_y, v_x, 0).

    Args:
        edges: of the step.
        sizes: n and d.
        std: (3,) m, rad, rad.
    """
    (vector, observer, neighbour), (n, d) = edges, sizes
    own, other = np.zeros((2, len(vector), 3, d))
    own[..., :3] = -np.eye(3)
    if d > 3:
        own[:, 0, 3], own[:, 1, 3] = vector[:, 1], -vector[:, 0]
    other[..., :3] = np.eye(3) * (neighbour >= 0)[:, None, None]
    weight = np.linalg.inv(vector_cov(np.stack(spherical(*vector.T), axis=-1), std))
    found, ends = np.zeros((n, n, d, d)), ((observer, own), (np.maximum(neighbour, 0), other))
    for here, rows in ends:
        for there, columns in ends:
            np.add.at(found, (here, there), rows.swapaxes(1, 2) @ weight @ columns)
    return found.swapaxes(1, 2).reshape(n * d, n * d)


def covariances(stages: list[Stage], smoothing: bool) -> Iterator[tuple[int, Floats]]:
    """Steps and the bound (dn, dn) of their members: forward, or for smoothing from the last step to the first.

    Smoothing is the two-filter form: information from the past with the present, plus that of the future.
    """
    filtered: list[Floats] = []
    cov: Floats = np.zeros((0, 0))
    with tqdm(total=len(stages) * (1 + smoothing), desc="bound", unit="step", delay=2.0) as bar:
        for t, stage in enumerate(stages):
            information = _onward(cov, stage) + stage.gained
            cov = np.linalg.inv(information)
            bar.update()
            if smoothing:
                filtered.append(information)
            else:
                yield t, cov
        future: Floats = np.zeros_like(cov)
        for t in range(len(filtered) - 1, -1, -1):
            yield t, np.linalg.inv(filtered.pop() + future)
            future = _backward(future, stages[t], len(stages[t - 1].members)) if t else future
            bar.update()


def drifting_covariances(stages: list[Stage], sensors: Sensors, dt: float) -> Iterator[tuple[int, Floats]]:
    """Filtering bound (3n, 3n) where fixes have time-correlated errors, which the state then holds (`Drift`).

    Args:
        stages: without the fixes, which do not see positions alone.
    """
    drift = Drift.of(sensors, dt)
    cov: Floats = np.zeros((0, 0))
    for t, stage in enumerate(tqdm(stages, desc="bound", unit="step", delay=2.0)):
        n, process = len(stage.members), np.diagonal(stage.process, axis1=1, axis2=2)
        fix_matrix, weight = drift.fix_matrix(n), np.tile(1.0 / np.square(sensors.gnss_std), n)
        information = np.linalg.inv(drift.carry(cov, stage.previous, process)) + (fix_matrix.T * weight) @ fix_matrix
        information[: 3 * n, : 3 * n] += stage.gained
        cov = np.linalg.inv(information)
        yield t, cov[: 3 * n, : 3 * n]


def _onward(cov: Floats, stage: Stage) -> Floats:
    """Information about the members of a step from the covariance one step before, (F P F^T + Q)^-1."""
    n, d = stage.motion.shape[:2]
    stays, out = np.flatnonzero(stage.previous >= 0), np.diag(np.tile(stage.prior, n))
    if len(stays):
        here, there = _numbers(stays, d), _numbers(stage.previous[stays], d)
        motion = diagonal(stage.motion[stays])
        moved = motion @ cov[np.ix_(there, there)] @ motion.T + diagonal(stage.process[stays])
        out[np.ix_(here, here)] = np.linalg.inv(moved)
    return out


def _backward(future: Floats, stage: Stage, n: int) -> Floats:
    """Information of a step and its future about the n members one step before, whose motion is the inverse one."""
    d, back = len(stage.prior), np.linalg.inv(stage.motion)
    stays, previous = np.flatnonzero(stage.previous >= 0), np.full(n, -1)
    previous[stage.previous[stays]] = stays
    motion, process = np.zeros((2, n, d, d))
    motion[stage.previous[stays]] = back[stays]
    process[stage.previous[stays]] = (back @ stage.process @ back.swapaxes(1, 2))[stays]
    reverse = replace(stage, previous=previous, motion=motion, process=process, prior=np.zeros(d))
    return _onward(np.linalg.inv(future + stage.gained), reverse)


def diagonal(blocks: Floats) -> Floats:
    """The matrix (nd, nd) that has n blocks (n, d, d) on its diagonal."""
    n, d = blocks.shape[:2]
    found = np.zeros((n, d, n, d))
    found[np.arange(n), :, np.arange(n)] = blocks
    return found.reshape(n * d, n * d)


def _numbers(places: Ints, d: int) -> Ints:
    """Places of all numbers of members."""
    return np.asarray(d * places[:, None] + np.arange(d)).ravel()
