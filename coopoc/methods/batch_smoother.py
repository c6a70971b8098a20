"""The whole-drive smoother at a centre that has the whole fleet: its problem, its bytes, its Track."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Bools, Floats, last_true
from ..errors import InputError
from ..kernels.compiling.waiting import clock
from ..kernels.gate import FIX_GATE, HARD_REJECT_FACTOR
from ..workers import progress_bar
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import Message
from .doubts import doubts
from .kalman import fix_noise, solo_filter
from .noise_model import NoiseModel, resolve
from .odometry_fault import with_odometry
from .track import Checked, Track, in_stretches

if TYPE_CHECKING:
    from ..optimize import Problem

UPLOAD = Message("fix, velocity and relative measurements", 8, per_neighbour=4)
"""To the centre: fix (3), velocity (3), id and time (2); range, two angles and id for each vehicle that is measured."""
DOWNLOAD = Message("estimate and covariance", 11)
"""From the centre: position (3), covariance (6), id and time (2)."""
CENTRE = (
    "needs a centre that every vehicle reaches without delay: lost messages cost relative measurements only, latency "
    "and a byte cap have no effect"
)
NOT_CAUSAL = "not causal: every estimate depends on the whole drive"
MIN_ANGLE_STDS = 0.1
"""Least distance of an angle's noise, over a range's standard deviation, whatever the sensors' `min_range`: the angles
between two vehicles in one place would have so large a weight that all digits are lost."""
STIFF = 1e-5
"""Least ratio of a motion's noise to a fix's. With less, a vehicle that hardly moves would have motions of so large a
weight that rounding hides all other measurements."""


@dataclass(frozen=True, eq=False)
class BatchSmoother(Checked):
    r"""Most probable positions of the whole fleet over the whole drive, by `coopoc.optimize`.

    $$
    \min_x \sum \lVert x_t - x_{t-1} - \Delta t \, u_t \rVert^2_{Q^{-1}} + \sum \lVert z - x \rVert^2_{R^{-1}} +
    \sum \lVert h(x_j - x_i) - y \rVert^2_{C^{-1}}
    $$

    with a point for each vehicle and step (`drive_problem`), from the vehicles' own filters, and marginal covariances.
    Not causal: a reference for what the drive holds. A measurement counts if a message gets through between the two,
    however late. Bytes are those of the way to the centre and back.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        robust: measurements beyond their gate weigh less, far beyond it nothing (`coopoc.kernels.gate`). Fixes are
            gated by the vehicles' own filters, and with the relative measurements at a solution with Huber's loss.
    """

    noise_model: NoiseModel | str = "nominal"
    robust: bool = True
    name: str = "batch-smoother"
    cooperative = whole_fleet = True
    message = UPLOAD

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""
        from ..optimize import Status, solve

        began, columns = clock(), check_recording(recording).columns(egos)
        model, active = resolve(self.noise_model, recording), located(recording)
        counts, robust, lost = counted(recording, active), self.robust and model.exact_relative, 0
        if robust:
            recording, model = with_odometry(recording, recording.observers, model)
        start, _, noise = solo_filter(recording, range(len(recording.ids)), model, fix_noise(model, robust))
        fix = noise if robust else model.fix_variance(recording)
        stds = [np.sqrt(np.broadcast_to(v, start.shape)) for v in (fix, model.process_variance(recording))]
        cov = np.full((*start.shape, 3), np.nan)
        x = np.full_like(start, np.nan)
        for run in progress_bar(range(len(x)), desc=self.name, unit="run", delay=2.0):
            there = active[run]
            problem = drive_problem(recording, run, start[run], there, counts[run], (stds[0][run], stds[1][run]), model)
            problem = gated(problem) if robust and counts[run].any() else problem
            solution = solve(problem, "gauss-newton", covariance=True, throw=False)
            lost += solution.status is not Status.SOLVED
            x[run, there], cov[run, there] = solution.x, solution.covariance
        note = (f"{lost} of {len(x)} runs did not end at a minimum",) if lost else ()
        received, sent = centre(recording, self.message)
        x, cov = x.take(columns, axis=2), cov.take(columns, axis=2)
        notes = (
            *model.notes,
            NOT_CAUSAL,
            CENTRE,
            *note,
            *doubts(recording, columns, x, cov, model, earlier=model.notes),
        )
        moved, seconds = (received[:, columns], sent[:, columns]), clock() - began
        return Track(recording.t, tuple(columns), x, cov, *moved, seconds, notes=notes, ids=recording.ids)


def drive_problem(
    recording: Recording,
    run: int,
    start: Floats,
    active: Bools,
    counts: Bools,
    stds: tuple[Floats, Floats],
    model: NoiseModel,
) -> "Problem":
    """The problem of a whole drive of the fleet: a point per vehicle and step at which it is active.

    Args:
        recording: of all vehicles.
        run: noise realisation.
        start: (T, N, 3) m.
        active: (T, N).
        counts: (L,) whose measurements count.
        stds: (T, N, 3) m of fixes and of motions.
        model: of relative measurements; without sensors, unit covariance of the converted vectors.
    """
    from ..optimize import Problem
    from ..optimize.model.window import drive_factors

    (step, column), link, (fix, motion) = np.nonzero(active), np.flatnonzero(counts), stds
    sensors = model.sensors
    if sensors is not None:
        sensors = replace(sensors, min_range=max(sensors.min_range, MIN_ANGLE_STDS * sensors.relative_std[0]))
    relative = recording.usable_relative[run, link]
    stds = fix, np.maximum(motion, STIFF * fix.min())
    factors = drive_factors(recording, run, (step, column), link, relative, stds, sensors)
    return Problem(tuple(map(str, range(len(step)))), factors, x0=start[active])


def gated(problem: "Problem") -> "Problem":
    """A drive whose fixes and relative measurements weigh less, or nothing, where they do not fit a solution with
    Huber's loss, from which it starts."""
    from ..optimize import Loss, solve
    from ..optimize.assess.assess import squared
    from ..optimize.model.factor import unchecked

    loss, factors = Loss("huber", FIX_GATE**0.5), list(problem.factors)
    judged = [k for k, factor in enumerate(factors) if factor.kind != "displacement"]
    for k in judged:
        factors[k] = unchecked(factors[k], loss=loss)
    bent = problem.replace_unchecked(factors=tuple(factors))
    x = solve(bent, "gauss-newton", covariance=False, throw=False, tolerance=0.01).x
    for k in judged:
        factor = problem.factors[k]
        q = squared(problem, factor, x)
        share = np.where(q > HARD_REJECT_FACTOR * FIX_GATE, np.inf, np.maximum(q / FIX_GATE, 1.0))
        factors[k] = unchecked(factor, std=np.asarray(factor.std) * np.sqrt(share)[:, None])
    return problem.replace_unchecked(factors=tuple(factors), x0=x)


