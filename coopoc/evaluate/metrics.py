"""Errors of a Track against its Fleet: RT-LE, maximum, CDF, NEES with its band."""

from __future__ import annotations

import numpy as np
from scipy import stats

from ..arrays import Floats
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..methods.track import Track
from ..world.fleet import Fleet
from ..world.recording import Recording


def errors(track: Track, fleet: Fleet) -> Floats:
    """Distance between estimate and truth, (R, T, E) m."""
    if len(track.t) != len(fleet.t):
        raise InputError(
            "track.t", f"{len(track.t)} steps", f"must have the fleet's {len(fleet.t)} steps",
            "Score a track against the fleet that its recording was observed from.",
        )  # fmt: skip
    return distance(track.x, fleet.position[:, list(track.egos)])


def distance(x: Floats, truth: Floats) -> Floats:
    """(R, T, E) m between estimates (R, T, E, 3) and the truth (T, E, 3).

    >>> distance(np.zeros((1, 1, 1, 3)), np.array([[[1.0, 2.0, 2.0]]])).item()
    3.0
    """
    if use_kernels():
        from ..kernels.scores import distances

        return distances(np.ascontiguousarray(x), np.ascontiguousarray(truth))
    a, b, c = np.moveaxis(x - truth, -1, 0)
    return np.asarray(np.sqrt(a * a + b * b + c * c))


def rt_le(track: Track, fleet: Fleet) -> Floats:
    """Root mean square localization error over time, sqrt(mean_t |x_t - truth_t|^2), (R, E) m (paper, section IV.A).

    >>> from coopoc import Gnss, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> rt_le(Gnss()(observe(fleet, Sensors(), runs=5)), fleet).shape
    (5, 1)
    """
    return np.asarray(np.sqrt(np.mean(errors(track, fleet) ** 2, axis=1)))


def max_error(track: Track, fleet: Fleet) -> Floats:
    """Largest error over time of each run and ego, (R, E) m; a reported maximum is the mean of these over runs."""
    return np.asarray(errors(track, fleet).max(axis=1))


def neighbour_rt_le(track: Track, recording: Recording, fleet: Fleet) -> Floats:
    """Error of what the egos think of their neighbours, sqrt(mean over links |x_j - truth_j|^2), (R, E) m.

    NaN where an ego has no neighbour or the method says nothing about them.
    """
    out = np.full((len(track.x), len(track.egos)), np.nan)
    if track.neighbours is None:
        return out
    mine = [recording.links.of(ego) for ego in track.egos]
    links, ends = np.concatenate(mine), np.cumsum([0, *map(len, mine)])
    truth = fleet.position[recording.links.step[links], recording.links.neighbour[links]]
    if use_kernels():
        from ..kernels.scores import root_mean_squares

        return root_mean_squares(np.ascontiguousarray(track.neighbours), truth, ends)
    for run, theirs in enumerate(track.neighbours):  # a run at a time stays in the cache
        x, y, z = (theirs - truth).T
        square = x * x + y * y + z * z
        for e in range(len(mine)):
            known = square[ends[e] : ends[e + 1]]
            known = known[np.isfinite(known)]
            if len(known):
                out[run, e] = np.sqrt(known.mean())
    return out


def nees(track: Track, fleet: Fleet) -> Floats:
    """Normalised estimation error squared, e^T P^-1 e, (R, T, E); its mean is 3 for a consistent filter.

    NaN where the covariance is zero: at a start that is known, there is nothing to normalise by.
    """
    if track.covariance is None:
        raise InputError(
            "covariance", None, "this method claims none", "NEES needs a method that reports a covariance."
        )
    truth = fleet.position[:, list(track.egos)]
    if use_kernels():
        from ..kernels.scores import normalised

        arrays = (np.ascontiguousarray(values) for values in (track.x, truth, track.covariance))
        values, sound = normalised(*arrays)
        if not sound:
            raise np.linalg.LinAlgError("Singular covariance")
        return values
    found: Floats = np.empty(track.x.shape[:-1])
    for run, (x, cov) in enumerate(zip(track.x, track.covariance, strict=True)):  # a run at a time stays in the cache
        found[run] = _normalised(x - truth, cov)
    return found


def _normalised(error: Floats, cov: Floats) -> Floats:
    """e^T P^-1 e (...,) of errors (..., 3) and covariances (..., 3, 3) by P = L D L^T; NaN where P is zero.

    Raises:
        LinAlgError: a P that is singular.
    """
    xx, xy, xz, yy, yz, zz = (cov[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    a, b, c = np.moveaxis(error, -1, 0)
    certain = (cov == 0).all(axis=(-2, -1)) if (xx == 0).any() else np.zeros(xx.shape, dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = xy / xx, xz / xx
        yy, yz = yy - first * xy, yz - first * xz
        third, b = yz / yy, b - first * a
        zz, c = zz - second * xz - third * yz, c - second * a - third * b
        found = a * a / xx + b * b / yy + c * c / zz
    if not (np.isfinite(found) | certain).all():
        raise np.linalg.LinAlgError("Singular covariance")
    return np.asarray(np.where(certain, np.nan, found))


def nees_band(runs: int, level: float = 0.99, size: int = 3) -> tuple[float, float]:
    """Two-sided chi-square band of the run-averaged NEES of one step, for `runs` runs (Bar-Shalom, section 5.4).

    Steps of one run are not independent, so the band is of each step's average over runs, never of a pool of steps.

    >>> [round(b, 2) for b in nees_band(30)]
    [1.97, 4.28]
    """
    low, high = stats.chi2.ppf([(1 - level) / 2, (1 + level) / 2], size * runs) / runs
    return float(low), float(high)


def nees_inside(track: Track, fleet: Fleet, level: float = 0.99) -> Floats:
    """Share of the steps whose run-averaged NEES lies inside the band, (E,); >= 0.95 passes the consistency gate."""
    found = nees(track, fleet)
    return share_of_average(found.mean(axis=0), len(found), level)


def share_of_average(average: Floats, runs: int, level: float = 0.99) -> Floats:
    """`nees_inside` of the average over `runs` runs of what `nees` has found, (T, E); NaN does not count.

    >>> share_of_average(np.array([[3.0], [9.0]]), 30)
    array([0.5])
    """
    low, high = nees_band(runs, level)
    inside = np.where(np.isnan(average), np.nan, (average >= low) & (average <= high))
    return np.asarray(np.nanmean(inside, axis=0))
