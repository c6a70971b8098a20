"""Rows of a log on one clock, in order of time, in SI units and one local frame; and the noise that they state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.links import wrap
from coopoc.world.sensors import Sensors

from .units import ANGLES, KINDS, Rows, Summary

ENU = {"longitude": "x", "latitude": "y", "height": "z"}
MOTION = ("vx", "vy", "speed")
Origin = tuple[float, float, float]
MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
"""Squared, of the ellipsoid of WGS84, whose semi-major axis is MAJOR m."""
PLANE_STD = 0.01
"""m, how well z = 0 is known where no height was logged; rad, the inclination that goes with it."""
HEADING_STD = 0.05
"""rad, of a compass in body frames whose noise was not logged."""


def on_one_clock(rows: Rows, clock: Mapping[str, float], name: str) -> Rows:
    """Rows with stamps less the s that each vehicle's clock is ahead; those without a time, of places, at the first
    instant.

    Raises:
        InputError: no stamp at all, a clock of a vehicle that is not there, a message that arrives before it was sent.
    """
    if np.isnan(rows.t).all():
        raise InputError("t", "in no file", "must be a column of some table", "Give the times of what was measured.")
    vehicles = set(rows.vehicle.tolist())
    for vehicle in clock:
        if vehicle not in vehicles:
            allowed = f"must be a vehicle of {name}, which has {', '.join(sorted(vehicles))}"
            raise InputError("clock", repr(vehicle), allowed, "Name the vehicle as in the log.")
    ahead, partner_ahead = (np.array([clock.get(one, 0.0) for one in names]) for names in (rows.vehicle, rows.partner))
    t = np.where(np.isnan(rows.t), np.nanmin(rows.t), rows.t) - ahead
    rows = replace(rows, t=t, arrival=rows.arrival - partner_ahead)
    early = rows.arrival < t - 1e-9
    if early.any():
        given = f"{rows.arrival[early][0]:.6f} s, sent at {t[early][0]:.6f} s"
        hint = 'Give the offsets of the clocks, as clock={"car2": 0.35}, or mend the row.'
        field, allowed = f"{rows.place(early)}, column arrival", "must not come before the message was sent"
        raise InputError(field, given, allowed, hint)
    return rows


def local(rows: Rows, origin: Origin | None) -> tuple[Rows, Origin | None]:
    """Rows in SI units, with x, y, z in place of latitude, longitude, height; and the origin of that frame: the given
    one, or the first complete fix in degrees (its height 0 where there is none in the log), None where positions
    were local.

    Raises:
        InputError: positions in metres beside those in degrees without an origin, or degrees that are never complete.
    """
    value, kind, std = rows.value.copy(), rows.kind.copy(), rows.std.copy()
    for name in dict.fromkeys(kind.tolist()):
        unit, same = KINDS[name], rows.kind == name
        value[same] = unit.scale * value[same] + unit.offset
        if unit.name in ANGLES[:3]:
            value[same] = wrap(value[same])
        std[same] *= abs(unit.scale)
        kind[same] = unit.name
    geodetic, flat = rows.of(*ENU), rows.of("x", "y")
    if not geodetic.any():
        return replace(rows, value=value, kind=kind, std=std), origin
    if origin is None and flat.any():
        hint = "Pass origin=(latitude, longitude, height) of the local frame, or give all positions in one of the two; "
        hint += "ignore= leaves out kinds, and topics of a bag."
        raise InputError(f"{rows.place(flat)}, x", "metres", "stand beside fixes in degrees", hint)
    frame = pd.DataFrame({"t": rows.t.round(6), "vehicle": rows.vehicle, "kind": kind, "value": value})[geodetic]
    fixes = frame.pivot_table(index=["t", "vehicle"], columns="kind", values="value", aggfunc="first", sort=False)
    if "height" not in fixes:
        fixes["height"] = origin[2] if origin else 0.0
    fixes = fixes.reindex(columns=["latitude", "longitude", "height"]).dropna()
    if not len(fixes):
        raise InputError("latitude, longitude", "never together", "must be given at one time", "Check the columns.")
    if origin is None:
        latitude, longitude, height = fixes.iloc[int(np.argmin(fixes.index.get_level_values("t")))].tolist()
        origin = latitude, longitude, height
    row = fixes.index.get_indexer(pd.MultiIndex.from_frame(frame[["t", "vehicle"]]))
    axis = [list(ENU).index(name) for name in frame["kind"]]
    value[geodetic] = np.where(row < 0, np.nan, to_enu(fixes.to_numpy(), origin)[row, axis])
    kind[geodetic] = frame["kind"].map(ENU)
    return replace(rows, value=value, kind=kind, std=std).take(~geodetic | np.isfinite(value)), origin


def to_enu(geodetic: Floats, origin: Origin) -> Floats:
    """(L, 3) east, north, up m of (L, 3) latitude deg, longitude deg, ellipsoidal height m of WGS84.

    x = R (X(p) - X(origin)) with the earth-centred X and the rotation R at the origin. Over 10 km the plane's height
    differs from the ellipsoid's by 8 m, as a tangent plane's must.

    Source: Hofmann-Wellenhof, Lichtenegger, Wasle, GNSS, 2008, section 8.

    >>> to_enu(np.array([[48.0, 11.001, 500.0]]), (48.0, 11.0, 500.0)).round(2).tolist()
    [[74.63, 0.0, -0.0]]
    """
    latitude, longitude = np.radians(origin[:2])
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east_north_up = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    enu: Floats = (_earth_centred(geodetic) - _earth_centred(np.array([origin]))) @ east_north_up.T
    return enu


def _earth_centred(geodetic: Floats) -> Floats:
    latitude, longitude = np.radians(geodetic[:, :2]).T
    normal = MAJOR / np.sqrt(1 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(latitude)
    up = (normal * (1 - ECCENTRICITY2) + geodetic[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), up])


def assumed(rows: Rows, planar: bool, body: bool, summary: Summary, dt: float) -> Sensors:
    """Sensors of a log: the root mean square of the logged standard deviations of each kind.

    A Recording holds one standard deviation per kind; what is not logged is that of `Sensors()`, and reported.

    Args:
        rows: in SI units and metres.
        planar: whether no height was logged.
        body: whether the recording is in body frames.
        summary: takes what is assumed.
        dt: s, of the recording.
    """
    base, used = Sensors(), set(rows.kind.tolist())
    given = {name: rows.std[(rows.kind == name) & np.isfinite(rows.std)] for name in used}
    given = {name: stds for name, stds in given.items() if len(stds)}

    def of(*names: str, default: float, unit: str) -> float:
        parts = [given[name] for name in names if name in given]
        if parts:
            return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
        if used & set(names):
            summary.assume("standard deviations of {}: none was logged", f"{default:.3g} {unit} ({names[0]})")
        return default

    x, y, z = base.gnss_std
    up = PLANE_STD if planar else of("z", default=z, unit="m")
    speed = of(*MOTION, default=0.0, unit="m/s") if {*MOTION} & set(given) else None
    if speed is None:
        summary.assume(f"{base.velocity_std_ratio:.0%} of a velocity as its noise, {base.velocity_floor} m/s at least")
    turned = body or ("heading" in given and "bearing" in used)
    found = replace(
        base,
        gnss_std=(of("x", default=x, unit="m"), of("y", default=y, unit="m"), up),
        range_std=of("range", default=base.range_std, unit="m"),
        azimuth_std=of("azimuth", "bearing", default=base.azimuth_std, unit="rad"),
        inclination_std=of("inclination", default=PLANE_STD if planar else base.inclination_std, unit="rad"),
        min_range=0.0,
    )
    if body:
        rate = of("yaw_rate", default=base.yaw_rate_std, unit="rad/s")
        found = replace(found, velocity_reading="speed", yaw_rate_std=rate, compass="heading" in used)
    found = replace(found, heading_std=of("heading", default=HEADING_STD, unit="rad") if turned else 0.0)
    if speed is None:
        return found
    if not body and {"speed", "heading"} <= set(given):
        speed = _across(speed, of("heading", default=0.0, unit="rad"), rows, dt)
        summary.assume(f"{speed:.2g} m/s as the noise of a velocity, with that of the headings which turn the speeds")
    return replace(found, velocity_std_ratio=0.0, velocity_floor=speed)


def _across(speed: float, heading: float, rows: Rows, dt: float) -> float:
    """Standard deviation m/s of each axis of a velocity that is a speed v turned by a measured heading: the mean of the
    variances along, s_v^2, and across, v^2 s_h^2 n, where a heading's error lasts for the n steps to the next one; at
    least s_v."""
    turned = rows.take(rows.of("heading"))
    gaps = [np.diff(np.unique(turned.t[turned.vehicle == one])) for one in set(turned.vehicle.tolist())]
    interval = float(np.median(np.concatenate([*gaps, [dt]])))
    across = float(np.mean(rows.value[rows.of("speed")] ** 2)) * heading**2 * max(interval / dt, 1.0)
    return max(speed, float(np.sqrt((speed**2 + across) / 2)))
