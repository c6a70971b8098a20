"""Errors of a Track against its Fleet: RT-LE, maximum, heading, NEES; metrics by name; innovations without a truth."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy import errstate, nan
from numpy.linalg import eigvalsh, norm, solve
from scipy import special

from ..arrays import Floats, checked, instance, refuse, whole
from ..errors import InputError
from ..kernels.covariances import normalised
from ..methods.track import UNSOUND, Track, of_recording
from ..plugins import called
from ..world.body_frames import true_heading, turned
from ..world.fleet import Fleet, same_drive
from ..world.links import wrap
from ..world.recording import Recording


def errors(track: Track, fleet: Fleet) -> Floats:
    """Distance between estimate and truth, (R, T, E) m."""
    return np.asarray(norm(_truth(track, fleet) - track.x, axis=-1))


def _truth(track: Track, fleet: Fleet) -> Floats:
    """(T, E, 3) m of the egos; InputError if the fleet is not the one that was recorded."""
    track = instance("track", track, Track, "A method makes one of a recording: the track stands before the fleet.")
    fleet = instance("fleet", fleet, Fleet, "Score a track against its fleet: the track stands before the fleet.")
    egos = np.array(track.egos, int)
    same_drive(fleet, (track.ids or fleet.ids)[: len(fleet.ids)], track.t)  # landmarks come last and have no truth
    hint = "Score a track against the fleet that its recording was observed from."
    refuse("track.egos", egos, egos >= len(fleet.ids), f"must be columns of the fleet, 0..{len(fleet.ids) - 1}", hint)
    return fleet.position[:, egos]


def rt_le(track: Track, fleet: Fleet) -> Floats:
    r"""Root mean square localization error over time, (R, E) m (paper, section IV.A).

    $$ \mathrm{RTLE} = \sqrt{\tfrac{1}{T} \sum_t \lVert \hat x_t - x_t \rVert^2} $$

    The mean is over the steps at which an ego is there and its truth known; NaN where it never is.

    >>> from coopoc import GNSS, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> rt_le(GNSS()(observe(fleet, Sensors(), runs=5)), fleet).shape
    (5, 1)
    """
    squares, present = errors(track, fleet) ** 2, fleet.present[:, list(track.egos)]
    present = present if track.absent is None else present & ~track.absent
    with errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.sum(squares, axis=1, where=present) / present.sum(0)))


def max_error(track: Track, fleet: Fleet) -> Floats:
    """Largest error over time of each run and ego, (R, E) m; a reported maximum is the mean of these over runs."""
    return np.asarray(np.fmax.reduce(errors(track, fleet), axis=1))


def nees(track: Track, fleet: Fleet, *, method: str = "the method") -> Floats:
    r"""Normalised estimation error squared, $e^\top P^{-1} e$, (R, T, E); its mean is 3 for a consistent filter,
    and 2 in the plane, where every height and its estimate are the same.

    NaN where the truth is unknown, or the covariance zero: at a start that is known, there is nothing to normalise by.

    Args:
        track: of a method with covariances.
        fleet: the truth.
        method: its name, for errors.

    Raises:
        InputError: another fleet, no covariance, or one that is singular (but of a height without error), or not
            symmetric and positive semidefinite.
    """
    truth = _truth(track, fleet)
    if track.covariance is None:
        hint = "NEES needs a method that reports a covariance."
        raise InputError("covariance", None, "this method claims none", hint)
    covariance = track.covariance
    if track.absent is not None:
        covariance = np.where(track.absent[..., None, None], np.eye(3), covariance)
    squares = normalised(*map(np.ascontiguousarray, (track.x, truth, covariance)))
    _require_sound(track, covariance, squares, method)
    return squares


def _require_sound(track: Track, p: Floats, square: Floats, method: str) -> None:
    """InputError for the first covariance p (R, T, E, 3, 3) that gives a negative or infinite square (R, T, E), or is
    neither symmetric nor positive semidefinite to a share of 1e-6."""
    wrong = (square < -1e-9) | np.isinf(square)
    if any(UNSOUND in note for note in track.notes):
        own, skew = eigvalsh(np.nan_to_num(p))[..., 0], abs(p - p.mT).max(axis=(-1, -2))
        wrong |= np.minimum(own, -skew) < -1e-6 * abs(p).max(axis=(-1, -2))
    if wrong.any():
        run, step, ego = np.argwhere(wrong)[0]
        actual = f"{p[run, step, ego].tolist()} of ego {track.egos[ego]} in run {run} at step {step}"
        allowed = f"must be symmetric and positive semidefinite, for NEES without a zero, and {method} returns another"
        hint = "Return (P + P.T) / 2; its eigenvalues are variances, m^2: assume noise in every direction."
        raise InputError("covariance", actual, allowed, hint)


def nees_band(runs: int, degrees: int = 3) -> tuple[float, float]:
    """Two-sided 99 % chi-square band of the run-averaged NEES of one step, for `runs` runs (Bar-Shalom, section 5.4).

    Steps of one run are not independent, so the band is of each step's average over runs, never of a pool of steps.

    Args:
        runs: that were averaged.
        degrees: of freedom, 2 in the plane (see `dimensions`).

    >>> [round(b, 2) for b in nees_band(30)]
    [1.97, 4.28]
    """
    runs = whole("runs", runs, 1, hint="Give the number of runs averaged.")
    low, high = special.chdtri(degrees * runs, [0.995, 0.005]) / runs
    return float(low), float(high)


def share_of_average(average: Floats, runs: int, degrees: int = 3) -> Floats:
    """Share (E,) of the steps at which the average over `runs` runs of what `nees` has found, (T, E), lies in its
    `nees_band`; >= 0.95 passes the consistency gate. NaN does not count.

    >>> share_of_average(np.array([[3.0], [9.0]]), 30)
    array([0.5])
    """
    low, high = nees_band(runs, degrees)
    return np.asarray(np.nanmean(np.where(np.isnan(average), nan, (average >= low) & (average <= high)), axis=0))


def heading_error(track: Track, fleet: Fleet) -> Floats:
    """Estimated less true heading, (R, T, E) rad in [-pi, pi); NaN where the truth is unknown.

    Raises:
        InputError: a track without headings, or another fleet's.

    >>> from coopoc import PoseFilter, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[9, 0, 0]]], np.full((2, 1, 3), [9.0, 0, 0]))
    >>> heading_error(PoseFilter("solo")(observe(fleet, Sensors(), frame="body")), fleet).shape
    (1, 2, 1)
    """
    errors(track, fleet)  # checks that both fit each other
    if track.heading is None:
        raise InputError("heading", None, "this method estimates none", "Take a pose filter.")
    return np.asarray(wrap(track.heading - true_heading(fleet)[:, list(track.egos)]))


def pose_nees(track: Track, fleet: Fleet) -> Floats:
    """Normalised estimation error squared of (x, y, heading), (R, T, E); its mean is 3 for a consistent filter.

    Heights stay out: a vehicle on the ground has three degrees of freedom, so that `nees_band(runs)` is its band.

    Raises:
        InputError: as `heading_error`, or a track without covariances.

    >>> from coopoc import PoseFilter, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[9, 0, 0]]], np.full((2, 1, 3), [9.0, 0, 0]))
    >>> pose_nees(PoseFilter("solo")(observe(fleet, Sensors(), runs=5, frame="body")), fleet).shape
    (5, 2, 1)
    """
    turn = heading_error(track, fleet)
    error = np.concatenate([(track.x - _truth(track, fleet))[..., :2], turn[..., None]], axis=-1)
    return np.asarray((error * solve(pose_covariance(track), error[..., None])[..., 0]).sum(-1))


def pose_covariance(track: Track) -> Floats:
    """Covariance (R, T, E, 3, 3) of (x, y, heading), m and rad.

    Raises:
        InputError: a track without covariances.
    """
    if track.covariance is None or track.heading_covariance is None:
        raise InputError("covariance", None, "this method claims none", "NEES needs one.")
    cov = np.empty((*track.x.shape, 3))
    cov[..., :2, :2] = track.covariance[..., :2, :2]
    cov[..., 2, :2] = cov[..., :2, 2] = track.heading_covariance[..., :2]
    cov[..., 2, 2] = track.heading_covariance[..., 3]
    return cov


METRICS: Mapping[str, Callable[[Track, Fleet], Floats]] = {
    "rt_le_m": rt_le,
    "max_error_m": max_error,
    "nees": lambda track, fleet: np.nanmean(nees(track, fleet), 1),
}
"""Column of a table -> function of a Track and its Fleet; a unit that is not SI stands in the name."""


def measure(name: str, track: Track, fleet: Fleet) -> Floats:
    """One metric of a track, (R, E).

    Args:
        name: one of METRICS, an entry point in `coopoc.metrics`, or "mine.py:NAME", a function of Track and Fleet.
        track: the estimates.
        fleet: the truth.

    Raises:
        InputError: an unknown name, another shape than (R, E), or an error of the metric itself.

    >>> from coopoc import GNSS, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> measure("rt_le_m", GNSS()(observe(fleet, Sensors(), runs=5)), fleet).shape
    (5, 1)
    """
    scores = called("coopoc.metrics", name, "Give a function of a Track and a Fleet.", track, fleet)
    return checked(name, scores, "(R, E)", (len(track.x), len(track.egos)))


def fix_innovations(track: Track, recording: Recording) -> Floats:
    """Fix less prediction, z_t - (x_{t-1} + dt u_t), (R, T, E, 3) m; NaN without a fix, and at the first step.

    In body frames u_t is turned by the heading in the middle of the step, h_{t-1} + dt w_t / 2.

    Args:
        track: of the recording.
        recording: whose fixes and velocities were used.

    >>> from coopoc import GNSS, Fleet, Sensors, observe
    >>> seen = observe(Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3))), Sensors(), runs=5)
    >>> fix_innovations(GNSS()(seen), seen).shape
    (5, 2, 1, 3)
    """
    of_recording(track, recording)
    egos, innovations = list(track.egos), np.full(track.x.shape, nan)
    moved = recording.dt * turned(recording.velocity[:, 1:, egos], _halfway(track, recording))
    innovations[:, 1:] = recording.gnss[:, 1:, egos] - (track.x[:, :-1] + moved)
    return innovations


def normalised_innovations(track: Track, recording: Recording) -> Floats | None:
    """d^T S^-1 d / n of the innovations d, (R, T, E): 1 on average if the assumed noise is right and white.

    S = P_{t-1} + dt^2 diag(sigma_u^2) + diag(sigma_fix^2), with the standard deviations that the recording states and
    its `dimensions` n. In body frames sigma_u is turned as u is, and the heading of the track adds its part of S.

    Returns:
        None for a method without a covariance.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
    """
    if track.covariance is None:
        return None
    egos, noise = list(track.egos), recording.sensors
    innovation = fix_innovations(track, recording)
    u, angle = recording.velocity[:, 1:, egos], _halfway(track, recording)
    axes = turned(np.eye(3), angle[..., None])  # rows: the axes of sigma_u
    moving = np.nan_to_num(noise.motion_std(recording.velocity[:, :, egos], recording.dt)[:, 1:])[..., None] * axes
    covariance = track.covariance[:, :-1] + np.einsum("...ki,...kj->...ij", moving, moving)
    fixes = np.square(noise.fix_std * recording.fix_scale[1:, egos])
    covariance[..., range(3), range(3)] += fixes + recording.motion_extra[1:, egos]
    if track.heading_covariance is not None:
        shared, variance = np.split(track.heading_covariance[:, :-1], [3], axis=-1)
        aside = recording.dt * np.nan_to_num(turned(u, angle + np.pi / 2) * [1.0, 1.0, 0.0])
        half = (shared + 0.5 * variance * aside)[..., None] * aside[..., None, :]
        covariance += half + half.mT
    squares, d = np.full(innovation.shape[:3], nan), innovation[:, 1:]
    squares[:, 1:] = np.einsum("...i,...i->...", d, solve(covariance, d[..., None])[..., 0]) / dimensions(recording)
    _require_sound(track, track.covariance, squares, "the method")
    return squares


def _halfway(track: Track, recording: Recording) -> Floats:
    """(R, T-1, E) rad from the frame of odometry to the world in the middle of each step; 0 in the world frame."""
    if recording.body is None or track.heading is None:
        return np.zeros(track.x[:, 1:, :, 0].shape)
    return track.heading[:, :-1] + 0.5 * recording.dt * recording.body.yaw_rate[:, 1:, list(track.egos)]


def dimensions(recording: Recording) -> int:
    """Degrees of freedom of a fix: 3, or 2 where every fix has the same height, which was not measured then.

    >>> from coopoc import Fleet, Sensors, observe
    >>> dimensions(observe(Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3))), Sensors()))
    3
    """
    height = recording.gnss[..., 2]
    return 3 if np.nanmax(height) > np.nanmin(height) else 2


def innovation_columns(track: Track, recording: Recording) -> dict[str, Floats]:
    """Columns (R, E): `innovation_m`, the root mean square of the fixes' innovations, m; `fixes`, their number; `nis`,
    the mean of the normalised ones, 1 if consistent, of a method with a covariance. NaN where there is no second fix.
    """
    square = (fix_innovations(track, recording) ** 2).sum(-1)
    count, normalised_square = np.isfinite(square).sum(1), normalised_innovations(track, recording)
    with errstate(invalid="ignore"):
        columns = {"innovation_m": np.sqrt(np.nansum(square, axis=1) / count), "fixes": count.astype(float)}
        if normalised_square is not None:
            columns["nis"] = np.nansum(normalised_square, axis=1) / count
    return columns
