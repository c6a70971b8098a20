"""Innovation and residual statistics of a log (`residuals`), and sentences on what is implausible."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import scipy  # its statistics take half a second, and are imported where they are used

from coopoc.arrays import Floats, robust_std
from coopoc.evaluate.metrics import dimensions
from coopoc.world.body_frames import turned
from coopoc.world.links import wrap
from coopoc.world.recording import Recording

from .estimates import (
    DRIFT,
    ENOUGH,
    FAR,
    LATE,
    OUTLYING,
    SCALE,
    SURELY,
    TURNED,
    Estimate,
    against_truth,
    by_pair,
    causes,
    factors,
    moves,
    odometry,
    offsets,
    on_time,
    worst,
)
from .estimates import median as median_of
from .motion import MOVING
from .read import Log
from .residuals import Check, filtered
from .unseen import unseen

UNITS = {"range": "m", "azimuth": "rad", "inclination": "rad"}
WIDE, NARROW = 2.0, 0.4
"""Ratios of a measured to a stated standard deviation at which something is wrong."""
ALIKE = 0.97
"""Correlation of the displacements of fixes and odometry that noise alone does not bring about."""
COARSE = 0.5
"""rad: no sensor's angles scatter as much about positions that are better known."""
HINTS = {
    "range": "Are clocks, or the positions of one, off?",
    "azimuth": "Check their zero (+x, or the heading for a bearing), their sense (anticlockwise), their unit (rad), "
    "whose heading they count from, and that no axis is mirrored.",
    "inclination": "Inclinations count from +z, elevations from the horizon.",
}
"""What to look for where measurements of a kind miss the positions."""
MISTAKEN = (
    (-1.0, 3e-3, "Is t in ms (scale=t:1e-3) or finer, or are positions in km? Or is a fix repeated?"),
    (0.2, 0.4, "Is speed in km/h? Name it speed_kmh. Or in feet a second? Speeds are in m/s."),
    (0.42, 0.55, "Is speed in miles an hour, or in knots? Speeds are in m/s."),
    (3.0, 3.6, "Are positions in feet? They are in m."),
)
"""Ratios of the distance of fixes to that of odometry (least, largest), and the unit that explains them."""
FEW, APART = 5, 1.5
"""Fixes with a truth from which a difference of frames shows; standard deviations of a fix that it must have."""
SIGMAS = 6.0
"""Standard errors of an offset beyond which it is no chance."""
ARM = 0.2
"""m, least arm of an antenna that is worth a word."""
CONFIDENT = 3.0
"""Errors over the deviations that a filter states, in a part of the drive, from which it is wrong."""
OUTLIERS = 0.01
"""Share of measurements beyond 5 standard deviations that is worth a word."""
WINDOW = 9
"""Measurements of a pair whose median is taken off to count outliers."""
UNUSED = 0.05
"""Share of what was logged that may be left out without a word."""
PLACED = "Give a fix of each, a table vehicle, x, y of places, or a column vehicle where files are not named after one."
ADVICE = {
    "repeated rows": "Do stamps lack their fraction, as stamp.sec without nanosec, or do two vehicles share a name?",
    "fixes in gaps of the odometry": "Where a vehicle stands, log a speed of 0; raise max_gap= for longer gaps.",
    "relative measurements of members": PLACED,
    "odometry and headings of vehicles": PLACED,
    "azimuths at times without": "Do they count from the heading? Then name them bearing; else log a heading.",
    "relative measurements while": "Do their clocks differ? Give clock=, or raise max_gap=.",
    "fixes beside": "A shorter dt= uses them.",
    "relative measurements beside": "A shorter dt= uses them.",
}
"""How to use what was left out, by the beginning of the reason."""


