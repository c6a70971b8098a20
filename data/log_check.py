"""Does a log make sense? Innovation statistics without a truth, and sentences on what looks wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coopoc.arrays import Floats, robust_std
from coopoc.evaluate.innovations import fix_innovations, normalised_innovations
from coopoc.methods.kalman import Kalman
from coopoc.world.recording import Recording
from coopoc.world.spherical import wrap

from .log import Log
from .log_clocks import apart_warnings, clock_warnings, truth_warning
from .log_truth import frame_warning

UNITS = {"range": "m", "azimuth": "rad", "inclination": "rad"}
WIDE, NARROW = 2.0, 0.4
"""Ratios of a measured to a stated standard deviation at which something is wrong."""
FAR = 10.0
"""Standard deviations of a fix that odometry must have moved, so that noise does not look like motion."""
ENOUGH = 20
COARSE = 0.5
"""rad: no sensor's angles scatter as much about positions that are better known."""
MISTAKEN = (
    (0.0, 3e-3, "Is t in ms, or finer? Divide it: stamps are in s."),
    (5e-3, 2e-2, "Is speed in cm/s? Speeds are in m/s."),
    (0.2, 0.4, "Is speed in km/h? Name it speed_kmh. Or in feet a second? Speeds are in m/s."),
    (0.42, 0.55, "Is speed in miles an hour, or in knots? Speeds are in m/s."),
    (3.0, 3.6, "Are positions in feet, or ranges? They are in m."),
)
"""Ratios of the distance of fixes to that of odometry (least, largest), and the unit that explains them."""


@dataclass(frozen=True, eq=False)
class Check:
    """What the measurements of a log say about each other.

    Args:
        x: (T, N, 3) m, solo Kalman filter of each vehicle, NaN where it is absent.
        variance: (T, N, 3) m^2.
        fix: (T, N, 3) m, innovations of the fixes.
        normalised: (T, N), 1 on average if the assumed noise is right.
        relative: (L, 3) m, rad, rad: measured less computed from the two filters, which use no relative measurement.
        vehicles: table, a row per vehicle.
        measurements: table, a row per kind of relative measurement.
        warnings: sentences.
    """

    x: Floats
    variance: Floats
    fix: Floats
    normalised: Floats
    relative: Floats
    vehicles: Sequence[Mapping[str, Any]]
    measurements: Sequence[Mapping[str, Any]]
    warnings: tuple[str, ...]


def check(log: Log) -> Check:
    """Innovation statistics of a log, with the noise that its recording states."""
    rec = log.recording
    shape = (len(rec.t), len(rec.ids), 3)
    x, variance, fix = (np.full(shape, np.nan) for _ in range(3))
    normalised = np.full(shape[:2], np.nan)
    for column in range(len(rec.ids)):
        for start, stop in rec.stretches(column):
            seen = rec.between(start, stop).of_runs(slice(0, 1))
            track = Kalman()(seen, [column])
            here = slice(start, stop)
            x[here, column] = track.x[0, :, 0]
            assert track.covariance is not None
            variance[here, column] = np.diagonal(track.covariance[0, :, 0], axis1=-2, axis2=-1)
            fix[here, column] = fix_innovations(track, seen)[0, :, 0]
            each = normalised_innovations(track, seen)
            if each is not None:
                normalised[here, column] = each[0, :, 0]
    relative, expected = relative_residuals(rec, x, variance)
    vehicles, warnings = _vehicles(log, fix, normalised)
    measurements, more = _measurements(rec, relative, expected)
    clocks = [*apart_warnings(rec), *clock_warnings(rec, x, relative, expected)]
    return Check(x, variance, fix, normalised, relative, vehicles, measurements, (*warnings, *clocks, *more))


def _vehicles(log: Log, fix: Floats, normalised: Floats) -> tuple[list[dict[str, Any]], list[str]]:
    rec, rows, warnings = log.recording, [], []
    for column, name in enumerate(rec.ids):
        seen = np.isfinite(normalised[:, column])
        speed = np.linalg.norm(rec.velocity[0, :, column], axis=-1)
        if not np.nanmax(speed, initial=0.0) > 0:
            continue
        distance, turn = _against_odometry(rec, column)
        row: dict[str, Any] = {
            "vehicle": name,
            "fixes": int(np.isfinite(rec.gnss[0, :, column, 0]).sum()),
            "there": float(np.isfinite(speed).mean()),
            "speed_m_s": float(np.nanmean(speed)),
            "innovation_m": float(np.sqrt((fix[seen, column] ** 2).sum(axis=-1).mean())) if seen.any() else None,
            "nis": float(normalised[seen, column].mean()) if seen.any() else None,
            "fixes_per_odometry": distance,
        }
        if log.truth is not None:
            error = np.linalg.norm(rec.gnss[0, :, column] - log.truth.position[:, column], axis=-1)
            row["fix_error_m"] = float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else None
        rows.append(row)
        warnings += _of_vehicle(name, row, distance, turn, int(seen.sum()))
        warnings += frame_warning(rec, log.truth, column) or truth_warning(rec, log.truth, column)
    return rows, warnings


def _of_vehicle(name: str, row: Mapping[str, Any], distance: float | None, turn: float | None, count: int) -> list[str]:
    found = []
    if row["nis"] is not None and count >= ENOUGH and not 0.2 <= row["nis"] <= 2:
        word = "larger" if row["nis"] > 2 else "smaller"
        found.append(
            f"{name}: NIS is {row['nis']:.3g}, not 1: the errors of fixes and odometry are {word} than stated, "
            "or correlated in time. Give std columns or sensors=."
        )
    if distance is not None and not 0.8 <= distance <= 1.25:
        hint = next((hint for low, high, hint in MISTAKEN if low < distance < high), "Check the units of both.")
        found.append(f"{name}: fixes travel {distance:.2f} times as far as the odometry says. {hint}")
    if turn is not None and abs(turn) > np.radians(20):
        found.append(
            f"{name}: fixes move {np.degrees(turn):.0f} deg anticlockwise of the odometry. Headings are anticlockwise "
            "from +x (east) in rad; clockwise from north in degrees is compass_deg."
        )
    return found