def centre(recording: Recording, upload: Message) -> tuple[Floats, Floats]:
    """Bytes (R, N) over the drive that every vehicle receives of a centre's answers, and sends of its `upload`."""
    links, overhead, present = recording.links, recording.v2x.overhead, recording.present
    measured = np.zeros(present.shape, int)
    np.add.at(measured, (links.step, links.observer), 1)
    sent = (present * upload.size(overhead, measured)).sum(axis=0, dtype=float)
    received = present.sum(0) * float(DOWNLOAD.size(overhead))
    runs = np.ones((recording.runs, 1))
    return runs * received, runs * sent


def counted(recording: Recording, active: Bools) -> Bools:
    """(R, L) which measurements reach the centre: both vehicles are `active` (R, T, N), and the message of one of them
    gets through to the other.

    Raises:
        InputError: the links of some vehicles were not recorded.
    """
    if silent := sorted(set(range(len(recording.ids))) - set(recording.observers)):
        names = f"without {[recording.ids[c] for c in silent[:4]]}"
        raise InputError("observers", names, "must be all vehicles here", "Leave observe(..., observers=...) out.")
    links, arrival = recording.links, recording.arrival
    ends = np.sort([links.observer, links.neighbour], 0)
    _, pair = np.unique(np.stack([links.step, *ends]), axis=1, return_inverse=True)
    arrives = (arrival >= 0) & (arrival - links.step <= recording.v2x.max_age / recording.dt + 1e-9)
    heard = np.zeros((len(links), recording.runs), bool)
    np.logical_or.at(heard, pair, arrives.T)
    return heard[pair].T & active[:, links.step, links.observer] & active[:, links.step, links.neighbour]


def located(recording: Recording) -> Bools:
    """(R, T, N) True from a vehicle's first fix on, for as long as it is present.

    A vehicle that has no fix yet has no position to linearise at: until then it takes no part.
    """
    present = recording.present
    joined = last_true(present & ~np.concatenate([np.zeros_like(present[:1]), present[:-1]]))
    return present & (last_true(np.isfinite(recording.gnss).all(-1), axis=1) >= joined)
