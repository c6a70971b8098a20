"""Trajectory: poses over time, as TUM and KITTI files hold them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import InitVar, dataclass

import numpy as np

from ..arrays import Floats, frozen
from ..errors import InputError
from ..short_repr import short_repr

ORTHONORMAL = 1e-3  # largest entry of |R R^T - I| of a matrix that was merely rounded


def _row(row: int) -> str:
    return f"pose {row}"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T poses of one body in one frame.

    Args:
        stamps: (T,) s, increasing, or None where the file has none.
        position: (T, 3) m.
        rotation: (T, 3, 3), body to frame.
        place: row -> where it came from, for messages; readers pass the line of the file.

    Raises:
        InputError: shapes, a number that is not finite, stamps that do not increase, or a matrix that is no rotation:
            not orthonormal to within 1e-3, or a reflection.

    >>> len(Trajectory(None, np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))))
    4
    """

    stamps: Floats | None
    position: Floats
    rotation: Floats
    place: InitVar[Callable[[int], str] | None] = None

    __repr__ = short_repr

    def __post_init__(self, place: Callable[[int], str] | None) -> None:
        for field in ("position", "rotation", *(() if self.stamps is None else ("stamps",))):
            object.__setattr__(self, field, frozen(getattr(self, field)))
        _check(self, place or _row)

    def __len__(self) -> int:
        return len(self.position)


def _check(poses: Trajectory, place: Callable[[int], str]) -> None:
    count = len(poses)
    for field, shape in {"stamps": (count,), "position": (count, 3), "rotation": (count, 3, 3)}.items():
        array = getattr(poses, field)
        if array is not None and array.shape != shape:
            raise InputError(field, f"shape {array.shape}", f"must have shape {shape}", "One row per pose.")
    stamps = np.arange(count) if poses.stamps is None else poses.stamps
    bad = np.flatnonzero(
        ~np.isfinite(np.column_stack([stamps, poses.position, poses.rotation.reshape(count, 9)])).all(1)
    )
    if len(bad):
        raise InputError(place(bad[0]), poses.position[bad[0]], "must be finite numbers", "Remove the pose.")
    late = 1 + np.flatnonzero(np.diff(stamps) <= 0)
    if len(late):
        found = f"{stamps[late[0]]!s} s after {stamps[late[0] - 1]!s} s"
        twice = stamps[late[0]] == stamps[late[0] - 1]
        hint = 'Remove the repeated pose, or read with repeats="drop".' if twice else "Sort the poses by time."
        raise InputError(f"{place(late[0])}, column t", found, "must increase", hint)
    off = np.abs(poses.rotation @ poses.rotation.swapaxes(-1, -2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(poses.rotation) < 0))
    if len(bad):
        raise InputError(
            place(bad[0]),
            f"rotation {poses.rotation[bad[0]].round(6).tolist()}",
            f"must be orthonormal to within {ORTHONORMAL:g}, with determinant 1",
            "Check the order of the numbers.",
        )
