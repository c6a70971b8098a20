"""CSV and Parquet: one row per vehicle and instant, columns id, t, x, y, z and, if known, vx, vy, vz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from coopoc.errors import InputError
from coopoc.plugins import suggestion, unknown
from coopoc.world.fleet import Fleet

from .cells import numeric, read_frame, seconds, words
from .rows import assemble

NEEDED, VELOCITY = ("id", "t", "x", "y", "z"), ("vx", "vy", "vz")


def read_table(
    path: Path,
    *,
    dt: float | None = None,
    max_gap: float | None = None,
    any_scale: bool = False,
    columns: Mapping[str, str] | None = None,
) -> Fleet:
    """Fleet of a CSV or Parquet file; without vx, vy, vz the velocity is the backward difference.

    Args:
        path: .csv or .parquet; s, m, m/s in a local east-north-up frame; a missing row means absent.
        dt: s, resample; None keeps the stamps.
        max_gap: s, as in `assemble`.
        any_scale: True accepts positions that do not look like metres and seconds.
        columns: names in the file, as {"id": "vehicle"}, where they differ from id, t, x, y, z, vx, vy, vz.

    Raises:
        InputError: a missing column, text or NaN in a cell (with its row, the header not counted), or stamps that no
            filter can use.
    """
    names = dict(columns or {})
    unknown_keys(names, (*NEEDED, *VELOCITY), path.name)
    frame = read_frame(path, names.get("id", "id"))
    given = [c for c in VELOCITY if names.get(c, c) in frame.columns]
    wanted = [*NEEDED, *(VELOCITY if given else ())]
    for column in wanted:
        if names.get(column, column) not in frame.columns:
            headers = [str(header) for header in frame.columns]
            raise InputError(
                f"{path.name}: column {names.get(column, column)}",
                "missing",
                f"columns {', '.join(NEEDED)} are needed and {', '.join(VELOCITY)} go together; "
                f"the file has {', '.join(headers)}",
                suggestion(names.get(column, column), headers, f'Add it, or name it: columns={{"{column}": "..."}}.'),
            )
    numbers = np.column_stack([numeric(frame, names.get(c, c), path.name) for c in wanted[2:]])
    return assemble(
        words(frame, names.get("id", "id"), path.name),
        seconds(frame, names.get("t", "t"), path.name),
        numbers[:, :3],
        numbers[:, 3:] if given else None,
        dt=dt,
        max_gap=max_gap,
        any_scale=any_scale,
        file=path.name,
        name=path.stem,
        source=f"table {path.name}" + ("" if given else ", velocity by backward difference"),
    )


def unknown_keys(columns: Mapping[str, str], known: Sequence[str], file: str) -> None:
    """InputError for a key of `columns` that is none of the known ones."""
    for key in columns:
        if key not in known:
            raise unknown(f"{file}: key of columns", key, known, 'Give columns={"t": "name in the file"}.')


def write_table(fleet: Fleet, path: Path) -> None:
    """Write id, t, x, y, z, vx, vy, vz of every present vehicle and instant; numbers come back bit by bit."""
    import pandas as pd

    step, column = np.nonzero(fleet.present)
    frame = pd.DataFrame({"id": np.array(fleet.ids)[column], "t": np.round(fleet.t[step], 6)})
    frame[["x", "y", "z"]] = fleet.position[step, column]
    frame[list(VELOCITY)] = fleet.velocity[step, column]
    if path.suffix == ".parquet":
        frame.to_parquet(path, index=False)
    else:
        frame.to_csv(path, index=False, lineterminator="\n")
