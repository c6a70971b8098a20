"""Texts: names from data as names of files, text from data where it must not act, and the short `repr` of results.

A name of a file must neither leave its folder nor clash with a device. In tables, pages and pictures, text must not act
as markup, a command, a formula or a control. Results that hold arrays show a line of names and shapes.
"""

import os
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import Any

from .errors import InputError, shown

_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{digit}" for port in ("COM", "LPT") for digit in range(1, 10))}
_LONGEST = 200


def given_path(path: object) -> Path:
    """A path from text or a Path.

    Raises:
        InputError: anything else, and what no file system of Linux holds.

    >>> given_path("town.pyfg").suffix
    '.pyfg'
    """
    try:
        encoded = os.fsencode(path) if isinstance(path, str | os.PathLike) else b""
    except Exception:  # half a surrogate pair, or a class from elsewhere
        encoded = b""
    if not encoded or b"\0" in encoded or len(encoded) > 4095 or max(map(len, encoded.split(b"/"))) > 255:
        allowed = "must be text or a Path, of at most 255 bytes per part and 4095 in all, without NUL"
        raise InputError("path", shown(path), allowed, 'Give for example "graph.pyfg".')
    return Path(os.fsdecode(encoded))


def file_name(field: str, name: object, hint: str) -> str:
    """`name`, if it is a valid file name on Linux, macOS and Windows.

    Args:
        field: named in the error.
        name: file name without its suffix.
        hint: of the error.

    Raises:
        InputError: text that is empty, too long or not printable, that contains a separator or a reserved character,
            that begins or ends with a dot or a space, or that names a device of Windows.

    >>> file_name("id", "car 12", "Rename the vehicle.")
    'car 12'
    """
    if isinstance(name, str) and name.isprintable() and re.fullmatch(r'[^<>:"/\\|?*]+', name):
        device = name.partition(".")[0].strip().upper() in _DEVICES
        if not device and name == name.strip(" .") and len(name.encode()) <= _LONGEST:
            return name
    allowed = (
        f'must be a file name: at most {_LONGEST} bytes, printable, without < > : " / \\ | ? *, '
        "no dot or space at its ends, and no device of Windows such as CON"
    )
    raise InputError(field, shown(name), allowed, hint)


def replaceable(path: Path) -> Path:
    """`path`, if a file that is written whole may take its place.

    Raises:
        InputError: a folder, or a device such as /dev/null, which a renamed file would replace for every program.
    """
    if os.path.lexists(path) and not (path.is_symlink() or path.is_file()):
        kind = "a folder" if path.is_dir() else "a device or a pipe"
        raise InputError("path", str(path), f"must be a file, and is {kind}", "Name a file to be written.")
    return path


def made_folder(folder: Path) -> Path:
    """`folder`, made if there is none; InputError if it cannot be, which costs less before the work than after."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("out", str(folder), f"cannot be made ({error.strerror})", "Choose another --out.") from None
    return folder


def inside(folder: Path, path: Path) -> Path:
    """`path`, if it stays in `folder` once symbolic links are followed.

    Raises:
        InputError: it leads out of the folder.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError("path", str(path), f"leads out of {folder} by a symbolic link", "Remove the link.")
    return path


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
    "≤": r"$\le$",
    "≥": r"$\ge$",
    "×": r"$\times$",
    "σ": r"$\sigma$",
    "°": r"$^\circ$",
    "²": "$^2$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}
"""Letter -> what LaTeX shows as it."""


def uncontrolled(text: str) -> str:
    """Text without control characters and marks of direction, which would reorder what stands beside it.

    >>> uncontrolled("a\\u202eb\\x1b[2J")
    'a b [2J'
    """
    return "".join(
        " " if letter not in "\n\t" and unicodedata.category(letter)[0] == "C" else letter for letter in text
    )


def visible(text: str) -> str:
    """The same on one line.

    >>> visible("a\\n b")
    'a b'
    """
    return " ".join(uncontrolled(text).split())


def picture(text: str) -> str:
    """Text that matplotlib shows as it is: without mathematics, and in the legend even behind an underscore.

    >>> picture("_a$b$")
    ' _a\\\\$b\\\\$'
    """
    line = visible(text).replace("$", r"\$")
    return f" {line}" if line.startswith("_") else line


def spreadsheet(text: str) -> str:
    """Text that a spreadsheet takes for text, without control characters: behind an apostrophe if it would be a formula
    and is no number.

    >>> spreadsheet("=1+1"), spreadsheet("-0.5"), spreadsheet("KF")
    ("'=1+1", '-0.5', 'KF')
    """
    text = uncontrolled(text)
    if not visible(text).startswith(("=", "+", "-", "@")):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def markdown(text: str) -> str:
    """Text on one line that ends no column and opens no HTML tag.

    >>> markdown("a|<b>")
    'a\\\\|\\\\<b>'
    """
    return re.sub(r"<(?=[A-Za-z/!?])", r"\\<", visible(text)).replace("|", "\\|")


def tex(text: str) -> str:
    r"""Text on one line without a command of LaTeX.

    >>> tex(r"\input{x}")
    '\\textbackslash{}input\\{x\\}'
    """
    return "".join(_LATEX.get(letter, letter) for letter in visible(text))


FEW_ENTRIES, LONGEST_FIELD = 4, 60
"""Entries up to which a value is shown whole, and the longest text of one field."""


def short_repr(self: Any) -> str:
    """One line for a dataclass of arrays: short values, the shapes of arrays, the lengths of sequences.

    Fields that are None or empty are left out. Use it as `__repr__ = short_repr` in the body of the class.

    >>> from coopoc.evaluate.ledger import of_training
    >>> of_training(["red", "blue"], [10.0, 12.0], [8.0, 8.0])
    Ledger(names=('red', 'blue'), seconds (2,), sent (2, 2, 1, 2), received (2, 2, 1, 2))
    """
    parts = (_part(each.name, getattr(self, each.name)) for each in fields(self) if each.repr)
    return f"{type(self).__name__}({', '.join(filter(None, parts))})"


def _part(name: str, value: Any) -> str:
    if value is None or (isinstance(value, Mapping | Sequence) and not value):
        return ""
    shape = getattr(value, "shape", ())
    if shape != ():
        return f"{name} {tuple(shape)}"
    if isinstance(value, Enum):
        return f"{name}={value.name}"
    if isinstance(value, Mapping) and len(value) > FEW_ENTRIES:
        return f"{name}={{{', '.join(map(repr, list(value)[:FEW_ENTRIES]))}, ...}}"
    text = _text(value.item() if hasattr(value, "item") else value)
    if len(text) <= LONGEST_FIELD and "\n" not in text:
        return f"{name}={text}"
    if isinstance(value, str):
        return f"{name}={value[:LONGEST_FIELD].splitlines()[0]!r}..."
    kind = type(value[0] if isinstance(value, Sequence) else value).__name__
    return f"{name}={len(value)} x {kind}" if isinstance(value, Sequence) else f"{name}={kind}(...)"


def _text(value: Any) -> str:
    """The repr of a value, of floats six digits of it."""
    if isinstance(value, tuple) and all(isinstance(one, float) for one in value):
        return f"({', '.join(map(_text, value))})"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)
