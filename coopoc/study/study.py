"""Study: a question, a grid of cells named by a hash of all that changes their numbers, and views of the results."""

import inspect
import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import instance, listed, named, one_of
from ..errors import InputError
from ..paths import file_name
from ..plugins import file_digest, find, from_file, in_file
from .cell import Cell, Params, Row, Scalar, digest, entries, parse
from .provenance import code_of, revision

if TYPE_CHECKING:
    from .plot import Plot
    from .results import Results
    from .tables import Table

Tracks = Callable[[Params], Iterable[tuple[Any, ...]]]


@dataclass(frozen=True, eq=False)
class Study:
    """A grid of cells, each a pure function of its parameters, and the tables and figures that answer one question.

    Args:
        name: of the study and of its folder.
        question: one sentence.
        cell: parameters -> rows, one per (run, ego). A module-level function (workers unpickle it); it gets the
            settings and the cell's own parameters in one mapping. A value of a row is a number, a string or a list of
            numbers. Columns that end in "seconds" are timings, all others are numbers that repeat to the last digit.
        grid: axis -> values (their product), or a list of parameter mappings. Values are scalars.
        settings: defaults that all cells share (runs, seed, data, egos ...), overridden by --set key=value.
        key: parameters -> anything else that changes the numbers (fleet digest, hash of weights, revision of the
            methods; the code of the cell counts anyway, see `code_of`). Evaluated for every cell before any work, so
            an InputError raised here is reported at once.
        prepare: called once with the parameters of the cells that are not finished and the number of processes,
            before they are computed, in the process that started the run: trains or downloads what several cells
            share. It must resume by itself.
        where: parameters -> False for combinations without a meaning.
        shares: names of parameters on which the expensive part (a Recording) depends: cells that agree on them follow
            each other in one worker, so that functools.lru_cache finds the recording.
        tables: name -> function of Results; None where the results lack what the table shows.
        figures: name -> function of Results, likewise.
        findings: Results -> sentences for the top of the report, empty where the results lack the numbers of one.
        recipe: Results -> field -> value of the training, for the report.
        idle: Results -> names of settings that do nothing in them, which the report leaves out.
        limitations: sentences.
        metrics: metrics with reference values -> "lower" or "higher", which is better, or the best value.
        reference: file of the reference values, see `coopoc.study.reference`; it may be absent.
        tracks: parameters -> name, t (T,) s and position (T, 3) m of each estimated path.

    Raises:
        InputError: an empty grid, a cell twice, a parameter that is no scalar, a name that is both axis and setting, a
            name of the study or of a view that is no file name, or a view that cannot be called with results alone.

    >>> Study("demo", "Does x matter?", cell=dict, grid={"x": (1, 2)}, settings={"runs": 3}).cells()[1].params
    {'x': 2}
    """

    name: str
    question: str
    cell: Callable[[Params], list[Row]]
    grid: Mapping[str, Sequence[Scalar]] | Sequence[Mapping[str, Scalar]]
    settings: Params = field(default_factory=dict)
    key: Callable[[Params], Params] = lambda params: {}
    prepare: Callable[[Sequence[Params], int], None] = lambda cells, jobs: None
    where: Callable[[Params], bool] = lambda params: True
    shares: tuple[str, ...] = ()
    tables: "Mapping[str, Callable[[Results], Table | None]]" = field(default_factory=dict)
    figures: "Mapping[str, Callable[[Results], Plot | None]]" = field(default_factory=dict)
    findings: "Callable[[Results], Sequence[str]]" = lambda results: ()
    recipe: "Callable[[Results], Params]" = lambda results: {}
    idle: "Callable[[Results], Collection[str]]" = lambda results: ()
    limitations: tuple[str, ...] = ()
    metrics: Mapping[str, str | float] = field(default_factory=dict)
    reference: str | Path | None = None
    tracks: Tracks | None = None

    def __post_init__(self) -> None:
        file_name("study", self.name, "Rename the study: its folder has this name.")
        both = sorted(set(self.axes) & set(self.settings))
        if both:
            raise InputError("settings", both, "must not name an axis of the grid", "Keep it in one of the two.")
        for kind, views in (("tables", self.tables), ("figures", self.figures)):
            for name, view in views.items():
                file_name(kind, name, "Rename it: its file has this name.")
                _check_view(f"{kind}[{name!r}]", view)

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the parameters that vary, in order."""
        return tuple(self.values())

    def values(self) -> dict[str, list[Scalar]]:
        """Values of each axis."""
        if isinstance(self.grid, Mapping):
            lists = {name: listed(name, values, "Give a tuple of values.") for name, values in self.grid.items()}
            return {k: [v.item() if isinstance(v, np.generic) else v for v in values] for k, values in lists.items()}
        hint = "Give {name: values}, or a list of {name: value}."
        names = dict.fromkeys(name for p in listed("grid", self.grid, hint) for name in named("grid", p, hint))
        return {name: list(dict.fromkeys(p[name] for p in self.grid if name in p)) for name in names}

    def cells(self) -> list[Cell]:
        """All cells in the order of the grid, each named by the hash of all that changes its numbers.

        >>> Study("demo", "?", cell=dict, grid={"x": ("off", 0.5)}).cells()
        Traceback (most recent call last):
        coopoc.errors.InputError: x = ['off', 0.5]: must be numbers, words or bools, as a column has one type. ...
        """
        for name, values in self.values().items():
            if len({(isinstance(v, str), isinstance(v, bool)) for v in values if v is not None}) > 1:
                hint = "Write the numbers as words, too."
                raise InputError(name, values, "must be numbers, words or bools, as a column has one type", hint)
        code = cache(lambda: self.cell.code if isinstance(self.cell, _FileCell) else code_of(self.cell))
        cells = [_named(self, params, code) for params in points(self)]
        if not cells:
            raise InputError("grid", "no cell", "must have at least one", "Widen an axis, or relax --set.")
        count = Counter(cell.name for cell in cells)
        if twice := [dict(cell.params) for cell in cells if count[cell.name] > 1]:
            raise InputError("grid", twice[0], "must not be there twice", "Give each value once.")
        return cells

    def tracks_of(self) -> Tracks:
        """`tracks`, or InputError if there are none."""
        if self.tracks is None:
            raise InputError("tracks", self.name, "has cells without estimates of vehicles", "Take side_by_side.")
        return self.tracks

    def answers(self, results: "Results") -> list[str]:
        """Findings whose numbers were run.

        >>> Study("demo", "?", dict, {"x": (1,)}, findings=lambda results: ["It does.", ""]).answers(None)
        ['It does.']
        """
        return [text for text in listed("findings", self.findings(results), "Give a list of sentences.") if text]

    def override(self, changes: Params) -> "Study":
        """The same study with other settings, or other values on an axis (a list, or words split at commas).

        Text is read as the type of the default. On a list of parameter mappings an axis is filtered, not replaced.
        """
        settings, grid, axes = dict(self.settings), self.grid, self.values()
        for name, value in changes.items():
            if name in settings:
                settings[name] = parse(name, value, settings[name])
                continue
            one_of("setting", name, (*settings, *axes))
            usual = axes[name]
            wanted = [parse(name, v, None if None in usual else next(iter(usual), None)) for v in entries(value)]
            if isinstance(grid, Mapping):
                grid = {**grid, name: wanted}
            elif other := [v for v in wanted if v not in usual]:
                allowed = f"must be among {usual}"
                raise InputError(name, repr(other[0]), allowed, "The grid of this study is a fixed list.")
            else:
                grid = [p for p in grid if name in p and p[name] in wanted]
        changed = replace(self, settings=settings, grid=grid)
        if not isinstance(grid, Mapping):
            return changed
        for name in changes.keys() - settings.keys():
            used = _used(changed, name) or _used(replace(changed, grid={**grid, name: axes[name]}), name)
            if used and (idle := [value for value in grid[name] if value not in used]):
                hint = f"Write {name}={','.join(map(str, used))}."
                raise InputError(name, repr(idle[0]), "leads to no cell under these settings", hint)
        return changed


def find_study(name: str) -> Study:
    """The study of an installed distribution, or of a file of one's own, "folder/mine.py:STUDY".

    The code of a file's cell names the cells, and workers load the file by its path.

    Raises:
        InputError: an unknown name, no such file, or an object that is no Study.
    """
    if not in_file(name):
        installed: Study = find("coopoc.studies", name)
        return installed
    study = instance(f"study {name!r}", from_file(name, "study"), Study, "Give STUDY = coopoc.Study(...) in the file.")
    path, _, attribute = name.rpartition(":")
    place = f"{Path(path).resolve()}:{attribute}"
    return replace(study, cell=_FileCell(place, file_digest(name, "study"), code_of(study.cell)))


@dataclass(frozen=True)
class _FileCell:
    """The study's cell, for processes that cannot import the file: by path, as long as its contents are these."""

    name: str
    contents: str
    code: str

    def __call__(self, params: Params) -> list[Row]:
        if file_digest(self.name, "study") != self.contents:
            raise InputError("study", repr(self.name), "has changed since the run began", "Repeat the command.")
        study: Study = from_file(self.name, "study")
        return study.cell(params)


