"""Vertices: the poses and points that a graph file names."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ..arrays import Bools, Floats
from ..short_repr import short_repr
from .rotations import to_rotation


@dataclass(frozen=True, eq=False)
class Vertices:
    """The first fields of a Graph, which documents them."""

    dimension: int
    names: tuple[str, ...]
    is_pose: Bools
    position: Floats
    orientation: Floats
    stamps: Floats = ()  # type: ignore[assignment]

    __repr__ = short_repr

    @cached_property
    def rotation(self) -> Floats:
        """(n, d, d), the identity for points."""
        return to_rotation(self.orientation)
