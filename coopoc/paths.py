"""Paths and files: what may be a name or a path, and files that are written whole or not at all."""

import os
import re
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from .errors import InputError, shown

_LONGEST = 200


def given_path(path: object) -> Path:
    """A path from text or a Path; ~ is the home folder.

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
    return Path(os.path.expanduser(os.fsdecode(encoded)))


def file_name(field: str, name: object, hint: str) -> str:
    """`name`, if it is a valid file name on Linux and macOS.

    Args:
        field: named in the error.
        name: file name without its suffix.
        hint: of the error.

    Raises:
        InputError: text that is empty, too long or not printable, that contains a separator or a reserved character,
            that begins or ends with a dot or a space.

    >>> file_name("id", "car 12", "Rename the vehicle.")
    'car 12'
    """
    plain = isinstance(name, str) and name.isprintable() and re.fullmatch(r'[^<>:"/\\|?*]+', name)
    if isinstance(name, str) and plain and name == name.strip(" .") and len(name.encode()) <= _LONGEST:
        return name
    allowed = (
        f'must be a file name: at most {_LONGEST} bytes, printable, without < > : " / \\ | ? *, '
        "no dot or space at its ends"
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


def write(path: Path, content: str | bytes | Callable[[Any], object]) -> None:
    """Write a file atomically: a temporary neighbour, flushed to disk, then renamed onto `path`. Its folder is made.

    A process that is killed in between leaves the old file or none, never half a file. A symbolic link at `path` is
    replaced, not followed.

    Raises:
        InputError: a folder or a device at `path`.
        OSError: a full or read-only disk, with the path.
    """
    replaceable(path)
    part = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        text = f"{error.strerror or error}. Finished files are kept: make room, or choose another folder, and repeat"
        raise OSError(error.errno, text, str(path)) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
