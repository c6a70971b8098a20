"""The `repr` of results that hold arrays: a line of names and shapes in place of all numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import Enum
from typing import Any

FEW, LONG = 4, 60
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
    if isinstance(value, Mapping) and len(value) > FEW:
        return f"{name}={{{', '.join(map(repr, list(value)[:FEW]))}, ...}}"
    text = _text(value.item() if hasattr(value, "item") else value)
    if len(text) <= LONG and "\n" not in text:
        return f"{name}={text}"
    if isinstance(value, str):
        return f"{name}={value[:LONG].splitlines()[0]!r}..."
    kind = type(value[0] if isinstance(value, Sequence) else value).__name__
    return f"{name}={len(value)} x {kind}" if isinstance(value, Sequence) else f"{name}={kind}(...)"


def _text(value: Any) -> str:
    """The repr of a value, of floats six digits of it."""
    if isinstance(value, tuple) and all(isinstance(one, float) for one in value):
        return f"({', '.join(map(_text, value))})"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)
