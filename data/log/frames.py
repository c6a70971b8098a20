"""Clock offsets, SI units and the local east-north-up frame of a log's rows; the sensor noise that they state."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pymap3d

from coopoc import InputError, Sensors
from coopoc.arrays import Bools, Floats, checked, refuse
from coopoc.formats.values import QUATERNION_ROUNDING, to_rotation
from coopoc.world.body_frames import turned
from coopoc.world.links import wrap
from coopoc.world.recording import DEGREES_STD

from ..assemble import PLANE_STD
from ..cells import Factors, factors
from .units import (
    ANGLES,
    BODY,
    DEGREE,
    KEYS,
    KIND_TABLE,
    QUATERNION,
    Rows,
    Summary,
    in_columns,
    in_group,
    only,
    row_of,
    stated_std,
)

if TYPE_CHECKING:
    from .motion import Member, Steps

UNSTATED = "standard deviations of {}: none was logged"
TOO_WIDE = "stated deviations of"
"""Beginnings of sentences on deviations that were not logged, or are rather in degrees."""
ENU = {"longitude": "x", "latitude": "y", "height": "z"}
MOTION = ("vx", "vy", "speed", "vy_body")
Origin = tuple[float, float, float]
WEEK = 604800.0
FAR_M = 7e4
"""m, from the origin from which its north is another: by half a degree."""
PERIODS = 3600.0, WEEK / 7, WEEK, 2**32 / 1000, 1024 * WEEK
"""s, after which clocks begin anew: an hour, where summer time ends, a day, a GPS week, 32 bits of milliseconds, and
the number of a week."""
SCALE_STD, RATE_BIAS_STD = 0.03, 0.005
"""Of wheels and gyros, which a log in body frames does not state: share of a speed, and rad/s."""
VELOCITY_BIAS_STD = 0.1
"""m/s, of each axis of a velocity that no wheel measures."""
OFFSET_STD = 1.0
"""m, assumed of what all ranges of a radio are too long by: a log does not say whether its delays are calibrated."""
DRIVES_APART = 3600.0
"""s between two files of a folder beyond which they are of several drives, if it is also longer than all files."""
LOCATING_FIXES, LEAPS = 10, 10.0
"""Fixes of a vehicle that show where it is; times its usual speed, to and from a fix that is none."""
DISORDER_SHARE = 0.02
"""Share of rows that are earlier than the one before, where a file is else in the order of its stamps."""
EQUAL_LOG_FACTOR = 0.1
"""Logarithm of a factor of deviations that is none."""
BENT_STDS = 1.15 * 6**0.5
"""Standard deviations of heights that three quarters of their second differences, which no slope changes, are below."""
HEADING_STD = 0.05
"""rad, of a compass in body frames whose noise was not logged."""


def check_origin(origin: Origin) -> None:
    """InputError unless it is latitude and longitude in degrees, and height in m."""
    values, allowed = checked("origin", origin, "(3,)", (3,)), "must be degrees of latitude and longitude, and m"
    refuse("origin", values, ~(abs(values) <= [90.0, 180.0, 1e6]), allowed, "Give origin=(48.14, 11.58, 520.0).")


def unwrapped(rows: Rows, summary: Summary) -> Rows:
    """Rows whose stamps go on where those of a vehicle begin anew after one of PERIODS; those of another file, such as
    the truth, may count on."""
    clock = rows.groupby("file", sort=False)["t"].transform(of_clock_face)
    if not clock.equals(rows["t"]):
        rows = rows.assign(t=clock)
        summary.assume("stamps are read as hhmmss.ss: none has minutes or seconds of 60 to 99")
    t, last = rows["t"], rows.groupby(["file", "vehicle", "kind", "partner"], sort=False)["t"].shift()
    back = t < last
    for period in PERIODS:
        part = (t - last[(last - t).between(0.9 * period, 1.1 * period)].max()) / period + 1.0
        if part.between(-0.25, 1.25)[t.notna()].all() and not part.between(0.25, 0.75).any():
            summary.assume(f"stamps wrap around after {period:.10g} s: those of its first half come later")
            return rows.assign(**{name: rows[name].mask(part < 0.5, rows[name] + period) for name in ("t", "arrival")})
    if 0 < back.mean() < DISORDER_SHARE:
        summary.assume(
            f"stamps of {', '.join(rows['vehicle'][back].unique())} go back (first: {row_of(rows[back])}): was a clock "
            "set? If the logger restarted, give each part a log of its own. Rows are sorted by time"
        )
    return rows


def of_clock_face(t: "pd.Series[float]") -> "pd.Series[float]":
    """Seconds of the day of times hhmmss.ss, as NMEA writes them: where no number is of the seconds 60 to 99, and those
    between which a minute begins are 40 further apart than others. Other times are as they were.

    >>> of_clock_face(pd.Series([235957.0, 235958.5, 235959.5, 235959.9])).tolist()[-1]
    235959.9
    >>> of_clock_face(pd.Series([15957.0, 15958.0, 15959.0, 20000.0, 20001.0])).diff().tolist()[1:]
    [1.0, 1.0, 1.0, 1.0]
    """
    each = np.unique(t.dropna())
    gaps, begins = np.diff(each), np.diff(each // 100) != 0
    if not begins.any() or begins.all() or each[-1] >= 240000 or np.max([each // 100 % 100, each % 100]) >= 60:
        return t
    if not abs(np.median(gaps[begins] % 4000) - 40.0) <= 1.5 * np.median(gaps[~begins]) < 40.0:
        return t
    return 3600.0 * (t // 10000) + 60.0 * (t // 100 % 100) + t % 100


def on_one_clock(rows: Rows, clock: Factors | None) -> Rows:
    """Rows with stamps, in whole microseconds, less the s that each vehicle's clock is ahead; those without a time, of
    places, at the first instant.

    Raises:
        InputError: no stamp at all, a clock of a vehicle that is not there, a message that arrives before it was sent.
    """
    if rows["t"].isna().all():
        raise InputError("t", "in no file", "must be a column of some table", "Give the times of what was measured.")
    clock = factors(clock, sorted(rows["vehicle"].unique()), "clock")
    ahead, partner_ahead = (rows[who].map(clock).fillna(0.0) for who in ("vehicle", "partner"))
    t = (rows["t"].fillna(rows["t"].min()) - ahead).round(6)
    rows = rows.assign(t=t, arrival=rows["arrival"] - partner_ahead)
    early = rows[rows["arrival"] < t - 1e-6]
    if len(early):
        raise InputError(
            f"{row_of(early)}, column arrival",
            f"{early['arrival'].iloc[0]:.6f} s, sent at {early['t'].iloc[0]:.6f} s",
            "must not come before the message was sent",
            'Give the offsets of the clocks, as clock={"car2": 0.35}, or correct the row.',
        )
    return rows


def check_one_drive(rows: Rows, name: str) -> None:
    """InputError for files of measurements that are too far apart in time to be of one drive."""
    spans = rows.groupby("file", sort=False)["t"].agg(["min", "max"]).sort_values("min")
    gaps = spans["min"] - spans["max"].cummax().shift()
    if (gaps > max(DRIVES_APART, spans["max"].max() - spans["min"].min() - gaps.clip(lower=0.0).sum())).any():
        raise InputError(
            name,
            "; ".join(f"{file}: {begin:.0f} to {end:.0f} s" for file, begin, end in spans.itertuples()),
            f"must hold the files of one drive; these are up to {gaps.max() / 3600:.3g} h apart",
            "Give each drive a folder of its own, and name that.",
        )


def local(rows: Rows, origin: Origin | None, summary: Summary) -> tuple[Rows, Origin | None]:
    """Rows in SI units, with x, y, z (east, north, up) in place of latitude, longitude, height of WGS84; and the origin
    of that frame: the given one, or the first fix in degrees, None where positions were local. A fix without a height
    is brought over at the usual one of the vehicle, else of the log, else of the origin (0); fixes `_nowhere` are none.

    Raises:
        InputError: positions in metres beside those in degrees without an origin, or degrees that are never complete.
    """
    kind, scale, offset = (rows["kind"].map(KIND_TABLE[column]) for column in ("name", "scale", "offset"))
    value = scale * rows["value"] + offset
    value = value.mask(kind.isin(ANGLES[:3]), wrap(value))
    rows = rows.assign(kind=kind, value=value, std=rows["std"] * abs(scale))
    rows = _by_attitude(rows, summary).replace({"kind": {"vz_body": "vz"}})
    none = _nowhere(rows)
    summary.refuse("fixes at zero, which are none", rows[none])
    rows = rows[~none]
    geodetic, metric = rows["kind"].isin(ENU), only(rows, "x", "y")
    if not geodetic.any():
        return rows, origin
    if origin is None and len(metric):
        raise InputError(
            f"{row_of(metric)}, x",
            "metres",
            "stand beside fixes in degrees",
            "Pass origin=(latitude, longitude, height) of the local frame, or give all positions in one of the two; "
            "ignore= leaves out kinds, and topics of a bag.",
        )
    fixes = in_columns(rows, ["latitude", "longitude", "height"]).sort_index(level="t")
    height = fixes["height"]
    for usual in (height.groupby("vehicle").transform("median"), height.median(), origin[2] if origin else 0.0):
        fixes["height"] = fixes["height"].fillna(usual)
    fixes = fixes.dropna()
    if not len(fixes):
        raise InputError("latitude, longitude", "never together", "must be given at one time", "Check the columns.")
    if origin is None:
        latitude, longitude, height = fixes.iloc[0].tolist()
        origin = latitude, longitude, height
    metres = np.column_stack(pymap3d.geodetic2enu(*fixes.to_numpy().T, *origin))
    for name in fixes.index[np.hypot(*metres.T[:2]) > FAR_M].unique("vehicle"):
        summary.assume(
            "fixes far from the origin, over 70 km, of {}: headings and velocities count from the north of the origin, "
            "which is another. Read each place alone (since=, until=, or a folder each), with an origin= near it",
            name,
        )
    enu = pd.DataFrame(metres, fixes.index, [*ENU]).stack()
    value = rows["value"].mask(geodetic, enu.reindex(rows.set_index(KEYS).index).to_numpy())
    lost = geodetic & value.isna()
    summary.refuse("incomplete fixes, without latitude or longitude", rows[lost])
    return rows.assign(value=value, kind=rows["kind"].replace(ENU))[~lost], origin


def _by_attitude(rows: Rows, summary: Summary) -> Rows:
    """Rows with the heading h of each quaternion, R from the body to the local frame, in its place, and with body
    velocities v of three axes without its tilt, R_z(-h) R v, by the last quaternion until then."""
    turns = rows["kind"].isin(QUATERNION)
    if not turns.any():
        return rows
    table = in_columns(rows, [*BODY, *QUATERNION])
    unit = abs(np.linalg.norm(table[QUATERNION], axis=1) - 1.0) < QUATERNION_ROUNDING
    table.loc[~unit, QUATERNION] = np.nan
    rotation = to_rotation(table[QUATERNION].groupby("vehicle").ffill().to_numpy())
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    table[BODY] = turned((rotation @ table[BODY].to_numpy()[..., None])[..., 0], -heading)
    table.loc[unit, "qw"] = heading[unit]
    made = table.stack().reindex(rows.set_index(KEYS).index).to_numpy()
    known = np.isfinite(made)
    summary.refuse("quaternions that lack a component or are not of unit length", rows[turns & ~known])
    for name in rows["vehicle"][turns].unique():
        summary.assume("quaternions turn from the body (x forward, y left, z up) to the local frame: those of {}", name)
    rows = rows.assign(value=np.where(known, made, rows["value"]), kind=rows["kind"].replace("qw", "heading"))
    kept: Rows = rows[~turns | (known & rows["kind"].eq("heading"))]
    return kept


def _nowhere(rows: Rows) -> Bools:
    """(L,) fixes of receivers that have none: at 0 N 0 E, or at x = y = 0 where the last fix before, or the next one,
    is too far away for the vehicle's speed."""
    axes = ["x", "y", "latitude", "longitude"]
    fixes = in_columns(rows, axes).reset_index()
    at_zero, no_degrees = (fixes[names].eq(0.0).all(axis=1) for names in (axes[:2], axes[2:]))
    vehicle = fixes["vehicle"]

    def pace(some: Rows) -> Any:
        """m/s to each fix from the one before."""
        moves = some.groupby("vehicle").diff()
        return np.hypot(moves["x"], moves["y"]) / moves["t"]

    usual = pace(fixes[~at_zero]).groupby(vehicle)
    most = LEAPS * vehicle.map(usual.quantile(0.8).where(usual.count() >= LOCATING_FIXES))
    leap = at_zero != at_zero.groupby(vehicle).shift(fill_value=False)
    far = leap & (pace(fixes) > most)
    away = (far | far.shift(-1, fill_value=False)).groupby(leap.cumsum()).transform("any")
    none = fixes.set_index(KEYS[:2]).index[no_degrees | (at_zero & away)]
    return rows.set_index(KEYS[:2]).index.isin(none) & in_group(rows, "fix")


