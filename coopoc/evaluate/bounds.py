"""The posterior Cramer-Rao bound of an information set: solo or star, filtering or smoothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from ..methods.star import rows
from ..world.fleet import Fleet
from ..world.sensing import find_links
from ..world.sensors import Sensors
from ..world.spherical import spherical, vector_cov
from ..world.v2x import V2X


@dataclass(frozen=True, eq=False)
class _Stage:
    """One step of the star: who stayed, the variance of their motion, and the information that the step brings."""

    kept: Ints
    process: Floats
    gained: Floats


def posterior_bound(
    fleet: Fleet, sensors: Sensors, ego: int | str, v2x: V2X | None = None, *, smoothing: bool = False
) -> Floats:
    """Bound covariance of the ego's position at every step, (T, 3, 3) m^2.

    Filtering: J_t = (Q_t + J_{t-1}^-1)^-1 + F_t (Tichavsky, Muravchik, Nehorai 1998), F_t the Fisher information of the
    fixes and relative measurements at the true positions, Q_t the true motion noise. Smoothing adds what the future
    says. The information set is the ego's own measurements (solo, `v2x` None or K = 0) or also the fixes and velocities
    of the linked neighbours over an ideal channel (star); a vehicle that leaves the star is forgotten, as nothing is
    heard of its motion. The bias is left out: it is unobservable from a GNSS start.

    Args:
        fleet: truth. sensors: the noise that acts, stds positive. ego: column or id. v2x: K and radius, not loss.
        smoothing: use measurements after t, too.

    Raises:
        InputError: an acting std of zero, for which the bound is zero; an ego that is unknown or absent.

    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> float(posterior_bound(fleet, Sensors(gnss_std=(2, 2, 2)), 0)[1, 0, 0])  # standing still: 4 / 2
    2.0
    """
    v2x = v2x or V2X(max_neighbours=0)
    if min(sensors.gnss_std) <= 0:
        raise InputError("gnss_std", sensors.gnss_std, "must be > 0", "With exact fixes the bound is zero.")
    if v2x.max_neighbours and min(sensors.relative_std) <= 0:
        raise InputError("relative_std", sensors.relative_std, "must be > 0", "Exact sightings merge two vehicles.")
    ego = fleet.index(ego)
    if not fleet.present[:, ego].all():
        raise InputError("ego", fleet.ids[ego], "is absent at some steps", "Choose another or cut the drive.")
    stages = _stages(fleet, sensors, ego, v2x)
    filtered: list[Floats] = []
    before: Floats = np.zeros((0, 0))
    for stage in stages:
        before = _carry(before, stage.kept, stage.process) + stage.gained
        filtered.append(before)
    if not smoothing:
        return np.stack([np.linalg.inv(j)[:3, :3] for j in filtered])
    return _smoothed(stages, filtered)


def bound_rt_le(cov: Floats) -> float:
    """RT-LE that belongs to a bound, sqrt(mean_t trace P_t), m."""
    return float(np.sqrt(np.trace(cov, axis1=-2, axis2=-1).mean()))


def _stages(fleet: Fleet, sensors: Sensors, ego: int, v2x: V2X) -> list[_Stage]:
    links = find_links(fleet, [ego], v2x.max_neighbours, v2x.radius, sensors.min_range)
    start = np.searchsorted(links.step, np.arange(len(fleet.t) + 1))
    stages, before = [], np.array([], dtype=np.int64)
    for t in range(len(fleet.t)):
        members = np.concatenate([[ego], links.neighbour[start[t] : start[t + 1]]])
        kept = np.array([int(np.flatnonzero(before == m)[0]) if m in before else -1 for m in members])
        process = (fleet.dt * sensors.velocity_std(fleet.velocity[t, members])) ** 2
        stages.append(_Stage(kept, process, _fisher(fleet.position[t, members], sensors)))
        before = members
    return stages


def _fisher(position: Floats, sensors: Sensors) -> Floats:
    """Information (3n, 3n) of n fixes and of the first vehicle's measurements of the others, at the truth."""
    n = len(position)
    information = np.kron(np.eye(n), np.diag(1.0 / np.square(sensors.gnss_std)))
    for j in range(1, n):
        relative = np.array(spherical(*(position[j] - position[0])))
        edge = np.linalg.inv(vector_cov(relative, sensors.relative_std))
        sign = np.zeros((1, n))
        sign[0, [0, j]] = -1.0, 1.0
        information += np.kron(sign.T @ sign, edge)
    return information


def _carry(information: Floats, kept: Ints, process: Floats) -> Floats:
    """Information about the members of a step from what was known one step before: who joins brings none."""
    n = len(kept)
    out = np.zeros((3 * n, 3 * n))
    stays = np.flatnonzero(kept >= 0)
    if len(stays) and len(information):
        here, there = rows(stays), rows(kept[stays])
        cov = np.linalg.inv(information)[np.ix_(there, there)] + np.diag(process[stays].ravel())
        out[np.ix_(here, here)] = np.linalg.inv(cov)
    return out


def _smoothed(stages: list[_Stage], filtered: list[Floats]) -> Floats:
    """Two-filter form: information from the past with the present, plus what the future says."""
    bound = [np.linalg.inv(filtered[-1])[:3, :3]]
    future: Floats = np.zeros_like(filtered[-1])
    for t in range(len(stages) - 1, 0, -1):
        ahead = stages[t]
        stays = np.flatnonzero(ahead.kept >= 0)
        back = np.full(len(filtered[t - 1]) // 3, -1, dtype=np.int64)
        back[ahead.kept[stays]] = stays
        process = np.zeros((len(back), 3))
        process[ahead.kept[stays]] = ahead.process[stays]
        future = _carry(future + ahead.gained, back, process)
        bound.append(np.linalg.inv(filtered[t - 1] + future)[:3, :3])
    return np.stack(bound[::-1])
