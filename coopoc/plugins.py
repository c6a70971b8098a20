"""Objects by name: data sets, methods, studies, backends and commands, which the core finds and never imports.

Entry points name those of installed distributions; "folder/mine.py:NAME" one of your own in a Python file.
"""

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Mapping
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

from .errors import InputError, MissingLibraryError, missing, said, suggestion, unknown

GROUPS = {
    "coopoc.datasets": "data set",
    "coopoc.methods": "method",
    "coopoc.studies": "study",
    "coopoc.backends": "backend",
    "coopoc.measurements": "measurement",
    "coopoc.recipes": "recipe",
    "coopoc.nets": "net",
    "coopoc.rules": "aggregation rule",
    "coopoc.channels": "channel",
    "coopoc.metrics": "metric",
    "coopoc.commands": "command",
}
"""Group -> what one of its names is called."""
LISTED = "List all with: coopoc list."
MAPPINGS = ("dict", "MappingProxyType")
_PREFIX = "coopoc_file_"


def points(group: str) -> Mapping[str, metadata.EntryPoint]:
    """Entry points of a group by name, none of them loaded; InputError if two distributions claim one name.

    Once the backport importlib_metadata is imported, as Dask does, Python's finder returns entry points of another
    class; each is therefore made anew as Python's own.
    """
    entry_points: dict[str, metadata.EntryPoint] = {}
    for point in _installed(group, tuple(sys.path)):
        _claim(entry_points, point.name, metadata.EntryPoint(point.name, point.value, point.group))
    return entry_points


def _claim(taken: dict[str, metadata.EntryPoint], name: str, point: metadata.EntryPoint) -> None:
    other = taken.setdefault(name, point).value
    if other != point.value:
        claims = f"is claimed by {other} and {point.value}"
        raise InputError(point.group, repr(name), claims, "Uninstall one of the two.")


@lru_cache(64)
def _installed(group: str, folders: tuple[str, ...]) -> tuple[metadata.EntryPoint, ...]:
    """Entry points by name, read once: Python reads every distribution at each call, 15 ms for two hundred. What is
    installed while Python runs is there when it starts again."""
    return tuple(sorted(metadata.entry_points(group=group), key=lambda point: point.name))


def names(group: str) -> tuple[str, ...]:
    """All names in a group. An entry point that holds a mapping stands for the names in it. Where these stand in the
    source nothing is imported.

    >>> isinstance(names("coopoc.methods"), tuple)
    True
    """
    return tuple(sorted(holders(group)))


def holders(group: str) -> Mapping[str, metadata.EntryPoint]:
    """The entry point that holds each name of a group; InputError if two do."""
    every: dict[str, metadata.EntryPoint] = {}
    for name, point in points(group).items():
        written = names_in(point.value)
        for each in (_members(point) if written is None else written) or [name]:
            _claim(every, each, point)
    return every


@cache
def names_in(value: str) -> tuple[str, ...] | None:
    """Keys of the mapping that an entry point names, read from its source, so that a list of names imports no library.

    Args:
        value: "package.module:NAME".

    Returns:
        No name for a definition or for what a call returns; None if only an import can show it.

    >>> names_in("coopoc.world.channels:CHANNELS")
    ('ideal', 'cam', 'bsm', 'cpm')
    >>> names_in("coopoc.plugins:find")
    ()
    """
    statement = _definition(value)
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return ()
    written = getattr(statement, "value", None)
    if isinstance(written, ast.Dict):
        keys = [key.value for key in written.keys if isinstance(key, ast.Constant)]
        return tuple(map(str, keys)) if len(keys) == len(written.keys) else None
    named = isinstance(written, ast.Call) and getattr(written.func, "id", "") not in MAPPINGS
    return () if named else None


