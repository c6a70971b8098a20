"""QCQPRelaxation: ranges and fixes of one step as a QCQP, its semidefinite relaxation, rounded and refined.

    coopoc run side_by_side --set method=joint,examples/qcqp_relaxation.py:QCQPRelaxation max_neighbours=10 runs=2

A method that optimises, in one file: docs/extend.md. It has no memory, and 4.5 m where fixes have 6.1 m.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coopoc.arrays import Floats, Ints, check_fields
from coopoc.methods.egos import Estimate, follow_egos
from coopoc.methods.noise_model import NoiseModel, resolve
from coopoc.methods.star import StarStep, stars
from coopoc.methods.track import Track
from coopoc.optimize.convex.relaxation import shor
from coopoc.optimize.model.problem import Problem
from coopoc.optimize.solve import solve
from coopoc.world.inbox import Inbox
from coopoc.world.recording import Recording
from coopoc.world.v2x import FIX_AND_VELOCITY, Message


@dataclass(frozen=True, eq=False)
class QCQPRelaxation:
    r"""Per step and run: Shor's relaxation of the star's ranges and fixes, rounded, then Gauss-Newton.

    $$
    \min_x \tfrac{1}{2} \sum_i \lVert x_i - z_i \rVert^2 / \sigma_i^2 + \tfrac{1}{2} \sum_j (\lVert x_j - x_0
    \rVert - r_j)^2 / \sigma_r^2
    $$

    is not convex: with a unit vector per range it is a QCQP. Angles are not used, and no step depends on another. Where
    the relaxation is tight the refined point is the global optimum of its step; the notes report how often. A
    semidefinite programme takes milliseconds per step and run, and is not batched: this is a baseline and a certificate
    for short drives. Late fixes, whose axes differ in variance, make it slower. The covariance is that of the problem
    linearised at the point found. A missing fix is the last one brought forward; a vehicle without a range takes no
    part.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.

    References:
        Beck, Stoica and Li, "Exact and Approximate Solutions of Source Localization Problems", IEEE TSP 56, 2008.
    """

    noise_model: NoiseModel | str = "nominal"
    name: str = "qcqp-relaxation"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_fields(self)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent.

        Raises:
            MissingLibraryError: Clarabel is not installed.
        """
        known = resolve(self.noise_model, recording)
        tight: list[bool] = []

        def run_ego(ego: int, box: Inbox) -> Iterator[Estimate]:
            for star, sent in bridged_stars(recording, ego, known, self.message, box):
                used = (sent >= 0) & np.isfinite(star.relative[..., 0])
                points, covariance = np.full_like(star.position, np.nan), np.empty((recording.runs, 3, 3))
                for run in range(recording.runs):
                    members = np.append(0, 1 + np.flatnonzero(used[run]))
                    problem = range_star(star, run, members, known)
                    if len(members) > 1:
                        relaxed = shor(problem)
                        solution = relaxed.solution
                        tight.append(relaxed.tight)
                    else:
                        solution = solve(problem)
                    points[run, members], covariance[run] = solution.x, solution.covariance[0]
                yield Estimate(points[:, 0], covariance, points[:, 1:], star.step, star.link)

        track = follow_egos(self, recording, egos, run_ego)
        share = f"{sum(tight)} of {len(tight)} relaxations were tight"
        return replace(track, notes=(share, *known.notes, *bridging_note(recording)))


def range_star(star: StarStep, run: int, members: Ints, known: NoiseModel) -> Problem:
    """Fixes of these members and the ego's ranges to them in one run, the ego first; no angles."""
    problem = Problem(tuple(map(str, range(len(members)))))
    std = np.sqrt(star.variance[run, members])
    problem = problem.add("position", list(range(len(members))), star.position[run, members], std=std)
    if len(members) == 1:
        return problem
    range_std = 1.0 if known.sensors is None else known.sensors.range_std
    pairs = [(0, j) for j in range(1, len(members))]
    return problem.add("range", pairs, star.relative[run, members[1:] - 1, :1], std=range_std)


def bridged_stars(
    recording: Recording, ego: int, known: NoiseModel, message: Message, box: Inbox
) -> Iterator[tuple[StarStep, Ints]]:
    """The star at every step for a method without a memory, and the steps (R, n-1) of the messages held, -1 for none.

    Where a fix is missing the last one counts, moved by the vehicle's own odometry; without one yet, no position does.
    """
    x, variance = bridged(recording, known)
    variance = np.broadcast_to(variance, x.shape)
    for star in stars(recording, ego, known, message, sent=(x, variance)):
        star.position[:, 0], star.variance[:, 0] = x[:, star.step, ego], variance[:, star.step, ego]
        yield star, box.newest[:, box.start[star.step] : box.start[star.step + 1]]


def bridging_note(recording: Recording) -> tuple[str, ...]:
    """A note on `bridged`, where it has replaced fixes."""
    driving = np.isfinite(recording.velocity)
    share = 100 * (np.isnan(recording.gnss) & driving).sum() / driving.sum()
    note = f"{share:.0f} % of the fixes are missing: the last one is brought forward with the velocity"
    return (note,) if share else ()


def bridged(recording: Recording, known: NoiseModel) -> tuple[Floats, Floats]:
    """All fixes (R, T, N, 3) m and their variances m^2, broadcastable to them; a missing one is the last one moved by
    odometry, z_t = z_{t-1} + dt u_t, whose variance has grown by the process noise."""
    x, variance = recording.gnss, np.ascontiguousarray(known.fix_variance(recording))
    process, missing = np.broadcast_to(known.process_variance(recording), x.shape), np.isnan(x)
    x, variance = x.copy(), np.broadcast_to(variance, x.shape).copy()
    for t in range(1, x.shape[1]):
        gap, moved = missing[:, t], recording.dt * recording.velocity[:, t]
        x[:, t] = np.where(gap, x[:, t - 1] + moved, x[:, t])
        variance[:, t] = np.where(gap, variance[:, t - 1] + process[:, t], variance[:, t])
    x.flags.writeable = False  # as the fixes are, for the same compiled code
    return x, variance
