"""Scores: how one method did in each run and for each ego of a recording, a few runs at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coopoc.arrays import Floats
from coopoc.evaluate.ledger import Kind, Way, of_track
from coopoc.evaluate.metrics import distance, errors, nees, neighbour_rt_le, share_of_average
from coopoc.methods.track import Method, Track
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

BYTES: Mapping[str, tuple[Kind, Way]] = {
    "bytes_per_second": ("on air", "per receiver"),
    "sent_bytes_per_second": ("on air", "broadcast"),
    "payload_bytes_per_second": ("payload", "per receiver"),
    "sent_payload_bytes_per_second": ("payload", "broadcast"),
}
"""Columns of rows that hold what is moved to decide, as a ledger counts it."""
SLAB = 2**25
"""Bytes of a Track, about: what many runs say is scored while the cache still holds it, and memory does not grow with
the number of runs."""
LANES = 4
"""Runs that kernels follow beside each other."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Of R runs and E egos.

    Args:
        columns: (R, E) by name. quantiles: (R, E, q) m of the distances. seconds: wall time of the method.
        nees: (T, E) sum over the runs, None of a method that claims no covariance.
    """

    columns: Mapping[str, Floats]
    quantiles: Floats
    seconds: float
    nees: Floats | None

    @property
    def runs(self) -> int:
        """R."""
        return len(self.quantiles)

    @property
    def inside(self) -> Floats:
        """(E,) share of steps whose run-averaged NEES is in its band; NaN without one."""
        if self.nees is None:
            return np.full(self.quantiles.shape[1], np.nan)
        return share_of_average(self.nees / self.runs, self.runs)


def scored(method: Method, recording: Recording, egos: Sequence[str], drive: Fleet, quantiles: int) -> Scores:
    """Scores of a method that follows the egos.

    Args:
        recording: what it sees. drive: the truth. quantiles: how many of the distances.
    """
    parts = [_of(method(part, egos), part, method, drive, quantiles) for part in slabs(recording, len(egos))]
    sums = [part.nees for part in parts if part.nees is not None]
    return Scores(
        {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns},
        np.concatenate([part.quantiles for part in parts]),
        sum(part.seconds for part in parts),
        np.sum(sums, axis=0) if sums else None,
    )


def slabs(recording: Recording, egos: int) -> Iterator[Recording]:
    """The recording in parts of some runs each, as many as kernels like."""
    per_run = 8 * (12 * len(recording.t) * egos + 3 * len(recording.links))
    runs = max(1, SLAB // (LANES * per_run)) * LANES
    for first in range(0, recording.runs, runs):
        yield recording.of_runs(slice(first, first + runs)) if runs < recording.runs else recording


def _of(track: Track, recording: Recording, method: Method, drive: Fleet, quantiles: int) -> Scores:
    error, mine = errors(track, drive), list(track.egos)
    level = np.sqrt((error**2).mean(axis=1))
    fixes = np.sqrt((distance(recording.gnss.take(mine, axis=2), drive.position[:, mine]) ** 2).mean(axis=1))
    account = of_track(track, recording, method.message)
    columns = {
        "rt_le_m": level,
        "max_error_m": error.max(axis=1),
        "neighbour_rt_le_m": neighbour_rt_le(track, recording, drive),
        **{name: account.of("online", *counted) / account.seconds for name, counted in BYTES.items()},
        "worse_than_gnss": (level > 1.001 * fixes).astype(float),
    }
    found = None if track.covariance is None else nees(track, drive)
    if found is not None:
        columns["nees"] = np.nanmean(found, axis=1)
    levels = (
        np.moveaxis(np.quantile(error, np.linspace(0, 1, quantiles), axis=1), 0, -1)
        if quantiles
        else (np.empty((*level.shape, 0)))
    )
    return Scores(columns, levels, track.seconds, None if found is None else found.sum(axis=0))
