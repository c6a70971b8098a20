"""Drives as logs of real roads have them: fixes that err together, jump and stop, odometry with a wrong heading and
scale; every vehicle in a world of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from coopoc.arrays import Floats
from coopoc.world.body_frames import gauss_markov
from coopoc.world.fleet import Fleet
from coopoc.world.outliers import Fault, Outliers
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors, stream
from coopoc.world.v2x import V2X

from .drives import MeasuredDrives

WORLDS, PIECE = 6, 1500
"""Worlds of each vehicle, and steps of a piece where a drive holds three: errors last."""


def roads(fleet: Fleet, seed: int = 0) -> MeasuredDrives:
    """Each vehicle of a fleet in some worlds, each of which is a vehicle of the answer, with its truth.

    A vehicle drives to and fro along its way until the fleet's last step. A world draws, most of it log-uniformly,
    speeds times 0.1 to 4; fixes at 1 to 10 Hz with a white error of 0.3 to 4 m and one of 0.3 to 6 m that lasts 5 to
    200 s, up to 15 % of them 5 to 60 m off for a while, and outages; a heading that errs by 0.01 to 0.3 rad and a scale
    by 0.005 to 0.1, which last 60 to 3000 s; slip, and stops.

    Args:
        fleet: drives (T, N), of which a vehicle may leave early.
        seed: of all draws.

    >>> t = np.arange(50) / 10
    >>> line = Fleet(("a",), t, np.zeros((50, 1, 3)), np.zeros((50, 1, 3)))
    >>> roads(line).ids[:2]
    ('a-0', 'a-1')
    """
    each = [(column, k) for column in range(len(fleet.ids)) for k in range(WORLDS)]
    ids = tuple(f"{fleet.ids[column]}-{k}" for column, k in each)
    parts = zip(*(_world(fleet, column, k, seed) for column, k in each), strict=True)
    gnss, velocity, position, motion = (np.stack(part, axis=1) for part in parts)
    truth = Fleet(ids, fleet.t, position, motion, name=f"{fleet.name}-roads", source=f"{fleet.name} in {WORLDS} worlds")
    like = observe(truth, Sensors(), V2X(max_neighbours=0), seed=seed)
    return MeasuredDrives(replace(like, gnss=gnss[None], velocity=velocity[None]), truth, ids)


def _world(fleet: Fleet, column: int, number: int, seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Fixes, velocities, true positions and velocities (T, 3) of one vehicle in one world."""
    name, dt, steps = f"{fleet.ids[column]}-{number}", fleet.dt, len(fleet.t)
    draw = stream(seed, "world", number, fleet.ids[column])

    def between(low: float, high: float) -> float:
        return float(np.exp(draw.uniform(np.log(low), np.log(high))))

    (there,) = np.nonzero(fleet.present[:, column])
    stands = gauss_markov(draw.standard_normal((steps, 1)), dt / 30.0)[:, 0] > draw.uniform(0.8, 3.0)
    at = np.cumsum(~stands) % (2 * len(there))
    x = fleet.position[there[np.minimum(at, 2 * len(there) - 1 - at)], column] * between(0.1, 4.0)
    alone = Fleet((name,), fleet.t, x[:, None], np.diff(x, axis=0, prepend=x[:1])[:, None] / dt)
    noise = Sensors(
        gnss_std=(between(0.3, 4.0),) * 2 + (between(0.5, 6.0),),
        gnss_drift_std=between(0.3, 6.0),
        gnss_drift_time=between(5.0, 200.0),
        velocity_std_ratio=between(0.02, 0.2),
        outliers=Outliers(
            fixes=Fault(draw.uniform(0.0, 0.15), (5.0, 60.0), lasts=between(3.0, 60.0)),
            outages=Fault(draw.uniform(0.0, 0.3), lasts=between(2.0, 30.0)),
            odometry=Fault(draw.uniform(0.0, 0.05), lasts=between(0.5, 5.0)),
        ),
    )
    seen = observe(alone, noise, V2X(max_neighbours=0), seed=seed + number)
    fixes, velocity = seen.gnss[0, :, 0].copy(), seen.velocity[0, :, 0]
    every = int(draw.integers(1, 11))
    fixes[np.arange(steps) % every > 0] = np.nan
    lasts = dt / between(60.0, 3000.0)
    turn, scale = gauss_markov(draw.standard_normal((steps, 2)), lasts).T * [
        [between(0.01, 0.3)],
        [between(0.005, 0.1)],
    ]
    c, s = np.cos(turn), np.sin(turn)
    east, north = c * velocity[:, 0] - s * velocity[:, 1], s * velocity[:, 0] + c * velocity[:, 1]
    wrong = (1.0 + scale)[:, None] * np.column_stack([east, north, velocity[:, 2]])
    return fixes, wrong, x, alone.velocity[:, 0]
