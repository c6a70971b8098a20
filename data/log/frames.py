"""Rows of a log on one clock, in order of time, in SI units and one local frame; and the noise that they state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.sensors import Sensors

from .motion import samples
from .units import ANGLES, KINDS, Rows, Summary, stacked

DEGREES = ("latitude", "longitude", "height")
ENU = (("x", "longitude"), ("y", "latitude"), ("z", "height"))
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
    for one in clock:
        if one not in rows.vehicle:
            allowed = f"must be a vehicle of {name}, which has {', '.join(sorted(set(rows.vehicle.tolist())))}"
            raise InputError("clock", repr(one), allowed, "Name the vehicle as in the log.")
    ahead, theirs = (np.array([clock.get(one, 0.0) for one in names]) for names in (rows.vehicle, rows.partner))
    t = np.where(np.isnan(rows.t), np.nanmin(rows.t), rows.t) - ahead
    rows = replace(rows, t=t, arrival=rows.arrival - theirs)
    early = rows.arrival < t - 1e-9
    if early.any():
        k = int(np.argmax(early))
        given, allowed = f"{rows.arrival[k]:.6f} s, sent at {t[k]:.6f} s", "must not come before the message was sent"
        hint = 'Give the offsets of the clocks, as clock={"car2": 0.35}, or mend the row.'
        raise InputError(f"{rows.place(k)}, column arrival", given, allowed, hint)
    return rows


def origin_of(rows: Rows, given: Origin | None) -> Origin | None:
    """The origin that is given, or the first fix in degrees; None where all positions are local.

    Raises:
        InputError: positions in metres beside those in degrees, or degrees that are never complete.
    """
    degrees = rows.take(rows.of(*DEGREES))
    if given is not None or not len(degrees):
        return given
    flat = rows.of("x", "y")
    if flat.any():
        hint = "Pass origin=(latitude, longitude, height) of the local frame, or give all positions in one of the two; "
        hint += "ignore= leaves out kinds, and topics of a bag."
        raise InputError(f"{rows.place(flat)}, x", "metres", "stand beside fixes in degrees", hint)
    heights = degrees.of("height").any()
    for k in np.argsort(degrees.t, kind="stable").tolist():
        here = degrees.take((degrees.t == degrees.t[k]) & (degrees.vehicle == degrees.vehicle[k]))
        found = dict(zip(here.kind.tolist(), here.value.tolist(), strict=True))
        if set(DEGREES[: 3 if heights else 2]) <= set(found):
            return found["latitude"], found["longitude"], found.get("height", 0.0)
    raise InputError("latitude, longitude", "never together", "must be given at one time", "Check the columns.")


def local(rows: Rows, origin: Origin | None) -> Rows:
    """Rows in SI units, with x, y, z in place of latitude, longitude, height (0 where there is none in the log)."""
    value, kind, std = rows.value.copy(), rows.kind.copy(), rows.std.copy()
    for name in dict.fromkeys(kind.tolist()):
        one, here = KINDS[name], rows.kind == name
        value[here] = one.scale * value[here] + one.offset
        if one.name in ANGLES[:3]:
            value[here] = np.arctan2(np.sin(value[here]), np.cos(value[here]))
        std[here] *= abs(one.scale)
        kind[here] = one.name
    rows = replace(rows, value=value, kind=kind, std=std)
    geodetic = rows.of(*DEGREES)
    if not geodetic.any() or origin is None:
        return rows
    parts, heights = [rows.take(~geodetic)], rows.of("height").any()
    for name in dict.fromkeys(rows.vehicle[geodetic].tolist()):
        mine = rows.take(geodetic & (rows.vehicle == name))
        fixes = samples(mine, DEGREES, Summary(), 3 if heights else 2)
        first = fixes.row
        at = fixes.value if heights else np.column_stack([fixes.value[:, :2], np.full(len(fixes.t), origin[2])])
        enu, base = to_enu(at, origin), mine.take(first)
        for axis, (to, what) in enumerate(ENU[: 3 if heights else 2]):
            own = mine.take(mine.of(what) & np.isfinite(mine.std))
            deviation = np.full(len(first), np.nan)
            if len(own):
                order = np.argsort(own.t, kind="stable")
                place = np.clip(np.searchsorted(own.t[order], fixes.t - 1e-9), 0, len(own) - 1)
                deviation = own.std[order][place]
            kinds = np.full(len(first), to, dtype=object)
            parts.append(replace(base, value=enu[:, axis], kind=kinds, std=deviation))
    return stacked(parts)


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
    found: Floats = (_earth_centred(geodetic) - _earth_centred(np.array([origin]))) @ east_north_up.T
    return found


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