def check(log: Log) -> Check:
    """Innovation statistics of a log, with the noise that its recording states.

    Raises:
        InputError: in body frames, vehicles that share no two steps, or first poses that are not known.
    """
    result = on_time(filtered(log))
    if not result.ahead.any():
        result = against_truth(result)
    result = replace(result, vehicles=_vehicles(result))
    if log.recording.body is None and (log.truth is None or result.ahead.any()):  # what errs says nothing of others
        errs = [result.world.ids.index(row["vehicle"]) for row in result.vehicles if _off(row)]
        links = result.world.links
        ends = np.isin(links.observer, errs) | np.isin(links.neighbour, errs)
        result = replace(result, relative=np.where(ends[:, None], np.nan, result.relative))
    result = replace(result, measurements=_measurements(result))
    sentences = [sentence for rule in CHECKS for sentence in rule(result)]
    return replace(result, warnings=tuple(sentences), unseen=tuple(unseen(result)))


def _vehicles(c: Check) -> list[dict[str, Any]]:
    rows, rec, truth = [], c.world, c.log.truth
    for column, name in enumerate(rec.ids):
        fixed = np.isfinite(c.normalised[:, column])
        speed = np.linalg.norm(rec.velocity[0, :, column], axis=-1)
        if not np.nanmax(speed, initial=0.0) > 0:
            continue
        distance, turn = _against_odometry(rec, column)
        wheels = odometry(c, column)
        if distance is None and np.isfinite(wheels.error[0]):
            distance = 1.0 / (1.0 + wheels.value[0])
        row: dict[str, Any] = {
            "vehicle": name,
            "fixes": int(np.isfinite(rec.gnss[0, :, column, 0]).sum()),
            "there": float(np.isfinite(speed).mean()),
            "innovation_m": _rms(c.fix[fixed, column]),
            "nis": float(c.normalised[fixed, column].mean()) if fixed.any() else None,
            "fixes_per_odometry": distance,
            "turned_deg": turn,
            **_with_error("speed_excess", wheels, 0),
            **_with_error("turned" if c.log.recording.body is None else "yaw_rate_bias", wheels, 1),
            **(_with_error("late_s", wheels, 2) if truth is not None else {}),
            "clock_s": float(c.ahead[column]) if np.isfinite(c.unsure[column]) else None,
            "std_m": _rms(np.sqrt(c.variance[:, column])),
        }
        if truth is not None:
            row["fix_error_m"] = _rms(rec.gnss[0, :, column] - truth.position[:, column])
            row["error_m"] = _rms(c.scored[0][:, column] - truth.position[:, column])
            row["error_per_std"], row["worst_at_s"] = worst(c, column)
        rows.append(row)
    return rows


def _with_error(name: str, found: Estimate, k: int) -> dict[str, float | None]:
    """Two columns of a table: an estimate and its standard error."""
    finite = bool(np.isfinite(found.error[k]))
    return (
        dict(zip((name, f"{name}_error"), map(float, (found.value[k], found.error[k])), strict=True)) if finite else {}
    )


def _rms(vectors: Floats) -> float | None:
    """Root of the mean squared length of vectors (M, 3), None where all are unknown."""
    square = np.square(vectors).sum(axis=-1)
    return float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else None


def _against_odometry(rec: Recording, column: int) -> tuple[float | None, float | None]:
    """Distance of fixes over distance of odometry, with the fixes' noise taken off; and the angle between the two, deg.
    None where too little moves."""
    moved, driven = moves(rec, column)
    if not len(moved):
        return None, None
    variance = 2 * len(moved) * float(np.square(rec.sensors.fix_std[:2]).sum())
    length = float(np.linalg.norm(driven))
    if length == 0:
        return float("inf"), None
    far = max(float(np.linalg.norm(moved)) ** 2 - variance, 0.0) ** 0.5
    return far / length, float(np.angle(np.vdot(driven, moved), deg=True))


