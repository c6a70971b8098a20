"""How kernels are compiled: machine code at the first call, kept on disk, no interpreter's lock."""

import gc
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

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
    return cast(Function, _made(function, set(), inline="always"))


USUAL_SECONDS: dict[str, float] = json.loads((Path(__file__).parent / "usual_seconds.json").read_text("utf-8"))
"""CPU seconds that a kernel took to compile where `benchmarks/compile.py` was run, of those above a second."""
QUIET_SECONDS = 2.0
"""s of compiling after which a line on stderr reports it."""
PLAIN = "COOPOC_PLAIN_NJIT"
"""Environment variable: 1 compiles by numba's public interface alone."""
kernels: list[Any] = []
"""Every compiled function of the modules that are imported, in order."""
seconds: dict[str, float] = {}
"""CPU seconds that kernels took to compile in this process."""


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
        timers: list[threading.Timer] = []  # noqa: RUF012
        collects = True
        began = used = 0.0

        def on_start(self, event: Any) -> None:
            self.timers.append(threading.Timer(QUIET_SECONDS, _say, [_line(event.data["dispatcher"].py_func)]))
            if len(self.timers) == 1:
                self.began, self.used = clock(), time.process_time()
                self.timers[0].daemon = True
                self.timers[0].start()
                self.collects = gc.isenabled()
                gc.disable()

        def on_end(self, event: Any) -> None:
            self.timers.pop().cancel()
            if not self.timers:
                seconds[_name(event.data["dispatcher"].py_func)] = time.process_time() - self.used
                _hold_bars(took := clock() - self.began)
                spent.compile += took
            if self.collects and not self.timers:
                gc.enable()

    event.register("numba:compile", Watcher())


def _name(function: Any) -> str:
    return f"{function.__module__}.{function.__qualname__}"


def _line(function: Any) -> str:
    """What is said of a kernel that compiles for more than QUIET_SECONDS."""
    usual = USUAL_SECONDS.get(_name(function), 0.0)
    title = function.__module__.rpartition(".")[2].replace("_", " ")
    often = f", usually {usual:.0f} s on an idle core" if usual > QUIET_SECONDS else ""
    return f"compiling the {title} kernel, once per machine{often}"


def _bars() -> list[Any]:
    """Progress bars that are open."""
    tqdm = getattr(sys.modules.get("tqdm"), "tqdm", None)
    return list(getattr(tqdm, "_instances", ()))


def _say(line: str) -> None:
    """Print a line to stderr, above a progress bar that is shown."""
    if shown := [bar for bar in _bars() if bar.last_print_t > bar.start_t]:
        shown[0].write(line, file=sys.stderr)
    else:
        print(line, file=sys.stderr)


def _hold_bars(seconds: float) -> None:
    """Take the time of compiling out of the progress bars that were open meanwhile."""
    for bar in _bars():
        bar.start_t, bar.last_print_t = bar.start_t + seconds, bar.last_print_t + seconds


def _made(function: Function, liberties: set[str], part: bool = False, **options: Any) -> Any:
    with waiting("load"):
        import numba

        _watch()
    if hooks := _hooks():
        options["pipeline_class"] = hooks[0].Part if part else hooks[0].Kernel
        if part:
            options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}
    return numba.njit(nogil=True, error_model="numpy", fastmath=liberties, **options)(function)


def _within(function: Function, liberties: set[str], **options: bool) -> Function:
    made = _made(function, liberties, True, **options)
    if hooks := _hooks():
        hooks[0].for_any_number(made)
    return cast(Function, made)


def _kept(function: Function, liberties: set[str]) -> Function:
    made = _made(function, liberties)
    if not getattr(sys.modules.get(function.__module__), "__file__", None):  # typed in: there is no source to go by
        return cast(Function, made)
    if hooks := _hooks():
        made._cache = hooks[1].MachineCode(function)
        kernels.append(made)
    else:
        with suppress(
            RuntimeError
        ):  # neither the source's folder nor the user's can be written: every process compiles
            made.enable_caching()
    return cast(Function, made)
