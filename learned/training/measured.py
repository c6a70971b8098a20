"""Clients of measured drives: the fixes and odometry of a recording in pieces, with its truth as the target."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from coopoc import InputError, Recording
from coopoc.arrays import Floats, instance, one_of
from coopoc.world.fleet import columns

from .clients import LONG_PIECES, Client, Segments, Start, check_pieces
from .drives import MeasuredDrives

LEAST_PIECES = 20
"""Pieces of a vehicle, of which four validate: fewer, longer ones hold too few errors that are independent."""
Cut = tuple[int, int]
"""Run and first step of a piece."""


def measured_clients(
    drives: MeasuredDrives,
    *,
    start: Start = "gnss",
    piece: int = 100,
    split: float = 0.8,
) -> tuple[Client, ...]:
    """Every vehicle of measured drives as a client: its own fixes and odometry in pieces, `split` of them for training.

    A piece begins at a fix and has odometry throughout; fixes may be missing in it, and steps without a truth have no
    loss. It is as long as `piece` fixes take at their median interval, since a filter needs fixes to leave its start
    behind; shorter, but no less than `piece` steps, where a vehicle would have fewer than LEAST_PIECES pieces. The last
    pieces validate: errors of neighbouring pieces are correlated, so that pieces from between those that train would
    hardly be new.

    Args:
        drives: what was measured, and the truth.
        start: of a piece, at its first fix ("gnss") or at the truth ("true").
        piece: fixes of a segment.
        split: share of the segments that train.

    Raises:
        InputError: a choice that does not exist, or a vehicle with fewer than two pieces.

    >>> from coopoc import Fleet, Sensors, observe
    >>> t = np.arange(303) / 10
    >>> line = Fleet(("a",), t, np.zeros((303, 1, 3)), np.ones((303, 1, 3)))
    >>> [(len(c.training), len(c.validation)) for c in measured_clients(MeasuredDrives(observe(line, Sensors()), line))]
    [(2, 1)]
    >>> [len(c.training) for c in measured_clients(MeasuredDrives(observe(line, Sensors()), line), split=0.1)]
    [1]
    """
    one_of("start", start, Start)
    instance("drives", drives, MeasuredDrives)
    check_pieces(piece, split)
    cols = columns("vehicles", drives.ids, drives.recording.ids)
    piece = _steps(drives.recording, cols, piece)
    cuts = {n: [list(_cuts(drives, column, n * piece, start)) for column in cols] for n in range(1, LONG_PIECES + 1)}
    for name, pieces in zip(drives.ids, cuts[1], strict=True):
        if len(pieces) < 2:
            hint = f"It takes {2 * (piece + 1)} steps with odometry, fixes and truth: give more, or shorten the pieces."
            raise InputError("recording", f"{name} with {len(pieces)} pieces of {piece}", "needs at least two", hint)
    longest = max(n for n, pieces in cuts.items() if all(pieces))
    group = []
    for name, column, pieces, long in zip(drives.ids, cols, cuts[1], cuts[longest], strict=True):
        count = min(max(int(split * len(pieces)), 1), len(pieces) - 1)
        parts = (pieces[:count], piece), (pieces[count:], piece), (long, longest * piece)
        group.append(Client(name, *(_segments(drives, column, *part, start) for part in parts)))
    return tuple(group)


def _steps(recording: Recording, cols: Sequence[int], piece: int) -> int:
    """Steps of a piece of so many fixes."""
    there = np.isfinite(recording.gnss[:, :, cols, 0]).transpose(0, 2, 1).reshape(-1, len(recording.t))
    gaps = np.concatenate([np.diff(np.flatnonzero(row)) for row in there])
    total = min(sum(stop - first for first, stop in recording.stretches(column)) for column in cols)
    return (
        max(piece, min(piece * int(np.median(gaps)), recording.runs * total // LEAST_PIECES - 1))
        if len(gaps)
        else piece
    )


def _cuts(drives: MeasuredDrives, column: int, piece: int, start: Start) -> Iterator[Cut]:
    """Pieces of `piece` + 1 steps of a vehicle, one after the other, each from a fix and with some truth."""
    there = drives.truth.present[:, column]
    for run, fixes in enumerate(np.isfinite(drives.recording.gnss[:, :, column, 0])):
        starts = fixes & there if start == "true" else fixes
        for first, stop in drives.recording.stretches(column, piece + 1):
            at = first
            while (at := _next(starts, at)) + piece < stop:
                if there[at + 1 : at + piece + 1].any():
                    yield run, at
                at += piece + 1


def _next(true: Any, at: int) -> int:
    """First step from `at` on where it is true, else one beyond the end."""
    return at + int(np.argmax(true[at:])) if true[at:].any() else len(true)


def _segments(drives: MeasuredDrives, column: int, cuts: Sequence[Cut], piece: int, start: Start) -> Segments:
    """Segments of these pieces, each relative to its first fix; of a drive in one plane the height has no loss."""
    recording, truth = drives.recording, drives.truth
    flat = not np.nan_to_num(recording.gnss[..., 2]).any() and not np.nan_to_num(recording.velocity[..., 2]).any()
    target = np.where([False, False, flat], np.nan, truth.position)[None]
    origin = np.stack([recording.gnss[run, at, column] for run, at in cuts])[:, None]

    def tensor(values: Floats, origin: Floats | float = 0.0) -> torch.Tensor:
        rows = np.stack([values[min(run, len(values) - 1), at : at + piece + 1, column] for run, at in cuts])
        return torch.tensor(rows - origin, dtype=torch.float32)

    return Segments(
        gnss=tensor(recording.gnss, origin),
        velocity=tensor(recording.velocity),
        truth=tensor(target, origin),
        true_start=start == "true",
        dt=recording.dt,
    )
