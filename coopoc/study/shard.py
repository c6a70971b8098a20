"""Shard: one of n disjoint parts of a study, for batch systems; the same part on every machine and at any time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ..errors import InputError
from .cell import Cell
from .compute import groups


@dataclass(frozen=True)
class Shard:
    """One part of a study.

    Args:
        index: of the part, counted from 1.
        count: number of parts.

    >>> str(Shard.parse("2/3"))
    '2/3'
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read "2/3"; InputError for anything else."""
        found = re.fullmatch(r"([0-9]+)/([0-9]+)", text.strip())
        if not found or not 1 <= int(found[1]) <= int(found[2]):
            raise InputError("shard", repr(text), "must be i/n with 1 <= i <= n", "Write for example: --shard 2/3.")
        return cls(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    def of(self, cells: Sequence[Cell], shares: Sequence[str]) -> list[Cell]:
        """Its cells: cells floor((i-1) N / n) to floor(i N / n) of the N, in an order that groups recordings.

        Parts differ by one cell at most, and at most n - 1 recordings are made twice. Finished cells count: a shard
        that is repeated resumes its own cells.

        Args:
            cells: of the study.
            shares: names of the parameters that a recording depends on.
        """
        ordered = [cell for group in groups(cells, shares) for cell in group]
        size = len(ordered)
        return ordered[(self.index - 1) * size // self.count : self.index * size // self.count]