def summary_in(value: str) -> str | None:
    """First line of the docstring of the function that an entry point names, or keys of its mapping, from its source.

    >>> summary_in("coopoc.plugins:summary_in")[:27]
    'First line of the docstring'
    """
    statement = _definition(value)
    if isinstance(statement, ast.FunctionDef):
        return (ast.get_docstring(statement) or "").partition("\n")[0]
    keys = names_in(value)
    return " | ".join(keys) if keys else None


def _definition(value: str) -> ast.stmt | None:
    """The statement that defines what "package.module:NAME" names; None if only an import can show it."""
    module, _, name = value.partition(":")
    parts, path, origin = module.split("."), None, ""
    try:
        for k in range(len(parts)):  # importlib.util.find_spec would import the packages above
            finders = (f.find_spec(".".join(parts[: k + 1]), path) for f in sys.meta_path if hasattr(f, "find_spec"))
            spec = next((spec for spec in finders if spec), None)
            path, origin = (spec.submodule_search_locations, str(spec.origin)) if spec else ([], "")
        body = ast.parse(Path(origin).read_text(encoding="utf-8")).body
    except (ImportError, OSError, SyntaxError, ValueError):
        return None
    for statement in body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef) and statement.name == name:
            return statement
        targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return statement
    return None


def find(group: str, name: str) -> Any:
    """Load the object that is registered under `name`; its library is imported only here.

    A path runs the file. It must come from the user: a name read from data is looked up only after `in_file` is False.

    Args:
        group: one of GROUPS, or a third party's own.
        name: an entry point, a key of an entry point that holds a mapping, or "folder/mine.py:NAME", a name in a file.

    Returns:
        The object itself: a class, a function, a Study.

    Raises:
        InputError: no such name (lists the names and the nearest one), no such file, or two distributions claim the
            name.
        MissingLibraryError: a library that it needs is not installed.

    >>> find("nothing", "x")
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: nothing = 'x': must be one of (there is none). There is none to use.
    """
    if not isinstance(name, str):
        raise _unknown(group, name)
    point = holders(group).get(name)
    if point is not None:
        loaded = load(point, name)
        return loaded[name] if isinstance(loaded, Mapping) else loaded
    if in_file(name):
        return from_file(name, GROUPS.get(group, group))
    raise _unknown(group, name)


def called(group: str, name: str, hint: str, *arguments: Any) -> Any:
    """What the object of a name returns; InputError if it cannot be called with the arguments.

    >>> called("coopoc.channels", "bsm", "Give the number of neighbours.", 4).rate
    10.0
    """
    plugin = find(group, name)
    try:
        return plugin(*arguments)
    except InputError:
        raise
    except Exception as error:  # of code that is not ours
        raise InputError(GROUPS[group], repr(name), f"cannot be called: {error}", hint) from error


def load(point: metadata.EntryPoint, name: str) -> Any:
    """What an entry point names, for one of its names.

    Raises:
        InputError: a broken one.
        MissingLibraryError: a library that it needs is not installed.
    """
    try:
        return point.load()
    except Exception as error:  # of code that may not be ours
        lacking = missing(error, name) if isinstance(error, ModuleNotFoundError) else error
        if isinstance(lacking, InputError | MissingLibraryError):
            raise lacking from None
        broken = f"cannot be loaded from {point.value}: {said(error)}"
        raise InputError(point.group, repr(name), broken, "Mend or uninstall its package.") from error


def _unknown(group: str, name: object) -> InputError:
    noun = GROUPS.get(group, group)
    if str(name).endswith(".py"):
        return InputError(noun, repr(name), "must name what the file has", f"Write {name}:NAME.")
    return unknown(noun, name, names(group), LISTED if group in GROUPS else None)


def _members(point: metadata.EntryPoint) -> Mapping[str, Any]:
    """Names in an entry point that holds a mapping. One that cannot be loaded is listed under its own name, and raises
    when it is asked for."""
    try:
        loaded = point.load()
    except Exception:
        return {}
    return loaded if isinstance(loaded, Mapping) else {}


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
        hint = suggestion(attribute, own, "Name what the file defines.")
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
