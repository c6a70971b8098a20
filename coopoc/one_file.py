"""What somebody keeps in one Python file of their own, by path: "folder/mine.py:NAME" wherever a name is asked for."""

from __future__ import annotations

import difflib
import hashlib
import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from .errors import InputError


def in_file(name: str) -> bool:
    """True for a path to a Python file and a name in it.

    >>> in_file("mine.py:StayPut"), in_file("kalman")
    (True, False)
    """
    path, colon, held = name.rpartition(":")
    return bool(colon and held) and path.endswith(".py")


def from_file(name: str, noun: str = "object") -> Any:
    """The object that the file holds under the name; the file is run once for each of its contents.

    Args:
        name: "folder/mine.py:NAME", from the working folder. noun: what it is to be, for the error.

    Raises:
        InputError: no such file, or no such name in it (lists its names). What the file itself raises comes as it is.
    """
    path, _, held = name.rpartition(":")
    module = _module(str(Path(path).resolve()), file_digest(name, noun))
    if not hasattr(module, held):
        own = [n for n, value in vars(module).items() if not n.startswith("_") and not isinstance(value, ModuleType)]
        near = difflib.get_close_matches(held, own, n=1)
        mend = f"Did you mean {path}:{near[0]}?" if near else "Name what the file defines."
        raise InputError(noun, repr(name), f"is not in the file, which has {', '.join(own) or 'no names'}", mend)
    return getattr(module, held)


def file_digest(name: str, noun: str = "object") -> str:
    """Hash of the file's contents, which the names of cells hold: they are computed again when the file changes.

    Raises:
        InputError: no such file.
    """
    path = Path(name.rpartition(":")[0])
    if not path.is_file():
        raise InputError(noun, repr(name), f"names a file that is not there ({path.resolve()})", "Check the path.")
    return hashlib.sha256(path.read_bytes()).hexdigest()[:20]


@cache
def _module(path: str, digest: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"coopoc_file_{Path(path).stem}_{digest}", path)
    if spec is None or spec.loader is None:  # no path that ends in .py is without
        raise InputError("path", repr(path), "is no Python source", "Name a .py file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up while it runs
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[spec.name]
        raise
    return module
