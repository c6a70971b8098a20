"""Machine code on disk: compiled once per machine, found again by the content of its sources."""

import hashlib
import re
import sys
from collections.abc import Callable
from contextlib import suppress
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
IMPORT = re.compile(r"^ *from (\.*[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
LOCATORS = (UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator)


class MachineCode:
    """The machine code of one function, kept from an earlier process. Numba's cache protocol.

    A key is the types of the arguments, the processor, the function's byte code, and the options that change the code;
    the index holds the digest of all sources that the code was made of (`stamp`). So folders can be copied, and nothing
    depends on the time of a file. Files that cannot be read count as absent.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.locator = function, _locator(function)
        name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")
        version, path = ".py{}{}".format(*sys.version_info), self.cache_path
        self.file: Any = path and IndexDataCacheFile(path, name + version, stamp(function))

    @property
    def cache_path(self) -> str | None:
        """Folder of what is compiled here; None if neither the source's nor the user's can be written."""
        path: str | None = self.locator and self.locator.get_cache_path()
        return path

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Compiled function for the types of a signature, or None."""
        with waiting("load"):
            context.refresh()
            try:
                data = self.file and self.file.load(self._key(signature, context.codegen()))
                return data and CompileResult._rebuild(context, *data)
            except Exception:  # a damaged file, or types that were renamed: any error of pickle or LLVM
                return None

    def save_overload(self, signature: Any, made: Any) -> None:
        """Keep what was compiled here, but what refers to addresses of this process."""
        if not self.file or made.library.has_dynamic_globals:
            return
        code, *rest = made._reduce()
        rest[5] = ""  # numba's listing of types, which names folders
        key = self._key(signature, made.codegen)
        with suppress(OSError):  # a full disk: the next process compiles again
            try:
                self.file.save(key, (code, *rest))
            except Exception:  # the index that is there cannot be read
                self.flush()
                self.file.save(key, (code, *rest))

    def flush(self) -> None:
        """Forget what was compiled here."""
        if self.file:
            self.file.flush()

    def _key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        code = hashlib.sha256(self.function.__code__.co_code).hexdigest()
        config: Any = numba.config
        options = bool(config.BOUNDSCHECK), config.OPT == 3, bool(config.DEBUGINFO_DEFAULT)
        return signature, codegen.magic_tuple(), code, options


def _locator(function: Any) -> Any:
    file = str(_file(function.__module__))
    locators = (locator.from_function(function, file) for locator in LOCATORS)  # type: ignore[no-untyped-call]
    return next((locator for locator in locators if locator is not None), None)


def stamp(function: Callable[..., Any]) -> str:
    """Digest of every source whose change makes a function's machine code stale, and of what compiles it."""
    compiler = sys.version_info[:2], numba.__version__, llvmlite.__version__, llvm.get_process_triple()
    digest = hashlib.sha256(repr(compiler).encode())
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
