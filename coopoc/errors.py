"""Exceptions that name the wrong field, the allowed values and a way to correct it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LONGEST = 1500
"""Characters of each part of a message."""


class InputError(ValueError):
    """A value that cannot be used: names the field, the value, what is allowed, and a hint.

    >>> print(InputError("max_neighbours", -1, "must be >= 0", "Use 0 for no neighbours."))
    max_neighbours = -1: must be >= 0. Use 0 for no neighbours.
    """

    def __init__(self, field: str, value: object, allowed: str, hint: str) -> None:
        self.field, self.value, self.allowed, self.hint = field, value, allowed, hint
        super().__init__(f"{_cut(field)} = {_cut(value)}: {_cut(allowed).rstrip('.')}. {_cut(hint)}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, object, str, str]]:
        return type(self), (self.field, self.value, self.allowed, self.hint)


def shown(value: object, longest: int = 60) -> str:
    """The repr of any value, cut; of an object whose own repr fails, its class.

    >>> shown("a" * 100, 3), shown([1])
    ("'aa", '[1]')
    """
    try:
        return repr(value)[:longest]
    except Exception:  # of a class from elsewhere, or a whole number of thousands of digits
        return f"a {type(value).__name__}"


def _cut(value: object) -> str:
    """What a file holds may be of any length, and what a caller gives may have no text."""
    try:
        text = str(value)
    except Exception:
        text = shown(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def suggestion(name: object, known: Iterable[str], otherwise: str) -> str:
    """The hint for an unknown name: the nearest known one, or another hint if none is near.

    >>> suggestion("tracee", ("trace", "det"), "Pick one.")
    'Did you mean trace?'
    """
    near = difflib.get_close_matches(name if isinstance(name, str) else shown(name), list(known), n=1)
    return f"Did you mean {near[0]}?" if near else otherwise


def unknown(noun: str, name: object, known: Iterable[str], otherwise: str | None = None) -> InputError:
    """The error for an unknown name: lists the known ones and proposes the nearest.

    Args:
        noun: kind of the thing, such as "method".
        name: that was asked for.
        known: names that exist.
        otherwise: hint if none is near; None for one about the list of names.

    >>> print(unknown("method", "kalmann", ["gnss", "kalman"]))
    method = 'kalmann': must be one of gnss, kalman. Did you mean kalman?
    """
    known = list(known)
    if otherwise is None:
        otherwise = "Use one of these names." if known else "There is none to use."
    allowed = "must be one of " + (", ".join(known) or "(there is none)")
    return InputError(noun, shown(name), allowed, suggestion(name, known, otherwise))


class MissingLibraryError(ImportError):
    """An optional library or program is not installed: the message carries the line that installs it."""

    def __init__(self, library: str, needed_for: str, package: str, how: str = "pip install") -> None:
        self.given = (library, needed_for, package, how)
        super().__init__(f"{needed_for} needs {library}, which is not installed. Run: {how} {package}")

    def __reduce__(self) -> tuple[type[MissingLibraryError], tuple[str, str, str, str]]:
        return type(self), self.given
