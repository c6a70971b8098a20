"""Measured drives: what vehicles measured and where they truly were, to train on in place of a fleet; their clients, of
fixes and odometry in pieces with the truth as the target.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch

from coopoc.arrays import Floats, instance, listed, one_of
from coopoc.errors import InputError, shown
from coopoc.text import short_repr
from coopoc.world.fleet import Fleet, columns
from coopoc.world.recording import Recording, check_recording
from coopoc.world.storage import digest

from .clients import LONG_PIECES, Client, Segments, Start, check_pieces


@dataclass(frozen=True, eq=False)
class MeasuredDrives:
    """What vehicles measured and where they truly were, to train on in place of a fleet whose measurements are drawn.

    Args:
        recording: in the world frame; every run of it is used.
        truth: of the same members at the same steps, NaN where there is none.
        ids: of the vehicles that train; empty: all that move.

    Raises:
        InputError: no truth, or one of other members or steps; no vehicle that moves; one without any truth.

    >>> from coopoc import Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.ones((2, 1, 3)))
    >>> MeasuredDrives(observe(fleet, Sensors()), fleet).ids
    ('a',)
    """

    recording: Recording
    truth: Fleet
    ids: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        hint = "Add a table named truth to the folder of the log, or name one: read_log(..., truth=)."
        recording, truth = check_recording(self.recording), instance("truth", self.truth, Fleet, hint)
        if truth.ids != recording.ids or len(truth.t) != len(recording.t):
            hint = "Give the truth on the steps of the recording, as read_log does."
            raise InputError("truth", repr(truth), "must hold the members and steps of the recording", hint)
        moving = np.flatnonzero(abs(np.nan_to_num(recording.velocity)).max(axis=(0, 1, 3)))
        wanted = listed("ids", self.ids, "Give a tuple of ids, () for all that move.") or moving.tolist()
        cols = columns("vehicles", wanted, recording.ids)
        if not cols:
            raise InputError("recording", repr(recording), "has no vehicle that moves", "Give one with odometry.")
        for column in cols:
            if not truth.present[:, column].any():
                hint = "Add its truth, or name those that have one: MeasuredDrives(recording, truth, ids=...)."
                raise InputError("truth", f"none of {recording.ids[column]}", "must be there for all that train", hint)
        object.__setattr__(self, "ids", tuple(recording.ids[column] for column in cols))

    @property
    def name(self) -> str:
        """Of the drives, for cards."""
        return self.truth.name

    @cached_property
    def digest(self) -> str:
        """SHA-256 of measurements, truth and vehicles."""
        parts = digest(self.recording), self.truth.digest, *self.ids
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def select(self, vehicles: Sequence[str]) -> "MeasuredDrives":
        """The same drives with these vehicles as the only clients."""
        return replace(self, ids=tuple(vehicles))


Drives = Fleet | MeasuredDrives
"""What clients are made of: a fleet, whose measurements are simulated, or what was measured."""


class Logged(Protocol):
    """What `coopoc.read_log` returns, as far as training needs it."""

    @property
    def recording(self) -> Recording:
        """What was measured."""

    @property
    def truth(self) -> Fleet | None:
        """Where vehicles were, None if there is no truth."""


def drives_of(data: Drives | Logged) -> Drives:
    """What a training takes: a Fleet or MeasuredDrives as it is, of a log its measurements and truth.

    Args:
        data: any of these.

    Raises:
        InputError: anything else; a log without a truth, or in body frames.
    """
    if isinstance(data, Fleet | MeasuredDrives):
        return data
    if hasattr(data, "recording") and hasattr(data, "truth"):
        return MeasuredDrives(data.recording, data.truth)  # type: ignore[arg-type]
    hint = "Take coopoc.load_fleet(...), or coopoc.read_log(...) of a log with a truth."
    raise InputError("data", shown(data), "must be a Fleet, or a log with its truth", hint)


LEAST_PIECES = 20
"""Pieces of a vehicle, of which four validate: fewer, longer ones hold too few errors that are independent."""
Cut = tuple[int, int]
"""Run and first step of a piece."""


def measured_clients(
    drives: MeasuredDrives, *, start: Start = "gnss", piece: int = 100, split: float = 0.8
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
            free = first
            for at in (first + np.flatnonzero(starts[first : stop - piece])).tolist():
                if at >= free:
                    free = at + piece + 1
                    if there[at + 1 : free].any():
                        yield run, at


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
        scale=tensor(recording.fix_scale[None]) if recording.fix_factor.size else None,
    )
