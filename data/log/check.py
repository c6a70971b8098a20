"""Does a log make sense? Innovation statistics of a filter of each vehicle alone, and sentences on what looks wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coopoc.arrays import Bools, Floats, robust_std
from coopoc.errors import InputError
from coopoc.evaluate.metrics import fix_innovations, normalised_innovations
from coopoc.methods.kalman import Kalman
from coopoc.methods.poses.pose_filter import PoseFilter
from coopoc.methods.poses.pose_start import pose_start
from coopoc.methods.track import Track
from coopoc.world.body_frames import midway, turned
from coopoc.world.fleet import Fleet
from coopoc.world.links import spherical, wrap
from coopoc.world.recording import Recording

from .read import Log

UNITS = {"range": "m", "azimuth": "rad", "inclination": "rad"}
GATE = 5.0
"""Of the pose filters that check a log: standard deviations beyond which a measurement is left out."""
WIDE, NARROW = 2.0, 0.4
"""Ratios of a measured to a stated standard deviation at which something is wrong."""
FAR = 10.0
"""Standard deviations of a fix that odometry must have moved, so that noise does not look like motion."""
ENOUGH = 20
"""Measurements from which a statistic is worth a word."""
COARSE = 0.5
"""rad: no sensor's angles scatter as much about positions that are better known."""
MISTAKEN = (
    (0.0, 3e-3, "Is t in ms, or finer? Divide it: stamps are in s."),
    (0.2, 0.4, "Is speed in km/h? Name it speed_kmh. Or in feet a second? Speeds are in m/s."),
    (0.42, 0.55, "Is speed in miles an hour, or in knots? Speeds are in m/s."),
    (3.0, 3.6, "Are positions in feet, or ranges? They are in m."),
)
"""Ratios of the distance of fixes to that of odometry (least, largest), and the unit that explains them."""
FEW, APART = 5, 3.0
"""Fixes with a truth from which a difference of frames shows; standard deviations of a fix that it must have."""
SIGMAS = 6.0
"""Standard errors of a clock's offset beyond which it is no chance."""
ROUNDS = 5
"""Reweighted least squares, so that outliers do not pull a clock."""
EXPLAINS, REST = 0.7, 2.0
"""An offset is named if it shrinks the residuals to this share, and to this many of their expected deviations."""


@dataclass(frozen=True, eq=False)
class Check:
    """What the measurements of a log say about each other.

    Args:
        log: the part that was followed.
        span: where that is, in words.
        world: its recording, in body frames turned into the world by the filter's headings.
        x: (T, N, 3) m, filter of each vehicle without relative measurements of others, NaN where it is absent.
        variance: (T, N, 3) m^2.
        fix: (T, N, 3) m, innovations of the fixes.
        normalised: (T, N), 1 on average if the assumed noise is right.
        relative: (L, 3) m, rad, rad: measured less computed from the filters.
        expected: (L, 3) standard deviations that these should have.
        vehicles: table, a row per vehicle.
        measurements: table, a row per kind of relative measurement.
        warnings: sentences.
    """

    log: Log
    span: str
    world: Recording
    x: Floats
    variance: Floats
    fix: Floats
    normalised: Floats
    relative: Floats
    expected: Floats
    vehicles: Sequence[Mapping[str, Any]] = ()
    measurements: Sequence[Mapping[str, Any]] = ()
    warnings: tuple[str, ...] = ()


def check(log: Log) -> Check:
    """Innovation statistics of a log, with the noise that its recording states.

    Raises:
        InputError: in body frames, vehicles that share no two steps, or first poses that are not known.
    """
    found = _followed(log)
    found = replace(found, vehicles=_vehicles(found), measurements=_measurements(found))
    return replace(found, warnings=tuple(sentence for one in CHECKS for sentence in one(found)))