def _axes(c: Check, column: int) -> str:
    """What is wrong with the axes of velocities that explain the fixes once they are mirrored, or whose direction never
    changes while that of the fixes does; nothing where they agree. In body frames velocities are turned by the
    integral of the yaw rate alone."""
    rec, log = c.world, c.log.recording
    if log.body is not None:
        heading = rec.dt * np.cumsum(np.nan_to_num(log.body.yaw_rate), axis=1)
        rec = replace(rec, velocity=turned(log.velocity, heading))
    moved, driven = moves(rec, column)
    size = np.linalg.norm(moved) * np.linalg.norm(driven)
    u = rec.velocity[0, np.isfinite(rec.velocity[0, :, column, 0]), column, :2]
    if not size or abs(np.vdot(driven, moved)) > ALIKE * size:
        return ""
    mirror = np.vdot(driven.conj(), moved)
    if abs(mirror) > ALIKE * size:
        return (
            f"axes look swapped or mirrored: fixes move as odometry mirrored at {np.angle(mirror, deg=True) / 2:.0f}"
            " deg from +x. At 45, swap easting and northing, latitude and longitude, or vx and vy; headings clockwise "
            "from north are compass_deg. At 0, change the sign of y or vy; at +-90, of x or vx; in body frames, of the "
            "yaw rate: it is anticlockwise."
        )
    if np.square(u[:, 1]).mean() < 0.01 * np.square(u[:, 0]).mean():
        return (
            "vx, vy look like a body-frame velocity: along +x throughout, while the fixes turn. Name vx speed, and log "
            "a heading or a yaw_rate."
        )
    return ""


def _measurements(c: Check) -> list[dict[str, Any]]:
    rows = []
    for k, (name, unit) in enumerate(UNITS.items()):
        there = np.isfinite(c.relative[:, k])
        residual = c.relative[there, k]
        if not there.any() or np.ptp(c.log.recording.relative[0, there, k]) == 0:
            continue
        named = {pair: offset for pair, offset, _ in _named(c, k, float(c.world.sensors.relative_std[k]))}
        less = np.concatenate([value - named.get(pair, 0.0) for pair, value, *_ in by_pair(c, k)])
        std, median = robust_std(less), float(np.median(residual))
        row: dict[str, Any] = {"measurement": name, "unit": unit, "number": len(residual), "median": median}
        row |= {"robust_std": std, "stated_std": float(c.world.sensors.relative_std[k])}
        row["expected_std"] = float(np.sqrt(np.mean(c.expected[there, k] ** 2)))
        rows.append(row | _scatter(c, k, row["stated_std"]))
    return rows


def _of_rows(c: Check) -> list[str]:
    """Measurements and columns that were left out."""
    summary, sentences = c.log.summary, []
    left = {why: number for why, (number, _) in summary.refused.items() if not why.startswith("steps of")}
    share = sum(left.values()) / max(sum(left.values()) + sum(summary.read.values()), 1)
    if share > UNUSED:
        why = max(left, key=lambda reason: left[reason])
        hint = next((hint for begin, hint in ADVICE.items() if why.startswith(begin)), "")
        first = summary.refused[why][1]
        sentences.append(
            f"{share:.0%} of what was logged is not used, first of all {left[why]} {why}"
            + f" (first: {first})" * bool(first)
            + f". {hint}".rstrip(" ")
        )
    return [*sentences, *filter(None, [summary.unread])]


def _of_errors(c: Check) -> list[str]:
    """Vehicles whose filter errs by more than it states."""
    return [
        f"{row['vehicle']}: its filter errs by {row['error_per_std']:.1f} times what it states in the tenth of the "
        f"drive from {row['worst_at_s']:.3g} s on, by {row['error_m']:.3g} m in all: by what is named below, or by "
        "noise that is not as stated."
        for row in sorted(c.vehicles, key=lambda row: -(row.get("error_per_std") or 0.0))
        if (row.get("error_per_std") or 0.0) > CONFIDENT
    ]


