"""A moving horizon: a window of the star's last steps behind an arrival cost, late messages at their true time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..world.inbox import Inbox
from ..world.recording import Recording, Vehicles
from ..world.v2x import FIX_AND_VELOCITY
from .egos import Estimate, assumptions, follow_egos, measurements
from .noise_model import NoiseModel, resolve
from .track import Track, check_options

STRAYED = 0.03
"""m, move of a vector v beyond which its measurement is made linear anew: off by at most 0.03^2 / 2 |v| then."""
REPEATS = 10
"""Gauss-Newton steps of a moving horizon after the first; one is common."""
DROPPED = "fixes came later than the horizon and were dropped"
MOVING = f"windows were still moving after {REPEATS + 1} Gauss-Newton steps"


@dataclass(frozen=True, eq=False)
class MovingHorizon:
    r"""Most probable positions of the star over the last N steps, behind an arrival cost.

    $$
    \min_{x_{t-N..t}} \lVert x_{t-N} - x_a \rVert^2_{P^{-1}} + \sum_k \lVert x_{k+1} - x_k - \Delta t \, u_k
    \rVert^2_{Q^{-1}} + \sum_k \lVert h(x_k) - z_k \rVert^2_{R^{-1}}
    $$

    x holds the ego and the neighbours of its star at each step. The arrival cost (x_a, P) is
    what the steps before the horizon leave when they are eliminated one by one, as a filter does. A message that comes
    late is put where it belongs: its fix at the step at which it was sent, its velocity in the place of the older one
    that stood in for it. A velocity that stands in n times makes the same error n times (kernels/stars/messages.py). A
    fix that is late by more than the horizon is dropped, and the notes count it. With linear relative
    measurements the newest point is that of the Kalman filter.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        horizon: N, steps.
        exact: False keeps relative measurements as converted vectors.
        robust: what is beyond its gate when it comes weighs less, far beyond it nothing (`coopoc.kernels.gate`).

    Raises:
        InputError: a horizon < 1.

    References:
        Rao, Rawlings, Mayne, Constrained state estimation for nonlinear discrete-time systems, IEEE TAC 48(2), 2003.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> MovingHorizon(horizon=1)(observe(fleet, Sensors(), V2X(latency=0.1), runs=4)).x.shape
    (4, 2, 1, 3)
    """

    noise_model: NoiseModel | str = "nominal"
    horizon: int = 10
    exact: bool = True
    robust: bool = True
    name: str = "mhe"
    cooperative = True
    message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self, {"horizon": (1, 1e18, "a whole number >= 1, such as 10 to 20 at 10 Hz")})

    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        from ..kernels.windows.horizon import Settings, horizons

        noise_model, counts = resolve(self.noise_model, recording), Counter[str]()
        exact, robust = (noise_model.exact_relative and wish for wish in (self.exact, self.robust))
        age = recording.v2x.max_age / recording.dt + 1e-9
        settings = Settings(self.horizon + 1, exact, REPEATS if exact else 0, STRAYED, age, robust)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            seen, assumed = measurements(recording, ego, box), assumptions(recording, noise_model, ego, box)
            seen = seen._replace(newest=seen.newest.copy(), fresh=np.zeros_like(box.fresh))
            counts[DROPPED] += int((box.arrival - recording.links.step[box.link] > self.horizon).sum())
            solved = horizons(seen, assumed, np.ascontiguousarray(box.arrival), settings)
            counts[MOVING] += int(solved.moving.sum())
            yield Estimate(solved.x, solved.covariance, solved.neighbours)

        track = follow_egos(self, recording, egos, drive)
        counted = tuple(f"{count} {note}" for note, count in counts.items() if count)
        return replace(track, notes=(*noise_model.notes, *counted))
