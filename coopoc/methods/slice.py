"""A slice: one step of a window of stars, and the quadratic cost that it and its past have around a point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Floats
from ..optimize.measurements import lookup
from ..optimize.sights import relative_std
from ..world.spherical import spherical
from .egos import Estimate
from .joint_filter import add_edges
from .knowledge import Knowledge
from .star import FORGOTTEN, StarStep

STRAYED = 0.03
"""m, move of a sighted vector v beyond which its sighting is made linear anew: off by at most 0.03^2 / 2 |v| then."""


@dataclass(frozen=True, eq=False)
class Slice:
    """One step of the window; its sightings say weight (x_j - x_ego) = seen.

    Args:
        star: what is known of the step. start: (R, n, 3) m, where its members were expected when it came.
        point: (R, n, 3) m, the estimate. base: (R, n-1, 3) m, the x_j - x_ego around which the sightings are linear.
        weight: (R, n-1, 3, 3) 1/m^2. seen: (R, n-1, 3) 1/m.
    """

    star: StarStep
    start: Floats
    point: Floats
    base: Floats
    weight: Floats
    seen: Floats

    @property
    def gap(self) -> Floats:
        """(R, n-1, 3) m, x_j - x_ego."""
        return self.point[:, 1:] - self.point[:, :1]

    @property
    def strayed(self) -> Bools:
        """(R,) True where the estimate has left the geometry at which the sightings are linear."""
        return np.asarray(np.abs(self.gap - self.base).max(axis=(1, 2), initial=0.0) > STRAYED)


@dataclass(frozen=True, eq=False)
class Arrival:
    """What the past says of a step: the cost 1/2 d^T information d - pull^T d of d = x - at.

    Args:
        at: (R, n, 3) m. information: (R, 3n, 3n) 1/m^2, zero for who has just joined. pull: (R, 3n) 1/m.
    """

    at: Floats
    information: Floats
    pull: Floats


def entering(before: Floats, star: StarStep, known: Knowledge) -> Slice:
    """A new slice at the expected positions: who stays moves with its velocity, who joins stands where the ego sees it.

    Its sightings are converted vectors, weighted at that geometry (see JointFilter).

    Args:
        before: (R, m, 3) m, the step before.
    """
    stays = np.flatnonzero(star.kept >= 0)
    start = np.empty_like(star.moved)
    start[:, stays] = before[:, star.kept[stays]] + star.moved[:, stays]
    if star.kept[0] < 0:
        start[:, 0] = star.fix[:, 0]
    joins = np.flatnonzero(star.kept[1:] < 0)
    start[:, 1 + joins] = start[:, :1] + star.vector[:, joins]
    gap = start[:, 1:] - start[:, :1]
    weight = np.linalg.inv(known.relative_cov(np.stack(spherical(*np.moveaxis(gap, -1, 0)), axis=-1)))
    return Slice(star, start, start, gap, weight, apply(weight, star.vector))


def exactly(part: Slice, point: Floats, known: Knowledge) -> Slice:
    """The slice with its sightings as range and angles, linear around `point` (R, n, 3)."""
    assert known.sensors is not None
    base, relative = point[:, 1:] - point[:, :1], part.star.relative
    residual, slope = lookup("spherical").differentiate(base, None, relative, relative[..., :0])
    std = relative_std(relative, known.sensors)
    root = np.swapaxes(slope / std[..., None], -1, -2)
    weight = root @ np.swapaxes(root, -1, -2)
    return replace(part, point=point, base=base, weight=weight, seen=apply(weight, base) - apply(root, residual / std))


def system(part: Slice, prior: Arrival) -> tuple[Floats, Floats]:
    """Information (R, 3n, 3n) and pull (R, 3n) of a slice around its point, without the motion that leaves it."""
    star, point = part.star, part.point
    joins = np.where(star.kept < 0, 1.0 / FORGOTTEN, 0.0)[:, None]
    fresh = np.where(star.heard[..., None], 1.0 / star.fix_variance, 0.0)
    total, at = prior.information.copy(), np.arange(point[0].size)
    total[:, at, at] += (joins + fresh).reshape(len(point), -1)
    pull = prior.pull - apply(prior.information, (point - prior.at).reshape(len(point), -1))
    pull += (joins * (part.start - point) + fresh * (star.fix - point)).reshape(len(point), -1)
    add_edges(total, pull, part.weight, part.seen - apply(part.weight, part.gap))
    return total, pull


def estimate(part: Slice, spread: Floats) -> Estimate:
    """What a solved slice and its covariance (R, 3n, 3n) say of the ego and its neighbours."""
    return Estimate(part.star.step, part.point[:, 0], spread[:, :3, :3], part.star.links, part.point[:, 1:])


def apply(matrix: Floats, vector: Floats) -> Floats:
    """Matrices (..., m, n) times vectors (..., n).

    >>> apply(np.eye(2), np.array([1.0, 2.0]))
    array([1., 2.])
    """
    product: Floats = (matrix @ vector[..., None])[..., 0]
    return product
