"""Centralised whole-fleet methods: the Kalman filter of all vehicles in one state, and the whole-drive smoother."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Floats
from ..kernels.gate import FIX_GATE, HARD_REJECT_FACTOR
from ..workers import progress_bar
from ..world.recording import Recording, Vehicles, check_recording
from ..world.sensors import Sensors
from .gaps import in_stretches
from .kalman import fix_noise, solo_filter
from .noise_model import NoiseModel
from .track import Checked, Track
from .whole_fleet import CENTRE, UPLOAD, Answer, fleet_track

if TYPE_CHECKING:
    from ..kernels.fleets.graph import Assumed, Measured, Pairs
    from ..optimize import Problem

STIFF = 1e-5
"""Least noise of a motion over that of a fix: where vehicles hardly move less would hide all other measurements."""
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

    A reference for what cooperation may reach: a relative measurement counts at its step if a message gets through
    between the two vehicles, either way, however late. Bytes are those of the way to the centre and back.

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

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed, _: NoiseModel) -> Answer:
            from ..kernels.fleets.central import run_filter

            x, cov = np.empty(measured.gnss.shape), np.empty((*measured.gnss.shape, 3))
            for run in progress_bar(range(len(x)), desc=self.name, unit="run", delay=2.0):
                x[run], cov[run] = run_filter(measured, pairs, assumed, run)
            return Answer(x, cov, notes)

        relative = check_recording(recording).relative[0]
        alone = np.isnan(relative[:, 0]) & np.isfinite(relative[:, 1])
        notes = (CENTRE, BEARINGS) if 2 * alone.sum() > len(alone) else (CENTRE,)
        return fleet_track(self, self.noise_model, self.robust, recording, egos, solve)


@dataclass(frozen=True, eq=False)
class BatchSmoother(Checked):
    r"""Most probable positions of the whole fleet over the whole drive, by `coopoc.optimize`.

    $$
    \min_x \sum \lVert x_t - x_{t-1} - \Delta t \, u_t \rVert^2_{Q^{-1}} + \sum \lVert z - x \rVert^2_{R^{-1}} +
    \sum \lVert h(x_j - x_i) - y \rVert^2_{C^{-1}}
    $$

    with a point for each vehicle and step (`drive_problem`), from the vehicles' own filters, and marginal covariances.
    Not causal: a reference for what the drive holds. A measurement counts if a message gets through between the two,
    however late.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        robust: what does not fit weighs less, what is far off nothing (`coopoc.kernels.gate`): of fixes, at the
            vehicles' own filters, of relative measurements, at a solution with Huber's loss.
    """

    noise_model: NoiseModel | str = "nominal"
    robust: bool = True
    name: str = "batch-smoother"
    cooperative = True
    message = UPLOAD

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve_all(measured: Measured, pairs: Pairs, assumed: Assumed, model: NoiseModel) -> Answer:
            from ..optimize import Status, solve

            x: Floats = np.full(measured.gnss.shape, np.nan)
            cov: Floats = np.full((*x.shape, 3), np.nan)
            lost = 0
            start = solo_filter(recording, range(x.shape[2]), model, fix_noise(model, assumed.robust))[0]
            for run in progress_bar(range(len(x)), desc=self.name, unit="run", delay=2.0):
                problem = drive_problem(recording, run, start[run], measured, pairs, assumed, model.sensors)
                if assumed.robust:
                    problem = gated(problem)
                solution = solve(problem, "gauss-newton", covariance=True, throw=False)
                lost += solution.status is not Status.SOLVED
                there = measured.active[run]
                x[run, there], cov[run, there] = solution.x, solution.covariance
            note = (f"{lost} of {len(x)} runs did not end at a minimum",) if lost else ()
            return Answer(x, cov, (NOT_CAUSAL, CENTRE, *note))

        return fleet_track(self, self.noise_model, self.robust, recording, egos, solve_all)


def drive_problem(
    recording: Recording,
    run: int,
    start: Floats,
    measured: Measured,
    pairs: Pairs,
    assumed: Assumed,
    sensors: Sensors | None,
) -> Problem:
    """The problem of a whole drive of the fleet: a point per vehicle and step at which it is active.

    Args:
        recording: of all vehicles.
        run: noise realisation.
        start: (T, N, 3) m.
        measured: of all runs.
        pairs: whose measurements count.
        assumed: noise of motions and fixes.
        sensors: relative noise; None: unit covariance of the converted vectors.
    """
    from ..optimize import Problem
    from ..optimize.model.window import drive_factors

    active = measured.active[run]
    step, column = np.nonzero(active)
    fix_std, motion_std = (
        np.sqrt(np.broadcast_to(each, measured.gnss.shape)[run]) for each in (assumed.fix, assumed.process)
    )
    link = np.concatenate([each[pairs.alive[run]] for each in (pairs.link, pairs.link_back)])
    link = np.sort(link[link >= 0])
    stds = fix_std, np.maximum(motion_std, STIFF * fix_std.min())
    if sensors is not None:
        sensors = replace(sensors, min_range=assumed.min_range)
    relative = recording.usable_relative[run, link]
    factors = drive_factors(recording, run, (step, column), link, relative, stds, sensors)
    return Problem(tuple(map(str, range(len(step)))), factors, x0=start[active])


def gated(problem: Problem) -> Problem:
    """A drive whose relative measurements weigh less, or nothing, where they do not fit a solution with Huber's loss,
    from which it starts."""
    from ..optimize import Loss, solve
    from ..optimize.assess.assess import squared
    from ..optimize.model.factor import unchecked

    own = [factor.kind in ("position", "displacement") for factor in problem.factors]
    loss = Loss("huber", FIX_GATE**0.5)
    bent = tuple(f if is_own else unchecked(f, loss=loss) for f, is_own in zip(problem.factors, own, strict=True))
    x = solve(problem.replace_unchecked(factors=bent), "gauss-newton", covariance=False, throw=False, tolerance=0.01).x
    factors = []
    for factor, is_own in zip(problem.factors, own, strict=True):
        q = squared(problem, factor, x)
        share = np.where(q > HARD_REJECT_FACTOR * FIX_GATE, np.inf, np.maximum(q / FIX_GATE, 1.0))
        factors.append(factor if is_own else unchecked(factor, std=np.asarray(factor.std) * np.sqrt(share)[:, None]))
    return problem.replace_unchecked(factors=tuple(factors), x0=x)
