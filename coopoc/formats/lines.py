"""Lines of text files: words and finite numbers, with the number of the line they stand on for messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError

LARGEST = 1e100
"""Numbers beyond it are none that was measured, and their squares overflow."""


def read_words(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(line number, words) of every line that is neither blank nor a comment, which starts with #.

    Raises:
        InputError: no such file, or no text.
    """
    if not path.is_file():
        raise InputError("path", path, "must be a file", "Check the path.")
    try:
        lines = path.read_text("utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(path.name, error, "must be text", "Check that this is the file you meant.") from None
    for number, line in enumerate(lines, 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def to_numbers(file: str, lines: Sequence[int], words: Sequence[Sequence[str]], form: str, columns: int) -> Floats:
    """(M, columns) finite numbers of M lines.

    Args:
        file: name and (M,) line numbers, for messages.
        lines: name and (M,) line numbers, for messages.
        words: (M, columns).
        form: of a line, for messages.

    Raises:
        InputError: another number of words, a word that is no number or not a finite one, with its line.

    >>> to_numbers("a.txt", [1], [["0", "1e3"]], "x y", 2)
    array([[   0., 1000.]])
    """
    values = np.empty((len(words), columns))
    for row, line in enumerate(words):
        try:
            values[row] = [_number(word) for word in line] if len(line) == columns else np.nan
        except ValueError:
            values[row] = np.nan
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST).all(axis=1))
    if len(bad):
        row = int(bad[0])
        raise wrong(file, lines[row], words[row], form)
    return values


def _number(word: str) -> float:
    """A number as C writes it: Python's float takes digits of any script and underscores, too."""
    return float(word) if word.isascii() and "_" not in word else float("nan")


def wrong(file: str, line: int, words: Sequence[str], form: str) -> InputError:
    """The error of a line that does not have its form."""
    shown = [word if len(word) <= 40 else f"{word[:40]}..." for word in words[:40]]
    found = " ".join(shown) + (" ..." if len(words) > 40 else "")
    allowed = f"must be {form}, all finite numbers"
    return InputError(f"{file}: line {line}", f"{found} ({len(words)} words)", allowed, "Mend or remove the line.")


def read_table(path: Path, form: str) -> tuple[Ints, Floats]:
    """(M,) line numbers and (M, columns) numbers of a file whose lines all have the same form, as "t x y z".

    Raises:
        InputError: what `read_words` and `to_numbers` raise, or a file without a line.
    """
    rows = list(read_words(path))
    if not rows:
        raise InputError(path.name, "0 lines", f"must hold lines {form}", "Check that the file is complete.")
    lines = [number for number, _ in rows]
    return np.array(lines), to_numbers(path.name, lines, [words for _, words in rows], form, len(form.split()))


def to_text(values: Floats) -> list[str]:
    """One line per row of (M, C) numbers, with as many digits as it takes to read the same bits again.

    >>> to_text(np.array([[0.1, 2.0]]))
    ['0.1 2.0']
    """
    return [" ".join(map(repr, row)) for row in values.tolist()]
