"""Processes: workers end with the process that started them; bars show progress."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any


@lru_cache
def leave_with(parent: int) -> None:
    """End this process when its parent ends. Ctrl-C is left to the parent, and a killed parent leaves no orphan.

    Args:
        parent: process id.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    if os.getppid() == parent:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=watch, daemon=True).start()


@lru_cache
def _blas() -> Any:
    """What limits the threads of BLAS; compiled code calls SciPy's."""
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


_LOCK = threading.Lock()
_limits: list[Any] = []
"""Of the contexts that are open; the first one knows what was before."""


@contextmanager
def one_thread() -> Iterator[None]:
    """A context in which BLAS does not share a matrix among threads, which wait for one another: where another process
    has one of two cores, 180 rows take 80 times as long as alone. The last of several to be left restores what was.

    >>> import numpy as np
    >>> with one_thread():
    ...     np.linalg.inv(np.diag([2.0]))
    array([[0.5]])
    """
    with _LOCK:
        _limits.append(_blas().limit(limits=1))
    try:
        yield
    finally:
        with _LOCK:
            first = _limits.pop()
            if not _limits:
                first.restore_original_limits()


def say(message: object) -> None:
    """Print a message to stderr, beside the result on stdout."""
    print(f"coopoc: {message}", file=sys.stderr)


LINE_SECONDS = 60.0
"""s between two lines of a bar where stderr is no terminal."""


class _Lines:
    """stderr without what moves a cursor: a line for each state of a bar."""

    def write(self, text: str) -> None:
        if line := text.replace("\x1b[A", "").strip("\r\n "):
            print(line, file=sys.stderr)


def progress_bar(*args: Any, **options: Any) -> Any:
    """A bar of tqdm on stderr; where that is no terminal, as of a batch job, a line a minute.

    Args:
        args: of tqdm.
        options: of tqdm.

    >>> list(progress_bar(range(2)))
    [0, 1]
    """
    from tqdm import tqdm

    if not sys.stderr.isatty():
        options |= {"file": _Lines(), "mininterval": LINE_SECONDS, "maxinterval": LINE_SECONDS, "delay": LINE_SECONDS}
    return tqdm(*args, **options)
