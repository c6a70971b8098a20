"""Posterior Cramer-Rao bounds of an information set: solo, star or whole fleet; of positions or of poses.

One recursion over the steps of a drive with members that come and go serves all, filtering or smoothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.linalg import inv
from scipy.linalg import block_diag

from ..arrays import Bools, Floats, Ints, checked, instance, refuse
from ..errors import InputError
from ..kernels.poses.odometry import UNKNOWN_HEADING_RAD2
from ..kernels.stars.messages import FORGOTTEN
from ..workers import one_thread, progress_bar
from ..world.body_frames import body_motion, midway, true_heading, turned
from ..world.fleet import Fleet, columns, same_drive
from ..world.links import Links, directions, spherical
from ..world.recording import Recording, Vehicles
from ..world.sensing import find_links
from ..world.sensors import Sensors
from ..world.v2x import V2X

NO_ERROR = 1e-18
"""m^2, variance of an error of the fixes that there is not."""
MIN_DISTANCE = 1e-3
"""m, below which an angle's information would cancel all other; nearer in the plane, vehicles have no azimuth."""


def posterior_bound(
    fleet: Fleet,
    sensors: Sensors,
    ego: int | str,
    v2x: V2X | None = None,
    *,
    smoothing: bool = False,
    past: bool = False,
    recording: Recording | None = None,
) -> Floats:
    r"""Bound covariance of the ego's position at every step, (T, 3, 3) m^2.

    $$ J_t = (Q_t + J_{t-1}^{-1})^{-1} + F_t $$

    for filtering (Tichavsky, Muravchik, Nehorai 1998), $F_t$ the Fisher information of the
    fixes and relative measurements at the true positions, Q_t the true motion noise. Smoothing adds the information of
    the future. The information set is the ego's own measurements (solo, `v2x` None or K = 0), also the fixes and
    velocities of the linked neighbours over an ideal channel (star); a vehicle that leaves the star is forgotten, as
    its motion is not received. The bias is left out: it is unobservable from a GNSS start. Drift and common errors of
    the fixes are unknowns beside the positions (filtering only). Outliers are not in the sensors' information: under
    outliers and attacks the bound is that of an estimator without the wrong measurements: give a `recording` that
    lacks them.

    Args:
        fleet: truth.
        sensors: the noise that acts, stds positive.
        ego: column or id.
        v2x: K and radius, not loss.
        smoothing: use measurements after t, too.
        past: the bound of an ego that also knows the fixes and velocities of neighbours from before they joined its
            star, as messages with sums since departure convey them. It is never above the star's bound, and equal to it
            while the same neighbours stay.
        recording: of this drive, such as `observe(..., remove_outliers=True)`: a fix, a range or an angle that it lacks
            (NaN) is not measured, and the bound is the mean over its runs. Default: all is measured.

    Raises:
        InputError: an acting std of zero, for which the bound is zero; an ego that is unknown or absent; a recording
            of other vehicles, steps or links.

    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> float(posterior_bound(fleet, Sensors(gnss_std=(2, 2, 2)), 0)[1, 0, 0])  # standing still: 4 / 2
    2.0
    """
    v2x, column = checked_noise(fleet, sensors, v2x), fleet.index(ego)
    if not fleet.present[:, column].all():
        raise InputError("ego", fleet.ids[column], "is absent at some steps", "Choose another or cut the drive.")
    links = find_links(fleet, [column], v2x, sensors.min_range)
    if instance("past", past, bool, "Give True for what messages bring of newcomers."):
        ever = np.isin(np.arange(len(fleet.ids)), [column, *links.neighbour])  # the others say nothing about it
        members = [np.flatnonzero(row & ever) for row in fleet.present]
    else:
        steps = np.split(links.neighbour, np.searchsorted(links.step, np.arange(1, len(fleet.t))))
        members = [np.append(column, near) for near in steps]
    return _bound(fleet, sensors, links, members, smoothing, recording)[:, column]


def fleet_bound(
    fleet: Fleet,
    sensors: Sensors,
    v2x: V2X | None = None,
    *,
    smoothing: bool = False,
    recording: Recording | None = None,
) -> Floats:
    """Bound covariances (T, N, 3, 3) m^2 of all vehicles from all that any of them measures; NaN where absent.

    Args and errors: as in `posterior_bound`.

    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> rigid = Sensors(gnss_std=(2, 2, 2), range_std=1e-3)
    >>> float(fleet_bound(fleet, rigid, V2X())[0, 1, 0, 0].round(3))  # two fixes for one body: 4 / 2
    2.0
    """
    v2x = checked_noise(fleet, sensors, v2x)
    links = find_links(fleet, range(len(fleet.ids)), v2x, sensors.min_range)
    return _bound(fleet, sensors, links, [np.flatnonzero(row) for row in fleet.present], smoothing, recording)


