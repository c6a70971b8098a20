"""Centralised whole-fleet methods: the Kalman filter of all vehicles in one state, and the whole-drive smoother."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import TINY, Floats
from ..workers import progress_bar
from ..world.recording import Recording, Vehicles, check_recording
from .gaps import in_stretches
from .noise_model import NoiseModel
from .track import Checked, Track, check_options
from .whole_fleet import CENTRE, UPLOAD, Answer, fleet_track

if TYPE_CHECKING:
    from ..kernels.fleets.graph import Assumed, Measured, Pairs

NOT_CAUSAL = "not causal: every estimate depends on the whole drive"
BEARINGS = (
    "most ranges are missing: bearings alone are taken at believed distances, whose errors they share, and covariances "
    "are too small; joint and the batch smoother hold"
)


@dataclass(frozen=True, eq=False)
class CentralFilter(Checked):
    r"""Kalman filter of all vehicles in information form, causal: the optimum of the same measurements.

    $$ \Lambda = P^{-1} + \mathrm{blkdiag}(R_i^{-1}) + B \, \mathrm{blkdiag}(W_e) \, B^\top $$

    over every pair $e$ of the fleet, $B$ its incidence matrix and $W_e$ the information of range and angles, linearised
    where prediction and measurement agree: to four digits the accuracy of a converted update followed by an exact
    Gauss-Newton step, at one solution a step. Cost O(n^3) of the n vehicles of a connected component, over others or at
    earlier steps: between components, covariances are zero.

    A relative measurement reaches the centre if a message gets through between the two vehicles, either way. Bytes are
    those of the way to the centre and back.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        robust: an innovation beyond its gate weighs less, far beyond it nothing (`coopoc.kernels.gate`); False believes
            every number.
    """

    noise_model: NoiseModel | str = "nominal"
    robust: bool = True
    name: str = "central-filter"
    cooperative = True
    message = UPLOAD

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.central import run_filter
            from ..kernels.fleets.graph import of_runs

            runs = len(measured.active)
            together = runs if share_covariance(measured, pairs, assumed) else 1
            x, cov = np.empty(measured.gnss.shape), np.empty((*measured.gnss.shape, 3))
            for run in progress_bar(range(0, runs, together), desc=self.name, unit="run", delay=2.0):
                some = slice(run, run + together)
                x[some], cov[some] = run_filter(*of_runs(measured, pairs, assumed, some))
            return Answer(x, cov, None, notes)

        relative = check_recording(recording).relative[0]
        alone = np.isnan(relative[:, 0]) & np.isfinite(relative[:, 1])
        notes = (CENTRE, BEARINGS) if 2 * alone.sum() > len(alone) else (CENTRE,)
        return fleet_track(self, self.noise_model, self.robust, recording, egos, solve, central=True)


def share_covariance(measured: Measured, pairs: Pairs, assumed: Assumed) -> bool:
    """Whether the covariance is the same in all runs: unit noise, and the same measurements and messages."""
    constant = len(assumed.std) == 0 and len(assumed.process) == len(assumed.fix) == 1
    if not constant or (measured.relative[..., 0] < 0).any() or (measured.relative[..., 1:] == 0).any():
        return False
    alike = (measured.active, pairs.alive, np.isnan(measured.gnss))
    return all(bool((each == each[:1]).all()) for each in alike)


@dataclass(frozen=True, eq=False)
class BatchSmoother:
    r"""Most probable positions of the whole fleet over the whole drive.

    $$
    \min_x \sum \lVert x_t - x_{t-1} - \Delta t \, u_t \rVert^2_{Q^{-1}} + \sum \lVert z - x \rVert^2_{R^{-1}} +
    \sum \lVert h(x_j - x_i) - y \rVert^2_{C^{-1}}
    $$

    The converted measurements make a linear problem; from its solution one exact Gauss-Newton step on range and angles
    is enough on average. Steps with the same factors, each a tenth of its cost, follow until none moves a position by
    `settle`: then it is the most probable drive. A step that raises the cost is halved, and the next one linearised
    anew: where angles are noisy and fixes poor, a whole step may leave by kilometres. Time makes the normal
    equations block-tridiagonal with blocks of 3N x 3N, and motion noise is diagonal, so that one sweep eliminates step
    after step,

    $$ S_t = J_t + D, \qquad J_{t+1} = D S_t^{-1} J_t + F_{t+1}, \qquad D = \mathrm{diag}(1 / q), $$

    and one sweep back gives positions and their marginal covariances, $\Sigma_t = S_t^{-1} + S_t^{-1} D \Sigma_{t+1} D
    S_t^{-1}$.

    Not causal: a reference for what the drive holds. O(T (3N)^3) and T (3N)^2 numbers per sweep, one run at a time:
    60 vehicles and 900 steps take 230 MB. A measurement counts if a message gets through between the two, however late.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        exact_steps: Gauss-Newton steps after the linear solution.
        settle: m, the largest step to stop at; inf stops after those.
        robust: what does not fit the solution weighs less, what is far off nothing (`coopoc.kernels.gate`); weights are
            set at the vehicles' own filters, and at each of the solutions that follow.
    """

    noise_model: NoiseModel | str = "nominal"
    exact_steps: int = 1
    settle: float = 1e-3
    robust: bool = True
    name: str = "batch-smoother"
    cooperative = True
    message = UPLOAD

    def __post_init__(self) -> None:
        steps = (0, 1e18, "a whole number >= 0, 0 for linear only")
        check_options(self, {"exact_steps": steps, "settle": (TINY, np.inf, "> 0 m, infinity for no further steps")})

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.graph import of_runs, own_filters
            from ..kernels.fleets.smoother import run_factors, smooth

            steps = self.exact_steps if len(assumed.std) else 0
            x, lost = own_filters(measured, assumed).reshape(measured.gnss.shape), 0
            cov: Floats = np.empty((*x.shape, 3))
            with progress_bar(total=len(x) * (1 + steps) * len(x[0]), desc=self.name, unit="step", delay=2.0) as bar:
                for run in range(len(x)):
                    factors = run_factors(*of_runs(measured, pairs, assumed, slice(run, run + 1)))
                    x[run], cov[run], small = smooth(x[run], factors, steps, self.settle, bar.update)
                    lost += not small
            note = (f"{lost} of {len(x)} runs did not settle within {self.settle:g} m",) if lost else ()
            return Answer(x, cov, 0, (NOT_CAUSAL, CENTRE, *note))

        return fleet_track(self, self.noise_model, self.robust, recording, egos, solve, central=True)
