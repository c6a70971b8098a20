"""Errors of estimated headings and poses."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..methods.track import Track
from ..world.fleet import Fleet
from ..world.frames import true_heading
from ..world.spherical import wrap
from .metrics import errors


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
    error = np.concatenate([(track.x - fleet.position[:, list(track.egos)])[..., :2], turn[..., None]], axis=-1)
    solved = np.linalg.solve(pose_covariance(track), error[..., None])[..., 0]
    return np.asarray((error * solved).sum(axis=-1))


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
