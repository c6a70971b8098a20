"""Innovation and residual statistics of a log (`residuals`), and sentences on what is implausible."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy import inf
from numpy.linalg import lstsq, norm

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.odometry_fault import failed, faults, when

from .estimates import (
    BEHIND,
    BESIDE,
    CONFIDENT_RATIO,
    LEAST_CORRELATION,
    LEAST_COUNT,
    LEAST_DRIFT,
    LEAST_LAG,
    LEAST_SCALE,
    LEAST_TURN,
    LONG_LAG,
    MAY,
    OUTLYING,
    PERHAPS,
    SURE_CLOCK_ERRORS,
    SURE_ERRORS,
    TENTHS,
    against_truth,
    causes,
    factors,
    lag_of_fixes,
    median,
    moves,
    odometry,
    on_time,
    ratio_of_moves,
    worst,
)
from .frames import TOO_WIDE
from .motion import HOLDS, LEAST_FIXES, OTHER_RATES, UNUSED_SHARE
from .read import SEVERAL, Log
from .relative import LEAST_OUTLIERS, OUTLIER_SHARE, measurements, misplaced, of_measurements, of_places, of_ranges
from .residuals import Check, Row, filtered, wandered, without, without_wild

WRONG_UNITS = (
    (-1.0, 3e-3, "Is t in ms (scale=t:1e-3) or finer, or are positions in km? Or is a fix repeated?"),
    (0.2, 0.4, "Is speed in km/h? Name it speed_kmh. Or in feet a second? Speeds are in m/s."),
    (0.42, 0.55, "Is speed in knots? Name it speed_knots. Or in miles an hour? Speeds are in m/s."),
    (3.0, 3.6, "Are positions in feet? They are in m."),
)
"""Ratios of the distance of fixes to that of odometry (least, largest), and the unit that explains them."""
FRAME_STDS = 1.5
"""Standard deviations of a fix that a difference of frames must have."""
OFFSET_ERRORS = 6.0
"""Standard errors of an offset beyond which it is significant."""
LEAST_ARM, LONGEST_ARM = 0.2, 30.0
"""m, least arm of an antenna that is reported, and longest that is one."""
AXIS_TURN = 20.0
"""Degrees by which odometry is turned from which its forward axis is another."""
JUMP_NIS = 1e3
"""NIS of a fix that is no noise."""
FAR_AWAY = 3e5
"""m, from all others, where no vehicle cooperates."""
LEAST_BACK = 0.02
"""Share of the way that a vehicle goes back, if it does."""
FORWARD = "speed", "vx", "vy"
"""Quantities that say how fast a vehicle goes ahead."""
DIVERGED = 0.3
"""Scale error of odometry beyond which the filter that estimates it has diverged."""
USED_COUNTS = "fixes", "relative measurements", "edges", "messages"
"""Counts of the summary that say how much was used; those of odometry and headings do not."""
EXPECTED = "steps of", "fixes and relative measurements that hold", "incomplete rows"
"""Beginnings of reasons that are no fault of the log, or named of each vehicle."""
FAULTS = "stamps of", "fixes far from", TOO_WIDE, SEVERAL.split("{")[0], OTHER_RATES.split("{")[0]
"""Beginnings of what is assumed that is a fault."""
PLACED = "Give a fix of each, a table vehicle, x, y of places, or a column vehicle where files are not named after one."
ADVICE = {
    "repeated rows": "Do stamps lack a fraction, as stamp.sec without nanosec, or in 32 bits? Do two share a name? "
    "Nothing is lost where a bus sends each twice.",
    "fixes in gaps of the odometry": "Where a vehicle stands, log a speed of 0; raise max_gap= for longer gaps.",
    "relative measurements of members": PLACED,
    "odometry and headings of vehicles": PLACED,
    "azimuths at times without": "Do they count from the heading? Then name them bearing; else log a heading.",
    "relative measurements while": "A vehicle is there from its first fix on. Clocks: clock=; gaps: max_gap=.",
    HOLDS: "A receiver that has lost its satellites may send the last fix on.",
    "fixes beside": "A shorter dt= uses them.",
    "speeds without a heading": "Behind a gap of yaw rates a direction is unknown until fixes show it anew.",
    "relative measurements beside": "A shorter dt= uses them.",
}
"""How to use what was left out, by the beginning of the reason."""


def check(log: Log) -> Check:
    """Innovation statistics of a log, with the noise that its recording states.

    Raises:
        InputError: no vehicle that a filter follows; in body frames, vehicles that share no two steps, or first poses
            that are not known.
    """
    first = filtered(log)
    first = without_wild(replace(first, failing={} if first.in_body else _failing(first)))
    rows = _vehicles(first)
    least = {"speed_excess": LEAST_SCALE, "turned": LEAST_TURN, "yaw_rate_bias": LEAST_DRIFT, "fixes_late_s": BEHIND}
    drifts = [
        first.world.ids.index(row["vehicle"])
        for row in rows
        if row["vehicle"] in first.failing or any(_beyond(row, *one) for one in least.items())
    ]
    alike = not drifts and not any(_beyond(row, "nis", OUTLYING) for row in rows)
    late = [row["vehicle"] for row in rows if _late(first, row)]
    result = on_time(first if first.in_body else without(first, drifts), alike, against_truth(first, late))
    result = replace(result, vehicles=_vehicles(result))
    if log.truth is not None and not any(of_ranges(result)):
        result = against_truth(result, [*late, *np.array(result.world.ids)[result.ahead != 0]])
    elif not first.in_body:  # odometry that errs says nothing of others
        result = without(_wider(result), drifts)
    result = misplaced(result)
    result = replace(result, measurements=measurements(result))
    named = [sentence for rule in CHECKS for sentence in rule(result)]
    return replace(result, warnings=(*_of_filters(result, named), *named), unseen=tuple(_unseen(result)))


def _failing(c: Check) -> dict[str, str]:
    """Vehicles whose odometry fixes correct, and when."""
    rec = c.world
    corrections = faults(rec, np.arange(len(rec.ids)), NoiseModel.nominal(rec.sensors))
    steps = () if corrections is None else failed(corrections, rec.dt).T
    return {name: when(rec.t - rec.t[0], each) for name, each in zip(rec.ids, steps, strict=False) if each.any()}


def _wider(c: Check) -> Check:
    """The same, where fixes err by more than is stated: so do the positions of these vehicles."""
    links, nis = c.world.links, {row["vehicle"]: row["nis"] for row in c.vehicles if _beyond(row, "nis", OUTLYING)}
    factor = np.array([nis.get(name, 1.0) for name in c.world.ids])
    more = factor[np.stack([links.observer, links.neighbour])].mean(0)[:, None]
    noise = np.square(c.world.sensors.relative_std)
    return replace(c, expected=np.sqrt((c.expected**2 - noise) * more + noise))


def _vehicles(c: Check) -> list[dict[str, Any]]:
    rows, rec, truth = [], c.world, c.log.truth
    turned = "yaw_rate_bias" if c.in_body else "turned"
    errors = "speed_excess", turned, "fixes_late_s" if truth is None else "late_s", "beside_east", "beside_north"
    for column, name in enumerate(rec.ids):
        fixed = np.isfinite(c.normalised[:, column])
        speed, fixes = norm(rec.velocity[0, :, column], axis=-1), pd.DataFrame(rec.gnss[0, :, column])
        if not max(np.nanmax(speed, initial=0.0), *(fixes.max() - fixes.min())) > 0:  # a place
            continue
        wheels, ratio = odometry(c, column), ratio_of_moves(c, column)
        row = {
            "vehicle": name,
            "fixes": int(fixes[0].count()),
            "there": float(np.isfinite(speed).mean()),
            "innovation_m": _rms(c.fix[fixed, column]),
            "nis": float(c.normalised[fixed, column].mean()) if fixed.any() else None,
            "fixes_per_odometry": None if ratio is None else abs(ratio),
            "turned_deg": None if ratio is None else float(np.angle(ratio, deg=True)),
            **{
                f"{error}{end}": float(number)
                for error, *numbers in zip(errors, *wheels, strict=True)
                if np.isfinite(numbers[1])
                for end, number in zip(("", "_error"), numbers, strict=True)
            },
            "clock_s": float(c.ahead[column]) if np.isfinite(c.unsure[column]) else None,
            "std_m": _rms(np.sqrt(c.variance[:, column])),
        }
        if truth is not None:
            row["fix_error_m"] = _rms(rec.gnss[0, :, column] - truth.position[:, column])
            row["error_m"] = _rms(c.x[:, column] - truth.position[:, column])
        row["misses"], row["per_std"], times = worst(c, column)
        row["worst_from_s"], row["worst_to_s"] = times.min(), times.max()
        rows.append(row)
    return rows


def _rms(vectors: Floats) -> float | None:
    """Root of the mean squared length of vectors (M, 3), None where all are unknown."""
    square = np.vecdot(vectors, vectors)
    return float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else None


def _axes(c: Check, column: int) -> str:
    """What is wrong with fixes that are far from all others, or with the axes of velocities that explain the fixes once
    they are mirrored, or whose direction never changes while that of the fixes does; nothing where they agree."""
    rec = c.world
    east, north = (pd.DataFrame(rec.gnss[0, ..., axis]).median() for axis in (0, 1))
    away = np.hypot(east - east[column], north - north[column]).drop(column).min()
    if away > FAR_AWAY:
        return (
            f"its fixes lie {away / 1000:.0f} km from all others: is the sign of a latitude or longitude lost, are "
            "both swapped, or is it in another frame?"
        )
    moved, driven, *_ = moves(c, column)
    length = norm(moved)
    size = length * norm(driven)
    u = rec.velocity[0, rec.present[:, column], column, :2]
    height = pd.Series(rec.gnss[0, :, column, 2]).dropna()
    climbed = pd.Series(rec.velocity[0, :, column, 2] * rec.dt).cumsum()[height.index]
    if height.corr(climbed, min_periods=LEAST_COUNT + 1) < -0.9 and np.ptp(climbed) > 4 * rec.sensors.fix_std[2]:
        return (
            "heights of fixes fall where vz is positive: it counts upwards, so that "
            f"{c.log.summary.scale(rec.ids[column], -1, 'vz', 'vz_body')} mends it."
        )
    if not size or abs(np.vdot(driven, moved)) > LEAST_CORRELATION * size:
        return ""
    both = np.column_stack([driven, driven.conj()])  # swapped degrees have other lengths; one axis, both
    (turn, mirror), *_ = lstsq(both, moved)
    if abs(mirror) > 2 * abs(turn) and norm(both @ [turn, mirror]) > LEAST_CORRELATION * length:
        return (
            f"axes look swapped or mirrored: fixes move as odometry mirrored at {np.angle(mirror, deg=True) / 2:.0f}"
            " deg from +x. At 45, swap easting and northing, latitude and longitude, or vx and vy; headings clockwise "
            "from north are compass_deg. At 0, change the sign of y or vy; at +-90, of x or vx."
        )
    if norm(u[:, 1]) < 0.1 * norm(u[:, 0]):
        return (
            "vx, vy look like a body-frame velocity: along +x throughout, while the fixes turn. Name vx speed, and log "
            "a heading or a yaw_rate."
        )
    return ""


def _noisier(c: Check, column: int) -> str:
    """When fixes scatter far more than is stated and than they do else: second differences of what they are beside the
    odometry, which slips hardly change; nothing where none do."""
    rec = c.world
    path = np.cumsum(np.nan_to_num(rec.velocity[0, :, column]) * rec.dt, 0)
    off = pd.DataFrame((rec.gnss[0, :, column] - path) / rec.fix_scale[:, column])[[0, 1]].dropna()
    motion = np.ptp(wandered(rec, column)) / max(len(off), 1)
    usual = np.log(2) * (6 * c.fix_noise**2 + 2 * motion)
    size = np.hypot(*off.diff().diff().shift(-1).to_numpy().T) / usual**0.5
    scatter = pd.Series(size).groupby(np.arange(len(off)) * TENTHS // len(off)).median()  # 1 if as stated
    most = scatter.max()
    if len(off) < TENTHS * LEAST_COUNT / 2 or most < CONFIDENT_RATIO * max(1.0, scatter.median()):
        return ""
    at = (rec.t - rec.t[0])[off.index[size > 0.5 * most]]
    return (
        f"its fixes scatter by {most:.2g} times their standard deviation from {at[0]:.3g} to {at[-1]:.3g} s: "
        "did the receiver lose its base or satellites? Give columns of std, or leave these fixes out."
    )


def _of_rows(c: Check) -> Iterator[str]:
    """Measurements and columns that were left out."""
    summary = c.log.summary
    left = {why: number for why, (number, _) in summary.refused.items() if not why.startswith(EXPECTED)}
    used = sum(number for why, number in left.items() if any(word in why for word in USED_COUNTS))
    share = max(used / max(used + sum(summary.read.values()), 1), sum(left.values()) / (summary.rows or inf))
    held = left.get(HOLDS, 0) > LEAST_FIXES
    if share > UNUSED_SHARE or held:
        why = HOLDS if held else max(left, key=left.__getitem__)
        hint = next((hint for begin, hint in ADVICE.items() if why.startswith(begin)), "")
        first = summary.refused[why][1]
        yield (
            f"{share:.0%} of what was logged is not used, mostly {left[why]} {why}"
            f"{f' (first: {first})' * bool(first)}. {hint}".rstrip(" ")
        )
    yield from (f"{sentence}." for sentence in summary.sentences if sentence.startswith(FAULTS))
    if summary.unread:
        yield summary.unread


def _of_filters(c: Check, named: Sequence[str]) -> Iterator[str]:
    """Vehicles whose filter errs by more than it states, or misses fixes so, and no sentence says why; and whether all
    do at once."""
    explained = {one.partition(": ")[0] for one in named if MAY not in one}
    rows = [row for row in sorted(c.vehicles, key=lambda row: -row["per_std"]) if row["per_std"] > CONFIDENT_RATIO]
    begins = [row["worst_from_s"] for row in rows]
    for row in rows:
        if row["misses"] == "filter errs" or row["vehicle"] not in explained:
            yield (
                f"{row['vehicle']}: its {row['misses']} by up to {row['per_std']:.1f} times its standard deviation "
                f"from {row['worst_from_s']:.3g} to {row['worst_to_s']:.3g} s: see the other lines, or the noise "
                "that is stated or assumed is wrong."
            )
    usual = pd.Series(c.normalised.ravel()).median() < CONFIDENT_RATIO  # else the noise is understated throughout
    if usual and len(rows) == len(c.vehicles) > 1 and np.ptp(begins) < 0.2 * np.ptp(c.world.t):
        yield f"all vehicles at once, from {begins[0]:.3g} s on: did a base station or the origin change?"


def _of_vehicles(c: Check) -> list[str]:
    """Noise, outliers, distances and directions of the fixes against the odometry."""
    return [sentence for row in c.vehicles for sentence in _of_vehicle(c, row)]


def _of_vehicle(c: Check, row: Row) -> list[str]:
    """Of one; odometry that fails, or noise that is not as stated, where nothing else explains it."""
    name, nis, distance, turn = (row[key] for key in ("vehicle", "nis", "fixes_per_odometry", "turned_deg"))
    column, sentences = c.world.ids.index(name), list[str]()
    say = sentences.append
    wild = c.wild[column]
    share = wild / max(row["fixes"] + wild, 1)
    if share > OUTLIER_SHARE and wild > LEAST_OUTLIERS:
        say(
            f"{name}: {share:.1%} of the fixes lie beyond 5 standard deviations of their usual innovation: outliers, "
            "which a filter without a gate follows."
        )
    axes = _axes(c, column)
    sentences += [f"{name}: {sentence}" for sentence in (_noisier(c, column), axes) if sentence]
    if axes or any(what.startswith(FAULTS[-1]) and name in who for what, who in c.log.summary.assumed.items()):
        return sentences
    if _beyond(row, "fixes_late_s", BEHIND):
        say(
            f"{name}: its fixes are {abs(row['fixes_late_s']):.2f} +- {row['fixes_late_s_error']:.2f} s "
            f"{'behind' if row['fixes_late_s'] > 0 else 'ahead of'} its odometry: clocks differ, or the receiver "
            "smooths them. It cannot be said yet whether the odometry errs."
        )
    east, north = row.get("beside_east", 0.0), row.get("beside_north", 0.0)
    unsure = np.hypot(row.get("beside_east_error", 0.0), row.get("beside_north_error", 0.0))
    if (pace := float(np.hypot(east, north))) > max(BESIDE, SURE_ERRORS * unsure):
        say(
            f"{name}: it moves by {pace:.2f} +- {unsure:.2f} m/s towards "
            f"{np.degrees(np.arctan2(north, east)):.0f} deg from +x relative to its odometry: wind, a "
            f"current, a ferry; or fixes that drift. offset={name}.vx:{-east:.2g},{name}.vy:{-north:.2g} takes it off; "
            "if it changes, the std of a speed or velocity that lets filters follow the fixes is "
            f"{pace * (len(c.world.t) / row['fixes']) ** 0.5:.2g} m/s."
        )
    if turn is not None and abs(turn) > AXIS_TURN:
        say(
            f"{name}: fixes move {turn:.0f} deg anticlockwise of the odometry: its forward axis, or the headings, "
            f"look turned by {-turn:.0f} deg. Speeds are positive forward, headings anticlockwise from +x (east), "
            f"rad; clockwise from north in degrees is compass_deg. At 180, "
            f"{c.log.summary.scale(name, -1, *FORWARD)}."
        )
    elif turn is not None and (may := _may(row, "turned", LEAST_TURN)):
        say(
            f"{name}: its odometry {may} turned by {np.rad2deg(row['turned']):.2f} +- "
            f"{np.rad2deg(row['turned_error']):.2f} deg anticlockwise: headings, the mounting of a sensor, "
            "or, on a bend at one speed, a clock."
        )
    if distance is not None and not 0.8 <= distance <= 1.25:
        unit = next((hint for low, high, hint in WRONG_UNITS if low < distance < high), "Check the units of both.")
        say(f"{name}: fixes travel {distance:.2g} times as far as the odometry says. {unit}")
    elif name in c.failing and all(MAY in one for one in sentences):
        moved, driven, *_ = moves(c, column)
        back = abs(moved + driven) < 0.5 * abs(moved)
        cause = "slips, a counter that begins anew, or a speed or heading that is held or wrong."
        if back.sum() >= 3 and back.mean() > LEAST_BACK:
            cause = f"fixes go back on {back.mean():.0%} of the way: speeds are negative in reverse."
        say(f"{name}: its odometry fails, or its fixes drift {c.failing[name]}: {cause}")
    elif c.in_body and abs(row.get("speed_excess", 0.0)) > DIVERGED:
        say(
            f"{name}: its filter has diverged, with speeds too large by {row['speed_excess']:.0%}: are yaw rates "
            "and bearings in rad and anticlockwise, bearings from the forward axis, and speeds negative in reverse?"
        )
        return sentences
    elif may := _may(row, "speed_excess", LEAST_SCALE):
        say(
            f"{name}: its odometry {may} too {'fast' if row['speed_excess'] > 0 else 'slow'} by "
            f"{100 * abs(row['speed_excess']):.2f} +- {100 * row['speed_excess_error']:.2f} %: "
            f"{c.log.summary.scale(name, 1 / (1 + row['speed_excess']), *FORWARD)} mends it, and a pose filter "
            "estimates it."
        )
    if may := _may(row, "yaw_rate_bias", LEAST_DRIFT):
        say(
            f"{name}: the bias of its yaw rates {may} {row['yaw_rate_bias']:.2g} +- "
            f"{row['yaw_rate_bias_error']:.2g} rad/s: a pose filter estimates it."
        )
    most = 2.0 if all(MAY in one for one in sentences) else inf
    squares = np.nan_to_num(c.normalised[:, column])
    at = squares.argmax()
    if most == 2.0 and squares[at] > JUMP_NIS and squares[:at].sum() < OUTLYING * at:
        say(
            f"{name}: its fixes jump by {norm(c.fix[at, column]):.3g} m at {c.world.t[at] - c.world.t[0]:.1f}"
            " s, and stay there: another zone, frame, place or base station?"
        )
    elif nis is not None and row["fixes"] > LEAST_COUNT and not 0.2 <= nis <= most:
        say(
            f"{name}: NIS is {nis:.3g}, not 1: the errors of fixes and odometry are {nis**0.5:.2g} times as large "
            "as stated or assumed, or correlated in time. Give std columns in m, or sensors=."
            + " Were variances given as deviations?"
            * bool(0.8 < nis * c.fix_noise / 2**0.5 < 1.25)
        )
    return sentences


def _beyond(row: Row, name: str, least: float, errors: float = SURE_ERRORS) -> bool:
    """Whether an estimate of a row is larger than that, and than so many standard errors."""
    return float(abs(row.get(name) or 0.0)) > max(least, errors * (row.get(f"{name}_error") or 0.0))


def _may(row: Row, name: str, least: float) -> str:
    """Whether an estimate "is" or "may be" more than chance; "" if not."""
    return "is" if _beyond(row, name, least) else MAY * _beyond(row, name, least, PERHAPS)


def _late(c: Check, row: Row) -> bool:
    """Whether the odometry of a row is late beside the truth."""
    return _beyond(row, "late_s", max(LEAST_LAG, 0.1 * c.world.dt), SURE_CLOCK_ERRORS)


def _of_presence(c: Check) -> Iterator[str]:
    """Vehicles that are there when no other is."""
    there = c.world.present[:, [c.world.ids.index(row["vehicle"]) for row in c.vehicles]]
    for row, met in zip(c.vehicles, there.T @ there, strict=True):
        if len(met) > 1 == met.sum():
            yield (
                f"{row['vehicle']}: it is there when no other vehicle is: do clocks or time zones differ (clock=; "
                "dates without a zone are UTC), is it another drive, or did its name change?"
            )


def _of_clocks(c: Check) -> list[str]:
    """Vehicles whose clocks differ from that of the others, by their relative measurements."""
    return [
        f"{name}: its clock is {abs(ahead):.3f} +- {error:.3f} s {'ahead of' if ahead > 0 else 'behind'} the others' "
        f"by relative measurements, or its fixes are {'late' if ahead > 0 else 'early'}. "
        f"clock={name}:{ahead:.3f} mends it."
        for name, ahead, error in zip(c.world.ids, c.ahead, c.unsure, strict=True)
        if ahead
    ] + [
        f"{row['vehicle']}: its odometry is {abs(row['late_s']):.3f} +- {row['late_s_error']:.3f} s "
        f"{'later' if row['late_s'] > 0 else 'earlier'} than the truth{_with_fixes(c, row)}"
        for row in c.vehicles
        if _late(c, row) and not c.ahead[c.world.ids.index(row["vehicle"])]
    ]


def _with_fixes(c: Check, row: Row) -> str:
    """Whether the fixes of a vehicle are as late beside the truth as its odometry, and what mends it."""
    off, made, _ = causes(c)
    name, late = row["vehicle"], row["late_s"]
    column, mends = c.world.ids.index(name), f"clock={name}:{late:.3f}"
    used = np.isfinite(off[:, column])
    (ahead,), (unsure,) = factors(
        off[used, column], made[2:3, used, column].T, c.fix_noise * max(row["nis"] or 1.0, 1.0) ** 0.5
    )
    if abs(ahead + late) > SURE_ERRORS * np.hypot(unsure, row["late_s_error"]):
        return ", its fixes are not: is a velocity the mean of the interval before its stamp, which is half of it late?"
    if abs(ahead) > SURE_ERRORS * unsure:
        return f", as its fixes are: its clock differs from that of the truth. {mends} mends it."
    return f": its clock differs, which {mends} mends, or velocities are means of the interval before their stamps."


def _of_fixes(c: Check) -> Iterator[str]:
    """A sentence where the fixes of a vehicle are those of an antenna elsewhere, lie behind its truth along its way, by
    the same time at any speed, or beside it by more than their noise explains, as where the truth has another
    origin."""
    rec, truth = c.world, c.log.truth
    what = "odometry" if truth is None else "truth"
    off, made, then = causes(c)
    usual = c.fix_noise
    for column, name in enumerate(rec.ids):
        row = next((row for row in c.vehicles if row["vehicle"] == name), {})
        finite = np.isfinite(off[:, column] + made[:, :, column].sum(axis=0))
        shown = truth is None and c.shown(column)
        fits, left = [], list[float]()
        for share in ([1, 1, 1, 0], [0, 0, 1, truth is None])[shown:]:  # what looks like an arm may be late signals
            x, z = (each[:, finite, column].T * share for each in (made, then))
            fits.append(factors(off[finite, column], x, usual, np.zeros(len(x), int), z=z))
            rest = off[finite, column] - x @ fits[-1].value
            left.append(float(norm(rest - rest.sum() / max(len(rest), 1))))
        factor, std = fits[0]
        arm = ((abs(factor) > OFFSET_ERRORS * std) & (abs(factor) > LEAST_ARM))[:2].any() and left[0] <= left[-1]
        if arm and abs(factor[:2]).max() < LONGEST_ARM:
            yield (
                f"{name}: fixes look like those of an antenna {factor[0]:.2f} +- {std[0]:.2f} m ahead and "
                f"{factor[1]:.2f} +- {std[1]:.2f} m to the left of its {what}: "
                f"antenna={name}:{factor[0]:.2f}/{factor[1]:.2f}/0 takes it off."
            )
        else:
            arm, (factor, std) = False, fits[-1]
        sure = abs(factor) > OFFSET_ERRORS * std
        wrong = _beyond(row, "nis", OUTLYING) or _beyond(row, "per_std", OUTLYING)
        if abs(lag := lag_of_fixes(c, column) if wrong else 0.0) >= LONG_LAG:
            yield (
                f"{name}: its fixes are {abs(lag):.0f} s {'behind' if lag > 0 else 'ahead of'} the {what}, which "
                f"they else follow: clocks differ, as by leap seconds (clock={name}:{lag:.0f} where all its stamps "
                "are so), or files of two drives."
            )
            continue
        if sure[3] and left[-1] < left[0] and abs(factor[3]) >= BEHIND:
            headings = abs(factor[2] + factor[3]) < abs(factor[2])
            lag, kind = (factor[2], "headings") if headings else (factor[3], "speeds")
            yield (
                f"{name}: its {kind} are {abs(lag):.2f} s {'behind' if lag > 0 else 'ahead of'} its other signals: "
                "a filter or a bus delays them. Correct their stamps."
            )
            continue
        if c.ahead[column] or _late(c, row) or _beyond(row, "fixes_late_s", BEHIND) or truth is None or arm:
            continue  # an arm, which draws aside, draws along a bend, too
        if sure[2] and abs(lag := factor[2]) >= LEAST_LAG:
            yield (
                f"{name}: its fixes are {abs(lag):.2f} s {'ahead of' if lag > 0 else 'behind'} the truth along its "
                "way: clocks differ, or fixes carry the time at which they arrived; at one speed an antenna ahead "
                "looks alike."
            )
            continue
        every = rec.gnss[0, :, column] - truth.position[:, column]
        both = np.isfinite(every[:, 0])
        if both.sum() < LEAST_FIXES:
            continue
        east, north, up = (median(axis) for axis in every[both].T)
        if np.ptp(rec.gnss[0, both, column, 2]) and abs(up[0]) > max(OFFSET_ERRORS * up[1], rec.sensors.fix_std[2] / 2):
            yield (
                f"{name}: fixes lie {up[0]:.3g} m above the truth in the median. Is one of the two above the "
                "ellipsoid, the other above the geoid, or are antennas elsewhere?"
            )
        away, unsure = np.hypot(east, north)
        if away > max(min(OFFSET_ERRORS * unsure, FRAME_STDS * usual), usual / 2):
            theirs = norm(rec.gnss[0, :, column, None, :2] - truth.position[..., :2], axis=-1)
            like = [one for one, far in zip(rec.ids, pd.DataFrame(theirs[both]).median(), strict=True) if far < usual]
            hint = "Has it another frame? Fixes in degrees are local at the first: give origin= of the truth, or it in "
            hint = f"They follow the truth of {like[0]}: are names exchanged?" if like else f"{hint}degrees."
            yield (
                f"{name}: fixes lie {east[0]:.3g} m east and {north[0]:.3g} m north of the truth in the median. {hint}"
            )


def _unseen(c: Check) -> Iterator[str]:
    """What the check could not see, and of whom."""
    every = [row["vehicle"] for row in c.vehicles]
    if c.log.truth is None:
        yield (
            "errors that all sensors share, as a constant shift of all fixes (a base station's, the origin's) or all "
            "clocks: there is no truth"
        )
    if not every:
        yield "errors of fixes, none of which changes while nothing moves"
    turns = ("turned", LEAST_TURN, "rad, of the direction of the odometry")
    if c.in_body:
        turns = ("yaw_rate_bias", LEAST_DRIFT, "rad/s, of the yaw rates")
    for name, least, what in (("speed_excess", LEAST_SCALE, "as a share, of the speeds"), turns):
        errors = {row["vehicle"]: SURE_ERRORS * row.get(f"{name}_error", inf) for row in c.vehicles}
        if blind := _below(errors, 2 * least):
            yield f"errors, {what} of {blind}"
    unsure = dict(zip(c.world.ids, c.unsure, strict=True))
    late = {row["vehicle"]: min(row.get("late_s_error", inf), unsure[row["vehicle"]]) for row in c.vehicles}
    if blind := _below({who: SURE_CLOCK_ERRORS * error for who, error in late.items()}, 2 * LEAST_LAG):
        yield f"errors, s, of the clocks of {blind}"
    fixes = dict(zip(c.world.ids, np.isfinite(c.fix[..., 0]).sum(0), strict=True))
    if few := [who for who in every if fixes[who] < LEAST_COUNT]:
        yield f"late fixes of {', '.join(few)}, and whether their deviations are right: too few fixes"


def _below(errors: Mapping[str, float], enough: float) -> str:
    """Names of what is not known as well as enough, with what stays hidden."""
    blind = {name: error for name, error in errors.items() if error > enough}
    return ", ".join(f"{name} (below {error:.2g})" if np.isfinite(error) else name for name, error in blind.items())


CHECKS: tuple[Callable[[Check], Iterable[str]], ...] = (
    _of_rows,
    _of_presence,
    _of_clocks,
    of_ranges,
    of_places,
    _of_vehicles,
    _of_fixes,
    of_measurements,
)
"""What looks wrong: each takes the filtered log and returns sentences. A new check is one more entry."""
