"""TUM trajectories: lines `t x y z qx qy qz qw`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import InputError
from ..file_names import given_path
from ..plugins import one_of
from .lines import read_table, to_text
from .rotations import UNIT, to_orientation, to_rotation
from .trajectory import Trajectory


def read_tum(path: str | Path, *, repeats: Literal["refuse", "drop"] = "refuse") -> Trajectory:
    """Trajectory of a TUM file: unit quaternions with the scalar last; lines that start with # are comments.

    Args:
        path: s, m; a quaternion whose length is within 1 % of 1 was rounded and is normalised.
        repeats: what happens to a pose whose stamp is that of the pose before: "refuse" raises, "drop" leaves it out.

    Raises:
        InputError: with the line, another number of words, one that is no finite number, stamps that do not increase, a
            quaternion of another length; a file without a pose.

    Source: the tools of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "a.tum"
    >>> write_tum(Trajectory([0.0, 0.1], np.ones((2, 3)), np.tile(np.eye(3), (2, 1, 1))), file)
    >>> read_tum(file).stamps
    array([0. , 0.1])
    """
    one_of("repeats", repeats, ("refuse", "drop"))
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
    if repeats == "drop":
        first = np.append(True, np.diff(table[:, 0]) != 0)
        lines, table = lines[first], table[first]
    rotation = to_rotation(table[:, 4:])
    return Trajectory(table[:, 0], table[:, 1:4], rotation, place=lambda row: f"{path.name}: line {lines[row]}")


def write_tum(poses: Trajectory, path: str | Path) -> None:
    """Write `t x y z qx qy qz qw`, qw >= 0: stamps and positions come back bit by bit, rotations to rounding.

    Raises:
        InputError: a trajectory without stamps.
    """
    if poses.stamps is None:
        raise InputError("stamps", None, "TUM needs a stamp for every pose", "Give them, or write KITTI.")
    table = np.column_stack([poses.stamps, poses.position, to_orientation(poses.rotation)])
    Path(path).write_text("\n".join([*to_text(table), ""]))