def together(log: Log) -> tuple[Log, str]:
    """The longest part of a log in which all its vehicles are there, and where that is in words.

    Raises:
        InputError: the vehicles share no two steps.
    """
    rec = log.recording
    there = np.isfinite(rec.velocity[0, :, _moving(rec), 0]).all(axis=0)
    edges = np.flatnonzero(np.diff(there.astype(int), prepend=0, append=0)).reshape(-1, 2)
    first, last = max(edges.tolist(), key=lambda edge: edge[1] - edge[0], default=(0, 0))
    if last - first < 2 or not _moving(rec):
        hint = " ".join([*_apart(rec), "Raise max_gap, or leave out files of vehicles that are hardly there."])
        raise InputError("log", log.summary.name, "must hold steps at which all vehicles are there", hint)
    t = rec.t - rec.t[0]
    span = "throughout" if there.all() else f"from {t[first]:.1f} to {t[last - 1]:.1f} s, where all are there"
    truth = None if log.truth is None else log.truth.between(first, last)
    return replace(log, recording=rec.between(first, last), truth=truth), span


def begin_of(log: Log, gate: float = GATE) -> tuple[Floats | None, str]:
    """First poses: those of fixes and compasses (None), those found in the first seconds, or the truth's; and which,
    where it is the last.

    Args:
        log: in body frames, all vehicles there at its first step.
        gate: of the filters that find them, standard deviations.

    Raises:
        InputError: a vehicle that has neither a fix nor sees a landmark in the first seconds, nor a true pose.
    """
    rec, truth, moving = log.recording, log.truth, _moving(log.recording)
    assert rec.body is not None
    if np.isfinite(np.column_stack([rec.gnss[0, 0], rec.body.heading[0, 0]])[moving]).all():
        return None, ""
    try:
        return pose_start(rec, gate=gate), ""
    except InputError:
        if truth is None or truth.heading is None:
            raise
        given = np.column_stack([truth.position[0], truth.heading[0]])
        if not np.isfinite(given[moving]).all():
            raise
        return given, ", from the truth's first poses"


def _moving(rec: Recording) -> list[int]:
    return [k for k in range(len(rec.ids)) if k not in rec.landmarks]


def _followed(log: Log) -> Check:
    """The log with a Kalman filter of each vehicle alone, in body frames a pose filter."""
    span, body = "", log.recording.body is not None
    if body:
        log, span = together(log)
    rec = log.recording.of_runs(slice(0, 1))
    shape = (len(rec.t), len(rec.ids))
    x, variance, fix = (np.full((*shape, 3), np.nan) for _ in range(3))
    normalised, heading, unsure = np.full(shape, np.nan), np.zeros(shape), np.zeros(shape)

    def take(track: Track, seen: Recording, here: slice) -> None:
        columns = list(track.egos)
        assert track.covariance is not None
        x[here, columns], fix[here, columns] = track.x[0], fix_innovations(track, seen)[0]
        variance[here, columns] = np.diagonal(track.covariance[0], axis1=-2, axis2=-1)
        squares = normalised_innovations(track, seen)
        assert squares is not None
        normalised[here, columns] = squares[0]

    marks = list(rec.landmarks)
    x[:, marks], variance[:, marks] = rec.gnss[0][:, marks], 0.0
    if body:
        begin, start = begin_of(log)
        track = PoseFilter("solo", gate=GATE, begin=begin)(rec, _moving(rec))
        take(track, rec, slice(None))
        assert track.heading is not None
        assert track.heading_covariance is not None
        span += start
        heading[:, track.egos], unsure[:, track.egos] = track.heading[0], track.heading_covariance[0, ..., 3]
        relative = rec.relative.copy()
        relative[..., 1] = wrap(relative[..., 1] + heading[rec.links.step, rec.links.observer])
        world = replace(rec, body=None, velocity=turned(rec.velocity, midway(heading)), relative=relative)
    else:
        world = rec
        for column in range(shape[1]):
            for start_, stop in rec.stretches(column):
                seen = rec.between(start_, stop)
                take(Kalman()(seen, [column]), seen, slice(start_, stop))
    residual, expected = _residuals(world, x, variance)
    if body:
        expected[:, 1] = np.sqrt(expected[:, 1] ** 2 + unsure[rec.links.step, rec.links.observer])
    return Check(replace(log, recording=rec), span, world, x, variance, fix, normalised, residual, expected)


