"""KITTI trajectories: the 12 numbers of a 3 x 4 pose [R | t] per line, row by row; stamps in a file of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..file_names import given_path
from .lines import read_table, to_text
from .trajectory import Trajectory

FORM = " ".join(f"{'r' * (j < 3)}{'t' * (j == 3)}{i + 1}{str(j + 1) * (j < 3)}" for i in range(3) for j in range(4))


def read_kitti(path: str | Path, times: str | Path | None = None) -> Trajectory:
    """Trajectory of a KITTI file.

    Args:
        path: lines r11 r12 r13 t1 r21 ... t3; m.
        times: file with one stamp per line, s.

    Raises:
        InputError: with the line, another number of words, one that is no finite number, a matrix that is no rotation;
            a file without a pose, or another number of stamps.

    Source: the KITTI odometry benchmark (Geiger, Lenz, Urtasun, CVPR 2012).

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "a.txt"
    >>> _ = file.write_text("1 0 0 5 0 1 0 6 0 0 1 7\\n")
    >>> read_kitti(file).position
    array([[5., 6., 7.]])
    """
    path = given_path(path)
    lines, table = read_table(path, FORM)
    stamps = None if times is None else read_table(Path(times), "t")[1][:, 0]
    if stamps is not None and len(stamps) != len(table):
        allowed = f"must be {len(table)}, one per pose of {path.name}"
        raise InputError("times", f"{len(stamps)} stamps", allowed, "Check that both files belong together.")
    poses = table.reshape(-1, 3, 4)
    return Trajectory(stamps, poses[..., 3], poses[..., :3], place=lambda row: f"{path.name}: line {lines[row]}")


def write_kitti(poses: Trajectory, path: str | Path, times: str | Path | None = None) -> None:
    """Write 3 x 4 poses that read back bit by bit, and their stamps to `times`.

    Raises:
        InputError: stamps without a file for them, or a file without stamps.
    """
    if (poses.stamps is None) != (times is None):
        raise InputError(
            "times",
            times,
            "must be given if and only if the trajectory has stamps",
            "KITTI keeps stamps in a file of their own.",
        )
    table = np.concatenate([poses.rotation, poses.position[:, :, None]], axis=2).reshape(-1, 12)
    Path(path).write_text("\n".join([*to_text(table), ""]))
    if times is not None and poses.stamps is not None:
        Path(times).write_text("\n".join([*to_text(poses.stamps[:, None]), ""]))
