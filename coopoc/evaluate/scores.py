"""Scores of a method in each run and for each ego of a recording, as columns and as rows."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import AnyArray
from ..errors import InputError, shown
from ..methods.track import Method, Track, far_off, follow, needs_fix
from ..world.fleet import Fleet
from ..world.recording import Recording, Vehicles
from .ledger import Kind, Way, of_track
from .metrics import METRICS, dimensions, errors, innovation_columns, max_error, measure, nees, rt_le, share_of_average

BYTES: Mapping[str, tuple[Kind, Way]] = {
    "bytes_per_second": ("on air", "per receiver"),
    "sent_bytes_per_second": ("on air", "broadcast"),
    "payload_bytes_per_second": ("payload", "per receiver"),
}
"""Columns of rows with the bytes of online cooperation, as a ledger counts them."""
COLUMNS = {"rt_le_m", "max_error_m", "error_quantiles_m", "nees", "nees_inside", "left_fixes", "seconds", *BYTES}
COLUMNS |= {"run", "ego", "label", "train_seed"}
"""Columns of rows that no metric of one's own may have."""
SLAB = 2**25
"""Bytes of a Track, about: runs are scored while the cache still holds them, and memory does not grow with the number
of runs."""


def rows_of(columns: Mapping[str, AnyArray], who: Sequence[str], **more: Any) -> list[dict[str, Any]]:
    """Rows of columns (R, E), or (R, E, q) for lists: one per ego and run, all with the same `more`.

    >>> rows_of({"rt_le_m": np.array([[1.0, 2.0]])}, ("a", "b"), round=3)[1]
    {'run': 0, 'ego': 'b', 'round': 3, 'rt_le_m': 2.0}
    """
    runs = len(next(iter(columns.values())))
    return [
        {"run": r, "ego": ego, **more, **{name: values[r, e].tolist() for name, values in columns.items()}}
        for e, ego in enumerate(who)
        for r in range(runs)
    ]


def scored(
    method: Method, recording: Recording, egos: Sequence[str], drive: Fleet, quantiles: int = 0, metric: str = ""
) -> dict[str, AnyArray]:
    """Errors, consistency and bytes of a method for E egos in R runs, some runs at a time, where an ego is there and
    its truth known; without a truth of each, `metrics.innovation_columns` take the place of errors.

    Args:
        method: that follows the egos.
        recording: its measurements and messages.
        egos: ids.
        drive: the truth.
        quantiles: number of quantiles of the distances.
        metric: one more, by its name or "mine.py:NAME", which is none of COLUMNS; "" for none.

    Returns:
        Columns (R, E): RT-LE and largest error in m; the rates of BYTES; `left_fixes`, 1 or 0; `nees` and
        `nees_inside` of a method with a covariance; `seconds` of wall time per run and vehicle served; and
        `error_quantiles_m` (R, E, q) and the column NAME of a metric if some are wanted.

    >>> from coopoc import GNSS, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> scored(GNSS(), observe(fleet, Sensors(), runs=3), ["a"], fleet)["rt_le_m"].shape
    (3, 1)
    >>> scored(GNSS(), observe(fleet, Sensors()), ["a"], fleet, metric="mine.py:nees")
    Traceback (most recent call last):
    coopoc.errors.InputError: metric = 'mine.py:nees': must not have the name of a column of every study. Rename it.
    """
    column = metric.rpartition(":")[2]
    if column in COLUMNS and metric not in METRICS:
        raise InputError("metric", repr(metric), "must not have the name of a column of every study", "Rename it.")
    seconds, parts, squares = 0.0, [], []
    there = recording.present[:, [recording.ids.index(ego) for ego in egos]]
    has_truth = bool((there & drive.present[:, [drive.index(ego) for ego in egos]]).any(0).all())
    for part in slabs(recording, len(egos)):
        track = follow(method, part, egos)
        wanted = tuple(map(part.ids.index, egos)), part.runs, *part.t.tolist()
        if (track.egos, len(track.x), *track.t.tolist()) != wanted:
            raise InputError(
                f"estimates of {method.name}",
                shown(track),
                f"must be a Track of {', '.join(egos)}",
                "Take egos in this order, every run, and the times of the recording.",
            )
        seconds += track.seconds
        if not has_truth:
            parts.append(innovation_columns(track, part) | online_columns(track, part, method))
            continue
        made = {"rt_le_m": rt_le(track, drive), "max_error_m": max_error(track, drive)}
        if quantiles:
            error = errors(track, drive)
            quantile = np.quantile if np.isfinite(error).all() else np.nanquantile
            made["error_quantiles_m"] = np.moveaxis(quantile(error, np.linspace(0, 1, quantiles), axis=1), 0, -1)
        made |= online_columns(track, part, method)
        if metric:
            made[column] = measure(metric, track, drive)
        if track.covariance is not None:
            each = nees(track, drive, method=method.name)
            made["nees"] = np.nanmean(each, 1)
            squares.append(each.sum(0))
        parts.append(made)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    served = len(recording.ids) if recording.observers == tuple(range(len(recording.ids))) else len(egos)
    more: dict[str, Any] = {"seconds": seconds / recording.runs / served}
    if squares:
        average, degrees = np.sum(squares, 0) / recording.runs, dimensions(recording)
        more["nees_inside"] = share_of_average(average, recording.runs, degrees)
    return {**{name: np.broadcast_to(value, columns["left_fixes"].shape) for name, value in more.items()}, **columns}


def causal(method: Method, recording: Recording, egos: Vehicles) -> bool:
    """Whether estimates of the first half of a drive are the same, to 1 mm in the first run, where the drive ends then.

    A method that knows later measurements changes them, and one that draws random numbers anew.
    """
    first = recording.of_runs(slice(1))
    half = first.between(0, max(len(recording.t) // 2, 2))
    if not (there := [ego for ego in egos if half.stretches(ego, fixed=needs_fix(method))]):
        return True
    whole, part = (follow(method, each, there).x[:, : len(half.t)] for each in (first, half))
    return not (abs(whole - part) > 1e-3).any()


def slabs(recording: Recording, egos: int) -> Iterator[Recording]:
    """The recording in parts of some runs each, as many as the cache holds."""
    runs = max(1, SLAB // (4 * 8 * (12 * len(recording.t) * egos + 3 * len(recording.links)))) * 4
    for first in range(0, recording.runs, runs):
        yield recording.of_runs(slice(first, first + runs)) if runs < recording.runs else recording


def online_columns(track: Track, recording: Recording, method: Method) -> dict[str, AnyArray]:
    """Bytes per second of a track, and whether it ever left the fixes, which need no truth."""
    account = of_track(track, recording, method.message)
    rates = {name: account.of(*counted) / account.seconds for name, counted in BYTES.items()}
    return {**rates, "left_fixes": far_off(track.x, recording, list(track.egos)).astype(float)}