def assumed(rows: Rows, steps: "Steps", members: "Sequence[Member]", drifts: float) -> Sensors:
    """Sensors of a log: the root mean square of the logged standard deviations of each kind.

    A Recording holds one standard deviation per kind; what is not logged is that of `Sensors()`, and reported;
    heights err as fixes show, if that is more.

    Args:
        rows: in SI units and metres.
        steps: of the recording, whose summary takes what is assumed.
        members: of the log.
        drifts: m^2/s, by which the vehicle that wanders least does, as fixes have shown its velocity.
    """
    base, used, body, assume, dt = Sensors(), set(rows["kind"]), steps.body, steps.summary.assume, steps.dt
    square = (rows["std"] ** 2).groupby(rows["kind"]).mean().dropna()
    rare = _apart(rows, MOTION, dt) ** 0.5  # the error of a motion that is measured seldom lasts until the next

    def of(default: float, unit: str, *names: str) -> float:
        stated = stated_std(rows, *names)
        if stated > 0.0:
            return stated
        if used & set(names):
            assume(UNSTATED, f"{default:.3g} {unit} ({names[0]})")
        return default

    usual = only(rows, *ANGLES, "yaw_rate").groupby("kind")["std"].median()
    for kind, std in usual[usual > DEGREES_STD].items():
        assume(f"{TOO_WIDE} {kind} are {std:.3g} rad: if they are degrees, std={kind}:{DEGREE * std:.3g} mends it")
    x, y, z = base.gnss_std
    bent = [pd.Series(member.gnss[:, 2]).dropna().diff().diff().abs().quantile(0.75) for member in members]
    z = max(z, *np.divide(bent, BENT_STDS))
    up = PLANE_STD if steps.planar else of(z, "m", "z")
    noise: dict[str, Any] = {
        "gnss_std": (of(x, "m", "x"), of(y, "m", "y"), up),
        "range_std": of(base.range_std, "m", "range"),
        "range_offset_std": OFFSET_STD * ("range" in used),
        "azimuth_std": of(base.azimuth_std, "rad", "azimuth", "bearing"),
        "inclination_std": of(PLANE_STD if steps.planar else base.inclination_std, "rad", "inclination"),
        "min_range": 0.0,
    }
    if body:
        noise |= {
            "velocity_reading": "speed",
            "yaw_rate_std": rare * of(base.yaw_rate_std, "rad/s", "yaw_rate"),
            "compass": "heading" in used,
            "speed_scale_std": SCALE_STD,
            "yaw_rate_bias_std": RATE_BIAS_STD,
            "velocity_bias_std": VELOCITY_BIAS_STD * ("vy_body" in used),
        }
    apart = dt * _apart(rows, ["bearing"], dt)
    errors = [(m.heading.unsure * max(1.0, m.heading.lasts / apart) ** 0.5, m.climbs) for m in members]
    derived, climbs = np.max(errors, axis=0).tolist()
    if body or ("heading" in square and "bearing" in used):
        noise["heading_std"] = of(HEADING_STD, "rad", "heading")
    elif derived and "bearing" in used:
        noise["heading_std"] = derived = min(derived, DEGREES_STD)
        assume(f"{derived:.2g} rad as the noise of derived headings, which rotate bearings")
    if climbs > 0.0:
        noise["climb_std"] = np.sqrt(climbs / dt)
        assume(f"heights change by {np.sqrt(10.0 * climbs):.2g} m in 10 s, estimated from fixes: no vz was logged")
    ratio, moving = 0.0, [member for member in members if not member.stands]
    if moving and all(member.wander.any() for member in moving):
        floor = max(np.sqrt(drifts / dt), rare * of(base.velocity_floor, "m/s", *MOTION))
        assume(
            f"{floor:.2g} m/s or more as the noise of velocities from fixes, where no velocity or heading was logged"
        )
    elif {*MOTION}.isdisjoint(square.index):
        ratio, floor = base.velocity_std_ratio, base.velocity_floor
        assume(f"{ratio:.0%} of a velocity as its noise, {floor:.2g} m/s at least")
    else:
        floor = rare * of(0.0, "m/s", *MOTION)
        if not body and {"speed", "heading"} <= set(square.index):
            heading = float(np.sqrt(square["heading"]))  # whose error, v^2 s_h^2 across, lasts until the next one
            across = (only(rows, "speed")["value"] ** 2).mean() * heading**2 * _apart(rows, ["heading"], dt)
            floor = max(floor, float(np.sqrt((floor**2 + across) / 2)))
            assume(f"{floor:.2g} m/s as the noise of velocities, with that of the headings that rotate speeds")
    return replace(base, **noise, velocity_std_ratio=ratio, velocity_floor=floor)


def fix_factors(rows: Rows, ids: Sequence[str], steps: "Steps") -> Floats:
    """(T, N) by which the fixes of each step and member, or the last before, err more than those of all, in the root
    mean square of what was logged; none where these are alike."""
    fixes = only(rows, "x", "y")
    square, step = np.square(fixes["std"]), steps.nearest(fixes["t"].to_numpy())[0]
    each = (square / square.mean()).groupby([step, fixes["vehicle"]]).mean().unstack()
    factor = np.sqrt(each.reindex(range(len(steps.grid)), columns=ids).ffill().bfill().fillna(1.0).to_numpy())
    return factor if (abs(np.log(factor)) > EQUAL_LOG_FACTOR).any() else np.empty(0)


def _apart(rows: Rows, kinds: Sequence[str], dt: float) -> float:
    """Steps from one measurement of these kinds to the next, 1 at least."""
    t = only(rows, *kinds).drop_duplicates(["vehicle", "t"]).sort_values("t").groupby("vehicle")["t"]
    return float(np.fmax(t.diff().median() / dt, 1.0))
