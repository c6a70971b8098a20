"""Innovation and residual statistics of a log (`residuals`), and sentences on what is implausible."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import scipy  # its statistics take half a second, and are imported where they are used

from coopoc.arrays import AnyArray, Floats, Ints, robust_std
from coopoc.evaluate.metrics import dimensions
from coopoc.world.body_frames import turned
from coopoc.world.links import wrap
from coopoc.world.recording import Recording

from .motion import MOVING
from .read import Log
from .residuals import Check, filtered, residual_of

UNITS = {"range": "m", "azimuth": "rad", "inclination": "rad"}
WIDE, NARROW = 2.0, 0.4
"""Ratios of a measured to a stated standard deviation at which something is wrong."""
FAR = 10.0
"""Standard deviations of a fix that odometry must have moved, so that noise does not look like motion."""
ALIKE = 0.97
"""Correlation of the displacements of fixes and odometry that noise alone does not bring about."""
ENOUGH = 20
"""Measurements from which a statistic is worth a word."""
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
ARM, VARIED, NUDGE = 0.2, 0.15, 0.01
"""m, least arm of an antenna that is worth a word; standard deviation over mean of a speed below which an arm ahead
and a late clock look alike; m and s by which fixes are moved to see what a filter makes of an arm."""
OUTLYING, OUTLIERS = 5.0, 0.01
"""Standard deviations beyond which a measurement is an outlier; the share of them that is worth a word."""
WINDOW, BLOCKS = 9, 10
"""Measurements of a pair whose median is taken off to count outliers; parts of a drive that show how sure it is."""
FIRST = 0.4
"""Share of a log that shows by what its ranges are too long."""
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
    result = filtered(log)
    result = replace(result, vehicles=_vehicles(result), measurements=_measurements(result))
    return replace(result, warnings=tuple(sentence for rule in CHECKS for sentence in rule(result)))


def _vehicles(c: Check) -> list[dict[str, Any]]:
    rows, rec, truth = [], c.world, c.log.truth
    for column, name in enumerate(rec.ids):
        fixed = np.isfinite(c.normalised[:, column])
        speed = np.linalg.norm(rec.velocity[0, :, column], axis=-1)
        if not np.nanmax(speed, initial=0.0) > 0:
            continue
        distance, turn = _against_odometry(rec, column)
        row: dict[str, Any] = {
            "vehicle": name,
            "fixes": int(np.isfinite(rec.gnss[0, :, column, 0]).sum()),
            "there": float(np.isfinite(speed).mean()),
            "innovation_m": _rms(c.fix[fixed, column]),
            "nis": float(c.normalised[fixed, column].mean()) if fixed.any() else None,
            "fixes_per_odometry": distance,
            "turned_deg": turn,
            "std_m": _rms(np.sqrt(c.variance[:, column])),
        }
        if truth is not None:
            row["fix_error_m"] = _rms(rec.gnss[0, :, column] - truth.position[:, column])
            row["error_m"] = _rms(c.x[:, column] - truth.position[:, column])
        rows.append(row)
    return rows


def _rms(vectors: Floats) -> float | None:
    """Root of the mean squared length of vectors (M, 3), None where all are unknown."""
    square = np.square(vectors).sum(axis=-1)
    return float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else None


def _moves(rec: Recording, column: int) -> tuple[AnyArray, AnyArray]:
    """Displacements (M,) m, x + iy, of the fixes and of the odometry over the same spans, in which the odometry (if
    that stands still, the fixes) moves far; none where too little moves."""
    fixes, velocity = rec.gnss[0, :, column, :2] @ [1, 1j], rec.velocity[0, :, column, :2] @ [1, 1j]
    path, gaps = np.cumsum(np.nan_to_num(velocity) * rec.dt), np.cumsum(np.isnan(velocity))
    for moves, far in ((path, FAR), (fixes, 2 * FAR)):
        pairs, last = [], -1
        for step in np.flatnonzero(np.isfinite(fixes)).tolist():
            if last < 0 or gaps[step] != gaps[last]:
                last = step
            elif abs(moves[step] - moves[last]) > far * np.hypot(*rec.sensors.fix_std[:2]):
                pairs.append((last, step))
                last = step
        if len(pairs) >= 3:
            a, b = np.array(pairs).T
            return fixes[b] - fixes[a], path[b] - path[a]
    return np.empty(0), np.empty(0)


def _against_odometry(rec: Recording, column: int) -> tuple[float | None, float | None]:
    """Distance of fixes over distance of odometry, with the fixes' noise taken off; and the angle between the two, deg.
    None where too little moves."""
    moved, driven = _moves(rec, column)
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
    moved, driven = _moves(rec, column)
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
        std, median = robust_std(residual), float(np.median(residual))
        row: dict[str, Any] = {"measurement": name, "unit": unit, "number": len(residual), "median": median}
        row |= {"robust_std": std, "stated_std": float(c.world.sensors.relative_std[k])}
        row["expected_std"] = float(np.sqrt(np.mean(c.expected[there, k] ** 2)))
        rows.append(row | {"beyond_5_std": _outliers(c, k, row["stated_std"])})
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
        if turn is not None and abs(turn) > 20:
            sentences.append(
                f"{name}: fixes move {turn:.0f} deg anticlockwise of the odometry: its forward axis, or the headings, "
                f"look turned by {-turn:.0f} deg. Speeds are positive forward, headings anticlockwise from +x (east), "
                "rad; clockwise from north in degrees is compass_deg."
            )
    return sentences


def _of_fixes(c: Check) -> list[str]:
    """A sentence where the fixes of a vehicle are those of an antenna elsewhere, lie behind its truth along its way, by
    the same time at any speed, or beside it by more than their noise explains, as where the truth has another
    origin."""
    rec, truth, sentences = c.world, c.log.truth, []
    off, causes = _causes(c)
    for column, name in enumerate(rec.ids):
        known = np.isfinite(off[:, column] + causes[:, :, column].sum(axis=0))
        for share in ([1, 1, 1], [0, 0, 1]):  # without an arm that is sure a clock may explain it all
            factor, std = _factors(off[known, column], causes[:, known, column].T * share)
            sure = np.abs(factor) > SIGMAS * std
            if (sure & (np.abs(factor) > ARM))[:2].any():
                sentences.append(
                    f"{name}: fixes look like those of an antenna {factor[0]:.2f} +- {std[0]:.2f} m ahead and "
                    f"{factor[1]:.2f} +- {std[1]:.2f} m to the left of its {'odometry' if truth is None else 'truth'}: "
                    f"antenna={name}:{factor[0]:.2f}/{factor[1]:.2f}/0 takes it off."
                )
                break
        if truth is None:
            continue
        every = rec.gnss[0, :, column] - truth.position[:, column]
        both = np.isfinite(every[:, 0])
        if both.sum() < FEW:
            continue
        (east, north), (up, spread) = np.median(every[both, :2], axis=0), _median(every[both, 2])
        if np.ptp(rec.gnss[0, both, column, 2]) and abs(up) > max(SIGMAS * spread, rec.sensors.fix_std[2] / 2):
            sentences.append(
                f"{name}: fixes lie {up:.3g} m above the truth in the median. Is one of the two above the "
                "ellipsoid, the other above the geoid, or are antennas elsewhere?"
            )
        if sure[2] and abs(lag := factor[2]) >= 0.5 * rec.dt:
            way = "ahead of" if lag > 0 else "behind"
            sentences.append(
                f"{name}: its fixes are {abs(lag):.2f} s {way} the truth along its way: the clock "
                "of the truth differs, or fixes carry the time at which they arrived; at one speed an antenna ahead "
                "looks alike."
            )
            continue
        if np.hypot(east, north) >= APART * np.hypot(*rec.sensors.fix_std[:2]):
            sentences.append(
                f"{name}: fixes lie {east:.3g} m east and {north:.3g} m north of the truth in the median. Has it "
                "another frame? Fixes in degrees are local at the first: give origin= of the truth, or it in degrees."
            )
    return sentences


def _causes(c: Check) -> tuple[AnyArray, AnyArray]:
    """What fixes are off by, x + iy m (T, N), and what an arm of 1 m ahead, one to the left, and a clock that is 1 s
    late make of it (3, T, N): against the truth, else against a filter, which is linear in what is added to fixes."""
    rec, truth = c.world, c.log.truth
    velocity = (rec.velocity[0] if truth is None else truth.velocity)[..., :2] @ [1, 1j]
    speed = pd.DataFrame(np.abs(velocity)).where(lambda v: v > MOVING)
    course = pd.DataFrame(np.angle(velocity)).where(speed > 0).ffill().bfill().to_numpy()
    ahead = np.nan_to_num(np.exp(1j * course)) * np.array(speed.std() > VARIED * speed.mean())
    causes = np.stack([ahead, 1j * ahead, velocity])
    if truth is not None:
        return (rec.gnss[0] - truth.position)[..., :2] @ [1, 1j], causes
    for k, cause in enumerate(np.nan_to_num(NUDGE * causes)):
        gnss = c.log.recording.gnss + np.stack([cause.real, cause.imag, 0 * cause.real], axis=-1)
        moved = filtered(replace(c.log, recording=replace(c.log.recording, gnss=gnss)))
        causes[k] = (moved.fix - c.fix)[..., :2] @ [1, 1j] / NUDGE
    return c.fix[..., :2] @ [1, 1j], causes


def _factors(y: AnyArray, x: AnyArray) -> Floats:
    """Factors (k,) of causes x (M, k) that explain y (M,) best, means and outliers aside, and their standard errors by
    parts of the drive that are left out, (2, k); of fewer measurements than enough zeros."""
    if len(y) < ENOUGH:
        return np.zeros((2, x.shape[1]))
    y, x = y - y.mean(), x - x.mean(axis=0)

    def fitted(rows: Ints) -> Floats:
        for _ in range(3):
            left, right = (np.concatenate([each[rows].real, each[rows].imag]) for each in (x, y))
            factor: Floats = np.linalg.lstsq(left, right)[0]
            gap = np.abs(y - x @ factor)
            rows = rows[gap[rows] <= OUTLYING * np.median(gap[rows])]
        return factor

    every = np.arange(len(y))
    without = [fitted(np.setdiff1d(every, part)) for part in np.array_split(every, BLOCKS)]
    return np.stack([fitted(every), np.sqrt(BLOCKS - 1.0) * np.std(without, axis=0)])


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
            if other and robust_std(ratios) < 0.2 * ratio:
                hint = f"They are {ratio:.3g} times as long: scale=range:{1 / ratio:.3g}, of mm 0.001, of feet 0.3048."
        outliers, offsets = row["beyond_5_std"], _offsets(c, list(UNITS).index(name), *2 * [row["stated_std"]])
        if outliers > OUTLIERS:
            sentences.append(
                f"{outliers:.1%} of the {word}s lie beyond 5 standard deviations of those before and after: outliers, "
                "as of reflections. Drop them, or take a method with a gate or a robust loss."
            )
        if wrong:
            sentences.append(f"{word}s miss the positions by {stated}. {hint}")
        if offsets and (not wrong or hint == HINTS["range"]):
            shown = ", ".join(f"{pair} by {offset:+.3g} {unit}" for pair, offset in offsets[:4])
            more = f" and {len(offsets) - 4} pairs more" if len(offsets) > 4 else ""
            given = ",".join(f"{pair.replace(' and ', '-')}:{offset:.3g}" for pair, offset in offsets)
            sentences.append(
                f"{word}s of {shown}{more} are off in the median, with {row['stated_std']:.3g} {unit} stated: an "
                "offset of the sensors, of antennas, or of fixes or heights of one of the two; "
                + (f"offset={given} takes it off." if word == "range" else "offset= takes it off.")
            )
        elif not wrong and std < NARROW * should and row["stated_std"] > 2 * std:
            sentences.append(f"{word}s are better than stated: {stated}.")
    return sentences


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


def _median(values: Floats) -> tuple[float, float]:
    """Median, and its standard error by the medians of parts of the drive."""
    parts = [np.median(part) for part in np.array_split(values, BLOCKS) if len(part)]
    return float(np.median(values)), float(np.std(parts) / np.sqrt(len(parts)))


def _by_pair(c: Check, k: int) -> Iterator[tuple[str, Floats, Floats]]:
    """Names of a pair, its residuals of one kind in order of time, and what they should scatter by."""
    links, ids = c.world.links, c.world.ids
    there = np.isfinite(c.relative[:, k])
    ends = np.column_stack([links.observer, links.neighbour])[there]
    pairs, index = np.unique(ends if k else np.sort(ends), axis=0, return_inverse=True)
    for number, (observer, neighbour) in enumerate(pairs.tolist()):
        mine = np.flatnonzero(there)[index.reshape(-1) == number]
        yield f"{ids[observer]} {'to' if k else 'and'} {ids[neighbour]}", c.relative[mine, k], c.expected[mine, k]


def _outliers(c: Check, k: int, stated: float) -> float:
    """Share of measurements beyond 5 standard deviations of the running median of their pair: errors of the filters
    last longer than that window."""
    near = (value - pd.Series(value).rolling(WINDOW, 1, center=True).median() for _, value, _ in _by_pair(c, k))
    off = np.concatenate([*near])
    return float(np.mean(np.abs(off) > OUTLYING * max(robust_std(off), 0.2 * stated)))


def _offsets(c: Check, k: int, stated: float, least: float) -> list[tuple[str, float]]:
    """Pairs whose residuals have a median above `least`, and above what the errors of the filters
    explain, which last for some time; largest first."""
    made, fixes, noise = [], np.isfinite(c.normalised).sum(axis=0), float(np.square(c.world.sensors.fix_std[:2]).mean())
    there = np.isfinite(c.variance[..., 0]).sum(axis=0)
    variance = np.nansum(c.variance[..., :2], axis=(0, 2)) / np.maximum(2 * there, 1)
    share = 2 * np.nanmax((variance + noise) / np.maximum(variance * fixes, 1e-12), where=variance > 0, initial=0.0)
    for pair, value, expected in _by_pair(c, k):
        (offset, error), position = _median(value), max(float(np.mean(expected**2)) - stated**2, 0.0)
        lasting = np.sqrt(stated**2 / len(value) + position * min(share, 1.0))
        if len(value) >= ENOUGH and abs(offset) > max(least, 3 * lasting, SIGMAS * error):
            made.append((pair, offset))
    return sorted(made, key=lambda row: -abs(row[1]))


def less_offsets(log: Log) -> Log:
    """The log with each pair's ranges less what they are too long by in the median over its first part, against the
    truth where there is one, else against the filters of each vehicle alone; nothing is taken off where that part shows
    none for sure. The summary names pairs and offsets.

    Raises:
        InputError: as `check`.
    """
    rec, until, by = log.recording, FIRST * float(np.ptp(log.recording.t)), "filters of each vehicle alone show"
    c = filtered(log.part(until=until))
    if c.log.truth is not None:
        true, by = c.log.truth.position, "the truth shows"
        residual = residual_of(c.world, np.where(np.isfinite(true), true, c.x))[1]
        c = replace(c, relative=residual, variance=0 * c.variance)
        rec = replace(rec, sensors=replace(rec.sensors, range_offset_std=0.0))
    relative, ends = rec.relative.copy(), np.sort([rec.links.observer, rec.links.neighbour], axis=0)
    found = dict(_offsets(c, 0, rec.sensors.range_std, 0.0))
    for one, other in np.unique(ends, axis=1).T:
        pair = f"{rec.ids[one]} and {rec.ids[other]}"
        if offset := found.get(pair, 0.0):
            log.summary.assume(
                f"ranges are less what {by} in the first {until:.3g} s: {{}}", f"{offset:+.3g} m of {pair}"
            )
            relative[:, (ends[0] == one) & (ends[1] == other), 0] -= offset
    notes = dict.fromkeys((*rec.notes, *log.summary.sentences))
    return replace(log, recording=replace(rec, relative=relative, notes=tuple(notes)))


CHECKS: tuple[Callable[[Check], list[str]], ...] = (_of_rows, _of_vehicles, _of_fixes, _of_measurements)
"""What looks wrong: each takes the filtered log and returns sentences. A new check is one more entry."""
