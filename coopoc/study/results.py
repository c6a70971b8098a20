"""Results: the tidy frame of a study, one row per (cell, run, ego), and its means with intervals."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from pandas import DataFrame

from ..arrays import Floats, listed, one_of
from ..errors import InputError
from ..evaluate.statistics import Interval, mean_interval
from ..paths import given_path
from ..text import short_repr
from . import store
from .cell import Params
from .style import METHODS, OWN_NAMES

SEED = "train_seed"
"""Column of the training seed: means are taken over it, and intervals are not."""
NO_VALUES = Interval(np.nan, np.nan, np.nan, 0)


@dataclass(frozen=True, eq=False)
class Results:
    """Rows of a study with its settings and environment.

    Args:
        study: name of the study.
        question: of the study.
        axes: names of the parameters that vary.
        settings: name -> value, the same in all cells.
        frame: rows of finished cells: parameters, `run`, `ego`, metrics, status "ok".
        failures: rows of failed cells: parameters, `reason`, `traceback`.
        pending: number of cells that were not computed yet.
        environment: versions, processor, revision.
    """

    study: str
    question: str
    axes: tuple[str, ...]
    settings: Params
    frame: DataFrame
    failures: DataFrame
    pending: int
    environment: Mapping[str, str]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if "label" in self.frame:
            own = self.frame.dropna(subset=["label"]).groupby("method")["label"].first().astype(str)
            taken = own.duplicated(keep=False) | own.isin([look.label for look in METHODS.values()])
            OWN_NAMES.update(own.mask(taken, own + " (" + own.index + ")"))

    @classmethod
    def load(cls, folder: str | Path) -> "Results":
        """Read the results in the folder of a study, finished or not.

        Args:
            folder: of the study.

        Raises:
            InputError: as `coopoc.study.store.read`.
        """
        folder = given_path(folder)
        manifest = store.read(folder)
        done, failed, pending = [], [], 0
        for name in manifest.cells:
            table = store.load(folder, name)
            if table is not None:
                done.append(table)
            elif (failure := store.load(folder, name, store.FAILED)) is not None:
                failed.append(failure)
            else:
                pending += 1
        header = manifest.study, manifest.question, tuple(manifest.axes), manifest.settings
        return cls(*header, _joined(done), _joined(failed), pending, manifest.environment)

    @property
    def failed(self) -> int:
        """Number of failed cells."""
        return len(self.failures)

    def with_failed(self) -> "Results":
        """The same with a row without numbers for each failed cell, if any has finished."""
        return replace(self, frame=pd.concat([self.frame, self.failures])) if len(self.frame) else self

    def select(self, where: Params | None = None, **also: Any) -> DataFrame:
        """Rows where each named column has the value, or one of a list of values.

        Raises:
            InputError: an unknown column, a value that no row has, or no row at all as every cell failed.
        """
        frame = self.frame
        if frame.empty and self.failed:
            raise InputError("results", "no row", f"{self.failed} cells failed", f"{self.failures['reason'][0]}.")
        for name, wanted in {**(where or {}), **also}.items():
            one_of("column", name, frame.columns)
            values = list(wanted) if pd.api.types.is_list_like(wanted) else [wanted]
            for value in values:
                if not _is(self.frame[name], value).any():
                    there = ", ".join(map(str, self.frame[name].unique()[:12])) or "(no cell has finished)"
                    raise InputError(name, repr(value), f"must be among {there}", "Widen the grid, or see failures.")
            frame = frame[np.logical_or.reduce([_is(frame[name], v) for v in values])]
        return frame

    def grid(self, value: str, where: Params | None = None, **also: Any) -> DataFrame:
        """Egos x runs of one metric, averaged over training seeds; NaN where a run or a seed has none."""
        frame = self.select(where, **also)
        self._one_cell(frame, [], value)
        return ego_by_run(frame, value)

    def values(self, value: str, where: Params | None = None, **also: Any) -> Floats:
        """(R, E) of one metric, sorted by run and ego, averaged over training seeds; see `numbers.paired` for pairs."""
        grid = whole(self.grid(value, where, **also)).to_numpy()
        if grid.size == 0:
            raise InputError(value, "no finite value", "needs an ego with all its runs", "See the failed cells.")
        return grid.T

    def interval(self, value: str, where: Params | None = None, **also: Any) -> Interval:
        """Mean of one metric over egos and runs with its interval."""
        return mean_interval(self.values(value, where, **also))

    def groups(self, by: Sequence[str], where: Params | None = None) -> Iterator[tuple[tuple[Any, ...], DataFrame]]:
        """Rows of each combination of the columns `by`, in the order of the grid; InputError if `where` leaves none."""
        frame = self.select(where)
        if frame.empty and where:
            raise InputError("where", dict(where), "must have a row with all of these values", "Name fewer of them.")
        by = listed("by", by, 'Give ["method"].')
        for name in by:
            one_of("column", name, frame.columns)
        yield from frame.groupby(by, sort=False, dropna=False)

    def summary(self, by: Sequence[str], value: str, where: Params | None = None) -> DataFrame:
        """One row per combination of `by`: mean, low, high (over egos, then runs), n, missing (values left out).

        A metric that a combination does not have at all is NaN with n = 0.

        Raises:
            InputError: rows that differ in an axis which neither `by` nor `where` names would be mixed.
        """
        rows = []
        for names, frame in self.groups(by, where):
            self._one_cell(frame, by, value)
            table = ego_by_run(frame[frame["status"] != "failed"] if "status" in frame else frame, value)
            grid = whole(table)
            each = mean_interval(grid.to_numpy().T) if grid.size else NO_VALUES
            rows.append([*names, *vars(replace(each, lost=lacking(table))).values()])
        return DataFrame(rows, columns=[*by, "mean", "low", "high", "n", "missing"])

    def _one_cell(self, frame: DataFrame, by: Sequence[str], value: str) -> None:
        one_of("metric", value, frame.columns)
        if len(scores := frame[value].dropna()) and not pd.api.types.is_numeric_dtype(scores):
            raise InputError("metric", repr(value), "must be a column of numbers", "It holds text or lists.")
        for axis in self.axes:
            if axis in frame and axis not in (*by, SEED, "ego", "run") and frame[axis].nunique(dropna=False) > 1:
                mixed = ", ".join(map(str, frame[axis].unique()))
                raise InputError(axis, mixed, "would be averaged together", f"Name {axis} in where, rows or columns.")


def _is(column: "pd.Series[Any]", value: Any) -> "pd.Series[bool]":
    return column.isna() if pd.isna(value) else column == value


def _joined(tables: Sequence[pa.Table]) -> DataFrame:
    try:
        return pa.concat_tables(tables, promote_options="permissive").to_pandas() if tables else DataFrame()
    except pa.ArrowTypeError as error:
        hint = "Let every cell return the same type, and repeat coopoc run."
        raise InputError("results", str(error), "must have one type in each column", hint) from None


def ego_by_run(frame: DataFrame, value: str) -> DataFrame:
    """Egos x runs: means over training seeds, NaN where a seed has none; rows without ego or run count as one.

    >>> ego_by_run(DataFrame({"x": [1.0, 3.0], "run": [None, None]}), "x").to_numpy().tolist()
    [[2.0]]
    """
    keys = frame.reindex(columns=["ego", "run"])
    keys = keys.astype(object).where(keys.notna(), 0)
    cells = frame[value].astype(float).groupby([keys["ego"], keys["run"]])
    return cells.mean().where(cells.count() == cells.size()).unstack("run")


def whole(table: DataFrame) -> DataFrame:
    """The egos with a finite value in every run in which any has one."""
    return table.where(np.isfinite(table)).dropna(axis="columns", how="all").dropna()


def lacking(table: DataFrame) -> int:
    """How many values `whole` lacks of egos that have any."""
    return table.dropna(how="all").size - whole(table).size