def _check_view(where: str, view: Any) -> None:
    try:
        inspect.signature(view).bind(object())
    except (TypeError, ValueError) as error:
        hint = "Give functools.partial(view, name=...) with the names of the view's own arguments."
        raise InputError(where, str(error), "must be a function of the Results alone", hint) from None


def _named(study: Study, params: Mapping[str, Scalar], code: Callable[[], str]) -> Cell:
    for name, value in params.items():
        if not isinstance(value, Scalar):
            raise InputError(name, repr(value), "must be a number, a word, a bool or None", "Pass a name instead.")
    values = {**study.settings, **params}
    content = {
        "study": study.name,
        "given": values,
        "axes": sorted(params),
        "key": study.key(values),
        "code": code(),
        "files": {name: file_digest(v, name) for name, v in values.items() if isinstance(v, str) and in_file(v)},
        "coopoc": revision("coopoc"),
    }
    return Cell(params, values, digest(content))


def points(study: Study) -> list[Mapping[str, Scalar]]:
    """Parameters of each cell, in the order of the grid."""
    grid = study.grid
    if isinstance(grid, Mapping):
        grid = [dict(zip(grid, values, strict=True)) for values in itertools.product(*study.values().values())]
    return [p for p in grid if study.where({**study.settings, **p})]


def _used(study: Study, name: str) -> list[Scalar]:
    """Values of an axis that lead to cells."""
    return list(dict.fromkeys(p[name] for p in points(study)))
