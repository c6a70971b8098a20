"""Trajectories: poses over time, in TUM files (`t x y z qx qy qz qw`)."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, check_turns, checked
from ..errors import InputError
from ..paths import given_path, write
from .values import QUATERNION_ROUNDING, read_table, to_orientation, to_rotation


class Trajectory(NamedTuple):
    """T poses of one body in one frame.

    Args:
        stamps: (T,) s, increasing.
        position: (T, 3) m.
        rotation: (T, 3, 3), body to frame.
    """

    stamps: Floats
    position: Floats
    rotation: Floats


def _check_order(stamps: Floats, location: Callable[[int], str]) -> None:
    """InputError at the first pose that is no later than the one before."""
    late = 1 + np.flatnonzero(np.diff(stamps) <= 0)
    if len(late):
        order = f"{stamps[late[0]]!s} s after {stamps[late[0] - 1]!s} s"
        hint = "Sort the poses by time, and remove one that repeats."
        raise InputError(f"{location(late[0])}, column t", order, "must increase", hint)


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
    off = np.flatnonzero(np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) > QUATERNION_ROUNDING)
    if len(off):
        raise InputError(
            f"{path.name}: line {lines[off[0]]}",
            f"quaternion {table[off[0], 4:].tolist()}",
            f"must have length 1 to within {QUATERNION_ROUNDING:g}",
            "Order is qx qy qz qw; write 0 0 0 1 where the orientation is unknown.",
        )
    _check_order(table[:, 0], lambda row: f"{path.name}: line {lines[row]}")
    return Trajectory(table[:, 0], table[:, 1:4], to_rotation(table[:, 4:]))


def write_tum(
    path: str | Path, t: npt.ArrayLike, position: npt.ArrayLike, heading: npt.ArrayLike | None = None
) -> None:
    """Write a path as a TUM file, `t x y z qx qy qz qw` by rows, which evo and most SLAM tools read.

    Args:
        path: of the file, which is replaced whole; its folder is made.
        t: (T,) s, increasing.
        position: (T, 3) m, such as `track.x[run, :, k]` of the k-th ego.
        heading: (T,) rad from +x, anticlockwise; None where it is unknown: all poses then point along +x.

    Raises:
        InputError: shapes, numbers that are not finite, stamps that do not increase, headings in degrees.

    Source: the tools of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

    >>> import tempfile
    >>> write_tum(file := Path(tempfile.mkdtemp()) / "a.tum", [0.0, 0.1], [[1, 2, 0], [2, 2, 0]], [0.0, np.pi])
    >>> read_tum(file).rotation[1].round(6).tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    where = checked("position", position, "(T, 3)", (-1, 3))
    stamps = checked("t", t, "(T,)", (len(where),))
    course = np.zeros(len(where)) if heading is None else checked("heading", heading, "(T,)", (len(where),))
    poses = np.column_stack([stamps, where, course])
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if len(bad):
        raise InputError(f"pose {bad[0]}", poses[bad[0]], "must be finite numbers", "Remove the pose.")
    _check_order(stamps, "pose {}".format)
    check_turns("heading", course)
    rotation = np.tile(np.eye(3), (len(where), 1, 1))
    rotation[:, :2, :2] = to_rotation(course[:, None])
    rows = np.column_stack([stamps, where, to_orientation(rotation)])
    write(given_path(path), lambda file: np.savetxt(file, rows, fmt="%.9f"))
