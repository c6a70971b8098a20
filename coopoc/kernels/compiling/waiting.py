"""Time that goes to loading libraries and to compiling, kept apart from that of computing."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from time import perf_counter

spent = {"load": 0.0, "compile": 0.0}
"""s of this process: loading libraries and machine code, and compiling."""


def clock() -> float:
    """s of a clock that stands still while this process loads or compiles."""
    return perf_counter() - sum(spent.values())


@contextmanager
def waiting(kind: str) -> Iterator[None]:
    """Count what is done within as loading or compiling, once where it is nested."""
    began = clock()
    try:
        yield
    finally:
        spent[kind] += clock() - began


def load(*modules: str) -> None:
    """Import modules by name now, so that no computation waits for them."""
    with waiting("load"):
        for name in modules:
            import_module(name)
