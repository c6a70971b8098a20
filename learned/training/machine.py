"""Resources of training: one core per process, memory that it keeps, a line of the terminal to report on."""

import ctypes
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

import torch

from coopoc.errors import InputError, shown
from coopoc.workers import progress_bar

Item = TypeVar("Item")
LINE: ContextVar[int] = ContextVar("line", default=0)
"""Of the terminal, for bars: processes side by side do not draw over each other."""


@contextmanager
def one_core() -> Iterator[None]:
    """One torch thread inside, the caller's number afterwards.

    The matrices of a rollout are too small to share: a second thread mostly waits, and on a busy machine it makes a
    step ten times slower. One thread also adds in one order, so weights do not depend on the machine's cores.
    """
    _keep_freed_memory()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@cache
def _keep_freed_memory() -> None:
    """Let glibc keep what a rollout frees for the next one instead of returning it to the system.

    A training step allocates some hundred MB in small tensors; giving the pages back and faulting them in again was
    about half of its time. Where the allocator is not glibc's, nothing changes.
    """
    trim_threshold, mmap_threshold, most = -1, -3, 2**31 - 1
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(mmap_threshold, 32 * 2**20)
        mallopt(trim_threshold, most)


def watched(items: Iterable[Item], name: str | None, unit: str, total: int | None = None) -> Iterator[Item]:
    """The items, with a bar of that name on stderr; None: without."""
    if not isinstance(name, str | None):
        raise InputError("progress", shown(name), "must be the name of a stage", "Give None for no bar.")
    return iter(progress_bar(items, desc=name, unit=unit, total=total, disable=name is None, position=LINE.get()))
