"""The source code that a cell runs: its function and all that it names, so that a view's text is no part of a cell."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import inspect
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Reference = tuple[str, str | None]
"""A name, and the attribute that is taken of it, if any."""


@dataclass(frozen=True, eq=False)
class _Module:
    """A parsed file: what defines each name, what each import binds, and the statements that only run.

    Args:
        name: dotted name of the module.
        definitions: name -> statements.
        imports: name -> module, and name in it (None for the module itself).
        runs: other statements.
    """

    name: str
    definitions: dict[str, list[ast.stmt]] = field(default_factory=lambda: defaultdict(list))
    imports: dict[str, Reference] = field(default_factory=dict)
    runs: list[ast.stmt] = field(default_factory=list)


def code_of(function: Callable[..., Any]) -> str:
    """Hash of a function's definition and of all definitions that it names, in its file and its package.

    Comments, docstrings and layout do not count, nor does what nothing in the cell names: tables, figures, captions.
    Other packages count by the names that are imported, not by their contents. Empty where there is no source.

    >>> len(code_of(code_of))
    20
    """
    found: set[str] = set()
    for root in _roots(function):
        found |= _texts(root)
    return hashlib.sha256("\n".join(sorted(found)).encode()).hexdigest()[:20] if found else ""


def _roots(function: Any) -> Iterator[Any]:
    """The functions of a cell: through partials, whose functions and scalars count, wrappers and callable objects."""
    if isinstance(function, functools.partial):
        for given in (function.func, *function.args, *function.keywords.values()):
            yield from (
                _roots(given) if callable(given) else [repr(given)] if isinstance(given, str | int | float) else []
            )
    else:
        function = inspect.unwrap(function)
        yield function if hasattr(function, "__qualname__") else type(function)


def _texts(root: Any) -> set[str]:
    if isinstance(root, str):
        return {root}
    module = sys.modules.get(root.__module__)
    file = getattr(module, "__file__", None)
    if file is None or not file.endswith(".py"):
        return set()
    package = getattr(module, "__package__", "") or ""
    whole = "<" in root.__qualname__  # a function within a function, or a lambda: what it names cannot be looked up
    return _Reached(package, Path(file), root.__module__).texts(None if whole else root.__qualname__.partition(".")[0])


class _Reached:
    """A walk over definitions; `package` is where names are followed to, the file alone if it has none."""

    def __init__(self, package: str, file: Path, name: str) -> None:
        self.package, self.seen, self.found = package, set[tuple[str, str]](), set[str]()
        self.modules = {name: _parsed(file.read_text(encoding="utf-8"), name, package)}
        self.first = self.modules[name]

    def texts(self, name: str | None) -> set[str]:
        self.all_of(self.first) if name is None else self.visit(self.first, name)
        return self.found

    def module(self, name: str) -> _Module | None:
        """The module of that name if it belongs to the package."""
        if name not in self.modules and self.package and f"{name}.".startswith(f"{self.package}."):
            inside = name[len(self.package) :].strip(".").split(".")
            for folder in map(Path, sys.modules[self.package].__path__):
                path = folder.joinpath(*inside)
                for file, package in ((path / "__init__.py", name), (path.with_suffix(".py"), name.rpartition(".")[0])):
                    if file.is_file():
                        self.modules[name] = _parsed(file.read_text(encoding="utf-8"), name, package)
        return self.modules.get(name)

    def all_of(self, module: _Module) -> None:
        for name in [*module.definitions, *module.imports]:
            self.visit(module, name)

    def visit(self, module: _Module, name: str, attribute: str | None = None) -> None:
        if bound := module.imports.get(name):
            self.follow(bound, attribute)
        if (module.name, name) in self.seen or name not in module.definitions:
            return
        self.seen.add((module.name, name))
        for statement in [*module.definitions[name], *module.runs]:
            self.found.add(ast.unparse(statement))
            for reference in _references(statement):
                self.visit(module, *reference)
            for bound in _imported(statement, module.name.rpartition(".")[0]).values():
                self.follow(bound, None)

    def follow(self, bound: Reference, attribute: str | None) -> None:
        """To what an import names: a definition, a whole module, or one name of a module."""
        target, name = bound
        self.found.add(f"import {target} {name}")
        within = self.module(target if name is None else f"{target}.{name}") if self.package else None
        if within is not None:
            self.visit(within, attribute) if attribute is not None else self.all_of(within)
        elif name is not None and (module := self.module(target)) is not None:
            self.visit(module, name, attribute)


@functools.lru_cache(maxsize=256)
def _parsed(text: str, name: str, package: str) -> _Module:
    tree, module = ast.parse(text), _Module(name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and _documented(node):
            node.body = node.body[1:] or [ast.Pass()]
    for statement in tree.body:
        if isinstance(statement, ast.Import | ast.ImportFrom):
            module.imports.update(_imported(statement, package))
        elif isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.unparse(statement.test):
            continue
        elif names := _bound(statement):
            for bound in names:
                module.definitions[bound].append(statement)
        elif not isinstance(statement, ast.Expr | ast.Pass) or not isinstance(
            getattr(statement, "value", 0), ast.Constant
        ):
            module.runs.append(statement)
    return module


def _documented(node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return ast.get_docstring(node, clean=False) is not None


def _bound(statement: ast.stmt) -> set[str]:
    """Names that a statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    nodes = list(ast.walk(statement))
    inner = {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)}
    return inner | {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}


def _imported(statement: ast.stmt, package: str) -> dict[str, Reference]:
    """What the imports in a statement bind."""
    found: dict[str, Reference] = {}
    for node in ast.walk(statement):
        if isinstance(node, ast.Import):
            for alias in node.names:
                found[alias.asname or alias.name.partition(".")[0]] = (alias.name, None)
        elif isinstance(node, ast.ImportFrom):
            target = "." * node.level + (node.module or "")
            target = importlib.util.resolve_name(target, package) if node.level and package else target
            found.update({alias.asname or alias.name: (target, alias.name) for alias in node.names})
    return found


def _references(statement: ast.stmt) -> Iterator[Reference]:
    """Names that a statement reads, each with the attribute that is taken of it."""
    taken = set()
    for node in ast.walk(statement):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            taken.add(id(node.value))
            yield node.value.id, node.attr
        elif isinstance(node, ast.Name) and id(node) not in taken:
            yield node.id, None
