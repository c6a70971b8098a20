"""Records of PyFG and g2o: a line is a tag, perhaps a stamp, vertices, numbers and the noise of a measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from ..errors import InputError
from ..plugins import suggestion
from .edges import ENDS
from .lines import wrong

VALUES = {"pose2": "x y theta", "pose3": "x y z qx qy qz qw", "point2": "x y", "point3": "x y z"}


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
        names = "i j" if len(self.ends) == 2 else "i"
        return f"{'stamp ' * self.stamped}{names}{' offset' * self.offset} {self.values}"

    @property
    def size(self) -> int:
        """Rows of the covariance: 0 for a vertex."""
        return 0 if self.kind not in ENDS else 6 if "qw" in self.values else len(self.values.split())

    @property
    def width(self) -> int:
        """Words of the line, the tag included."""
        return 1 + len(self.words.split()) + self.size * (self.size + 1) // 2


@dataclass(frozen=True)
class Grammar:
    """A format.

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
        record = self.records[tag]
        one = "variance" if self.noise == "covariance" else "information"
        triangle = f"and the {record.size * (record.size + 1) // 2} numbers of the {self.noise}'s upper triangle"
        return " ".join([tag, record.words, *([one if record.size == 1 else triangle] if record.size else [])])


@dataclass(frozen=True)
class Rows:
    """The lines of one kind: what they are, and for each its number and words."""

    record: Record
    form: str
    lines: list[int] = field(default_factory=list)
    words: list[list[str]] = field(default_factory=list)


def collect(file: str, lines: Iterable[tuple[int, list[str]]], grammar: Grammar) -> tuple[int, dict[str, Rows]]:
    """Dimension of a file, and its lines by kind.

    Raises:
        InputError: an unknown tag, another number of words, 2-D beside 3-D, or no vertex at all; with the line.
    """
    rows: dict[str, Rows] = {}
    dimension, since = 0, ""
    width = {tag: record.width for tag, record in grammar.records.items()}
    for number, words in lines:
        tag = words[0]
        record = grammar.records.get(tag)
        if record is None:
            known = [*grammar.records, *grammar.others]
            hint = suggestion(tag, known, "Remove or convert the line.")
            raise InputError(f"{file}: line {number}", tag, f"must be one of {', '.join(known)}", hint)
        if record.dimension and not dimension:
            dimension, since = record.dimension, f"line {number}, {tag}"
        if record.dimension not in (0, dimension):
            raise InputError(
                f"{file}: line {number}",
                tag,
                f"must be {dimension}-D as {since}",
                "Keep 2-D and 3-D in separate files.",
            )
        if len(words) != width[tag]:
            raise wrong(file, number, words, grammar.form(tag))
        if record.kind not in rows:
            rows[record.kind] = Rows(record, grammar.form(tag))
        rows[record.kind].lines.append(number)
        rows[record.kind].words.append(words)
    if not {"pose", "point"} & set(rows):
        raise InputError(file, "0 vertices", "must have a line for every vertex", "Check that the file is complete.")
    return dimension, rows
