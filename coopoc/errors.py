"""Exceptions that name the wrong field, the allowed values and a way to correct it."""

import difflib
import json
import re
from collections.abc import Iterable
from importlib import metadata
from urllib.parse import unquote, urlsplit

LONGEST_PART = 1500
"""Characters of each part of a message."""


class InputError(ValueError):
    """A value that cannot be used: names the field, the value, what is allowed, and a hint.

    >>> print(InputError("max_neighbours", -1, "must be >= 0", "Use 0 for no neighbours."))
    max_neighbours = -1: must be >= 0. Use 0 for no neighbours.
    """

    def __init__(self, field: str, value: object, allowed: str, hint: str) -> None:
        self.field, self.value, self.allowed, self.hint = field, value, allowed, hint
        super().__init__(f"{_cut(field)} = {_cut(value)}: {_cut(allowed).rstrip('.')}. {_cut(hint)}")

    def __reduce__(self) -> "tuple[type[InputError], tuple[str, object, str, str]]":
        return type(self), (self.field, self.value, self.allowed, self.hint)


def shown(value: object, longest: int = 60) -> str:
    """The repr of any value, cut; of an object whose own repr fails, its class.

    >>> shown("a" * 100, 3), shown([1]), len(shown("a" * 100))
    ("'aa", '[1]', 60)
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
    return text if len(text) <= LONGEST_PART else f"{text[:LONGEST_PART]}..."


def suggestion(name: object, known: Iterable[str], otherwise: str) -> str:
    """The hint for an unknown name: the nearest known one, or another hint if none is near; no single letter is, and
    of several words each has to be near one of its words.

    >>> suggestion("tracee", ("trace", "det"), "Pick one."), suggestion("range_rate", ("yaw_rate",), "Pick one.")
    ('Did you mean trace?', 'Pick one.')
    """
    names = {one.lower(): one for one in known if len(one) > 1}  # else a quaternion's qx would be meant as x
    text = (name if isinstance(name, str) else shown(name)).lower()
    near = difflib.get_close_matches(text, names, n=1)
    if not near:
        return otherwise
    words, theirs = text.split("_"), near[0].split("_")
    alike = len(words) == 1 or all(difflib.get_close_matches(word, theirs, cutoff=0.75) for word in words)
    return f"Did you mean {names[near[0]]}?" if alike else otherwise


def unknown(noun: str, name: object, names: Iterable[str], otherwise: str | None = None) -> InputError:
    """The error for an unknown name: lists the known ones and proposes the nearest.

    Args:
        noun: kind of the thing, such as "method".
        name: that was asked for.
        names: names that exist.
        otherwise: hint if none is near; None for one about the list of names.

    >>> print(unknown("method", "kalmann", ["gnss", "kalman"]))
    method = 'kalmann': must be one of gnss, kalman. Did you mean kalman?
    """
    names = list(names)
    if otherwise is None:
        otherwise = "Use one of these names." if names else "There is none to use."
    allowed = "must be one of " + (", ".join(names) or "(there is none)")
    return InputError(noun, shown(name), allowed, suggestion(name, names, otherwise))


def said(error: BaseException) -> str:
    """The first line of what an error of another library says, else its name.

    >>> said(KeyError())
    'KeyError'
    """
    return next(iter(str(error).splitlines()), type(error).__name__)[:200]


class MissingLibraryError(ImportError):
    """An optional library or program is not installed: the message carries the line that installs it."""

    def __init__(self, library: str, needed_for: str, package: str) -> None:
        self.arguments = (library, needed_for, package)
        super().__init__(f"{needed_for} needs {library}, which is not installed. Run: pip install {_where(package)}")

    def __reduce__(self) -> "tuple[type[MissingLibraryError], tuple[str, str, str]]":
        return type(self), self.arguments


def _where(package: str) -> str:
    """An extra of coopoc as pip finds it: in the folder that it was installed from, else on the index."""
    texts = (each.read_text("direct_url.json") for each in metadata.distributions(name="coopoc"))
    source = json.loads(next(filter(None, texts), "{}"))  # what pip left in a clone that it built has none
    if not package.startswith("'coopoc[") or not (url := str(source.get("url", ""))).startswith("file:"):
        return package
    editable = "-e " if source.get("dir_info", {}).get("editable") else ""
    return f"{editable}{package.replace('coopoc', unquote(urlsplit(url).path), 1)}"


def dependencies() -> dict[str, str]:
    """Libraries that coopoc itself needs, by the name that is imported: the name that pip installs."""
    stated = [text for text in metadata.requires("coopoc") or () if "extra ==" not in text]
    names = [re.split(r"[^\w-]", text)[0] for text in stated]
    return {name.removesuffix("-base"): name for name in names}


def missing(error: ModuleNotFoundError, needed_for: str) -> ImportError:
    """The error for a library that could not be imported: with the line that installs it if coopoc needs it."""
    library = (error.name or "").partition(".")[0]
    packages = dependencies()
    return MissingLibraryError(library, needed_for, packages[library]) if library in packages else error
