"""coopoc score: trajectories of any program against a truth."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from math import isnan
from pathlib import Path as File
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from coopoc.errors import InputError
from coopoc.escapes import picture
from coopoc.evaluate.trajectory_scores import Aligned, Path, Score, Unit, compared, scores
from coopoc.formats.trajectories import read_kitti, read_tum
from coopoc.formats.values import read_words, to_rotation
from coopoc.world.pictures import COLORS, INK, axes, finish

from .cells import TABLES, named_columns, numeric, read_frame, seconds, words
from .source import split

COVARIANCE = ("cxx", "cxy", "cxz", "cyy", "cyz", "czz")
SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
QUATERNION = ("qx", "qy", "qz", "qw")


def read_paths(name: str) -> dict[str, Path]:
    """Trajectories of a file, by vehicle: TUM and KITTI hold one, named after the file, a table several.

    A table has columns t, x, y, z (m; without z in the plane), and may have id, qx, qy, qz, qw, and cxx, cxy, cxz,
    cyy, cyz, czz (m^2). KITTI files have no stamps: poses are numbered, or `?times=FILE` gives them.

    Raises:
        InputError: a file with a fault, named with its line or row.
    """
    word, options = split(name)
    file = File(word)
    if file.suffix.lower() in TABLES:
        return _of_table(file, options.get("columns", {}))
    if len(next(read_words(file), (0, []))[1]) == 12:
        poses = read_kitti(file, options.get("times"))
        stamps = np.arange(len(poses), dtype=float) if poses.stamps is None else poses.stamps
        return {file.stem: Path(stamps, poses.position, poses.rotation)}
    poses = read_tum(file, repeats="drop" if options.get("repeats") == "drop" else "refuse")
    assert poses.stamps is not None
    return {file.stem: Path(poses.stamps, poses.position, poses.rotation)}


def _of_table(file: File, columns: dict[str, str]) -> dict[str, Path]:
    frame = read_frame(file, columns.get("id", "id"))
    allowed = ("id", "t", *"xyz", *QUATERNION, *COVARIANCE)
    frame = named_columns(frame, columns, allowed, ("t", "x", "y"), file.name)
    frame = frame.assign(t=seconds(frame, "t", file.name), z=frame.get("z", 0.0))
    frame["id"] = words(frame, "id", file.name) if "id" in frame.columns else file.stem
    twice = frame.duplicated(["id", "t"])
    if twice.any():
        row = frame[twice].iloc[0]
        where, once = f"{file.name}: row {row.name}", f"is there twice for {row['id']}"
        raise InputError(where, f"{float(row['t'])!r} s", once, "Leave one of them out.")
    paths = {}
    for name, rows in frame.sort_values("t", kind="stable").groupby("id", sort=False):
        position, quaternion, covariance = (
            np.column_stack([numeric(rows, column, file.name) for column in group])
            if set(group) <= set(frame.columns)
            else None
            for group in ([*"xyz"], QUATERNION, COVARIANCE)
        )
        assert position is not None  # the reader requires x, y and z
        rotation = None if quaternion is None else to_rotation(quaternion)
        spread = None if covariance is None else covariance[:, SYMMETRIC]
        paths[str(name)] = Path(rows["t"].to_numpy(dtype=float), position, rotation, spread)
    return paths


def score(
    estimates: Annotated[Positional[tuple[str, ...]], arg(metavar="ESTIMATE")],
    /,
    truth: Annotated[tuple[str, ...], arg(metavar="FILE")] = (),
    align: Aligned = "none",
    max_diff: float = 0.01,
    offset: float = 0.0,
    delta: float = 1.0,
    unit: Unit = "steps",
    plot: Annotated[File | None, arg(metavar="FILE")] = None,
    output: Annotated[File | None, arg(metavar="FILE")] = None,
) -> int:
    """Score trajectories of any program against a truth: RT-LE, APE and RPE of positions and rotations, and NEES.

    Example: coopoc score orb.txt --truth truth.txt --align each

    Example: coopoc score team.csv --truth truth.csv --align team --output scores.json

    Args:
        estimates: TUM, KITTI, CSV or Parquet files; several vehicles are several files or a column id.
        truth: files of the same kinds; vehicles are matched by file name or id, and a single one is that of all.
        align: none compares as given, each aligns every vehicle, sim3 with its scale, team all by one motion.
        max_diff: largest difference of matched time stamps in s.
        offset: time in s that is added to the estimates' stamps.
        delta: distance between the poses of the relative error, in --unit.
        unit: unit of delta, steps or metres.
        plot: picture of the paths.
        output: file for the scores as JSON.
    """
    if not truth:
        raise InputError("truth", "()", "must name a file", "Add --truth FILE.")
    made: list[dict[str, Path]] = [{}, {}]
    for paths, files in zip(made, (estimates, truth), strict=True):
        for name in files:
            for vehicle, path in read_paths(name).items():
                if vehicle in paths:
                    raise InputError("vehicle", repr(vehicle), "is in two files", "Name the files, or ids, apart.")
                paths[vehicle] = path
    rows = scores(*made, aligned=align, max_diff=max_diff, offset=offset, delta=delta, unit=unit)
    print(table(rows, delta, unit))
    for row in rows:
        for remark in row.remarks:
            print(f"coopoc: {row.vehicle}: {remark}", file=sys.stderr)
    if plot is not None:
        draw(compared(made[0], made[1], align, max_diff, offset), plot)
    if output is not None:
        output.write_text(json.dumps([_plain(asdict(row)) for row in rows], indent=1, allow_nan=False) + "\n")
        print(f"coopoc: scores are in {output}", file=sys.stderr)
    return 0


def draw(pairs: Mapping[str, tuple[Path, Path, Path]], path: File) -> None:
    """Picture of aligned estimates and, dashed, of their truths in the plane."""
    ax = axes(None)
    for k, (name, (_, estimate, truth)) in enumerate(pairs.items()):
        ax.plot(*truth.position[:, :2].T, color=INK, lw=1, ls="--")
        ax.plot(*estimate.position[:, :2].T, color=COLORS[k % len(COLORS)], label=picture(name))
    finish(ax).figure.savefig(path)  # type: ignore[union-attr]


def _plain(value: Any) -> Any:
    """JSON knows no NaN: null stands for an interval that one block does not give."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    return None if isinstance(value, float) and isnan(value) else value


def table(rows: list[Score], delta: float, unit: Unit) -> str:
    """The scores as a Markdown table."""
    from tabulate import tabulate

    header = f"vehicle|poses|without truth|RT-LE [m]|APE [m]|largest [m]|RPE, {delta:g} {unit} [m]|APE [°]|RPE [°]|NEES"
    shown = [
        [row.vehicle, row.poses, row.missed, row.rt_le_m, row.ape_m, f"{row.ape_max_m:.3g}"]
        + ["" if value is None else f"{value:.3g}" for value in (row.rpe_m, row.ape_deg, row.rpe_deg, row.nees)]
        for row in rows
    ]
    return str(tabulate(shown, headers=header.split("|"), tablefmt="github", disable_numparse=True))
