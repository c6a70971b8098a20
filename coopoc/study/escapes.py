"""Text from data in Markdown, LaTeX and CSV, where it must not act as markup, a command or a formula."""

from __future__ import annotations

import re

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
    "²": r"$^2$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}


def spreadsheet(text: str) -> str:
    """Text that a spreadsheet takes for text: behind an apostrophe if it would be a formula and is no number.

    >>> spreadsheet("=1+1"), spreadsheet("-0.5"), spreadsheet("KF")
    ("'=1+1", '-0.5', 'KF')
    """
    if not text.startswith(("=", "+", "-", "@", "\t", "\r", "\n")):
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
    return re.sub(r"<(?=[A-Za-z/!?])", r"\\<", " ".join(text.splitlines())).replace("|", "\\|")


def tex(text: str) -> str:
    r"""Text on one line without a command of LaTeX.

    >>> tex(r"\input{x}")
    '\\textbackslash{}input\\{x\\}'
    """
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.splitlines()))