def _of_vehicles(c: Check) -> list[str]:
    """Noise, outliers, distances and directions of the fixes against the odometry."""
    sentences, size = [], dimensions(c.world)
    for row in c.vehicles:
        name, nis, distance, turn = (row[key] for key in ("vehicle", "nis", "fixes_per_odometry", "turned_deg"))
        column = c.world.ids.index(name)
        square = size * c.normalised[np.isfinite(c.normalised[:, column]), column]
        usual = max(float(np.median(square)) / scipy.stats.chi2.median(size), 0.04) if len(square) > ENOUGH else np.inf
        outliers = float(np.mean(square > OUTLYING**2 * usual)) if len(square) else 0.0
        if outliers > OUTLIERS:
            sentences.append(
                f"{name}: {outliers:.1%} of the fixes lie beyond 5 standard deviations of their usual innovation: "
                "outliers, which a filter without a gate follows."
            )
        if nis is not None and row["fixes"] > ENOUGH and not 0.2 <= nis <= 2:
            word = "larger" if nis > 2 else "smaller"
            sentences.append(
                f"{name}: NIS is {nis:.3g}, not 1: the errors of fixes and odometry are {word} than stated, "
                "or correlated in time. Give std columns or sensors=."
            )
        if axes := _axes(c, column):
            sentences.append(f"{name}: {axes}")
            continue
        if distance is not None and not 0.8 <= distance <= 1.25:
            unit = next((hint for low, high, hint in MISTAKEN if low < distance < high), "Check the units of both.")
            sentences.append(f"{name}: fixes travel {distance:.2g} times as far as the odometry says. {unit}")
        elif row.get("speed_excess") is not None and _beyond(row, "speed_excess", SCALE):
            sentences.append(
                f"{name}: its odometry is too fast by {100 * row['speed_excess']:.2f} +- "
                f"{100 * row['speed_excess_error']:.2f} %: multiply its speeds by "
                f"{1 / (1 + row['speed_excess']):.4g}, or take a pose filter, which estimates it."
            )
        if _beyond(row, "yaw_rate_bias", DRIFT):
            sentences.append(
                f"{name}: its yaw rates are too large by {row['yaw_rate_bias']:.2g} +- "
                f"{row['yaw_rate_bias_error']:.2g} rad/s: a pose filter estimates it."
            )
        if turn is not None and abs(turn) <= 20 and _beyond(row, "turned", TURNED):
            sentences.append(
                f"{name}: its odometry is turned by {np.rad2deg(row['turned']):.2f} +- "
                f"{np.rad2deg(row['turned_error']):.2f} deg anticlockwise: headings, or the mounting of a sensor."
            )
        if turn is not None and abs(turn) > 20:
            sentences.append(
                f"{name}: fixes move {turn:.0f} deg anticlockwise of the odometry: its forward axis, or the headings, "
                f"look turned by {-turn:.0f} deg. Speeds are positive forward, headings anticlockwise from +x (east), "
                "rad; clockwise from north in degrees is compass_deg."
            )
    return sentences


def _beyond(row: Mapping[str, Any], name: str, least: float) -> bool:
    """Whether an estimate of a row is larger than that, and than chance."""
    return float(abs(row.get(name) or 0.0)) > max(least, SURELY * (row.get(f"{name}_error") or 0.0))


def _off(row: Mapping[str, Any]) -> bool:
    """Whether the odometry of a row errs."""
    return any(_beyond(row, *one) for one in (("speed_excess", SCALE), ("turned", TURNED), ("yaw_rate_bias", DRIFT)))


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
        f"{'later' if row['late_s'] > 0 else 'earlier'} than the truth: "
        f"its clock differs from that of the truth. clock={row['vehicle']}:{row['late_s']:.3f} mends it."
        for row in c.vehicles
        if _beyond(row, "late_s", max(LATE, 0.5 * c.world.dt)) and not c.ahead[c.world.ids.index(row["vehicle"])]
    ]


