"""Records of PyFG and g2o: a line is a tag, perhaps a stamp, vertices, numbers and the noise of a measurement."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import InputError, suggestion
from .graph import ENDS, Edges, Graph, edges_of
from .values import inverse, malformed, symmetric, to_numbers

VALUES = {"pose2": "x y theta", "pose3": "x y z qx qy qz qw", "point2": "x y", "point3": "x y z"}
TAG_KINDS = ("pose", "point", *ENDS)[:-1]
"""Of vertices and edges, in the order of a format's tags; ranges have one tag for the plane and for space."""
Index = dict[str, dict[str, int]]  # pose or point -> the word for a vertex -> its place


@dataclass(frozen=True)
class Record:
    """Content of a line with one tag.

    Args:
        kind: pose or point (a vertex), or an edge as in `ENDS`.
        dimension: 2 or 3, 0 for both.
        stamped: a stamp follows the tag.
        offset: the id of a sensor offset follows the vertices (g2o).

    >>> Record("relative_point", 3, stamped=True).words
    'stamp i j x y z'
    """

    kind: str
    dimension: int
    stamped: bool = False
    offset: bool = False

    @property
    def ends(self) -> tuple[str, ...]:
        """Kinds of the vertices."""
        return ENDS.get(self.kind, (self.kind,))

    @property
    def values(self) -> str:
        """Names of the numbers that are measured, or that a vertex holds."""
        return "r" if self.kind == "ranges" else VALUES[f"{'pose' if 'pose' in self.kind else 'point'}{self.dimension}"]

    @property
    def words(self) -> str:
        """Names of the words between the tag and the noise."""
        return f"{'stamp ' * self.stamped}i{' j' * (len(self.ends) == 2)}{' offset' * self.offset} {self.values}"

    @property
    def size(self) -> int:
        """Rows of the covariance: 0 for a vertex."""
        return 0 if self.kind not in ENDS else 6 if "qw" in self.values else len(self.values.split())

    @property
    def triangle(self) -> int:
        """Numbers of the covariance's upper triangle."""
        return self.size * (self.size + 1) // 2

    @property
    def width(self) -> int:
        """Words of the line, the tag included."""
        return 1 + len(self.words.split()) + self.triangle


def by_tag(tags: Mapping[int, str], stamped: Collection[str] = (), offset: Collection[str] = ()) -> dict[str, Record]:
    """Records of the tags of a format, dimension -> those of TAG_KINDS in one text, and of EDGE_RANGE: kinds with a
    stamp, tags with an offset."""
    made = {tag: (kind, d) for d, row in tags.items() for kind, tag in zip(TAG_KINDS, row.split(), strict=True)}
    made["EDGE_RANGE"] = "ranges", 0
    return {tag: Record(kind, d, kind in stamped, tag in offset) for tag, (kind, d) in made.items()}


class _Rows(NamedTuple):
    """The lines of one kind: what they are, and for each its number and words."""

    tag: str
    lines: list[int]
    words: list[list[str]]


