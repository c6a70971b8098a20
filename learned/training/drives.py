"""Measured drives: what vehicles measured and where they truly were, to train on in place of a fleet."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeAlias, cast

import numpy as np

from coopoc.arrays import instance, listed
from coopoc.errors import InputError, shown
from coopoc.text import short_repr
from coopoc.world.fleet import Fleet, columns
from coopoc.world.recording import Recording, check_recording
from coopoc.world.storage import digest


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
        moving = np.flatnonzero(np.abs(np.nan_to_num(recording.velocity)).max(axis=(0, 1, 3)))
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


Drives: TypeAlias = Fleet | MeasuredDrives
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
        return MeasuredDrives(data.recording, cast(Fleet, data.truth))
    hint = "Take coopoc.load_fleet(...), or coopoc.read_log(...) of a log with a truth."
    raise InputError("data", shown(data), "must be a Fleet, or a log with its truth", hint)
