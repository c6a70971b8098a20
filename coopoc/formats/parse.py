"""Records -> Graph: shared by the readers of PyFG and g2o."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from .edges import ENDS, PointEdges, PoseEdges, RangeEdges
from .graph import Graph
from .lines import to_numbers
from .noise import inverse, symmetric
from .records import Grammar, Rows, collect

Index = dict[str, dict[str, int]]  # pose or point -> the word for a vertex -> its place


def to_graph(
    file: str, lines: Iterable[tuple[int, list[str]]], grammar: Grammar, fixed: Sequence[tuple[int, str]] = ()
) -> Graph:
    """Graph of the lines of a file.

    Args:
        file: named in messages.
        lines: (line number, words) of every record.
        fixed: (line number, vertex) of those that stay where they are.

    Raises:
        InputError: what `collect` and `Graph` raise, an unknown vertex, or a singular information; with the line.
    """
    dimension, rows = collect(file, lines, grammar)
    origin = {kind: one.lines for kind, one in rows.items()}
    origin["names"], words, arrays = _vertices(file, rows, dimension)
    origin["fixed"] = [line for line, _ in fixed]

    def place(field: str, row: int) -> str:
        return f"{file}: line {origin[field][row]}"

    kinds = ["pose" if pose else "point" for pose in arrays["is_pose"]]
    names = [_name(place("names", row), *of, grammar) for row, of in enumerate(zip(words, kinds, strict=True))]
    vertices = Graph(dimension, tuple(names), **arrays, place=place)
    index: Index = {"pose": {}, "point": {}}
    for row, (word, kind) in enumerate(zip(words, kinds, strict=True)):
        index[kind][word] = row
    edges: dict[str, Any] = {kind: _edges(file, rows[kind], grammar, index) for kind in ENDS if kind in rows}
    still = [_find(place("fixed", row), word, "any", index) for row, (_, word) in enumerate(fixed)]
    return replace(vertices, **edges, fixed=np.array(still, dtype=np.int64), place=place)


def _vertices(file: str, rows: Mapping[str, Rows], dimension: int) -> tuple[list[int], list[str], dict[str, Any]]:
    """Lines, words for and arrays of the poses and points, in the order of the file."""
    parts = []
    for kind in ("pose", "point"):
        if kind in rows:
            stamps, ids, values = _split(file, rows[kind])
            turn = values[:, dimension:]
            if kind == "point":
                turn = np.tile(np.zeros(1) if dimension == 2 else np.eye(4)[3], (len(ids), 1))
            is_pose = np.full(len(ids), kind == "pose")
            parts.append((rows[kind].lines, [word for (word,) in ids], is_pose, values[:, :dimension], turn, stamps))
    lines, words, *arrays = [np.concatenate(part) for part in zip(*parts, strict=True)]
    order = np.argsort(lines)
    fields = ("is_pose", "position", "orientation", "stamps")
    return lines[order].tolist(), words[order].tolist(), {f: a[order] for f, a in zip(fields, arrays, strict=True)}


def _edges(file: str, rows: Rows, grammar: Grammar, index: Index) -> PoseEdges | PointEdges | RangeEdges:
    record, (stamps, ids, numbers) = rows.record, _split(file, rows)
    places = [f"{file}: line {line}" for line in rows.lines]
    nodes = np.array(
        [
            [_find(place, word, role, index) for word, role in zip(words, record.ends, strict=True)]
            for place, words in zip(places, ids, strict=True)
        ]
    )
    count = len(record.values.split())
    values, noise = numbers[:, :count], symmetric(numbers[:, count:], record.size)
    if grammar.noise == "information":
        noise = inverse(noise, places.__getitem__, "information")
    if record.kind == "ranges":
        return RangeEdges(nodes, values[:, 0], noise[:, 0, 0], stamps)
    if "point" in record.kind:
        return PointEdges(nodes, values, noise, stamps)
    return PoseEdges(nodes, values[:, : record.dimension], values[:, record.dimension :], noise, stamps)


def _split(file: str, rows: Rows) -> tuple[Floats, list[list[str]], Floats]:
    """Stamps (M,), vertices, and the other numbers (M, C) of the lines of one kind."""
    record = rows.record
    start = 1 + record.stamped
    stop = start + len(record.ends)
    digits = [words[1:start] + words[stop + record.offset :] for words in rows.words]
    numbers = to_numbers(file, rows.lines, digits, rows.form, len(digits[0]))
    stamps = numbers[:, 0] if record.stamped else np.full(len(digits), np.nan)
    return stamps, [words[start:stop] for words in rows.words], numbers[:, start - 1 :]


def _name(place: str, word: str, kind: str, grammar: Grammar) -> str:
    name = grammar.name(word, kind)
    if not name:
        raise InputError(
            place,
            f"vertex {word}",
            f"must be called as {grammar.format} does",
            "PyFG: a letter and a number as A0. g2o: a number.",
        )
    return name


def _find(place: str, word: str, role: str, index: Index) -> int:
    found = [index[kind][word] for kind in (("pose", "point") if role == "any" else (role,)) if word in index[kind]]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(place, f"vertex {word}", "is both a pose and a point", "Give every vertex its own id.")
    other = any(word in names for names in index.values())
    allowed = f"must be a {role}" if other else "must be one of the vertices of the file"
    raise InputError(place, f"vertex {word}", allowed, "Check the order." if other else "Add its VERTEX line.")
