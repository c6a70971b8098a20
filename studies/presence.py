"""Scores of vehicles that come and go, and of data without a truth: stretch by stretch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from coopoc.arrays import AnyArray, Bools
from coopoc.errors import InputError
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import innovation_columns
from coopoc.evaluate.scores import BYTES, scored
from coopoc.methods.track import Method
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

RMS, MAXIMA, SUMS = ("rt_le_m", "neighbour_rt_le_m", "innovation_m"), ("max_error_m",), ("fixes", "seconds")
"""Columns that are not averaged over the stretches of a vehicle: root mean squares, maxima and sums."""


def complete(recording: Recording, who: Sequence[str], drive: Fleet) -> bool:
    """Whether all egos are there, with a truth, throughout."""
    columns = [recording.ids.index(ego) for ego in who]
    whole = np.isfinite(recording.velocity[0][:, columns]).all() and np.isfinite(recording.gnss[:, 0, columns]).all()
    return bool(whole and drive.present[:, [drive.index(ego) for ego in who]].all())


def scored_where_present(
    method: Method, recording: Recording, who: Sequence[str], drive: Fleet, quantiles: int = 0, metric: str = ""
) -> dict[str, AnyArray]:
    """Columns (R, E) as of `scored`, over the stretches in which an ego and its truth are there.

    A filter starts anew in each stretch. Without a truth the columns are innovations and bytes.

    Args:
        method: that follows the egos.
        recording: its measurements and messages.
        who: ids of the egos.
        drive: the truth, NaN where it is unknown.
        quantiles: number of quantiles of the distances, of egos that are there in one stretch.
        metric: one more, by its name or "mine.py:NAME"; not used without a truth.

    Raises:
        InputError: an ego that is never there at two steps in a row.
    """
    each = [_ego(method, recording, ego, drive, quantiles, metric) for ego in who]
    names = [name for name in each[0] if all(name in columns for columns in each)]
    return {name: np.concatenate([columns[name] for columns in each], axis=1) for name in names}


def _ego(
    method: Method, recording: Recording, ego: str, drive: Fleet, quantiles: int, metric: str
) -> dict[str, AnyArray]:
    known = drive.present[:, drive.index(ego)]
    parts, lengths = list[Mapping[str, AnyArray]](), list[int]()
    stretches = recording.stretches(ego)
    cuts = [(a + i, a + j) for a, b in stretches for i, j in _runs(known[a:b])] if known.any() else stretches
    for start, stop in cuts:
        seen = recording.between(start, stop)
        # a truth that begins between two fixes leaves a start without one
        begin = next(iter(seen.stretches(ego)), None)
        if begin is None or begin[1] - begin[0] < 2:
            continue
        seen, truth = seen.between(*begin), drive.between(start + begin[0], start + begin[1])
        if known.any():
            columns = scored(method, seen, [ego], truth, quantiles, metric)
        else:
            columns = _without_truth(method, seen, ego)
        parts.append(columns)
        lengths.append(len(seen.t))
    if not parts:
        raise InputError("egos", repr(ego), "is never there at two steps in a row, with a fix", "Choose another ego.")
    return {name: _merged(name, [part[name] for part in parts], lengths) for name in parts[0]}


def _without_truth(method: Method, recording: Recording, ego: str) -> dict[str, AnyArray]:
    track = method(recording, [ego])
    account = of_track(track, recording, method.message)
    near = len(recording.links.of(recording.ids.index(ego))) / len(recording.t)
    shape = (recording.runs, 1)
    return {
        **innovation_columns(track, recording),
        **{name: account.of("online", *counted) / account.seconds for name, counted in BYTES.items()},
        "neighbours_mean": np.full(shape, near),
        "seconds": np.full(shape, track.seconds / recording.runs),
    }


def _merged(name: str, parts: Sequence[AnyArray], lengths: Sequence[int]) -> AnyArray:
    if len(parts) == 1:
        return parts[0]
    if name in MAXIMA:
        return np.asarray(np.max(parts, axis=0))
    if name in SUMS:
        return np.asarray(np.sum(parts, axis=0))
    power = 2 if name in RMS else 1
    values, weights = np.stack(parts).astype(float) ** power, np.array(lengths, dtype=float)
    weights = weights.reshape(-1, *[1] * (values.ndim - 1)) * np.isfinite(values)
    total = weights.sum(axis=0)
    mean = np.divide(
        (np.nan_to_num(values) * weights).sum(axis=0), total, out=np.full(total.shape, np.nan), where=total > 0
    )
    return np.asarray(mean ** (1 / power))


def _runs(known: Bools) -> list[tuple[int, int]]:
    """(start, stop) of the runs of True."""
    edges = np.flatnonzero(np.diff(known.astype(int), prepend=0, append=0)).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in edges if b - a >= 2]
