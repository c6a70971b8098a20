"""Rows of a log on one clock and in one local frame: SI units, x, y, z for latitude, longitude and height."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError

from .geodetic import to_enu
from .kinds import KINDS
from .log_rows import Rows, stacked
from .log_summary import Tally
from .log_vehicle import samples
from .motion import Signal


def local(rows: Rows, origin: tuple[float, float, float] | None) -> Rows:
    """Rows in SI units, with x, y, z in place of latitude, longitude, height (0 where there is none in the log)."""
    value, kind, std = rows.value.copy(), rows.kind.copy(), rows.std.copy()
    for name in dict.fromkeys(kind.tolist()):
        one, here = KINDS[name], rows.kind == name
        value[here] = one.turn * one.scale * value[here] + one.offset
        if one.name in ("heading", "azimuth", "bearing"):
            value[here] = np.arctan2(np.sin(value[here]), np.cos(value[here]))
        std[here] *= one.scale
        kind[here] = one.name
    rows = replace(rows, value=value, kind=kind, std=std)
    geodetic = np.isin(kind, ["latitude", "longitude", "height"])
    if not geodetic.any() or origin is None:
        return rows
    parts, heights = [rows.take(~geodetic)], bool((kind == "height").any())
    for name in dict.fromkeys(rows.vehicle[geodetic].tolist()):
        mine = rows.take(geodetic & (rows.vehicle == name))
        fixes, first = samples(mine, ("latitude", "longitude", "height"), Tally(), 3 if heights else 2)
        at = fixes.value if heights else np.column_stack([fixes.value[:, :2], np.full(len(fixes.t), origin[2])])
        enu, base = to_enu(at, origin), mine.take(first)
        deviation = _std_of_sample(mine, fixes)
        for axis, kind_ in enumerate("xyz" if heights else "xy"):
            parts.append(
                replace(base, value=enu[:, axis], kind=np.full(len(first), kind_, dtype=object), std=deviation[:, axis])
            )
    return stacked(parts)


def _std_of_sample(rows: Rows, fixes: Signal) -> Floats:
    """(M, 3) m along east, north and up, of fixes in degrees, whose standard deviations are metres."""
    out = np.full((len(fixes.t), 3), np.nan)
    for axis, kind in enumerate(("longitude", "latitude", "height")):
        own = rows.take((rows.kind == kind) & np.isfinite(rows.std))
        if len(own):
            order = np.argsort(own.t, kind="stable")
            place = np.clip(np.searchsorted(own.t[order], fixes.t - 1e-9), 0, len(own) - 1)
            out[:, axis] = own.std[order][place]
    return out


def origin_of(rows: Rows, given: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """The origin that is given, or the first fix in degrees."""
    degrees = rows.take(np.isin(rows.kind, ["latitude", "longitude", "height"]))
    if given is not None or not len(degrees):
        return given
    flat = np.flatnonzero(np.isin(rows.kind, ["x", "y"]))
    if len(flat):
        hint = "Pass origin=(latitude, longitude, height) of the local frame, or give all positions in one of the two; "
        hint += "ignore= leaves out kinds, and topics of a bag."
        raise InputError(f"{rows.place(int(flat[0]))}, x", "metres", "stand beside fixes in degrees", hint)
    heights = bool((degrees.kind == "height").any())
    order = np.argsort(degrees.t, kind="stable")
    for k in order.tolist():
        here = degrees.take((degrees.t == degrees.t[k]) & (degrees.vehicle == degrees.vehicle[k]))
        found = dict(zip(here.kind.tolist(), here.value.tolist(), strict=True))
        if {"latitude", "longitude", *(["height"] if heights else [])} <= set(found):
            return found["latitude"], found["longitude"], found.get("height", 0.0)
    raise InputError("latitude, longitude", "never together", "must be given at one time", "Check the columns.")


def on_one_clock(rows: Rows, clock: Mapping[str, float], name: str) -> Rows:
    """Rows with stamps less the s that each vehicle's clock is ahead; an InputError for a vehicle not there."""
    known = sorted(set(rows.vehicle.tolist()))
    for one in clock:
        if one not in known:
            allowed = f"must be a vehicle of {name}, which has {', '.join(known)}"
            raise InputError("clock", repr(one), allowed, "Name the vehicle as in the log.")
    ahead = np.array([clock.get(one, 0.0) for one in rows.vehicle.tolist()])
    partner = np.array([clock.get(one, 0.0) for one in rows.partner.tolist()])
    return replace(rows, t=rows.t - ahead, arrival=rows.arrival - partner)
