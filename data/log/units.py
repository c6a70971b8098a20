"""What a log is made of: kinds of measurements with their units, rows of them, and what became of the rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from coopoc.arrays import AnyArray, Bools, Floats, Ints

if TYPE_CHECKING:
    import pandas as pd

DEGREE, TURN = float(np.pi / 180), float(2 * np.pi) + 1e-3


class Kind(NamedTuple):
    """What a number of this kind means.

    Attributes:
        group: fix, odometry, heading, relative or message.
        name: of the same quantity in SI units.
        limit: largest |value| in its own unit that can be meant; beyond it another unit is.
        scale: in SI it is scale * value + offset.
        offset: rad.
    """

    group: str
    name: str
    limit: float = np.inf
    scale: float = 1.0
    offset: float = 0.0


KINDS: dict[str, Kind] = {
    **{name: Kind("fix", name) for name in ("x", "y", "z", "height")},
    "latitude": Kind("fix", "latitude", 90.0),
    "longitude": Kind("fix", "longitude", 180.0),
    **{name: Kind("odometry", name, 500.0) for name in ("vx", "vy", "vz", "speed")},
    "speed_kmh": Kind("odometry", "speed", 1800.0, 1 / 3.6),
    "yaw_rate": Kind("odometry", "yaw_rate", 35.0),
    "heading": Kind("heading", "heading", TURN),
    "range": Kind("relative", "range"),
    "azimuth": Kind("relative", "azimuth", TURN),
    "bearing": Kind("relative", "bearing", TURN),
    "inclination": Kind("relative", "inclination", TURN / 2),
    "elevation": Kind("relative", "inclination", TURN / 4, -1.0, float(np.pi / 2)),
    "message": Kind("message", "message"),
}
"""Azimuth and heading are anticlockwise from +x (east), compass_deg clockwise from north, bearing anticlockwise from
the observer's heading, inclination from +z, elevation above the horizon. A unit that is not SI is in the name."""
for _name in ("yaw_rate", "heading", "azimuth", "bearing", "inclination", "elevation"):
    KINDS[f"{_name}_deg"] = KINDS[_name]._replace(scale=DEGREE * KINDS[_name].scale, limit=KINDS[_name].limit / DEGREE)
KINDS["compass_deg"] = KINDS["heading_deg"]._replace(scale=-DEGREE, offset=float(np.pi / 2))
ANGLES = ("heading", "azimuth", "bearing", "inclination")


@dataclass(frozen=True, eq=False)
class Rows:
    """L measurements in the units of their kinds.

    Args:
        t: (L,) s; of a message, when it was sent; NaN of a place without a time.
        vehicle: (L,) names: what measures, or sends.
        kind: (L,) names of KINDS.
        partner: (L,) names: what is measured, or receives; "" for none, or for a message to all.
        value: (L,) NaN for a message.
        std: (L,) NaN where it is not given.
        arrival: (L,) s, infinite for a message that was lost; NaN where there is none.
        file: (L,) names.
        row: (L,) from 1, the header not counted.
    """

    t: Floats
    vehicle: AnyArray
    kind: AnyArray
    partner: AnyArray
    value: Floats
    std: Floats
    arrival: Floats
    file: AnyArray
    row: Ints

    def __len__(self) -> int:
        return len(self.t)

    def take(self, which: Bools | Ints) -> Rows:
        """Some of the rows."""
        return replace(self, **{name: getattr(self, name)[which] for name in self.__dataclass_fields__})

    def of(self, *kinds: str) -> Bools:
        """(L,) True for rows of these kinds."""
        return np.isin(self.kind, list(kinds))

    def in_group(self, *groups: str) -> Bools:
        """(L,) True for rows of these groups."""
        return self.of(*(name for name, kind in KINDS.items() if kind.group in groups))

    def place(self, which: Bools | int) -> str:
        """File and row of one of them, or of the first where `which` is true."""
        k = which if isinstance(which, int) else int(np.argmax(which))
        return f"{self.file[k]}: row {self.row[k]}"


