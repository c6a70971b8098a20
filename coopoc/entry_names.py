"""Names that an entry point stands for, read from its source: a list of names imports no library."""

from __future__ import annotations

import ast
import importlib.util
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

MAPPINGS = ("dict", "MappingProxyType")


@cache
def names_in(value: str) -> tuple[str, ...] | None:
    """Keys of the mapping that an entry point names, none for another object; None if only an import can show it.

    Args:
        value: "package.module:NAME". A definition, or what a call returns, is one object; a mapping is one whose keys
            are written out.

    >>> names_in("coopoc.world.v2x:CHANNELS")
    ('ideal', 'cam', 'bsm', 'cpm')
    >>> names_in("coopoc.plugins:find")
    ()
    """
    module, _, name = value.partition(":")
    file = _file(module)
    if file is None:
        return None
    try:
        body = ast.parse(file.read_text(encoding="utf-8")).body
    except (OSError, SyntaxError, ValueError):
        return None
    for statement in body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef) and statement.name == name:
            return ()
        targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return _keys(getattr(statement, "value", None))
    return None


def _keys(value: ast.expr | None) -> tuple[str, ...] | None:
    if isinstance(value, ast.Dict):
        found = [key.value for key in value.keys if isinstance(key, ast.Constant) and isinstance(key.value, str)]
        return tuple(found) if len(found) == len(value.keys) else None
    if isinstance(value, ast.Call):
        return None if isinstance(value.func, ast.Name) and value.func.id in MAPPINGS else ()
    return None


def _file(module: str) -> Path | None:
    """Source of a module, none of its packages imported but the first, and that only where a finder needs it."""
    spec: ModuleSpec | None = None
    parts = module.split(".")
    for k in range(len(parts)):
        name = ".".join(parts[: k + 1])
        within = None if spec is None else spec.submodule_search_locations
        if k and within is None:
            return None
        found = PathFinder.find_spec(name, within)
        if found is None and k < 2:
            try:
                found = importlib.util.find_spec(name)
            except (ImportError, ValueError):
                return None
        if found is None:
            return None
        spec = found
    return Path(spec.origin) if spec is not None and spec.origin is not None and spec.origin.endswith(".py") else None
