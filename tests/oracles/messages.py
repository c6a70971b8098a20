"""Members of a star at a step, one run, as objects: `coopoc.stars` for the oracles; and slopes of what they measure."""

from dataclasses import dataclass

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.star import StarStep


def directions(azimuth: float, inclination: float) -> Floats:
    """Unit vectors (rows) along which range, azimuth and inclination grow."""
    (sa, si), (ca, ci) = np.sin([azimuth, inclination]), np.cos([azimuth, inclination])
    return np.array([[si * ca, si * sa, ci], [-sa, ca, 0.0], [ci * ca, ci * sa, -si]])


def slopes(vector: Floats, least: float) -> Floats:
    """Jacobian of range, azimuth and inclination, at least `least` m away and not straight above."""
    (x, y, z), r = vector, np.linalg.norm(vector)
    d = max(r, least)
    ground = d * max(np.hypot(x, y) / r, 1e-3)
    return np.array(
        [
            vector / r,
            [-y / ground**2, x / ground**2, 0.0],
            [x * z / (ground * d**2), y * z / (ground * d**2), -ground / d**2],
        ]
    )


@dataclass
class Member:
    """A vehicle in the star at a step: where it stood in the last star (None: joins), motion m and its variance m^2
    since then, position m brought forward and its variance m^2 (infinite: not known), whether that is new, and the
    measurement of it (None for the ego)."""

    before: int | None
    moved: Floats
    process: Floats
    position: Floats
    variance: Floats
    new: bool
    relative: Floats | None


def members(star: StarStep, run: int) -> list[Member]:
    """The members of a star in one run, the ego first."""
    return [
        Member(
            None if index < 0 else int(index),
            star.moved[run, k],
            star.process[run, k],
            star.position[run, k],
            star.variance[run, k],
            bool(star.new[run, k]),
            star.relative[run, k - 1] if k else None,
        )
        for k, index in enumerate(star.previous)
    ]
