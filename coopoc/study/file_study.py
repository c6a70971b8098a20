"""A study in a file of one's own: the code of its cell names the cells, and workers load the file by its path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..one_file import file_digest, from_file
from .cell import Params, Row
from .reached import code_of
from .study import Study


@dataclass(frozen=True)
class _FileCell:
    """The study's cell, for processes that cannot import the file: by path, as long as its contents are these."""

    name: str
    contents: str

    def __call__(self, params: Params) -> list[Row]:
        if file_digest(self.name, "study") != self.contents:
            raise InputError("study", repr(self.name), "has changed since the run began", "Repeat the command.")
        study: Study = from_file(self.name, "study")
        return study.cell(params)


def file_study(name: str) -> Study:
    """The study that a file holds, as "folder/mine.py:STUDY".

    Raises:
        InputError: no such file or name, or an object that is no Study.
    """
    study = from_file(name, "study")
    if not isinstance(study, Study):
        hint = "Give STUDY = coopoc.Study(...) in the file."
        raise InputError("study", repr(name), f"is a {type(study).__name__}, no Study", hint)
    path, _, attribute = name.rpartition(":")
    code, own = code_of(study.cell), study.key

    def key(params: Params) -> Mapping[str, Any]:
        return {**own(params), "cell": code}

    cell = _FileCell(f"{Path(path).resolve()}:{attribute}", file_digest(name, "study"))
    return replace(study, cell=cell, key=key)
