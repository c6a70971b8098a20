"""Provenance of results: versions and processor, the git revision, and hashes of the source code that cells run."""

import ast
import functools
import hashlib
import importlib.util
import os
import pickletools
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

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
    """Hash of the text of a function's file and of the files that it imports: of what is installed, those of the
    function's own package only.

    Comments and layout do not count, nor functions and values whose names stand in nothing that counts: tables,
    figures, captions. Of a function that no file names, as a partial or one of a shell, its pickle counts, too.

    >>> len(code_of(code_of))
    20
    >>> code_of(eval("lambda: 2")) == code_of(eval("lambda: 3"))
    False
    """
    inner = function.func if isinstance(function, functools.partial) else function
    home, name = getattr(inner, "__module__", None) or "", getattr(function, "__qualname__", "")
    module, contents = sys.modules.get(home), [("", name)]
    if not hasattr(module, "__file__") or getattr(module, name, None) is not function:
        from joblib.externals.loky.backend.reduction import dumps  # 30 ms, and workers get it so

        contents = [(code.name, part) for code, part, _ in pickletools.genops(bytes(dumps(function)))]
    words = {home, "", "__getattr__", *(part for _, part in contents if isinstance(part, str))}
    package = getattr(module, "__package__", "") or home
    if not package.startswith("coopoc."):
        package = package.partition(".")[0]
    modules, before = words & sys.modules.keys(), 0
    statements = cache(lambda name: _statements(name, package, words, modules))
    while before < (before := len(words) + len(modules)):
        kept = [each for name in sorted(modules) for each in statements(name) if _counts(each, words)]
    return hashlib.sha256(f"{contents}{ast.unparse(ast.Module(kept, []))}".encode()).hexdigest()[:20]


def _statements(name: str, package: str, words: set[str], modules: set[str]) -> list[ast.stmt]:
    """Statements of a module; its strings and what it imports join the words and modules. None of one that is installed
    beside the package."""
    base = name.partition(".")[0]
    with suppress(ImportError, ValueError, OSError, SyntaxError, TypeError):  # no module, or no text
        if not f"{name}.".startswith(f"{package}.") and (
            base in {*sys.stdlib_module_names, "coopoc"}
            or re.search(r"[/\\](site|dist)-packages\b", str(importlib.util.find_spec(base)))
        ):
            return []
        found = sys.modules.get(name) or importlib.util.find_spec(name)
        file = Path(getattr(found, "__file__", getattr(found, "origin", "")))
        tree, above = ast.parse(file.read_bytes()), name.rpartition(".")[0]
        modules.add(above)
        for node in ast.walk(tree):
            match node:
                case ast.Constant(str(word)):
                    words.add(word)
                case ast.Import(names) | ast.ImportFrom(names=names):
                    relative = "." * getattr(node, "level", 0) + (getattr(node, "module", "") or "")
                    home = importlib.util.resolve_name(relative, name if file.stem == "__init__" else above)
                    modules |= {home, *(f"{home}.{alias.name}".strip(".") for alias in names)}
        return tree.body
    return []


def _counts(statement: ast.stmt, words: set[str]) -> bool:
    """Whether one of the words names what a statement binds, or it may do more; then its own words join them."""
    match statement:
        case ast.FunctionDef(name, decorator_list=[]):
            bound = {name}
        case ast.Assign(targets):
            bound = {getattr(target, "id", "") for target in targets}
        case _:
            bound = {""}
    if not bound & words:
        return False
    for node in ast.walk(statement):
        match node:
            case ast.Name(word) | ast.Attribute(attr=word) | ast.alias(word, str()):
                words.add(word)
    return True


def _processor() -> str:
    with suppress(OSError):
        if model := re.search(r"^model name\s*:(.+)", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return f"{model[1].strip()}, {os.cpu_count()} cores"
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
