"""Objects of one's own in one Python file, by path: "folder/mine.py:NAME" is accepted wherever a name is."""

import difflib
import hashlib
import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from .errors import InputError

_PREFIX = "coopoc_file_"


def in_file(name: str) -> bool:
    """True for a path to a Python file and a name in it.

    >>> in_file("mine.py:StayPut"), in_file("kalman")
    (True, False)
    """
    path, colon, attribute = name.rpartition(":")
    return bool(colon and attribute) and path.endswith(".py")


def from_file(name: str, noun: str = "object") -> Any:
    """The object of that name in the file; the file is run once for each of its contents.

    Args:
        name: "folder/mine.py:NAME", from the working folder.
        noun: kind of the object, for the error.

    Raises:
        InputError: no such file, or no such name in it (lists its names). Errors of the file itself pass unchanged.
    """
    path, _, attribute = name.rpartition(":")
    module = _module(str(Path(path).resolve()), file_digest(name, noun))
    if not hasattr(module, attribute):
        own = [n for n, value in vars(module).items() if not n.startswith("_") and not isinstance(value, ModuleType)]
        near = difflib.get_close_matches(attribute, own, n=1)
        hint = f"Did you mean {path}:{near[0]}?" if near else "Name what the file defines."
        raise InputError(noun, repr(name), f"is not in the file, which has {', '.join(own) or 'no names'}", hint)
    return getattr(module, attribute)


def file_digest(name: str, noun: str = "object") -> str:
    """Hash of the file's contents. Cells are named by it, so that they are computed again when the file changes.

    Args:
        name: "folder/mine.py:NAME".
        noun: kind of the object, for the error.

    Raises:
        InputError: no such file.
    """
    path = Path(name.rpartition(":")[0])
    if not path.is_file():
        raise InputError(noun, repr(name), f"names a file that is not there ({path.resolve()})", "Check the path.")
    return hashlib.sha256(path.read_bytes()).hexdigest()[:20]


def path_of(kind: type[Any]) -> Path | None:
    """Path of the file that `from_file` loaded a class from; None for any other class."""
    module = sys.modules.get(kind.__module__)
    held = kind.__module__.startswith(_PREFIX) and module is not None and module.__file__
    return Path(held) if held else None


@cache
def _module(path: str, digest: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"{_PREFIX}{Path(path).stem}_{digest}", path)
    if spec is None or spec.loader is None:  # no path that ends in .py is without
        raise InputError("path", repr(path), "is no Python source", "Name a .py file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up while it runs
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[spec.name]
        if isinstance(error, SystemExit):
            hint = 'Put what runs as a script under if __name__ == "__main__".'
            raise InputError(path, f"exit {error.code!r}", "must not end Python while it loads", hint) from None
        raise
    return module
