"""Resources of training: one core per process, a line of the terminal to report on."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch

from coopoc.errors import InputError, shown
from coopoc.workers import progress_bar

Item = TypeVar("Item")
LINE = ContextVar("line", default=0)
"""Of the terminal, for bars: processes side by side do not draw over each other."""


@contextmanager
def one_core() -> Iterator[None]:
    """One torch thread inside, the caller's number afterwards.

    The matrices of a rollout are too small to share: a second thread mostly waits, and on a busy machine it makes a
    step ten times slower. One thread also adds in one order, so weights do not depend on the machine's cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def watched(items: Iterable[Item], name: str | None, unit: str, total: int | None = None) -> Iterator[Item]:
    """The items, with a bar of that name on stderr; None: without."""
    if not isinstance(name, str | None):
        raise InputError("progress", shown(name), "must be the name of a stage", "Give None for no bar.")
    return iter(progress_bar(items, desc=name, unit=unit, total=total, disable=name is None, position=LINE.get()))