@dataclass(frozen=True)
class Grammar:
    """A format of lines.

    Args:
        format: its name.
        records: tag -> Record.
        noise: "covariance" or "information".
        name: (word, pose or point) -> the name of that vertex, "" if the word is malformed.
        others: tags that the format's own reader takes care of.
    """

    format: str
    records: Mapping[str, Record]
    noise: str
    name: Callable[[str, str], str]
    others: tuple[str, ...] = ()

    def form(self, tag: str) -> str:
        """Form of a line with a tag."""
        record, noise = self.records[tag], []
        if record.size == 1:
            noise = ["variance" if self.noise == "covariance" else "information"]
        elif record.size:
            noise = [f"and the {record.triangle} numbers of the {self.noise}'s upper triangle"]
        return " ".join([tag, record.words, *noise])

    def read(
        self,
        file: str,
        lines: Iterable[tuple[int, list[str]]],
        fixed: Sequence[tuple[int, str]] = (),
        repair: bool = False,
    ) -> Graph:
        """Graph of the lines of a file.

        Args:
            file: named in messages.
            lines: (line number, words) of every record.
            fixed: (line number, vertex) of those that stay where they are.
            repair: take the nearest positive definite matrix where the noise is none, and say so in the graph's notes.

        Raises:
            InputError: with the line, an unknown tag or vertex, another number of words, 2-D beside 3-D, no vertex at
                all, a singular information, or what `Graph` raises.
        """
        dimension, rows = self._collect(file, lines)
        origin = {kind: of_kind.lines for kind, of_kind in rows.items()}
        origin["names"], words, arrays = self._vertices(file, rows, dimension)
        origin["fixed"] = [line for line, _ in fixed]

        def location(kind: str, row: int) -> str:
            return f"{file}: line {origin[kind][row]}"

        names, index = [], Index(pose={}, point={})
        for row, (word, is_pose) in enumerate(zip(words, arrays["is_pose"], strict=True)):
            kind = "pose" if is_pose else "point"
            names.append(self.name(word, kind))
            if not names[-1]:
                hint = "PyFG: a letter and a number as A0. g2o: a number."
                raise InputError(
                    location("names", row), f"vertex {word}", f"must be called as {self.format} does", hint
                )
            index[kind][word] = row
        vertices = Graph(dimension, tuple(names), **arrays, location=location)
        notes = list[str]() if repair else None
        edges: dict[str, Any] = {kind: self._edges(file, rows[kind], index, notes) for kind in ENDS if kind in rows}
        still = [_find(location("fixed", row), word, "any", index) for row, (_, word) in enumerate(fixed)]
        return replace(vertices, **edges, fixed=np.array(still, int), notes=tuple(notes or ()), location=location)

    def _collect(self, file: str, lines: Iterable[tuple[int, list[str]]]) -> tuple[int, dict[str, _Rows]]:
        """Dimension of a file, and its lines by kind."""
        rows: dict[str, _Rows] = {}
        dimension, since = 0, ""
        width = {tag: record.width for tag, record in self.records.items()}
        for number, words in lines:
            tag, location = words[0], f"{file}: line {number}"
            record = self.records.get(tag)
            if record is None:
                kinds = [*self.records, *self.others]
                toro = "Convert the file: TORO orders information otherwise."
                hint = toro if tag[:-1] in ("VERTEX", "EDGE") else suggestion(tag, kinds, "Remove or convert the line.")
                raise InputError(location, tag, f"must be one of {', '.join(kinds)}", hint)
            if record.dimension and not dimension:
                dimension, since = record.dimension, f"line {number}, {tag}"
            if record.dimension not in (0, dimension):
                hint = "Keep 2-D and 3-D in separate files."
                raise InputError(location, tag, f"must be {dimension}-D as {since}", hint)
            if len(words) != width[tag]:
                raise malformed(file, number, words, self.form(tag))
            of_kind = rows.setdefault(record.kind, _Rows(tag, [], []))
            of_kind.lines.append(number)
            of_kind.words.append(words)
        if not {"pose", "point"} & set(rows):
            hint = "Check that the file is complete."
            raise InputError(file, "0 vertices", "must have a line for every vertex", hint)
        return dimension, rows

    def _vertices(
        self, file: str, rows: Mapping[str, _Rows], dimension: int
    ) -> tuple[list[int], list[str], dict[str, Any]]:
        """Lines, words for and arrays of the poses and points, in the order of the file."""
        parts = []
        for kind in ("pose", "point"):
            if kind in rows:
                stamps, ids, values = self._split(file, rows[kind])
                turn = values[:, dimension:]
                if kind == "point":
                    turn = np.tile(np.zeros(1) if dimension == 2 else np.eye(4)[3], (len(ids), 1))
                is_pose, words = np.full(len(ids), kind == "pose"), np.array([word for (word,) in ids])
                parts.append((np.array(rows[kind].lines), words, is_pose, values[:, :dimension], turn, stamps))
        lines, words, *arrays = [np.concatenate(part) for part in zip(*parts, strict=True)]
        order = np.argsort(lines)
        fields = ("is_pose", "position", "orientation", "stamps")
        return lines[order].tolist(), words[order].tolist(), {f: a[order] for f, a in zip(fields, arrays, strict=True)}

    def _edges(self, file: str, rows: _Rows, index: Index, notes: list[str] | None) -> Edges:
        record, (stamps, ids, numbers) = self.records[rows.tag], self._split(file, rows)
        places = [f"{file}: line {line}" for line in rows.lines]
        nodes = [
            [_find(location, word, role, index) for word, role in zip(words, record.ends, strict=True)]
            for location, words in zip(places, ids, strict=True)
        ]
        count = len(record.values.split())
        noise = symmetric(numbers[:, count:], record.size)
        if self.noise == "information":
            noise = inverse(noise, places.__getitem__, notes)
        return edges_of(record.kind, nodes, numbers[:, :count], noise, stamps)

    def _split(self, file: str, rows: _Rows) -> tuple[Floats, list[list[str]], Floats]:
        """Stamps (M,), vertices, and the other numbers (M, C) of the lines of one kind."""
        record = self.records[rows.tag]
        start = 1 + record.stamped
        stop = start + len(record.ends)
        digits = [words[1:start] + words[stop + record.offset :] for words in rows.words]
        numbers = to_numbers(file, rows.lines, digits, self.form(rows.tag), len(digits[0]))
        stamps = numbers[:, 0] if record.stamped else np.full(len(digits), np.nan)
        return stamps, [words[start:stop] for words in rows.words], numbers[:, start - 1 :]


def _find(location: str, word: str, role: str, index: Index) -> int:
    """Place of a vertex in the graph; InputError if there is none, or more than one."""
    roles = ("pose", "point") if role == "any" else (role,)
    candidates = [index[each][word] for each in roles if word in index[each]]
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise InputError(location, f"vertex {word}", "is both a pose and a point", "Give every vertex its own id.")
    other = any(word in names for names in index.values())
    allowed = f"must be a {role}" if other else "must be one of the vertices of the file"
    raise InputError(location, f"vertex {word}", allowed, "Check their order." if other else "Add its VERTEX line.")
