"""Names that come from data, used as names of files: they must neither leave their folder nor clash with a device."""

from __future__ import annotations

import os
import re
from pathlib import Path

from .errors import InputError

_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{digit}" for port in ("COM", "LPT") for digit in range(1, 10))}
_LONGEST = 200


def given_path(path: object) -> Path:
    """A path from text or a Path.

    Raises:
        InputError: anything else.

    >>> given_path("town.pyfg").suffix
    '.pyfg'
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError("path", repr(path)[:60], "must be text or a Path", 'Give for example "graph.pyfg".')
    return Path(path)


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
    shown = repr(name) if len(repr(name)) < 60 else f"{repr(name)[:60]}..."
    allowed = (
        f'must be a file name: at most {_LONGEST} bytes, printable, without < > : " / \\ | ? *, '
        "no dot or space at its ends, and no device of Windows such as CON"
    )
    raise InputError(field, shown, allowed, hint)


def inside(folder: Path, path: Path) -> Path:
    """`path`, if it stays in `folder` once symbolic links are followed.

    Raises:
        InputError: it leads out of the folder.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError("path", str(path), f"leads out of {folder} by a symbolic link", "Remove the link.")
    return path
