"""Machine code on disk: shipped with the wheel or compiled here, found again by the content of its sources."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import date
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
from numba.core.caching import IndexDataCacheFile, InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
from numba.core.compiler import CompileResult

from .waiting import waiting

KERNELS = Path(__file__).resolve().parents[1]
SHIPPED = KERNELS / "shipped"
"""Folder of the machine code that a wheel holds; a clone has none."""
SHIPPED_CPU = "x86-64-v3"
SHIPPED_TARGET = ("x86_64-unknown-linux-gnu", SHIPPED_CPU, "")
"""LLVM's triple, processor and features, for which a wheel's kernels are compiled."""
NEEDED = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
"""Instructions of x86-64-v3; a processor without one compiles."""
IMPORT = re.compile(r"^from (\.*[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
LOCATORS = (UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator)


class MachineCode:
    """The machine code of one function: what a wheel ships, else what was compiled here. Numba's cache protocol.

    A key is the types of the arguments, the processor, the function's byte code, and the options that change the code;
    the index holds the digest of all sources that the code was made of (`stamp`). So folders can be copied, and nothing
    depends on the time of a file. Files that cannot be read count as absent.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.locator = function, _locator(function)
        self.name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")
        self.origin: str | None = None
        version = ".py{}{}".format(*sys.version_info)
        names = str(SHIPPED), self.cache_path
        self.files: list[Any] = [
            folder and IndexDataCacheFile(folder, self.name + version, stamp(function)) for folder in names
        ]

    @property
    def cache_path(self) -> str | None:
        """Folder of what is compiled here; None if neither the source's nor the user's can be written."""
        path: str | None = self.locator and self.locator.get_cache_path()
        return path

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Compiled function for the types of a signature, or None."""
        with waiting("load"):
            context.refresh()
            for origin, file, target in self._places(context.codegen()):
                try:
                    data = file.load(self._key(signature, target))
                    made = None if data is None else CompileResult._rebuild(context, *data)
                except Exception:  # a damaged file, or types that were renamed: any error of pickle or LLVM
                    continue
                if made is not None:
                    self.origin = origin
                    return made
        return None

    def save_overload(self, signature: Any, made: Any) -> None:
        """Keep what was compiled here, but what refers to addresses of this process."""
        self.origin = "compiled"
        if self.locator is None or made.library.has_dynamic_globals:
            return
        code, *rest = made._reduce()
        rest[5] = ""  # numba's listing of types, which names folders
        key = self._key(signature, made.codegen.magic_tuple())
        with suppress(OSError):  # a full disk: the next process compiles again
            try:
                self.files[1].save(key, (code, *rest))
            except Exception:  # the index that is there cannot be read
                self.flush()
                self.files[1].save(key, (code, *rest))

    def flush(self) -> None:
        """Forget what was compiled here."""
        if self.locator:
            self.files[1].flush()

    @property
    def kept(self) -> str:
        """What a process here finds: "shipped", "compiled here" with the day, or "not compiled yet"."""
        for origin, file, _ in self._places(None):
            try:
                if file._load_index():
                    day = date.fromtimestamp(Path(file._index_path).stat().st_mtime)
                    return origin if origin == "shipped" else f"compiled here, {day}"
            except Exception:  # as in `load_overload`
                continue
        return "not compiled yet"

    def _places(self, codegen: Any) -> Iterator[tuple[str, Any, Any]]:
        if not mismatch():
            yield "shipped", self.files[0], SHIPPED_TARGET
        if self.files[1]:
            yield "compiled", self.files[1], codegen and codegen.magic_tuple()

    def _key(self, signature: Any, target: Any) -> tuple[Any, ...]:
        code = hashlib.sha256(self.function.__code__.co_code).hexdigest()
        config: Any = numba.config
        return signature, target, code, (bool(config.BOUNDSCHECK), config.OPT == 3, bool(config.DEBUGINFO_DEFAULT))


def _locator(function: Any) -> Any:
    file = str(_file(function.__module__))
    locators = (locator.from_function(function, file) for locator in LOCATORS)  # type: ignore[no-untyped-call]
    return next((locator for locator in locators if locator is not None), None)


@cache
def mismatch() -> str:
    """Why this process cannot use what a wheel ships; "" if it can, "-" if there is nothing shipped."""
    try:
        about = json.loads((SHIPPED / "about.json").read_text())
    except (OSError, ValueError):
        return "-"
    here = versions()
    for name, version in about.items():
        if here.get(name) != version:
            return f"the wheel's machine code is for {name} {version}, this is {here.get(name)}"
    features = llvm.get_host_cpu_features()
    if lacking := [name for name in NEEDED if not features.get(name)]:
        return f"the wheel's machine code needs a processor with {', '.join(lacking)}"
    return ""


def versions() -> dict[str, str]:
    """What machine code depends on beside its sources and the processor."""
    python = "{}.{}".format(*sys.version_info)
    return {
        "python": python,
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "platform": llvm.get_process_triple(),
    }


def stamp(function: Callable[..., Any]) -> str:
    """Digest of every source whose change makes a function's machine code stale, and of what compiles it."""
    digest = hashlib.sha256(json.dumps(versions()).encode())
    for name in sorted(sources(function.__module__)):
        digest.update(f"{name} {_digest(_file(name))}\n".encode())
    return digest.hexdigest()


@cache
def sources(module: str) -> frozenset[str]:
    """A module, and those of the kernels and of its own folder that it imports, directly or through others."""
    names, new = {module}, {module}
    while new := {other for name in new for other in _imported(name)} - names:
        names |= new
    return frozenset(names)


@cache
def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


@cache
def _imported(module: str) -> set[str]:
    """Modules of the kernels and of its own folder that a module imports at its top."""
    file, package = _file(module), sys.modules[module].__package__
    names = set()
    for base, parts in IMPORT.findall(file.read_text(encoding="utf-8")):
        base = resolve_name(base, package)
        names |= {base, *(f"{base}.{name}" for name in re.findall(r"\w+", parts))}
    files = {name: _file(name) for name in names if getattr(sys.modules.get(name), "__file__", None)}
    return {name for name, other in files.items() if other.parent == file.parent or KERNELS in other.parents}


def _file(module: str) -> Path:
    return Path(str(sys.modules[module].__file__)).resolve()
