"""The posterior Cramer-Rao bound of an information set: solo, star or whole fleet, filtering or smoothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from ..arrays import Floats, Ints, checked, instance
from ..errors import InputError
from ..methods.drift_state import drifting, require_white
from ..plugins import unknown
from ..world.fleet import Fleet
from ..world.links import Links
from ..world.sensing import find_links
from ..world.sensors import Sensors
from ..world.v2x import V2X
from .recursion import covariances, drifting_covariances, stages_of


def posterior_bound(
    fleet: Fleet,
    sensors: Sensors,
    ego: int | str,
    v2x: V2X | None = None,
    *,
    smoothing: bool = False,
    information: Literal["star", "fleet"] = "star",
) -> Floats:
    """Bound covariance of the ego's position at every step, (T, 3, 3) m^2.

    Filtering: J_t = (Q_t + J_{t-1}^-1)^-1 + F_t (Tichavsky, Muravchik, Nehorai 1998), F_t the Fisher information of the
    fixes and relative measurements at the true positions, Q_t the true motion noise. Smoothing adds the information of
    the future. The information set is the ego's own measurements (solo, `v2x` None or K = 0), also the fixes and
    velocities of the linked neighbours over an ideal channel (star), or all that any vehicle measures (fleet); a
    vehicle that leaves the star is forgotten, as its motion is not received. The bias is left out: it is unobservable
    from a GNSS start. Drift and common errors of the fixes are unknowns beside the positions (filtering only).

    Args:
        fleet: truth.
        sensors: the noise that acts, stds positive.
        ego: column or id.
        v2x: K and radius, not loss.
        smoothing: use measurements after t, too.
        information: "fleet" costs O(T (3N)^3); for several egos use
            `fleet_bound`, which gives all at once.

    Raises:
        InputError: an acting std of zero, for which the bound is zero; an ego that is unknown or absent.

    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> float(posterior_bound(fleet, Sensors(gnss_std=(2, 2, 2)), 0)[1, 0, 0])  # standing still: 4 / 2
    2.0
    """
    v2x = checked_noise(fleet, sensors, v2x)
    if not isinstance(information, str) or information not in ("star", "fleet"):
        raise unknown("information", information, ("star", "fleet"), "For solo give K = 0.")
    instance("smoothing", smoothing, bool)
    column = fleet.index(ego)
    if not fleet.present[:, column].all():
        raise InputError("ego", fleet.ids[column], "is absent at some steps", "Choose another or cut the drive.")
    if information == "fleet":
        return fleet_bound(fleet, sensors, v2x, smoothing=smoothing)[:, column]
    links = find_links(fleet, [column], v2x.max_neighbours, v2x.radius, sensors.min_range)
    steps = np.split(links.neighbour, np.searchsorted(links.step, np.arange(1, len(fleet.t))))
    members = [np.concatenate([[column], near]) for near in steps]
    out = np.empty((len(fleet.t), 3, 3))
    for t, cov in _recursion(fleet, sensors, links, members, smoothing):
        out[t] = cov[:3, :3]
    return out


def past_bound(fleet: Fleet, sensors: Sensors, ego: int, v2x: V2X) -> Floats:
    """`posterior_bound` (T, 3, 3) m^2, filtering, of an ego that knows all fixes and velocities of all vehicles, too.

    Messages that carry sums since departure bring a new neighbour's past, which a star that forgets absent vehicles
    does not count. It is never above the star's bound, and equal to it while the same neighbours stay.

    Args:
        fleet: truth.
        sensors: the noise that acts, stds positive.
        ego: column.
        v2x: K and radius, not loss.

    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> float(past_bound(fleet, Sensors(gnss_std=(2, 2, 2)), 0, V2X(0))[1, 0, 0])  # standing still: 4 / 2
    2.0
    """
    links = find_links(fleet, [ego], v2x.max_neighbours, v2x.radius, sensors.min_range)
    members = [np.flatnonzero(row) for row in fleet.present]
    out = np.empty((len(fleet.t), 3, 3))
    for t, cov in _recursion(fleet, sensors, links, members, smoothing=False):
        own = 3 * int(np.searchsorted(members[t], ego)) + np.arange(3)
        out[t] = cov[np.ix_(own, own)]
    return out


def fleet_bound(fleet: Fleet, sensors: Sensors, v2x: V2X | None = None, *, smoothing: bool = False) -> Floats:
    """Bound covariances (T, N, 3, 3) m^2 of all vehicles from all that any of them measures; NaN where absent.

    Args and errors: as in `posterior_bound`.

    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> rigid = Sensors(gnss_std=(2, 2, 2), range_std=1e-3)
    >>> float(fleet_bound(fleet, rigid, V2X())[0, 1, 0, 0].round(3))  # two fixes for one body: 4 / 2
    2.0
    """
    v2x = checked_noise(fleet, sensors, v2x)
    instance("smoothing", smoothing, bool, "Give True for the bound of a smoother.")
    everyone = range(len(fleet.ids))
    links = find_links(fleet, everyone, v2x.max_neighbours, v2x.radius, sensors.min_range)
    members = [np.flatnonzero(row) for row in fleet.present]
    out = np.full((*fleet.position.shape, 3), np.nan)
    for t, cov in _recursion(fleet, sensors, links, members, smoothing):
        n = len(members[t])
        out[t, members[t]] = cov.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    return out


def _recursion(
    fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints], smoothing: bool
) -> Iterator[tuple[int, Floats]]:
    if not drifting(sensors):
        return covariances(stages_of(fleet, sensors, links, members), smoothing)
    if smoothing:
        require_white(sensors, "the smoothing bound")
    return drifting_covariances(stages_of(fleet, sensors, links, members, fixes=False), sensors, fleet.dt)


def bound_rt_le(cov: Floats) -> float:
    """RT-LE that belongs to a bound (T, 3, 3), sqrt(mean_t trace P_t), m."""
    return float(np.sqrt(np.trace(checked("cov", cov, "(T, 3, 3)", (-1, 3, 3)), axis1=-2, axis2=-1).mean()))


def checked_noise(fleet: Fleet, sensors: Sensors, v2x: V2X | None, landmarks: bool = False) -> V2X:
    """The channel, None being none; InputError for an acting std of zero."""
    instance("fleet", fleet, Fleet)
    instance("sensors", sensors, Sensors)
    v2x = V2X(max_neighbours=0) if v2x is None else instance("v2x", v2x, V2X)
    if min(sensors.gnss_std) <= 0:
        raise InputError("gnss_std", sensors.gnss_std, "must be > 0", "With exact fixes the bound is zero.")
    if (v2x.max_neighbours or landmarks) and min(sensors.relative_std) <= 0:
        raise InputError("relative_std", sensors.relative_std, "must be > 0", "An exact one merges two vehicles.")
    return v2x
