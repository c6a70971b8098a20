"""TUM trajectories: one file per vehicle with lines `t x y z qx qy qz qw`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet

from .rows import assemble, increasing

SUFFIXES = (".tum", ".txt")


def tum_files(path: Path) -> list[Path]:
    """The file itself, or the .tum (else .txt) files of a folder by name."""
    if path.is_file():
        return [path]
    for suffix in SUFFIXES:
        if found := sorted(path.glob(f"*{suffix}")):
            return found
    return []


def read_tum(path: Path, *, dt: float | None = None) -> Fleet:
    """Fleet of a TUM file or a folder of them; ids are file names, velocity is the backward difference.

    Args:
        path: file or folder; s and m; orientation is checked for its four numbers and not kept (a Fleet has none).
        dt: s, resample: needed when the vehicles' stamps differ.

    Raises:
        InputError: no file, an empty one, a line that is not eight finite numbers (with its number), stamps that do not
            increase.
    """
    files = tum_files(path)
    if not files:
        raise InputError("path", path, "must be a TUM file or a folder with .tum or .txt files", "Check the path.")
    poses = [_read(file) for file in files]
    vehicle = [file.stem for file, pose in zip(files, poses, strict=True) for _ in pose]
    table = np.concatenate(poses)
    return assemble(
        vehicle,
        table[:, 0],
        table[:, 1:4],
        dt=dt,
        file=path.name,
        name=path.stem,
        source=f"TUM {path.name}, velocity by backward difference",
    )


def write_tum(fleet: Fleet, folder: Path) -> None:
    """Write <id>.tum for every vehicle: no velocity, and the identity as orientation, which a Fleet lacks."""
    folder.mkdir(parents=True, exist_ok=True)
    for column, name in enumerate(fleet.ids):
        present = fleet.present[:, column]
        rows = zip(fleet.t[present], fleet.position[present, column], strict=True)
        lines = [f"{t:.6f} {float(x)!r} {float(y)!r} {float(z)!r} 0 0 0 1" for t, (x, y, z) in rows]
        (folder / f"{name}.tum").write_text("\n".join([*lines, ""]))


def _read(file: Path) -> Floats:
    texts = file.read_text("utf-8-sig").splitlines()
    lines = [(k, text.split()) for k, text in enumerate(texts, 1) if not _comment(text)]
    rows = []
    for number, words in lines:
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 8 or not np.isfinite(row).all():
            raise InputError(
                f"{file.name}: line {number}",
                " ".join(words),
                "must be eight finite numbers t x y z qx qy qz qw",
                "Mend or remove the line.",
            )
        rows.append(row)
    if not rows:
        raise InputError(file.name, "0 lines", "must hold at least two poses", "Check that the file is complete.")
    table = np.array(rows)
    increasing(table[:, 0], lambda row: f"{file.name}: line {lines[row][0]}", file.stem)
    return table


def _comment(text: str) -> bool:
    return not text.strip() or text.lstrip().startswith("#")
