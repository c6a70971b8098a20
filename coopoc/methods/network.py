"""The measured graph of the whole fleet at one step: who measured whom, and with what information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..world.exchange import Exchange
from ..world.recording import Recording
from ..world.spherical import spherical, to_vector, wrap
from .knowledge import Knowledge


@dataclass(frozen=True, eq=False)
class Network:
    """The n vehicles that are present at one step, what they believe, and the P pairs that measured each other.

    Both sightings of a pair are merged, so that a pair is one edge: two parallel ones would be a loop.

    Args:
        here: (n,) columns. first, second: (P,) places in `here`.
        x, cov: (R, n, 3) m, (R, n, 3, 3) m^2, each vehicle's belief.
        weight, pull: (R, P, 3, 3) 1/m^2, (R, P, 3) 1/m, what the pairs measured of the difference of the two errors:
            weight (e_second - e_first) = pull, where e is the true position less `x`.
        to_first, to_second: (R, P) True where the other's message gets through.
    """

    here: Ints
    first: Ints
    second: Ints
    x: Floats
    cov: Floats
    weight: Floats
    pull: Floats
    to_first: Bools
    to_second: Bools


def network(
    recording: Recording, contacts: Exchange, t: int, x: Floats, cov: Floats, known: Knowledge,
    shared: Floats | None = None,
) -> Network:  # fmt: skip
    """The graph of step t around what the vehicles that are present believe.

    Range and angles are linearised at the relative vector on which the two beliefs and the converted sightings agree,
    v + (I + C W)^-1 C (w - W v), with C the covariance of the believed vector v and (W, w) the converted information.
    A good belief decides alone: then the weight does not depend on the noise, as it does at the measured geometry
    (performance.md section 1.1 of the design notes). A poor one is ignored, as it must be at the start.

    Args:
        x, cov: (R, N, 3) m, (R, N, 3, 3) m^2, NaN where absent.
        shared: (R, P, 3, 3) m^2, cov(x_first, x_second) and its transpose; None for independent beliefs.
    """
    here = present(recording)[t].nonzero()[0]
    span = slice(contacts.start[t], contacts.start[t + 1])
    sight, back = contacts.sight[span], contacts.sight_back[span]
    first, second = np.searchsorted(here, contacts.first[span]), np.searchsorted(here, contacts.second[span])
    x, cov = x[:, here], cov[:, here]
    vector = x[:, second] - x[:, first]
    weight, pull = pair_sightings(recording.relative, sight, back, None, known)
    pull = pull - apply(weight, vector)
    if known.exact_relative and len(first):
        spread = cov[:, first] + cov[:, second] - (0.0 if shared is None else shared)
        moved = np.linalg.solve(np.eye(3) + spread @ weight, (spread @ pull[..., None]))[..., 0]
        weight, pull = pair_sightings(recording.relative, sight, back, vector + moved, known)
        pull = pull + apply(weight, moved)
    return Network(here, first, second, x, cov, weight, pull, contacts.to_first[:, span], contacts.to_second[:, span])


def pair_sightings(
    relative: Floats, sight: Ints, back: Ints, vector: Floats | None, known: Knowledge
) -> tuple[Floats, Floats]:
    """Information (R, P, 3, 3) of both sightings of each pair, and what they pull at `vector`.

    Args:
        relative: (R, L, 3) m, rad, rad. sight, back: (P,) links by which the first sees the second, and back; -1: none.
        vector: (R, P, 3) m from first to second; None linearises each where it was measured and pulls at zero.
    """
    shape = (len(relative), len(sight), 3)
    weight, pull = np.zeros((*shape, 3)), np.zeros(shape)
    for link, sign in ((sight, 1.0), (back, -1.0)):
        there = np.flatnonzero(link >= 0)
        seen = relative[:, link[there]]
        at = to_vector(seen) if vector is None else sign * vector[:, there]
        information, toward = sighting(at, seen, known)
        weight[:, there] += information
        pull[:, there] += sign * (apply(information, at) if vector is None else toward)
    return weight, pull


def sighting(vector: Floats, relative: Floats, known: Knowledge) -> tuple[Floats, Floats]:
    """Information J^T J (..., 3, 3) of a measured relative vector and its pull J^T r (..., 3) at `vector`.

    J and r belong to the whitened range and angles. At `vector` = `to_vector(relative)` this is the converted
    measurement with its rotated covariance. With identity knowledge: the unit matrix, and the difference of the two.

    >>> from coopoc import Sensors
    >>> known = Knowledge.nominal(Sensors(range_std=0.5))
    >>> sighting(np.array([10.0, 0, 0]), np.array([11.0, 0, np.pi / 2]), known)[1].round(6)
    array([4., 0., 0.])
    """
    if known.sensors is None:
        return np.broadcast_to(np.eye(3), (*vector.shape, 3)), to_vector(relative) - vector
    root, residual = whitened(vector, relative, known)
    back = np.swapaxes(root, -1, -2)
    return back @ root, apply(back, residual)


def whitened(vector: Floats, relative: Floats, known: Knowledge) -> tuple[Floats, Floats]:
    """Whitened Jacobian (..., 3, 3) by a relative vector and residual (..., 3) of range, azimuth and inclination.

    Args:
        vector: (..., 3) m, where to linearise. relative: (..., 3) m, rad, rad as measured. known: with sensors.
    """
    assert known.sensors is not None
    dx, dy, dz = np.moveaxis(vector, -1, 0)
    d, azimuth, inclination = spherical(dx, dy, dz)
    residual = relative - np.stack([d, azimuth, inclination], axis=-1)
    residual[..., 1:] = wrap(residual[..., 1:])
    d = np.maximum(d, known.sensors.min_range)
    ground = np.maximum(np.hypot(dx, dy), 1e-3 * d)
    jacobian = np.zeros((*vector.shape, 3))
    jacobian[..., 0, :] = to_vector(np.stack([np.ones_like(d), azimuth, inclination], axis=-1))
    jacobian[..., 1, 0], jacobian[..., 1, 1] = -dy / ground**2, dx / ground**2
    tilt = dz / (ground * d**2)
    jacobian[..., 2, 0], jacobian[..., 2, 1], jacobian[..., 2, 2] = dx * tilt, dy * tilt, -ground / d**2
    std = known.sensors.relative_std
    return jacobian / std[:, None], residual / std


def present(recording: Recording) -> Bools:
    """(T, N) True where a vehicle exists."""
    return np.isfinite(recording.gnss[0, :, :, 0])


def apply(matrix: Floats, vector: Floats) -> Floats:
    """Products (..., 3) of matrices (..., 3, 3) and vectors (..., 3)."""
    product: Floats = (matrix @ vector[..., None])[..., 0]
    return product


def collect(values: Floats, to: Ints, n: int) -> Floats:
    """Sums (R, n, ...) of values (R, M, ...) by the place `to` (M,) that each belongs to."""
    sums = np.zeros((len(values), n, *values.shape[2:]))
    if len(to):
        order = np.argsort(to, kind="stable")
        begins = np.flatnonzero(np.diff(to[order], prepend=-1))
        sums[:, to[order][begins]] = np.add.reduceat(values[:, order], begins, axis=1)
    return sums


def information(n: int, first: Ints, second: Ints, weight: Floats, pull: Floats) -> tuple[Floats, Floats]:
    """Information (R, 3n, 3n) and pull (R, 3n) of P measured differences x_second - x_first, each pair once.

    B blkdiag(W) B^T and B w with B the incidence matrix: the weighted Laplacian of the network.

    Args:
        first, second: (P,) places of n vehicles. weight: (R, P, 3, 3). pull: (R, P, 3).
    """
    runs, i = len(weight), np.arange(n)
    blocks = np.zeros((runs, n, 3, n, 3))
    per_pair = np.moveaxis(weight, 1, 0)
    blocks[:, first, :, second] = -per_pair
    blocks[:, second, :, first] = -per_pair
    blocks[:, i, :, i] = np.moveaxis(collect(weight, first, n) + collect(weight, second, n), 1, 0)
    total = collect(pull, second, n) - collect(pull, first, n)
    return blocks.reshape(runs, 3 * n, 3 * n), total.reshape(runs, 3 * n)