def _residuals(rec: Recording, x: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Residuals (L, 3) of the relative measurements against the filters, and the deviations (L, 3) they should have."""
    links, noise = rec.links, rec.sensors
    gap = x[links.step, links.neighbour] - x[links.step, links.observer]
    flat, d = np.hypot(gap[:, 0], gap[:, 1]), np.linalg.norm(gap, axis=1)
    residual = rec.relative[0] - np.column_stack(spherical(*gap.T))
    residual[:, 1:] = wrap(residual[:, 1:])
    both = (variance[links.step, links.neighbour] + variance[links.step, links.observer])[:, :2].mean(axis=1)
    position = np.column_stack([both, both / np.maximum(flat, 1.0) ** 2, both / np.maximum(d, 1.0) ** 2])
    stated = np.array([noise.range_std, noise.world_azimuth_std, noise.inclination_std])
    return residual, np.sqrt(stated**2 + position)


def _vehicles(c: Check) -> list[dict[str, Any]]:
    rows, rec, truth = [], c.world, c.log.truth
    for column, name in enumerate(rec.ids):
        seen = np.isfinite(c.normalised[:, column])
        speed = np.linalg.norm(rec.velocity[0, :, column], axis=-1)
        if not np.nanmax(speed, initial=0.0) > 0:
            continue
        distance, turn = _against_odometry(rec, column)
        row: dict[str, Any] = {
            "vehicle": name,
            "fixes": int(np.isfinite(rec.gnss[0, :, column, 0]).sum()),
            "there": float(np.isfinite(speed).mean()),
            "innovation_m": _rms(c.fix[seen, column]),
            "nis": float(c.normalised[seen, column].mean()) if seen.any() else None,
            "fixes_per_odometry": distance,
            "turned_deg": None if turn is None else float(np.degrees(turn)),
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


def _measurements(c: Check) -> list[dict[str, Any]]:
    rows = []
    for k, (name, unit) in enumerate(UNITS.items()):
        seen = np.isfinite(c.relative[:, k])
        if not seen.any() or np.ptp(c.log.recording.relative[0, seen, k]) == 0:
            continue
        r = c.relative[seen, k]
        std, median = robust_std(r), float(np.median(r))
        row: dict[str, Any] = {"measurement": name, "unit": unit, "number": len(r), "median": median}
        row |= {"robust_std": std, "stated_std": float(c.world.sensors.relative_std[k])}
        row["expected_std"] = float(np.sqrt(np.mean(c.expected[seen, k] ** 2)))
        rows.append(row | {"beyond_5_std": float(np.mean(np.abs(r - median) > 5 * max(std, 1e-12)))})
    return rows


def _of_vehicles(c: Check) -> list[str]:
    """Noise, distances and directions of the fixes against the odometry, errors against the truth."""
    found = []
    for row in c.vehicles:
        name, nis, distance, turn = (row[key] for key in ("vehicle", "nis", "fixes_per_odometry", "turned_deg"))
        column = c.world.ids.index(name)
        if nis is not None and np.isfinite(c.normalised[:, column]).sum() >= ENOUGH and not 0.2 <= nis <= 2:
            word = "larger" if nis > 2 else "smaller"
            found.append(
                f"{name}: NIS is {nis:.3g}, not 1: the errors of fixes and odometry are {word} than stated, "
                "or correlated in time. Give std columns or sensors=."
            )
        if distance is not None and not 0.8 <= distance <= 1.25:
            found.append(f"{name}: fixes travel {distance:.2f} times as far as the odometry says. {_unit(distance)}")
        if turn is not None and abs(turn) > 20:
            found.append(
                f"{name}: fixes move {turn:.0f} deg anticlockwise of the odometry. Headings are anticlockwise "
                "from +x (east) in rad; clockwise from north in degrees is compass_deg."
            )
        found += [] if c.log.truth is None else _truth(c.world, c.log.truth, column)
    return found


def _unit(ratio: float) -> str:
    return next((hint for low, high, hint in MISTAKEN if low < ratio < high), "Check the units of both.")


def _truth(rec: Recording, truth: Fleet, column: int) -> list[str]:
    """A sentence where the fixes of a vehicle lie behind its truth along its way, by the same time at any speed, or
    beside it by more than their noise explains, as they do where the truth has another origin."""
    gap = (rec.gnss[0, :, column] - truth.position[:, column])[:, :2]
    moves = rec.velocity[0, :, column, :2]
    known = np.isfinite(gap).all(axis=1)
    both, name = known & np.isfinite(moves).all(axis=1), rec.ids[column]
    if both.sum() >= ENOUGH:
        off, along = gap[both] - np.median(gap[both], axis=0), moves[both] - moves[both].mean(axis=0)
        power = max(float((along**2).sum()), 1e-12)
        late = float((off * along).sum()) / power
        std = float(np.sqrt(((off - late * along) ** 2).mean() / power))
        if abs(late) >= max(SIGMAS * std, 0.5 * rec.dt):
            return [
                f"{name}: its fixes are {abs(late):.2f} s {'ahead of' if late > 0 else 'behind'} the truth along its "
                "way: the clock of the truth differs, or fixes carry the time at which they arrived."
            ]
    east, north = np.median(gap[known], axis=0) if known.sum() >= FEW else (0.0, 0.0)
    if np.hypot(east, north) < APART * np.hypot(*rec.sensors.fix_std[:2]):
        return []
    return [
        f"{name}: fixes lie {east:.3g} m east and {north:.3g} m north of the truth in the median. Fixes in degrees are "
        "local at the first one: give origin= of the frame of the truth, or the truth in degrees."
    ]


def _of_measurements(c: Check) -> list[str]:
    """Residuals of relative measurements that no stated noise explains."""
    found, direction = [], "azimuth" if c.log.recording.body is None else "bearing"
    for row in c.measurements:
        name, median, std, should = (row[key] for key in ("measurement", "median", "robust_std", "expected_std"))
        k = list(UNITS).index(name)
        seen = np.isfinite(c.relative[:, k])
        if seen.sum() < ENOUGH:
            continue
        position = float(np.sqrt(max(should**2 - row["stated_std"] ** 2, 0.0)))
        if name == "range":
            measured = c.world.relative[0, seen, 0]
            true = measured - c.relative[seen, 0]
            far = true > FAR * position
            ratio = float(np.median(measured[far] / true[far])) if far.sum() >= ENOUGH else 1.0
            if not 0.8 <= ratio <= 1.25:
                hint = _unit(ratio) if ratio > 1 else "Check the units of both."
                found.append(f"ranges are {ratio:.2f} times the distances of the positions. {hint}")
        if name == "azimuth":
            name = direction
            if std > COARSE > 3 * position:
                found.append(
                    f"{name}s scatter by {np.degrees(std):.0f} deg about the positions: check their sense "
                    "(anticlockwise) and whose heading they count from, and that no axis is mirrored."
                )
            if abs(np.exp(1j * c.relative[seen, 1]).mean()) < 0.5 or abs(median) > max(0.35, 3 * should):
                found.append(
                    f"{name}s miss the positions by {np.degrees(median):.0f} deg in the median: check their zero "
                    "(+x, or the heading for a bearing), their sense (anticlockwise) and their unit (rad)."
                )
                continue
        if std > WIDE * should or abs(median) > 3 * should:
            wrong = f"{median:.3g} +- {std:.3g} {row['unit']}, {should:.3g} {row['unit']} expected"
            found.append(f"{name}s miss the positions by {wrong}.")
        elif std < NARROW * should and row["stated_std"] > 2 * std:
            better = f"{std:.3g} {row['unit']}, {row['stated_std']:.3g} {row['unit']} stated"
            found.append(f"{name}s are better than stated: {better}.")
    return found


def _clocks(c: Check) -> list[str]:
    """A sentence for each vehicle whose clock explains what relative measurements and positions disagree about.

    Vehicle k writes stamps that are delta_k too late. What i measures of j then misses their logged positions by
    u v_j (delta_j - delta_i) in its direction u: linear in the offsets, which are fitted with an offset of each kind.
    """
    rec, links, vehicles = c.world, c.world.links, len(c.world.ids)
    gap = (c.x[links.step, links.neighbour] - c.x[links.step, links.observer])[:, :2]
    moves, every = rec.velocity[0, links.step, links.neighbour, :2], np.arange(len(gap))
    flat = np.maximum(np.linalg.norm(gap, axis=1), 1.0)
    A, b = np.zeros((2, len(gap), vehicles + 2)), (c.relative / c.expected)[:, :2].T
    for kind, direction in enumerate((gap, gap[:, ::-1] * [-1.0, 1.0] / flat[:, None])):
        A[kind, every, links.neighbour] = (moves * direction).sum(axis=1) / flat
        A[kind, every, links.observer] -= A[kind, every, links.neighbour]
        A[kind, :, vehicles + kind] = 1.0
    A /= c.expected[:, :2].T[..., None]
    seen = np.isfinite(b) & np.isfinite(A).all(axis=2)
    A, b = A[seen], b[seen]
    if len(b) < 10 * vehicles:
        return []
    weight = np.ones(len(b))
    for _ in range(ROUNDS):  # with Huber's weights
        root = np.sqrt(weight)[:, None]
        offset = np.linalg.lstsq(root * A, root[:, 0] * b, rcond=1e-9)[0]
        rest = np.abs(b - A @ offset)
        scale = max(1.4826 * float(np.median(rest)), 1e-9)
        weight = np.minimum(1.0, 2.0 * scale / np.maximum(rest, 1e-12))
    covariance = scale**2 * np.linalg.pinv(A.T @ (weight[:, None] * A), rcond=1e-9, hermitian=True)
    std = np.sqrt(np.maximum(np.diagonal(covariance)[:vehicles], 0.0))
    if scale / 1.4826 > min(EXPLAINS * float(np.median(np.abs(b))), REST * 0.6745):
        return []
    apart = offset[:vehicles] - np.median(offset[:vehicles])
    if vehicles == 2:  # only their difference is known
        apart = np.array([0.0, offset[1] - offset[0]]) if offset[1] > offset[0] else np.array([apart[0] * 2, 0.0])
    late = np.flatnonzero(np.abs(apart) > np.maximum(SIGMAS * std, 0.5 * rec.dt))
    return [
        f"{(name := rec.ids[k])}: its stamps are about {apart[k]:.2f} s ahead of the others', as its motion and "
        f"the relative measurements say. Give clock={{{name!r}: {apart[k]:.2f}}} (?clock={name}:{apart[k]:.2f})."
        for k in late
    ]


def _apart(rec: Recording) -> list[str]:
    """A sentence for each vehicle that drives while no other is there, as after stamps of another time zone."""
    there: Bools = np.isfinite(rec.velocity[0, :, :, 0])
    moving = [k for k in _moving(rec) if there[:, k].any()]
    found = []
    for k in moving:
        others = there[:, [j for j in moving if j != k]].any(axis=1)
        if len(moving) > 1 and not (there[:, k] & others).any():
            late = rec.t[np.argmax(there[:, k])] - rec.t[np.argmax(others)]
            found.append(
                f"{(name := rec.ids[k])}: is there while no other vehicle is, its log begins {late:.6g} "
                f"s after theirs. If that is another time zone or clock, give clock={{{name!r}: {late:.6g}}}."
            )
    return found[-1:] if len(moving) == 2 else found


CHECKS: tuple[Callable[[Check], list[str]], ...] = (
    _of_vehicles,
    lambda c: _apart(c.world),
    _clocks,
    _of_measurements,
)
"""What looks wrong: each takes what was followed and returns sentences. A new check is one more entry."""
