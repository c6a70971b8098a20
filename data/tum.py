"""TUM trajectories: one file per vehicle with lines `t x y z qx qy qz qw`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from coopoc.errors import InputError
from coopoc.file_names import file_name, inside
from coopoc.formats import trajectories
from coopoc.formats.trajectories import Trajectory
from coopoc.world.fleet import Fleet

from .rows import assemble

SUFFIXES = (".tum", ".txt")


def tum_files(path: Path) -> list[Path]:
    """The file itself, or the .tum (else .txt) files of a folder by name."""
    if path.is_file():
        return [path]
    for suffix in SUFFIXES:
        if found := sorted(path.glob(f"*{suffix}")):
            return found
    return []


def read_tum(
    path: Path,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    any_scale: bool = False,
    repeats: Literal["refuse", "drop"] = "refuse",
) -> Fleet:
    """Fleet of a TUM file or a folder of them; ids are file names, velocity is the backward difference.

    Args:
        path: file or folder; s and m; orientation is checked for a unit quaternion and not kept (a Fleet has none).
        dt: s, resample: needed when the vehicles' stamps differ.
        max_gap: s, as in `assemble`.
        any_scale: True accepts positions that do not look like metres and seconds.
        repeats: "drop" leaves out a pose whose stamp is that of the pose before, "refuse" raises.

    Raises:
        InputError: no file, or what `coopoc.formats.trajectories.read_tum` raises.
    """
    files = tum_files(path)
    if not files:
        raise InputError("path", path, "must be a TUM file or a folder with .tum or .txt files", "Check the path.")
    poses = [trajectories.read_tum(file, repeats=repeats) for file in files]
    return assemble(
        [file.stem for file, one in zip(files, poses, strict=True) for _ in range(len(one))],
        np.concatenate([one.stamps for one in poses]),
        np.concatenate([one.position for one in poses]),
        dt=dt,
        max_gap=max_gap,
        any_scale=any_scale,
        file=path.name,
        name=path.stem,
        source=f"TUM {path.name}, velocity by backward difference",
    )


def write_tum(fleet: Fleet, folder: Path) -> None:
    """Write <id>.tum for every vehicle: no velocity, and the identity as orientation, which a Fleet lacks.

    Args:
        fleet: to write.
        folder: for the files.

    Raises:
        InputError: an id that is no file name, ids that differ in case only, or a symbolic link out of the folder.
    """
    hint = "Write a .csv or .parquet file, which takes any id."
    paths = [folder / f"{file_name('id', name, hint)}.tum" for name in fleet.ids]
    if len({name.casefold() for name in fleet.ids}) < len(fleet.ids):
        raise InputError("id", sorted(fleet.ids), "must differ in more than their case", hint)
    folder.mkdir(parents=True, exist_ok=True)
    for column, path in enumerate(inside(folder, path) for path in paths):
        present = fleet.present[:, column]
        position = fleet.position[present, column]
        poses = Trajectory(np.round(fleet.t[present], 6), position, np.tile(np.eye(3), (len(position), 1, 1)))
        trajectories.write_tum(poses, path)