def pose_bound(fleet: Fleet, sensors: Sensors, v2x: V2X | None = None, *, landmarks: Vehicles = ()) -> Floats:
    """Bound covariances of (x, y, z, heading, ...) of all vehicles from all that any measures, filtering.

    J_t = (F_t J_{t-1}^-1 F_t^T + G_t Q_t G_t^T)^-1 + H_t^T R^-1 H_t (Tichavsky, Muravchik, Nehorai 1998) with the
    derivatives of `PoseFilter`'s motion and measurements at the truth. Each error that lasts and acts is one more
    state, in this order: the speed's scale, the yaw rate's bias, the compass's bias. First positions have no prior,
    first headings are uniform over a turn. Outliers do not count.

    Args:
        fleet: truth.
        sensors: the noise that acts.
        v2x: K and radius, not loss; None or K = 0: each vehicle alone with its landmarks.
        landmarks: columns or ids of vehicles that stand at known positions.

    Returns:
        (T, N, d, d) m and rad, NaN where absent and for landmarks.

    Raises:
        InputError: an acting std of zero, for which the bound is zero; drifting fixes.

    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> alone, together = (pose_bound(fleet, Sensors(compass=False), V2X(k))[0, 0, 3, 3] for k in (0, 1))
    >>> bool(together < 0.1 * alone)  # a bearing of a neighbour with a fix gives a heading
    True
    """
    marks = columns("landmarks", landmarks, instance("fleet", fleet, Fleet).ids)
    v2x = checked_noise(fleet, sensors, v2x, bool(marks))
    links = find_links(fleet, range(len(fleet.ids)), v2x, sensors.min_range, marks)
    members = [np.setdiff1d(np.flatnonzero(row), marks) for row in fleet.present]
    return _marginals(fleet, pose_stages(fleet, sensors, links, members), smoothing=False)


def bound_rt_le(cov: Floats) -> float:
    """RT-LE that belongs to a bound (T, 3, 3), sqrt(mean_t trace P_t), m.

    Raises:
        InputError: another shape, numbers that are not finite, or a negative trace.
    """
    cov = checked("cov", cov, "(T, 3, 3)", (-1, 3, 3))
    refuse("cov", cov, ~np.isfinite(cov), "must be finite", "Take the steps at which the ego is there.")
    square = np.trace(cov, axis1=-2, axis2=-1)
    refuse("trace of cov", square, square < 0.0, "must be >= 0: variances, m^2", "Give a covariance, no information.")
    return float(np.sqrt(square.mean()))


def checked_noise(fleet: Fleet, sensors: Sensors, v2x: V2X | None, landmarks: bool = False) -> V2X:
    """The channel, None being none; InputError for an acting std of zero."""
    instance("fleet", fleet, Fleet)
    instance("sensors", sensors, Sensors)
    v2x = V2X(max_neighbours=0) if v2x is None else instance("v2x", v2x, V2X)
    if min(sensors.gnss_std) <= 0:
        raise InputError("gnss_std", sensors.gnss_std, "must be > 0", "With exact fixes the bound is zero.")
    if (v2x.max_neighbours or landmarks) and min(sensors.relative_std) <= 0:
        raise InputError("relative_std", sensors.relative_std, "must be > 0", "An exact one merges two vehicles.")
    return v2x


class Measured(NamedTuple):
    """What is measured in one run.

    Attributes:
        fixes: (T, N).
        relative: (L, 3), of the links of the bound.
    """

    fixes: Bools
    relative: Bools


def _bound(
    fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints], smoothing: bool, recording: Recording | None
) -> Floats:
    """Bound covariances (T, N, 3, 3) m^2 of positions, NaN for those that are no members; the mean over runs."""
    if instance("smoothing", smoothing, bool, "Give True for the bound of a smoother."):
        require_white(sensors, "the smoothing bound")
    runs = [None] if recording is None else _measured(fleet, links, np.unique(np.concatenate(members)), recording)
    total = np.zeros(())
    for run in runs:
        total = total + _marginals(fleet, position_stages(fleet, sensors, links, members, run), smoothing)[..., :3, :3]
    return total / len(runs)


