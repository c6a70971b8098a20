"""How kernels are compiled: machine code at the first call, kept on disk, no interpreter's lock."""

import gc
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any, TypeVar

from .waiting import clock, spent, waiting

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
    return _made(function, set(), inline="always")  # type: ignore[no-any-return]


QUIET_SECONDS = 2.0
"""s of compiling after which a line on stderr reports it."""
PLAIN = "COOPOC_PLAIN_NJIT"
"""Environment variable: 1 compiles by numba's public interface alone."""


@cache
def _hooks() -> Any:
    """The module of private hooks, or None: it is switched off, or numba has changed."""
    if os.environ.get(PLAIN) == "1":
        return None
    try:
        from . import machine_code, pipeline
    except (ImportError, AttributeError):
        return None
    return pipeline, machine_code


@cache
def _watch() -> None:
    """Collect no garbage while a kernel compiles, a tenth of the time, and report it after QUIET_SECONDS."""
    from numba.core import event

    class Watcher(event.Listener):
        timer: threading.Timer
        depth, collects, began = 0, True, 0.0

        def on_start(self, event: Any) -> None:
            if self.depth == 0:
                title = event.data["dispatcher"].py_func.__module__.rpartition(".")[2].replace("_", " ")
                line = f"compiling the {title} kernel, once per machine"
                self.timer = threading.Timer(QUIET_SECONDS, print, [line], {"file": sys.stderr})
                self.timer.daemon = True
                self.timer.start()
                self.began, self.collects = clock(), gc.isenabled()
                gc.disable()
            self.depth += 1

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                self.timer.cancel()
                spent.compile += clock() - self.began
                if self.collects:
                    gc.enable()

    event.register("numba:compile", Watcher())


def _made(function: Function, liberties: set[str], part: bool = False, **options: Any) -> Any:
    with waiting("load"):
        import numba

        _watch()
    if hooks := _hooks():
        options |= {"pipeline_class": hooks[0].Part if part else hooks[0].Kernel, "no_cfunc_wrapper": True}
        if part:
            options |= {"no_cpython_wrapper": True, "_nrt": False}
    return numba.njit(nogil=True, error_model="numpy", fastmath=liberties, **options)(function)


def _within(function: Function, liberties: set[str], **options: bool) -> Function:
    made = _made(function, liberties, True, **options)
    if hooks := _hooks():
        hooks[0].for_any_number(made)
    return made  # type: ignore[no-any-return]


def _kept(function: Function, liberties: set[str]) -> Function:
    made = _made(function, liberties)
    if not getattr(sys.modules.get(function.__module__), "__file__", None):  # typed in: there is no source to go by
        return made  # type: ignore[no-any-return]
    if hooks := _hooks():
        made._cache = hooks[1].MachineCode(function)
    else:
        with suppress(
            RuntimeError
        ):  # neither the source's folder nor the user's can be written: every process compiles
            made.enable_caching()
    return made  # type: ignore[no-any-return]