def _of_fixes(c: Check) -> list[str]:
    """A sentence where the fixes of a vehicle are those of an antenna elsewhere, lie behind its truth along its way, by
    the same time at any speed, or beside it by more than their noise explains, as where the truth has another
    origin."""
    rec, truth, sentences = c.world, c.log.truth, []
    off, made = causes(c)
    for column, name in enumerate(rec.ids):
        finite = np.isfinite(off[:, column] + made[:, :, column].sum(axis=0))
        every_one = np.zeros(finite.sum(), int)
        for share in ([1, 1, 1], [0, 0, 1]):  # without an arm that is sure a clock may explain it all
            factor, std = factors(off[finite, column], made[:, finite, column].T * share, every_one)
            sure = np.abs(factor) > SIGMAS * std
            if (sure & (np.abs(factor) > ARM))[:2].any():
                sentences.append(
                    f"{name}: fixes look like those of an antenna {factor[0]:.2f} +- {std[0]:.2f} m ahead and "
                    f"{factor[1]:.2f} +- {std[1]:.2f} m to the left of its {'odometry' if truth is None else 'truth'}: "
                    f"antenna={name}:{factor[0]:.2f}/{factor[1]:.2f}/0 takes it off."
                )
                break
        row = next((row for row in c.vehicles if row["vehicle"] == name), {})
        if c.ahead[column] or _beyond(row, "late_s", max(LATE, 0.5 * c.world.dt)):
            continue
        derived = truth is None and rec.sensors.velocity_reading == "fixes"
        derived |= truth is None and _off(row)  # what draws positions aside draws them along a bend, too
        if sure[2] and abs(lag := factor[2]) >= LATE and not derived:
            way = "ahead of" if lag > 0 else "behind"
            sentences.append(
                f"{name}: its fixes are {abs(lag):.2f} s {way} the {'odometry' if truth is None else 'truth'} along "
                "its way: clocks differ, or fixes carry the time at which they arrived; at one speed an antenna ahead "
                "looks alike."
            )
            continue
        if truth is None:
            continue
        every = rec.gnss[0, :, column] - truth.position[:, column]
        both = np.isfinite(every[:, 0])
        if both.sum() < FEW:
            continue
        (east, north), (up, spread) = np.median(every[both, :2], axis=0), median_of(every[both, 2])
        if np.ptp(rec.gnss[0, both, column, 2]) and abs(up) > max(SIGMAS * spread, rec.sensors.fix_std[2] / 2):
            sentences.append(
                f"{name}: fixes lie {up:.3g} m above the truth in the median. Is one of the two above the "
                "ellipsoid, the other above the geoid, or are antennas elsewhere?"
            )
        if np.hypot(east, north) >= APART * np.hypot(*rec.sensors.fix_std[:2]):
            sentences.append(
                f"{name}: fixes lie {east:.3g} m east and {north:.3g} m north of the truth in the median. Has it "
                "another frame? Fixes in degrees are local at the first: give origin= of the truth, or it in degrees."
            )
    return sentences