def _against_odometry(rec: Recording, column: int) -> tuple[float | None, float | None]:
    """Distance of fixes over distance of odometry, over spans in which the odometry (if that stands still, the fixes)
    moves far, with the fixes' noise taken off; and the angle between the two, rad. None where too little moves."""
    z, u = rec.gnss[0, :, column, :2], rec.velocity[0, :, column, :2]
    path = np.cumsum(np.nan_to_num(u) * rec.dt, axis=0)
    gone = np.cumsum(np.isnan(u[:, 0]))
    variance = float(np.square(rec.sensors.fix_std[:2]).sum())
    for goes, far in ((path, FAR), (z, 2 * FAR)):
        pairs, last = [], None
        for step in np.flatnonzero(np.isfinite(z[:, 0])).tolist():
            if last is None or gone[step] != gone[last]:
                last = step
            elif np.linalg.norm(goes[step] - goes[last]) > far * np.sqrt(variance):
                pairs.append((last, step))
                last = step
        if len(pairs) >= 3:
            break
    else:
        return None, None
    a, b = np.array(pairs).T
    moved, driven = z[b] - z[a], path[b] - path[a]
    length, driven2 = (moved**2).sum() - 2 * variance * len(pairs), (driven**2).sum()
    distance = float(np.sqrt(max(length, 0.0) / driven2)) if driven2 > 0 else float("inf")
    whole = complex(((moved[:, 0] + 1j * moved[:, 1]) * (driven[:, 0] - 1j * driven[:, 1])).sum())
    return distance, float(np.angle(whole)) if abs(whole) > 0 else None


def relative_residuals(rec: Recording, x: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Residuals (L, 3) of the relative measurements against the filters, and the deviations (L, 3) they should have."""
    links = rec.links
    gap = x[links.step, links.neighbour] - x[links.step, links.observer]
    flat, d = np.hypot(gap[:, 0], gap[:, 1]), np.linalg.norm(gap, axis=1)
    computed = np.column_stack([d, np.arctan2(gap[:, 1], gap[:, 0]), np.arctan2(flat, gap[:, 2])])
    residual = rec.relative[0] - computed
    residual[:, 1:] = wrap(residual[:, 1:])
    both = (variance[links.step, links.neighbour] + variance[links.step, links.observer])[:, :2].mean(axis=1)
    noise = rec.sensors
    spread = np.column_stack([both, both / np.maximum(flat, 1.0) ** 2, both / np.maximum(d, 1.0) ** 2])
    stated = np.array([noise.range_std, noise.world_azimuth_std, noise.inclination_std])
    return residual, np.sqrt(stated**2 + spread)


def _measurements(rec: Recording, residual: Floats, expected: Floats) -> tuple[list[dict[str, Any]], list[str]]:
    rows, warnings = [], []
    for k, (name, unit) in enumerate(UNITS.items()):
        seen = np.isfinite(residual[:, k])
        if not seen.any() or np.ptp(rec.relative[0, seen, k]) == 0:
            continue
        r, should = residual[seen, k], float(np.sqrt(np.mean(expected[seen, k] ** 2)))
        stated = float(rec.sensors.relative_std[k])
        std = robust_std(r)
        median = float(np.median(r))
        rows.append(
            {
                "measurement": name,
                "unit": unit,
                "number": int(seen.sum()),
                "median": median,
                "robust_std": std,
                "stated_std": stated,
                "expected_std": should,
                "beyond_5_std": float(np.mean(np.abs(r - median) > 5 * max(std, 1e-12))),
            }
        )
        if len(r) < ENOUGH:
            continue
        place = float(np.sqrt(max(should**2 - stated**2, 0.0)))
        far = rec.relative[0, seen, 0] - residual[seen, 0] > FAR * place
        if k == 0 and far.sum() >= ENOUGH:
            ratio = float(np.median(rec.relative[0, seen, 0][far] / (rec.relative[0, seen, 0] - r)[far]))
            if not 0.8 <= ratio <= 1.25:
                hint = next(
                    (hint for low, high, hint in MISTAKEN[4:] if low < ratio < high), "Check the units of both."
                )
                warnings.append(f"ranges are {ratio:.2f} times the distances of the positions. {hint}")
        if k == 1 and std > COARSE > 3 * place:
            warnings.append(
                f"azimuths scatter by {np.degrees(std):.0f} deg about the positions: check their sense (anticlockwise) "
                "and whose heading they count from, and that no axis is mirrored."
            )
        if (k == 1 and abs(np.exp(1j * r).mean()) < 0.5) or (abs(median) > max(0.35, 3 * should) and k == 1):
            warnings.append(
                f"azimuths miss the positions by {np.degrees(median):.0f} deg in the median: check their zero "
                "(+x, or the heading for a bearing), their sense (anticlockwise) and their unit (rad)."
            )
        elif std > WIDE * should or abs(median) > 3 * should:
            wrong = f"{median:.3g} +- {std:.3g} {unit}, {should:.3g} {unit} expected"
            warnings.append(f"{name}s miss the positions by {wrong}.")
        elif std < NARROW * should and stated > 2 * std:
            warnings.append(f"{name}s are better than stated: {std:.3g} {unit}, {stated:.3g} {unit} stated.")
    return rows, warnings
