"""Text from data in tables, pages and pictures, where it must not act as markup, a command, a formula or a control."""

import re
import unicodedata

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
    shown = visible(text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


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
