"""How kernels are compiled: machine code at the first call, kept on disk, no interpreter's lock."""

from __future__ import annotations

import gc
import os
import re
import sys
import threading
from collections.abc import Callable
from functools import cache, partial
from importlib.util import resolve_name
from pathlib import Path
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compiled at the first call. A product and a sum may become one instruction; nothing is reordered.

    The machine code is kept beside the source, or in the user's cache where that is read-only. It holds what it calls:
    it is made anew after a change of the function's file, or of a file of the kernels or of its own folder that it
    imports, directly or through others.
    """
    return _kept(function, {"contract"})


def as_written(function: Function) -> Function:
    """Compiled, each product and sum rounded as it stands, so that numbers and vectors of them get the same digits."""
    return _kept(function, set())


def part(function: Function) -> Function:
    """Compiled as `compiled` is, for compiled callers only, and kept in their machine code.

    References to arrays are not counted within: the caller holds them. So it allocates nothing and returns no
    array; counting every array of every NamedTuple would take longer than the sums, and to compile. It raises nothing:
    callers look for no exception, but under NUMBA_BOUNDSCHECK=1.
    """
    return _within(function, {"contract"})


def summing(function: Function) -> Function:
    """A part that adds many terms: it may do so in several sums, in one way for all arguments."""
    return _within(function, {"contract", "reassoc"})


def inner(function: Function) -> Function:
    """A part, rounded as `as_written` is."""
    return _within(function, set())


def inside(function: Function) -> Function:
    """As `inner`, and copied into the caller: a call would hand over every number that describes an array, which
    takes longer than to read three of its elements."""
    return _within(function, set(), forceinline=True)


def storage(function: Function) -> Function:
    """A function that allocates arrays or returns views of them, typed as if its lines stood in its caller."""
    return cast(Function, _made(function, set(), inline="always"))


KERNELS = Path(__file__).resolve().parents[1]
IMPORT = re.compile(r"^from (\.*[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
PATIENCE = 2.0
"""s of compiling after which a line on stderr reports it."""
PLAIN = "COOPOC_PLAIN_NJIT"
"""Environment variable: 1 compiles by numba's public interface alone."""


@cache
def _hooks() -> Any:
    """The module of private hooks, or None: it is switched off, or numba has changed."""
    if os.environ.get(PLAIN) == "1":
        return None
    try:
        from . import pipeline
    except (ImportError, AttributeError):
        return None
    return pipeline


@cache
def _watch() -> None:
    """While a kernel compiles collect no garbage, which a tenth of the time would go to; report it after PATIENCE."""
    from numba.core import event

    class Watcher(event.Listener):
        timers: list[threading.Timer] = []  # noqa: RUF012
        collects = True

        def on_start(self, event: Any) -> None:
            name = event.data["dispatcher"].py_func.__module__.rpartition(".")[2].replace("_", " ")
            line = f"compiling the {name} kernel, once per machine\n"
            self.timers.append(threading.Timer(PATIENCE, sys.stderr.write, [line]))
            if len(self.timers) == 1:
                self.timers[0].daemon = True
                self.timers[0].start()
                self.collects = gc.isenabled()
                gc.disable()

        def on_end(self, event: Any) -> None:
            self.timers.pop().cancel()
            if self.collects and not self.timers:
                gc.enable()

    event.register("numba:compile", Watcher())


def _made(function: Function, liberties: set[str], part: bool = False, **options: Any) -> Any:
    import numba

    _watch()
    if hooks := _hooks():
        options["pipeline_class"] = hooks.Part if part else hooks.Kernel
        if part:
            options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}
    return numba.njit(nogil=True, error_model="numpy", fastmath=liberties, **options)(function)


def _within(function: Function, liberties: set[str], **options: bool) -> Function:
    return cast(Function, _made(function, liberties, True, **options))


def _kept(function: Function, liberties: set[str]) -> Function:
    made = _made(function, liberties)
    try:
        made.enable_caching()
    except RuntimeError:  # neither the source's folder nor the user's can be written: every process compiles
        return cast(Function, made)
    if _hooks():
        file = made._cache._cache_file
        file._source_stamp = _stamp(function.__module__)
        file._load_index = partial(_index_or_none, file._load_index)
    return cast(Function, made)


def _index_or_none(load: Callable[[], Any]) -> Any:
    """What is on disk; nothing if it names types that have been renamed since."""
    try:
        return load()
    except (ImportError, AttributeError):
        return {}


@cache
def _stamp(module: str) -> tuple[tuple[str, int, int], ...]:
    """Name, time and size of every file whose change makes the machine code of a module stale."""
    names, new = {module}, {module}
    while new := {other for name in new for other in _imported(name)} - names:
        names |= new
    files = [_file(name) for name in sorted(names)]
    return tuple((file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in files)


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
