"""Rows of a log: measurements with their time, member, kind, partner, standard deviation and place in a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coopoc.arrays import AnyArray, Bools, Floats, Ints
from coopoc.errors import InputError

from .kinds import KINDS
from .log_summary import Tally


@dataclass(frozen=True, eq=False)
class Rows:
    """L measurements in the units of their kinds.

    Args:
        t: (L,) s; of a message, when it was sent.
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

    def place(self, k: int) -> str:
        """File and row of one of them."""
        return f"{self.file[k]}: row {self.row[k]}"

    @property
    def group(self) -> AnyArray:
        """(L,) group of each kind."""
        found = np.empty(len(self), dtype=object)
        for kind in set(self.kind.tolist()):
            found[self.kind == kind] = KINDS[kind].group
        return found


def stacked(parts: Sequence[Rows]) -> Rows:
    """All rows of several files."""
    fields = Rows.__dataclass_fields__
    return Rows(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})


def stamped(rows: Rows) -> Rows:
    """Rows without a time, those of places, at the first instant of the others."""
    if np.isnan(rows.t).all():
        raise InputError("t", "in no file", "must be a column of some table", "Give the times of what was measured.")
    return replace(rows, t=np.where(np.isnan(rows.t), np.nanmin(rows.t), rows.t))


def rows_of(
    file: str, t: Floats, vehicle: Sequence[str], kind: Sequence[str], value: Floats, row: Ints, **more: Any
) -> Rows:
    """Rows from columns: partner, std and arrival are empty unless they are given."""
    size = len(t)
    filled: dict[str, Any] = {
        "partner": np.full(size, "", dtype=object),
        "std": np.full(size, np.nan),
        "arrival": np.full(size, np.nan),
        **more,
    }
    names = {"vehicle": vehicle, "kind": kind, "partner": filled.pop("partner")}
    return Rows(
        np.asarray(t, dtype=float),
        value=np.asarray(value, dtype=float),
        file=np.full(size, file, dtype=object),
        row=np.asarray(row, dtype=np.int64),
        **{key: np.array(column, dtype=object).reshape(size) for key, column in names.items()},
        **filled,
    )


def check_arrivals(rows: Rows) -> None:
    """InputError at the first message that arrives before it was sent."""
    early = np.flatnonzero(rows.arrival < rows.t - 1e-9)
    if len(early):
        k = int(early[0])
        raise InputError(
            f"{rows.place(k)}, column arrival",
            f"{rows.arrival[k]:.6f} s, sent at {rows.t[k]:.6f} s",
            "must not come before the message was sent",
            'Give the offsets of the clocks, as clock={"car2": 0.35}, or mend the row.',
        )


def in_order(rows: Rows, tally: Tally) -> None:
    """Say where the stamps of one quantity go back within a file; its rows are taken in order of time."""
    import pandas as pd  # here: the help of commands loads nothing heavy

    codes = np.zeros(len(rows), dtype=np.int64)
    for column in (rows.file, rows.vehicle, rows.kind, rows.partner):
        own, known = pd.factorize(column)
        codes = pd.factorize(codes * (len(known) + 1) + own)[0]
    order = np.argsort(codes, kind="stable")
    step = np.diff(rows.t[order])
    back = np.flatnonzero((np.diff(codes[order]) == 0) & (step < 0))
    if len(back):
        first = order[back + 1].argmin()
        given = f"{rows.place(int(order[back[first] + 1]))}, by {-step[back[first]]:.6g} s"
        tally.assume(
            f"rows are in order of time where stamps go back in a file ({len(back)} times, first: {{}})", given
        )
