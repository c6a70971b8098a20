"""CSV and Parquet: one row per vehicle and instant, columns id, t, x, y, z and, if known, vx, vy, vz."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.plugins import suggestion
from coopoc.world.fleet import Fleet

from .rows import assemble

if TYPE_CHECKING:
    import pandas as pd

NEEDED, VELOCITY = ("id", "t", "x", "y", "z"), ("vx", "vy", "vz")


def read_table(path: Path, *, dt: float | None = None, columns: Mapping[str, str] | None = None) -> Fleet:
    """Fleet of a CSV or Parquet file; without vx, vy, vz the velocity is the backward difference.

    Args:
        path: .csv or .parquet; s, m, m/s in a local east-north-up frame; a missing row means absent.
        dt: s, resample; None keeps the stamps.
        columns: names in the file, as {"id": "vehicle"}, where they differ from id, t, x, y, z, vx, vy, vz.

    Raises:
        InputError: a missing column, text or NaN in a cell (with its row, the header not counted), or stamps that no
            filter can use.
    """
    import pandas as pd

    names = dict(columns or {})
    frame = pd.read_parquet(path) if path.suffix == ".parquet" else read_csv(path, names.get("id", "id"))
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
    numbers = np.column_stack([numeric(frame, names.get(c, c), path.name) for c in wanted[1:]])
    vehicle = _ids(frame, names.get("id", "id"), path.name)
    return assemble(
        vehicle,
        numbers[:, 0],
        numbers[:, 1:4],
        numbers[:, 4:] if given else None,
        dt=dt,
        file=path.name,
        name=path.stem,
        source=f"table {path.name}" + ("" if given else ", velocity by backward difference"),
    )


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


def numeric(frame: pd.DataFrame, column: str, file: str) -> Floats:
    """A column as finite numbers; InputError with the row of the first cell that is none."""
    import pandas as pd

    values = pd.to_numeric(frame[column], errors="coerce").to_numpy(dtype=float)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise InputError(
            f"{file}: row {bad[0] + 1}, column {column}",
            frame[column].iloc[int(bad[0])],
            "must be a finite number",
            "Interpolate the value, or remove the row: a missing row means that the vehicle is absent.",
        )
    return values


def read_csv(path: Path, text: str = "") -> pd.DataFrame:
    """Table of a CSV file whose column `text`, if it has one, is kept as it is written: "007" stays "007".

    Raises:
        InputError: no commas, no header, or rows that are longer than the header (pandas would shift the columns).
    """
    import pandas as pd

    allowed, hint = "must be comma separated text with a header", "Export it again, with commas and decimal points."
    try:
        frame = pd.read_csv(path, skipinitialspace=True, converters={text: str.strip})
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise InputError(path.name, error, allowed, hint) from None
    if len(frame.columns) == 1:
        raise InputError(path.name, repr(frame.columns[0]), allowed, hint)
    if len(frame) and not isinstance(frame.index, pd.RangeIndex):
        longer = f"{frame.index.nlevels + len(frame.columns)} cells under {len(frame.columns)} names"
        raise InputError(path.name, longer, "must have one name per column", "Name every column in the header.")
    return frame


def _ids(frame: pd.DataFrame, column: str, file: str) -> list[str]:
    bad = np.flatnonzero((frame[column].isna() | (frame[column] == "")).to_numpy())
    if len(bad):
        raise InputError(f"{file}: row {bad[0] + 1}, column {column}", "empty", "must be a name", "Fill it in.")
    return [str(v) for v in frame[column]]
