"""Trajectories: poses over time, in TUM files (`t x y z qx qy qz qw`)."""

from collections.abc import Callable
from dataclasses import InitVar, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, checked, frozen
from ..errors import InputError
from ..file_names import given_path
from ..short_repr import short_repr
from .values import UNIT, read_table, to_orientation, to_rotation

ORTHONORMAL = 1e-3
"""Largest entry of |R R^T - I| of a matrix that was merely rounded."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T poses of one body in one frame.

    Args:
        stamps: (T,) s, increasing, or None where the file has none.
        position: (T, 3) m.
        rotation: (T, 3, 3), body to frame.
        location: row -> where it came from, for messages; readers pass the line of the file.

    Raises:
        InputError: shapes, a number that is not finite, stamps that do not increase, or a matrix that is no rotation:
            not orthonormal to within 1e-3, or a reflection.

    >>> len(Trajectory(None, np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))))
    4
    """

    stamps: Floats | None
    position: Floats
    rotation: Floats
    location: InitVar[Callable[[int], str] | None] = None

    __repr__ = short_repr

    def __post_init__(self, location: Callable[[int], str] | None) -> None:
        for field in ("position", "rotation", *(() if self.stamps is None else ("stamps",))):
            self.__dict__[field] = frozen(getattr(self, field))
        _check(self, location or "pose {}".format)

    def __len__(self) -> int:
        return len(self.position)


def _check(poses: Trajectory, location: Callable[[int], str]) -> None:
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
        raise InputError(location(bad[0]), poses.position[bad[0]], "must be finite numbers", "Remove the pose.")
    late = 1 + np.flatnonzero(np.diff(stamps) <= 0)
    if len(late):
        order = f"{stamps[late[0]]!s} s after {stamps[late[0] - 1]!s} s"
        hint = "Sort the poses by time, and remove one that repeats."
        raise InputError(f"{location(late[0])}, column t", order, "must increase", hint)
    off = np.abs(poses.rotation @ poses.rotation.swapaxes(-1, -2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(poses.rotation) < 0))
    if len(bad):
        raise InputError(
            location(bad[0]),
            f"rotation {poses.rotation[bad[0]].round(6).tolist()}",
            f"must be orthonormal to within {ORTHONORMAL:g}, with determinant 1",
            "Check the order of the numbers.",
        )


def read_tum(path: str | Path) -> Trajectory:
    """Trajectory of a TUM file: unit quaternions with the scalar last; lines that start with # are comments.

    Args:
        path: s, m; a quaternion whose length is within 1 % of 1 was rounded and is normalised.

    Raises:
        InputError: with the line, another number of words, one that is no finite number, stamps that do not increase, a
            quaternion of another length; a file without a pose.

    Source: the tools of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "a.tum"
    >>> _ = file.write_text("0.0 1 1 1 0 0 0 1\\n0.1 1 1 1 0 0 0 1\\n")
    >>> read_tum(file).stamps
    array([0. , 0.1])
    """
    path = given_path(path)
    lines, table = read_table(path, "t x y z qx qy qz qw")
    off = np.flatnonzero(np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) > UNIT)
    if len(off):
        raise InputError(
            f"{path.name}: line {lines[off[0]]}",
            f"quaternion {table[off[0], 4:].tolist()}",
            f"must have length 1 to within {UNIT:g}",
            "Order is qx qy qz qw; write 0 0 0 1 where the orientation is unknown.",
        )
    rotation = to_rotation(table[:, 4:])
    return Trajectory(table[:, 0], table[:, 1:4], rotation, location=lambda row: f"{path.name}: line {lines[row]}")


def write_tum(
    path: str | Path, t: npt.ArrayLike, position: npt.ArrayLike, heading: npt.ArrayLike | None = None
) -> None:
    """Write a path as a TUM file, `t x y z qx qy qz qw` by rows, which evo and most SLAM tools read.

    Args:
        path: of the file, which is replaced.
        t: (T,) s, increasing.
        position: (T, 3) m, such as `track.x[run, :, k]` of the k-th ego.
        heading: (T,) rad from +x, anticlockwise; None where it is unknown: all poses then point along +x.

    Raises:
        InputError: shapes, numbers that are not finite, stamps that do not increase.

    Source: the tools of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

    >>> import tempfile
    >>> write_tum(file := Path(tempfile.mkdtemp()) / "a.tum", [0.0, 0.1], [[1, 2, 0], [2, 2, 0]], [0.0, np.pi])
    >>> read_tum(file).rotation[1].round(6).tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    stamps, where = checked("t", t, "(T,)", (-1,)), checked("position", position, "(T, 3)", (-1, 3))
    course = np.zeros(len(where)) if heading is None else checked("heading", heading, "(T,)", (len(where),))
    rotation = np.tile(np.eye(3), (len(where), 1, 1))
    rotation[:, :2, :2] = to_rotation(course[:, None])
    poses = Trajectory(stamps, where, rotation)
    rows = np.column_stack([stamps, poses.position, to_orientation(poses.rotation)])
    np.savetxt(given_path(path), rows, fmt="%.9f")
