"""Time that goes to loading libraries and to compiling, kept apart from that of computing."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from threading import local
from time import perf_counter


class _Spent(local):
    """s of this thread: loading libraries and machine code, and compiling. What other threads wait for is not ours."""

    load = compile = 0.0


spent = _Spent()


def clock() -> float:
    """s of a clock that stands still while this thread loads or compiles, and goes on while another does.

    >>> from threading import Thread
    >>> from time import sleep
    >>> began, other = clock(), Thread(target=waiting("load")(sleep), args=(0.05,))
    >>> other.start(), other.join(), clock() - began > 0.04
    (None, None, True)
    """
    return perf_counter() - spent.load - spent.compile


@contextmanager
def waiting(kind: str) -> Iterator[None]:
    """Count what is done within as loading or compiling, once where it is nested."""
    began = clock()
    try:
        yield
    finally:
        setattr(spent, kind, getattr(spent, kind) + clock() - began)


@cache
def load(*modules: str) -> None:
    """Import modules by name now, so that no computation waits for them."""
    with waiting("load"):
        for name in modules:
            import_module(name)
