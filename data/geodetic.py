"""WGS84: latitude, longitude and height to a local east-north-up frame and back, exactly."""

from __future__ import annotations

import numpy as np

from coopoc.arrays import Floats

MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
"""Squared, of the ellipsoid of WGS84, whose semi-major axis is MAJOR m."""


def to_enu(geodetic: Floats, origin: tuple[float, float, float]) -> Floats:
    """(L, 3) east, north, up m of (L, 3) latitude deg, longitude deg, ellipsoidal height m.

    x = R (X(p) - X(origin)) with the earth-centred X and the rotation R at the origin. Over 10 km the plane's height
    differs from the ellipsoid's by 8 m, as a tangent plane's must.

    Source: Hofmann-Wellenhof, Lichtenegger, Wasle, GNSS, 2008, section 8.

    >>> to_enu(np.array([[48.0, 11.001, 500.0]]), (48.0, 11.0, 500.0)).round(2).tolist()
    [[74.63, 0.0, -0.0]]
    """
    at = np.array([origin])
    found: Floats = (_centred(geodetic) - _centred(at)) @ _frame(origin).T
    return found


def _centred(geodetic: Floats) -> Floats:
    latitude, longitude = np.radians(geodetic[:, :2]).T
    normal = MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(latitude)
    up = (normal * (1 - ECCENTRICITY2) + geodetic[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), up])


def _frame(origin: tuple[float, float, float]) -> Floats:
    """Rows: east, north, up."""
    latitude, longitude = np.radians(origin[:2])
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