def _of_measurements(c: Check) -> list[str]:
    """Residuals of relative measurements that no stated noise explains: scale, outliers, offsets of pairs."""
    sentences = []
    for row in c.measurements:
        name, unit, median, std, should = (
            row[key] for key in ("measurement", "unit", "median", "robust_std", "expected_std")
        )
        if row["number"] < ENOUGH:
            continue
        word = "bearing" if name == "azimuth" and c.log.recording.body is not None else name
        hint = HINTS[name]
        stated = f"{median:.3g} +- {std:.3g} {unit}, {should:.3g} {unit} expected"
        position = float(np.sqrt(max(should**2 - row["stated_std"] ** 2, 0.0)))
        wrong = std > WIDE * should or (name == "azimuth" and std > COARSE > 3 * position)
        scaled = False
        if name != "range":
            wrong |= abs(median) > 3 * should
            hint = (_other_angle(c) if name == "azimuth" else "") or hint
        else:
            measured = c.world.relative[0, :, 0]
            true = measured - c.relative[:, 0]
            far = measured + true > 2 * FAR * position
            ratios = measured[far] / np.maximum(true[far], 1e-3)
            ratio = float(np.median(ratios)) if len(ratios) >= ENOUGH else 1.0
            wrong |= (other := not 0.8 <= ratio <= 1.25)
            if scaled := other and robust_std(ratios) < 0.2 * ratio:
                power = round(np.log10(ratio))
                unit_of = 10.0**-power if power and abs(np.log10(ratio) - power) < 0.1 else 1 / ratio
                unit_text = f"scale=range:{unit_of:.3g} (of mm 0.001, of feet 0.3048); then check again."
                hint = f"They are {ratio:.3g} times as long: {unit_text}"
        outliers, pairs = row["beyond_5_std"], _named(c, list(UNITS).index(name), row["stated_std"])
        if outliers > OUTLIERS and not scaled:
            sentences.append(
                f"{outliers:.1%} of the {word}s lie beyond 5 standard deviations of those before and after: outliers, "
                "as of reflections. Drop them, or take a method with a gate or a robust loss."
            )
        if wrong:
            sentences.append(f"{word}s miss the positions by {stated}. {hint}")
        if pairs and (not wrong or hint == HINTS["range"]):
            shown = ", ".join(f"{pair} by {offset:+.3g} +- {error:.2g} {unit}" for pair, offset, error in pairs)
            offsets_text = ",".join(f"{pair.replace(' and ', '-')}:{offset:.3g}" for pair, offset, _ in pairs)
            sentences.append(
                f"{word}s of {shown} are off in the median, with {row['stated_std']:.3g} {unit} stated: an "
                "offset of the sensors, of antennas, or of fixes or heights of one of the two; "
                + (f"offset={offsets_text} takes it off." if word == "range" else "offset= takes it off.")
            )
        noise, least = row["noise"], row["stated_std"]
        if not wrong and not NARROW * least < noise < WIDE * np.hypot(least, position):
            size = "less" if noise < least else "more"
            sentences.append(
                f"{word}s scatter {size} than stated, by {noise:.2g} {unit} from one to the next, {least:.2g} {unit} "
                f"stated: std={word}:{noise:.2g}. Were variances given as deviations?"
            )
    return sentences


def _named(c: Check, k: int, stated: float) -> list[tuple[str, float, float]]:
    """Pairs whose measurements of one kind are off by more than chance and a quarter of their noise, with their offsets
    and standard errors, largest first."""
    offset_and_error = [(pair, *offset_and_error) for pair, offset_and_error in offsets(c, k, stated).items()]
    return sorted(
        (row for row in offset_and_error if abs(row[1]) > max(SURELY * row[2], 0.25 * stated)),
        key=lambda row: -abs(row[1]),
    )


def _other_angle(c: Check) -> str:
    """What azimuths look like that miss the positions by the course of their observers."""
    links = c.world.links
    moves = c.world.velocity[0, links.step, links.observer, :2] @ [1, 1j]
    there = np.isfinite(c.relative[:, 1]) & (np.abs(moves) > MOVING)
    residual, course, measured = c.relative[there, 1], np.angle(moves[there]), c.world.relative[0, there, 1]
    off = float(np.angle(np.exp(1j * residual).sum()))
    off += float(np.median(wrap(residual - off)))
    for like, turn in (
        ("bearings: name them bearing", course),
        ("azimuths: name them azimuth", -course),
        ("bearings clockwise from the heading: change their sign", 2 * (course - measured)),
        (f"angles from an axis that is turned by {-off:.3g} rad: add {-off:.3g}", -off),
    ):
        if len(course) >= ENOUGH and 3 * np.median(np.abs(wrap(residual + turn))) < np.median(np.abs(residual)):
            return f"They look like {like}."
    return ""


def _scatter(c: Check, k: int, stated: float) -> dict[str, float]:
    """Standard deviation of measurements about the running median of their pair, and the share beyond 5 of them: errors
    of the filters last longer than that window."""
    near = (value - pd.Series(value).rolling(WINDOW, 1, center=True).median() for _, value, *_ in by_pair(c, k))
    off = np.concatenate([*near])
    noise = robust_std(off)
    return {"noise": noise, "beyond_5_std": float(np.mean(np.abs(off) > OUTLYING * max(noise, 0.2 * stated)))}


CHECKS: tuple[Callable[[Check], list[str]], ...] = (
    _of_errors,
    _of_rows,
    _of_clocks,
    _of_vehicles,
    _of_fixes,
    _of_measurements,
)
"""What looks wrong: each takes the filtered log and returns sentences. A new check is one more entry."""
