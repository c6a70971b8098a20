"""The recursion of the posterior Cramer-Rao bound over the steps of a drive, with members that come and go."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from ..arrays import Floats, Ints
from ..methods.drift_state import Drift
from ..methods.star import rows
from ..world.fleet import Fleet
from ..world.links import Links
from ..world.sensors import Sensors
from ..world.spherical import spherical, vector_cov


@dataclass(frozen=True, eq=False)
class Stage:
    """One step: the members' columns, their places before, the variance of their motion, the information gained."""

    members: Ints
    previous: Ints
    process: Floats
    gained: Floats


def stages_of(fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints], *, fixes: bool = True) -> list[Stage]:
    """Every step of the vehicles (columns) that are members of it, with fixes or without."""
    start = np.searchsorted(links.step, np.arange(len(fleet.t) + 1))
    stages, before = [], np.full(len(fleet.ids), -1)
    for t, now in enumerate(members):
        span = slice(start[t], start[t + 1])
        place = np.full(len(fleet.ids), -1)
        place[now] = np.arange(len(now))
        process = (fleet.dt * sensors.velocity_std(fleet.velocity[t, now])) ** 2
        gained = _fisher(fleet.position[t, now], place[links.observer[span]], place[links.neighbour[span]], sensors)
        if fixes:
            gained += np.diag(np.tile(1.0 / np.square(sensors.gnss_std), len(now)))
        stages.append(Stage(now, before[now], process, gained))
        before = place
    return stages


def _fisher(position: Floats, observer: Ints, neighbour: Ints, sensors: Sensors) -> Floats:
    """Information (3n, 3n) about n vehicles of what observers measure of neighbours (places), at the truth."""
    n = len(position)
    information = np.zeros((3 * n, 3 * n))
    if len(observer):
        relative = np.stack(spherical(*(position[neighbour] - position[observer]).T), axis=-1)
        edge = np.linalg.inv(vector_cov(relative, sensors.relative_std))
        incidence = np.zeros((len(observer), n))
        incidence[np.arange(len(observer)), observer] = -1.0
        incidence[np.arange(len(observer)), neighbour] = 1.0
        halves = np.einsum("eij,eb->eibj", edge, incidence).reshape(len(observer), -1)
        information += (incidence.T @ halves).reshape(3 * n, 3 * n)
    return information


def covariances(stages: list[Stage], smoothing: bool) -> Iterator[tuple[int, Floats]]:
    """Steps and the bound (3n, 3n) of their members: forward, or for smoothing from the last step to the first.

    Smoothing is the two-filter form: information from the past with the present, plus that of the future.
    """
    filtered: list[Floats] = []
    cov: Floats = np.zeros((0, 0))
    with tqdm(total=len(stages) * (1 + smoothing), desc="bound", unit="step", delay=2.0) as bar:
        for t, stage in enumerate(stages):
            information = _carry(cov, stage.previous, stage.process) + stage.gained
            cov = np.linalg.inv(information)
            bar.update()
            if smoothing:
                filtered.append(information)
            else:
                yield t, cov
        future: Floats = np.zeros_like(cov)
        for t in range(len(filtered) - 1, -1, -1):
            yield t, np.linalg.inv(filtered.pop() + future)
            future = _from_ahead(future, stages[t], len(stages[t - 1].members)) if t else future
            bar.update()


def drifting_covariances(stages: list[Stage], sensors: Sensors, dt: float) -> Iterator[tuple[int, Floats]]:
    """Filtering bound (3n, 3n) where fixes have time-correlated errors, which the state then holds (`Drift`).

    Args:
        stages: without the fixes, which do not see positions alone.
    """
    drift = Drift.of(sensors, dt)
    cov: Floats = np.zeros((0, 0))
    for t, stage in enumerate(tqdm(stages, desc="bound", unit="step", delay=2.0)):
        n = len(stage.members)
        fix_matrix, weight = drift.fix_matrix(n), np.tile(1.0 / np.square(sensors.gnss_std), n)
        information = (
            np.linalg.inv(drift.carry(cov, stage.previous, stage.process)) + (fix_matrix.T * weight) @ fix_matrix
        )
        information[: 3 * n, : 3 * n] += stage.gained
        cov = np.linalg.inv(information)
        yield t, cov[: 3 * n, : 3 * n]


def _carry(cov: Floats, previous: Ints, process: Floats) -> Floats:
    """Information about the members of a step from the covariance one step before: none of new members."""
    n = len(previous)
    out = np.zeros((3 * n, 3 * n))
    stays = np.flatnonzero(previous >= 0)
    if len(stays):
        here, there = rows(stays), rows(previous[stays])
        out[np.ix_(here, here)] = np.linalg.inv(cov[np.ix_(there, there)] + np.diag(process[stays].ravel()))
    return out


def _from_ahead(future: Floats, ahead: Stage, n: int) -> Floats:
    """Information of a step and its future about the n members one step before."""
    stays = np.flatnonzero(ahead.previous >= 0)
    back = np.full(n, -1, dtype=np.int64)
    back[ahead.previous[stays]] = stays
    process = np.zeros((n, 3))
    process[ahead.previous[stays]] = ahead.process[stays]
    return _carry(np.linalg.inv(future + ahead.gained), back, process)
