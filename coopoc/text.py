"""Texts: text from data where it must not act, and the short `repr` of results.

In tables, pages and pictures, text must not act as markup, a command, a formula or a control. Results that hold arrays
show a line of names and shapes.
"""

import re
import textwrap
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import Enum
from typing import Any

_MATHEMATICS = (
    "± pm ≤ le ≥ ge × times ≈ approx → to ∞ infty α alpha β beta γ gamma δ delta ε epsilon ζ zeta η eta θ theta ι iota "
    "κ kappa λ lambda μ mu ν nu ξ xi π pi ρ rho ς varsigma σ sigma τ tau υ upsilon φ phi χ chi ψ psi ω omega Γ Gamma "
    "Δ Delta Θ Theta Λ Lambda Ξ Xi Π Pi Σ Sigma Υ Upsilon Φ Phi Ψ Psi Ω Omega"
)
_LATEX = {
    **{letter: rf"$\{name}$" for letter, name in re.findall(r"(\S) (\S+)", _MATHEMATICS)},
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
    "–": "--",
    "−": "$-$",
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


def wrapped(text: str) -> str:
    """`picture` of a name in lines of at most 40 letters.

    >>> wrapped("a " * 21)
    'a a a a a a a a a a a a a a a a a a a a\\na'
    """
    return "\n".join(map(picture, textwrap.wrap(visible(text), 40)))


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
    r"""Text on one line without a command of LaTeX; a symbol that it lacks is named.

    >>> tex(r"\input{x}"), tex("α ∇")
    ('\\textbackslash{}input\\{x\\}', '$\\alpha$ (nabla)')
    """
    return "".join(map(_tex, unicodedata.normalize("NFC", visible(text))))


def _tex(letter: str) -> str:
    if letter in _LATEX or letter < "\u0100" or unicodedata.category(letter) not in ("Sm", "So", "Mn"):
        return _LATEX.get(letter, letter)
    return f"({unicodedata.name(letter, 'symbol').lower()})"


FEW_ENTRIES, LONGEST_FIELD = 4, 60
"""Entries up to which a value is shown whole, and the longest text of one field."""


def short_repr(self: Any) -> str:
    """One line for a dataclass of arrays: short values, the shapes of arrays, the lengths of sequences.

    Fields that are None or empty are left out. Use it as `__repr__ = short_repr` in the body of the class.

    >>> from coopoc.evaluate.ledger import of_training
    >>> of_training(["red", "blue"], [10.0, 12.0], [8.0, 8.0])
    Ledger(names=('red', 'blue'), seconds (2,), sent (2, 1, 2), received (2, 1, 2))
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
