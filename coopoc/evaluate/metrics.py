"""Errors of a Track against its Fleet: RT-LE, maximum, CDF, NEES with its band."""

from __future__ import annotations

import numpy as np
from scipy import stats

from ..arrays import Floats, instance, number, refuse
from ..errors import InputError
from ..kernels.scores import distances, normalised, root_mean_squares
from ..methods.track import Track
from ..world.fleet import Fleet
from ..world.recording import Recording


def errors(track: Track, fleet: Fleet) -> Floats:
    """Distance between estimate and truth, (R, T, E) m."""
    truth = _truth(track, fleet)
    return distance(track.x, truth)


def _truth(track: Track, fleet: Fleet) -> Floats:
    """(T, E, 3) m of the egos; InputError if the fleet is not the one that was recorded."""
    track = instance("track", track, Track, "A method makes one of a recording: the track stands before the fleet.")
    fleet = instance("fleet", fleet, Fleet, "Score a track against its fleet: the track stands before the fleet.")
    egos = np.array(track.egos, dtype=np.int64)
    hint = "Score a track against the fleet that its recording was observed from."
    if len(track.t) != len(fleet.t):
        raise InputError("track.t", f"{len(track.t)} steps", f"must have the fleet's {len(fleet.t)} steps", hint)
    refuse("track.egos", egos, egos >= len(fleet.ids), f"must be columns of the fleet, 0..{len(fleet.ids) - 1}", hint)
    return fleet.position[:, egos]


def distance(x: Floats, truth: Floats) -> Floats:
    """(R, T, E) m between estimates (R, T, E, 3) and the truth (T, E, 3).

    >>> distance(np.zeros((1, 1, 1, 3)), np.array([[[1.0, 2.0, 2.0]]])).item()
    3.0
    """
    if x.shape[1:] != truth.shape:
        allowed = f"must have shape (T, E, 3) = {x.shape[1:]}"
        raise InputError("truth", f"shape {truth.shape}", allowed, "Give the truth of the same egos and steps.")
    return distances(np.ascontiguousarray(x), np.ascontiguousarray(truth))


def rt_le(track: Track, fleet: Fleet) -> Floats:
    """Root mean square localization error over time, sqrt(mean_t |x_t - truth_t|^2), (R, E) m (paper, section IV.A).

    The mean is over the steps at which the truth of an ego is known; NaN where it never is.

    >>> from coopoc import GNSS, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> rt_le(GNSS()(observe(fleet, Sensors(), runs=5)), fleet).shape
    (5, 1)
    """
    squares = errors(track, fleet) ** 2
    known = fleet.present[:, list(track.egos)]
    if known.all():
        return np.asarray(np.sqrt(np.mean(squares, axis=1)))
    total = np.sum(squares, axis=1, where=known)
    mean = np.divide(total, known.sum(axis=0), out=np.full(total.shape, np.nan), where=known.any(axis=0))
    return np.asarray(np.sqrt(mean))


def max_error(track: Track, fleet: Fleet) -> Floats:
    """Largest error over time of each run and ego, (R, E) m; a reported maximum is the mean of these over runs."""
    return np.asarray(errors(track, fleet).max(axis=1))


def neighbour_rt_le(track: Track, recording: Recording, fleet: Fleet) -> Floats:
    """Error of the egos' estimates of their neighbours, sqrt(mean over links |x_j - truth_j|^2), (R, E) m.

    NaN where an ego has no neighbour or the method does not estimate them.
    """
    if fleet.ids != recording.ids:
        hint = "Give the fleet that the recording was observed from."
        raise InputError("fleet", fleet.name or "unnamed", "must hold the vehicles that were observed", hint)
    if track.neighbours is None:
        return np.full((len(track.x), len(track.egos)), np.nan)
    mine = [recording.links.of(ego) for ego in track.egos]
    links, ends = np.concatenate(mine), np.cumsum([0, *map(len, mine)])
    truth = fleet.position[recording.links.step[links], recording.links.neighbour[links]]
    return root_mean_squares(np.ascontiguousarray(track.neighbours), truth, ends)


def nees(track: Track, fleet: Fleet) -> Floats:
    """Normalised estimation error squared, e^T P^-1 e, (R, T, E); its mean is 3 for a consistent filter.

    NaN where the covariance is zero: at a start that is known, there is nothing to normalise by.
    """
    truth = _truth(track, fleet)
    if track.covariance is None:
        hint = "NEES needs a method that reports a covariance."
        raise InputError("covariance", None, "this method claims none", hint)
    arrays = (np.ascontiguousarray(values) for values in (track.x, truth, track.covariance))
    found, sound = normalised(*arrays)
    if not sound:
        hint = "Assume noise in every direction: no standard deviation may be zero."
        raise InputError("covariance", "singular", "must have an inverse for NEES", hint)
    return found


def nees_band(runs: int, level: float = 0.99, size: int = 3) -> tuple[float, float]:
    """Two-sided chi-square band of the run-averaged NEES of one step, for `runs` runs (Bar-Shalom, section 5.4).

    Steps of one run are not independent, so the band is of each step's average over runs, never of a pool of steps.

    >>> [round(b, 2) for b in nees_band(30)]
    [1.97, 4.28]
    """
    runs = number("runs", runs, 1, kind=int, allowed=">= 1", hint="Give the number of runs averaged.")
    level = number("level", level, 0, 1, allowed="in [0, 1]", hint="0.99 is the default.")
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
