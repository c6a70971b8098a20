"""Provenance of results: versions and processor, the git revision, and hashes of the source code that cells run."""

import ast
import functools
import hashlib
import importlib.util
import inspect
import os
import platform
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from ..errors import InputError

_LIBRARIES = "numpy scipy numba torch gtsam casadi cvxpy osqp pandas pyarrow joblib"


def environment() -> dict[str, str]:
    """Versions of Python, coopoc and the libraries that compute, the processor, and the git revision if any."""
    versions = {
        "coopoc": metadata.version("coopoc"),
        "git revision": git_revision(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }
    for name in _LIBRARIES.split():
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return {name: value for name, value in versions.items() if value}


def git_revision() -> str:
    """Commit of the checkout this package runs from, with "+ changes" if files differ; "" if it is none."""
    here = Path(__file__).resolve()

    def git(*words: str) -> str:
        try:
            done = subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True, timeout=20)
        except (OSError, subprocess.TimeoutExpired):
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    if not git("ls-files", "--error-unmatch", here.name):
        return ""
    return git("rev-parse", "--short=12", "HEAD") + (" + changes" if git("status", "--porcelain") else "")


@lru_cache
def revision(*modules: str) -> str:
    """Hash of the source files of modules or packages: cells that name it are computed again when the code changes.

    Args:
        modules: dotted names, such as "coopoc.methods".

    Raises:
        InputError: no such module.

    >>> len(revision("coopoc.world", "coopoc.errors"))
    20
    """
    sha = hashlib.sha256()
    for module in modules:
        spec = importlib.util.find_spec(module)
        if spec is None or spec.origin is None:
            raise InputError("module", repr(module), "must be importable from source", "Give its dotted name.")
        folders = spec.submodule_search_locations
        files = [Path(spec.origin)] if folders is None else sorted(p for f in folders for p in Path(f).rglob("*.py"))
        for file in files:
            sha.update(file.name.encode() + file.read_bytes())
    return sha.hexdigest()[:20]


def code_of(function: Callable[..., Any]) -> str:
    """Hash of a function's source and of all that it names in its own package, functions, classes and constants.

    Comments, docstrings and layout do not count, nor does what nothing in the cell names: tables, figures, captions.
    Other packages count by the names that are used, not by their contents.

    >>> len(code_of(code_of))
    20
    >>> code_of(textwrap.dedent) == code_of(textwrap.fill)  # of Python itself nothing counts
    True
    >>> code_of(eval("lambda: 2")) == code_of(eval("lambda: 3"))  # no file, as in a shell
    False
    """
    texts: set[str] = set()
    _reach(function, texts, [])
    return hashlib.sha256("\n".join(sorted(texts)).encode()).hexdigest()[:20]


def _reach(thing: Any, texts: set[str], visited: list[Any]) -> None:
    """Add the text of a value and of what it names: source of functions and classes, contents of constants."""
    if isinstance(thing, functools.partial):
        thing = [thing.func, thing.args, thing.keywords]
    if callable(thing):
        thing = inspect.unwrap(thing)
    if isinstance(thing, str | int | float | bool | None | bytes):
        texts.add(repr(thing))
    elif not any(thing is other for other in visited):
        visited.append(thing)
        if isinstance(thing, Mapping):
            thing = list(thing.items())
        if isinstance(thing, list | tuple | set | frozenset):
            for each in thing:
                _reach(each, texts, visited)
        elif isinstance(thing, np.ndarray):
            texts.add(repr(thing.tolist()))
        elif isinstance(thing, FunctionType | type):
            for each in _named(thing, texts):
                _reach(each, texts, visited)
        elif not isinstance(thing, ModuleType):
            _reach([type(thing), {} if callable(thing) else getattr(thing, "__dict__", {})], texts, visited)


def _named(thing: FunctionType | type, texts: set[str]) -> Iterator[Any]:
    """What a function or a class names in its package, after its own source was added; nothing without source."""
    module = sys.modules.get(thing.__module__)
    package = getattr(module, "__package__", "") or thing.__module__
    if module is None or package.partition(".")[0] in sys.stdlib_module_names:
        return
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(thing)))
    except (OSError, TypeError, SyntaxError):  # no file, as in a shell, or a lambda within an expression
        if isinstance(thing, type):
            yield from vars(thing).values()
            return
        tree = ast.Module([], [])
        for code in _codes(thing.__code__):
            constants = [each for each in code.co_consts if not isinstance(each, CodeType)]
            texts.add(f"{thing.__qualname__} {code.co_code!r} {code.co_names} {constants}")
            tree.body += [ast.Expr(ast.Name(name)) for name in (*code.co_names, *code.co_freevars)]
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(node):
            node.body = node.body[1:] or [ast.Pass()]
    texts.add(ast.unparse(tree))
    names = dict(vars(module))
    if isinstance(thing, FunctionType):
        names |= inspect.getclosurevars(thing).nonlocals

    def within(name: str) -> bool:
        return f"{name}.".startswith(f"{package}.")

    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            home = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            if within(home):
                source = importlib.import_module(home)
                names |= {alias.asname or alias.name: getattr(source, alias.name, None) for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = names.get(node.value.id)
            if isinstance(owner, ModuleType) and within(owner.__name__):
                yield getattr(owner, node.attr, None)
        elif isinstance(node, ast.Name) and node.id in names:
            value = names[node.id]
            home = getattr(value, "__module__", None) or package
            yield value if within(home) else f"{home}.{getattr(value, '__qualname__', '')}"


def _codes(code: CodeType) -> list[CodeType]:
    """Byte code of a function, and of the functions within it."""
    return [code, *(inner for each in code.co_consts if isinstance(each, CodeType) for inner in _codes(each))]


def _processor() -> str:
    with suppress(OSError):
        if model := re.search(r"^model name\s*:(.+)", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return f"{model[1].strip()}, {os.cpu_count()} cores"
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
