"""The whole-drive smoother of the whole fleet: all positions at all steps from all measurements of a drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from ..arrays import Floats
from ..errors import InputError
from ..world.recording import Recording
from ..world.v2x import Message
from .central_filter import CENTRE, UPLOAD, centre
from .noise_model import NoiseModel
from .options import check_options
from .track import Track
from .whole_fleet import Answer, fleet_track

if TYPE_CHECKING:
    from ..kernels.fleets.fleet_graph import Assumed, Measured, Pairs
    from ..kernels.fleets.fleet_normal import Drive

NOT_CAUSAL = "not causal: every estimate depends on the whole drive"


@dataclass(frozen=True, eq=False)
class BatchSmoother:
    """argmin of sum |x_t - x_{t-1} - dt u_t|^2_Q + sum |z - x|^2_GNSS + sum |h(x_j - x_i) - y|^2 over fleet and drive.

    The converted measurements make a linear problem; from its solution one exact Gauss-Newton step on range and angles
    is enough on average. Steps with the same factors, each a tenth of its cost, follow until none moves a position by
    `settle`: then it is the most probable drive. A step that raises the cost is halved, and the next one linearised
    anew: where angles are noisy and fixes poor, a whole step may leave by kilometres. Time makes the normal
    equations block-tridiagonal with blocks of 3N x 3N, and motion noise is diagonal, so that one sweep eliminates step
    after step,

        S_t = J_t + D,   J_{t+1} = D S_t^-1 J_t + F_{t+1},   D = diag(1 / q),

    and one sweep back gives positions and their marginal covariances, Sigma_t = S_t^-1 + S_t^-1 D Sigma_{t+1} D S_t^-1.

    Not causal: a reference for what the drive holds. O(T (3N)^3) and T (3N)^2 numbers per sweep, one run at a time:
    60 vehicles and 900 steps take 230 MB. A measurement counts if a message gets through between the two, however late.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        exact_steps: Gauss-Newton steps after the linear solution.
        settle: m, the largest step to stop at; inf stops after those.
    """

    noise_model: NoiseModel | str = "nominal"
    exact_steps: int = 1
    settle: float = 1e-3
    name: str = "batch-smoother"
    cooperative: bool = True
    message: Message = UPLOAD

    def __post_init__(self) -> None:
        check_options(self)
        if self.exact_steps < 0:
            raise InputError("exact_steps", self.exact_steps, "must be a whole number >= 0", "Use 1; 0 is linear only.")
        if not self.settle > 0:
            raise InputError("settle", f"{self.settle} m", "must be > 0", "Use 1e-3, or infinity for no further steps.")

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.block_tridiagonal import Memory
            from ..kernels.fleets.fleet_normal import alone
            from ..kernels.fleets.fleet_smoother import smooth

            steps, start = (
                self.exact_steps if len(assumed.std) else 0,
                alone(measured, assumed).reshape(measured.gnss.shape),
            )
            settling = [Settling(self.settle) for _ in range(recording.runs)]
            memory = Memory(3 * measured.active.sum(axis=2).max(axis=0))
            total = recording.runs * (1 + steps) * len(recording.t)
            with tqdm(total=total, desc=self.name, unit="step", delay=2.0) as bar:
                found = [
                    smooth(at, drive, steps, settled, memory, bar.update)
                    for at, drive, settled in zip(start, _drives(measured, pairs, assumed), settling, strict=True)
                ]
            lost = sum(settled.given_up for settled in settling)
            note = (f"{lost} of {recording.runs} runs did not settle within {self.settle:g} m",)
            x, cov = (np.stack(each) for each in zip(*found, strict=True))
            return Answer(x, cov, 0, (NOT_CAUSAL, CENTRE, *(note if lost else ())))

        met = lambda: centre(recording, self.message)  # noqa: E731
        return fleet_track(self, self.noise_model, recording, egos, met, solve, both_ways=False)


@dataclass
class Settling:
    """Whether Gauss-Newton steps have become small, or no longer become smaller: then it is given up.

    >>> settling = Settling(1e-3)
    >>> [settling(largest) for largest in (0.5, 0.1, 1e-4)], settling.given_up
    ([False, False, True], False)
    """

    tolerance: float
    last: float = np.inf
    given_up: bool = False

    def __call__(self, largest: float) -> bool:
        """True to stop after a step that moved some position by `largest` m."""
        small = self.tolerance == np.inf or largest <= self.tolerance
        self.given_up = not small and not largest < self.last
        self.last = largest
        return small or self.given_up


def _drives(measured: Measured, pairs: Pairs, assumed: Assumed) -> Iterator[Drive]:
    """Each run as the sweeps take it."""
    from ..kernels.fleets.fleet_normal import Drive

    shape = measured.gnss.shape
    fix_weight: Floats = np.where(np.isnan(measured.gnss), 0.0, 1.0 / assumed.fix)
    motion_weight = np.broadcast_to(1.0 / assumed.process, shape)
    for run in range(shape[0]):
        active = measured.active[run]
        place = np.where(active, np.cumsum(active, axis=1) - 1, -1)
        alive, fix = pairs._replace(alive=pairs.alive[run : run + 1]), np.nan_to_num(measured.gnss[run])
        motion = measured.dt * measured.velocity[run]
        yield Drive(place, alive, measured.relative[run], assumed, fix_weight[run], fix, motion_weight[run], motion)