def rows_of(frame: pd.DataFrame, file: str) -> Rows:
    """Rows of a table with columns t, vehicle, kind and value, and, if there are any, partner, std and arrival; its
    index numbers them."""
    numbers = {name: frame.get(name, np.full(len(frame), np.nan)) for name in ("t", "value", "std", "arrival")}
    names = {name: frame.get(name, [""] * len(frame)) for name in ("vehicle", "kind", "partner")}
    return Rows(
        **{name: np.array(column, dtype=float) for name, column in numbers.items()},
        **{name: np.array(list(column), dtype=object) for name, column in names.items()},
        file=np.full(len(frame), file, dtype=object),
        row=frame.index.to_numpy(dtype=np.int64),
    )


def stacked(parts: Sequence[Rows]) -> Rows:
    """All rows of several files."""
    return Rows(**{name: np.concatenate([getattr(one, name) for one in parts]) for name in Rows.__dataclass_fields__})


@dataclass
class Summary:
    """What became of the rows of a log, counted while it is read.

    Args:
        name: of the log.
        grid: steps and interval in words.
        vehicles: id -> what was read of it, in words.
        read: what -> number of measurements in the Recording.
        refused: reason -> (number, place of the first) of measurements that are not in it.
        unused: what was never meant to be read -> number of cells.
        assumed: sentence on what the log does not say, with {} for names -> the names, none where it is about all.

    >>> summary = Summary("drive", "3 steps of 0.1 s", {"a": "3 fixes"}, {"fixes": 3})
    >>> summary.refuse("a second fix in a step", 1, "f: row 2")
    >>> summary.assume("{} stands", "a"), summary.assume("{} stands", "b")
    (None, None)
    >>> print(summary)
    drive: 3 steps of 0.1 s, 1 vehicle
      a: 3 fixes
    read: 3 fixes
    not used: 1 a second fix in a step (first: f: row 2)
    assumed: a, b stands
    """

    name: str = ""
    grid: str = ""
    vehicles: dict[str, str] = field(default_factory=dict)
    read: dict[str, int] = field(default_factory=dict)
    refused: dict[str, tuple[int, str]] = field(default_factory=dict)
    unused: dict[str, int] = field(default_factory=dict)
    assumed: dict[str, list[str]] = field(default_factory=dict)

    def count(self, what: str, number: int) -> None:
        """Add to what was read."""
        if number:
            self.read[what] = self.read.get(what, 0) + number

    def refuse(self, reason: str, number: int, where: str = "") -> None:
        """Add to what is not in the Recording."""
        if number:
            before, first = self.refused.get(reason, (0, where))
            self.refused[reason] = before + number, first

    def refuse_rows(self, reason: str, rows: Rows, wrong: Bools | Ints) -> None:
        """Refuse the rows that are True, or at these indices."""
        which = np.flatnonzero(wrong) if wrong.dtype == bool else wrong
        if len(which):
            self.refuse(reason, len(which), rows.place(int(which[0])))

    def leave(self, what: str, number: int) -> None:
        """Add to what was not meant to be read."""
        self.unused[what] = self.unused.get(what, 0) + number

    def assume(self, sentence: str, name: str = "") -> None:
        """Add a sentence, once, and a name that takes the place of its {}."""
        names = self.assumed.setdefault(sentence, [])
        if name and name not in names:
            names.append(name)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is assumed, with the names."""
        return tuple(sentence.format(", ".join(names)) for sentence, names in self.assumed.items())

    def __str__(self) -> str:
        count = len(self.vehicles)
        lines = [f"{self.name}: {self.grid}, {count} vehicle{'s' * (count != 1)}"]
        lines += [f"  {name}: {text}" for name, text in self.vehicles.items()]
        lines += [f"read: {', '.join(f'{number} {what}' for what, number in self.read.items())}"]
        for why, (number, first) in self.refused.items():
            lines.append(f"not used: {number} {why}" + (f" (first: {first})" if first else ""))
        lines += [f"not read: {what} ({number} cells)" for what, number in self.unused.items()]
        lines += [f"assumed: {sentence}" for sentence in self.sentences]
        return "\n".join(lines)