def _measured(fleet: Fleet, links: Links, members: Ints, recording: Recording) -> list[Measured | None]:
    """What the members measure in each run; one run where all measure the same.

    Raises:
        InputError: a recording of other vehicles or steps, or one that lacks a link.
    """
    instance("recording", recording, Recording, "Give observe(..., remove_outliers=True).")
    same_drive(fleet, recording.ids, recording.t)
    recorded, wanted = (
        list(zip(of.step.tolist(), of.observer.tolist(), of.neighbour.tolist(), strict=True))
        for of in (recording.links, links)
    )
    row_of = {link: k for k, link in enumerate(recorded)}
    rows = [row_of.get(link, -1) for link in wanted]
    if -1 in rows:
        hint = "Observe the fleet with the same K and radius, and name the ego among the observers."
        raise InputError("recording", repr(recording), "must hold the links of the bound", hint)
    fixes, relative = np.isfinite(recording.gnss[..., 0]), np.isfinite(recording.relative[:, rows])
    alike = all((part == part[:1]).all() for part in (fixes[:, :, members], relative))
    return [Measured(fixes[r], relative[r]) for r in range(1 if alike else recording.runs)]


def _marginals(fleet: Fleet, stages: "list[Stage]", smoothing: bool) -> Floats:
    """(T, N, d, d) of each member from the covariances of all at each step."""
    d, vehicles = stages[0].motion.shape[-1], len(fleet.ids)
    out = np.full((*fleet.position.shape[:2], d, d), np.nan)
    for t, cov in covariances(stages, smoothing):
        n, members = len(stages[t].members), stages[t].members
        out[t, members[members < vehicles]] = cov.reshape(n, d, n, d)[np.arange(n), :, np.arange(n)][members < vehicles]
    return out


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of n members with d numbers each, at the truth.

    Attributes:
        members: (n,) columns.
        previous: (n,) their places one step before, -1 for a new member.
        motion: (n, d, d) derivatives F of a member's state by the one before.
        process: (n, d, d) covariance Q of the motion.
        prior: (n, d) information of what is known of a new member's numbers.
        gained: (dn, dn) information of the step's measurements.
    """

    members: Ints
    previous: Ints
    motion: Floats
    process: Floats
    prior: Floats
    gained: Floats


def position_stages(
    fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints], measured: Measured | None
) -> list[Stage]:
    """Every step of the positions of vehicles (columns) that are members of it.

    Where fixes have time-correlated errors, z = x + own + common + white noise, each member has its own error as three
    more states, and one more member, in the last column, has the common error as its first three. Errors are
    Gauss-Markov, e_t = keep e_{t-1} + w. Where not all is `measured`, positions have a weak prior, so that a member
    without any measurement has a covariance.
    """
    drifts, white, stages = drifting(sensors), 1.0 / np.square(sensors.gnss_std), list[Stage]()
    own, common = (max(std**2, NO_ERROR) for std in (sensors.gnss_drift_std, sensors.gnss_common_std))
    keep, d = float(np.exp(-fleet.dt / sensors.gnss_drift_time)), 6 if drifts else 3
    behind = [len(fleet.ids)] if drifts else []
    rows_of = [np.append(row, behind).astype(int) for row in members]
    for now, previous, edges in steps_of(fleet, links, rows_of, measured and measured.relative):
        t, n, m = len(stages), len(now), len(now) - len(behind)
        motion, process, prior = np.ones((n, d)), np.zeros((n, d)), np.zeros((n, d))
        process[:m, :3] = (fleet.dt * sensors.velocity_std(fleet.velocity[t, now[:m]])) ** 2
        rows, weight = np.kron(np.eye(m, n), np.eye(3, d) + np.eye(3, d, 3)), np.tile(white, m)
        if drifts:
            motion[:m, 3:], process[:m, 3:], prior[:m] = keep, own * (1 - keep**2), [1 / FORGOTTEN] * 3 + [1 / own] * 3
            motion[m, :3], process[m, :3], prior[m] = keep, common * (1 - keep**2), [1 / common] * 3 + [1.0] * 3
            rows[:, m * d : m * d + 3] = np.tile(np.eye(3), (m, 1))
        if measured:
            weight *= np.repeat(measured.fixes[t, now[:m]], 3)
            prior[:m, :3] = np.maximum(prior[:m, :3], 1 / FORGOTTEN)
        gained = edge_information(edges, (n, d), sensors.relative_std) + (rows.T * weight) @ rows
        unit = np.eye(d)
        stages.append(Stage(now, previous, motion[..., None] * unit, process[..., None] * unit, prior, gained))
    return stages


def pose_stages(fleet: Fleet, sensors: Sensors, links: Links, members: list[Ints]) -> list[Stage]:
    """Every step of the poses of vehicles (columns) that are members of it.

    Raises:
        InputError: an exact compass, or fixes whose errors drift.
    """
    require_white(sensors, "the bound of poses")
    if sensors.compass and sensors.heading_std <= 0:
        raise InputError("heading_std", sensors.heading_std, "must be > 0", "Give a small one, or compass=False.")
    acting = (sensors.speed_scale_std, sensors.yaw_rate_bias_std, sensors.heading_bias_std * sensors.compass)
    lasting = [kind for kind, std in enumerate(acting) if std > 0]
    own, d = _own(sensors, lasting), 4 + len(lasting)
    prior = np.r_[0, 0, 0, 1.0 / UNKNOWN_HEADING_RAD2, 1.0 / np.square([acting[kind] for kind in lasting])]
    motion, process = _motion(fleet, sensors, lasting)
    stages = list[Stage]()
    for now, previous, edges in steps_of(fleet, links, members):
        t, n = len(stages), len(now)
        gained = edge_information(edges, (n, d), sensors.relative_std, posed=True) + np.kron(np.eye(n), own)
        stages.append(Stage(now, previous, motion[t, now], process[t, now], np.tile(prior, (n, 1)), gained))
    return stages


def _own(sensors: Sensors, lasting: list[int]) -> Floats:
    """Information (d, d) of a fix and a compass, which measures its bias with the heading."""
    rows = np.eye(4, 4 + len(lasting))
    if 2 in lasting:
        rows[3, 4 + lasting.index(2)] = 1.0
    weight = np.append(1.0 / np.square(sensors.fix_std), sensors.heading_std**-2.0 if sensors.compass else 0.0)
    return np.asarray((rows.T * weight) @ rows)


def _motion(fleet: Fleet, sensors: Sensors, lasting: list[int]) -> tuple[Floats, Floats]:
    """Derivatives F (T, N, d, d) of th' = th + dt (w - b), p' = p + dt R(th + dt (w - b) / 2) u / (1 + s) at the truth,
    and the covariance Q (T, N, d, d) of its noise."""
    (forward, _), dt, d = body_motion(fleet), fleet.dt, 4 + len(lasting)
    heading = midway(true_heading(fleet))
    moved, shape = dt * turned(forward, heading), heading.shape
    aside = np.stack([-moved[..., 1], moved[..., 0], np.zeros(shape)], -1)
    motion, noise = np.zeros((*shape, d, d)), np.zeros((*shape, d, d))
    motion[...] = np.eye(d)
    motion[..., :3, 3] = aside
    noise[..., :3, :3] = dt * turned(sensors.velocity_std(forward)[..., None] * np.eye(3), heading[..., None]).mT
    noise[..., :3, 3], noise[..., 3, 3] = 0.5 * dt * sensors.yaw_rate_std * aside, dt * sensors.yaw_rate_std
    keep = float(np.exp(-dt / sensors.odometry_error_time))
    for column, kind in enumerate(lasting, 4):
        if kind == 0:
            motion[..., :3, column] = -moved
        elif kind == 1:
            motion[..., :3, column], motion[..., 3, column] = -0.5 * dt * aside, -dt
        if kind < 2:
            fresh = (sensors.speed_scale_std, sensors.yaw_rate_bias_std)[kind] * np.sqrt(1.0 - keep**2)
            motion[..., column, column], noise[..., column, column] = keep, fresh
    return motion, noise @ noise.mT


class Edges(NamedTuple):
    """E relative measurements.

    Attributes:
        vector: (E, 3) m, true.
        observer: (E,) place among the members.
        neighbour: (E,) place, -1 if it is no member.
        measured: (E, 3) whether range, azimuth and inclination are measured; True: all are.
    """

    vector: Floats
    observer: Ints
    neighbour: Ints
    measured: Bools | bool


def steps_of(
    fleet: Fleet, links: Links, members: list[Ints], measured: Bools | None = None
) -> Iterator[tuple[Ints, Ints, Edges]]:
    """Members of each step, their places one step before (-1 for new ones), and its true vectors."""
    start, before = np.searchsorted(links.step, np.arange(len(fleet.t) + 1)), np.full(len(fleet.ids) + 1, -1)
    for t, now in enumerate(members):
        index = np.full(len(before), -1)
        index[now] = np.arange(len(now))
        observer, neighbour = (side[start[t] : start[t + 1]] for side in (links.observer, links.neighbour))
        vector = fleet.position[t, neighbour] - fleet.position[t, observer]
        part = True if measured is None else measured[start[t] : start[t + 1]]
        yield now, before[now], Edges(vector, index[observer], index[neighbour], part)
        before = index


def edge_information(edges: Edges, sizes: tuple[int, int], std: Floats, *, posed: bool = False) -> Floats:
    """Information (dn, dn) of relative measurements about n members of d numbers.

    A measured vector v moves by dp_j - dp_i, and with the observer's heading by -dth (-v_y, v_x, 0).

    Args:
        edges: of the step.
        sizes: n and d.
        std: (3,) m, rad, rad.
        posed: whether the fourth number is the heading.
    """
    (vector, observer, neighbour, _), (n, d) = edges, sizes
    own, other = np.zeros((2, len(vector), 3, d))
    own[..., :3] = -np.eye(3)
    if posed:
        own[:, 0, 3], own[:, 1, 3] = vector[:, 1], -vector[:, 0]
    other[..., :3] = np.eye(3) * (neighbour >= 0)[:, None, None]
    weight = vector_information(edges, std)
    information, ends = np.zeros((n, n, d, d)), ((observer, own), (np.maximum(neighbour, 0), other))
    for here, rows in ends:
        for there, others in ends:
            np.add.at(information, (here, there), rows.mT @ weight @ others)
    return information.swapaxes(1, 2).reshape(n * d, n * d)


def vector_information(edges: Edges, std: Floats) -> Floats:
    r"""Information (E, 3, 3) 1/m^2 of relative vectors, $\sum_k \nabla h_k \nabla h_k^\top / \sigma_k^2$ over what is
    measured of range, azimuth and inclination."""
    away, azimuth, inclination = spherical(*edges.vector.T)
    levers = np.stack([np.ones_like(away), np.hypot(*edges.vector[:, :2].T), away], 1)
    gradients = directions(azimuth, inclination) / np.maximum(levers, MIN_DISTANCE)[..., None]
    weight = np.square(std) ** -1.0 * edges.measured * (levers > [0.0, MIN_DISTANCE, 0.0])
    return np.asarray(gradients.mT @ (weight[..., None] * gradients))


def covariances(stages: list[Stage], smoothing: bool) -> Iterator[tuple[int, Floats]]:
    """Steps and the bound (dn, dn) of their members: forward, or for smoothing from the last step to the first, by the
    recursion of Rauch, Tung and Striebel."""
    filtered = []
    cov: Floats = np.zeros((0, 0))
    bar = progress_bar(total=len(stages) * (1 + smoothing), desc="bound", unit="step", delay=2.0)
    with bar, one_thread():
        for t, stage in enumerate(stages):
            _, now, _, moved = _moved(cov, stage)
            information = np.diag(stage.prior.ravel())
            information[np.ix_(now, now)] = inv(moved)  # (F P F^T + Q)^-1
            cov = inv(information + stage.gained)
            bar.update()
            if smoothing:
                filtered.append(cov)
            else:
                yield t, cov
        for t in range(len(filtered) - 1, -1, -1):
            yield t, cov
            if t:
                before, now, motion, moved = _moved(filtered[t - 1], stages[t])
                gain = filtered[t - 1][:, before] @ motion.T @ inv(moved)
                cov = filtered[t - 1] + gain @ (cov[np.ix_(now, now)] - moved) @ gain.T
            bar.update()


def drifting(sensors: Sensors) -> bool:
    """Whether fixes have time-correlated errors."""
    return sensors.gnss_drift_std > 0 or sensors.gnss_common_std > 0


def require_white(sensors: Sensors, what: str) -> None:
    """InputError where fixes have time-correlated errors and `what` takes them as white."""
    if drifting(sensors):
        lasting_stds = (sensors.gnss_drift_std, sensors.gnss_common_std)
        hint = "Set them to 0, or take the filtering one."
        raise InputError("gnss_drift_std, gnss_common_std", lasting_stds, f"must be 0 for {what}", hint)


def _moved(cov: Floats, stage: Stage) -> tuple[Ints, Ints, Floats, Floats]:
    """Of the members that stay: places of their numbers one step before and now, F, and F P F^T + Q."""
    stays, none = np.flatnonzero(stage.previous >= 0), np.zeros((0, 0))
    d = stage.motion.shape[-1]
    before, now = (np.add.outer(d * of, np.arange(d)).ravel() for of in (stage.previous[stays], stays))
    motion, process = (block_diag(*of[stays], none) for of in (stage.motion, stage.process))
    return before, now, motion, motion @ cov[np.ix_(before, before)] @ motion.T + process
