"""A bar on stderr for loops that last: steps so far and the cost that they have reached."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

DELAY = 2.0
"""s before the bar is shown: most solves are over by then, and a bar takes longer to make than a small one."""


@contextmanager
def progress(name: str) -> Iterator[Callable[[float], None]]:
    """A function that counts a step and takes its cost.

    >>> with progress("solve") as step:
    ...     step(1.5)
    """
    began, count, bars = perf_counter(), 0, list[Any]()

    def step(cost: float) -> None:
        nonlocal count
        count += 1
        if not bars and perf_counter() - began > DELAY:
            from tqdm import tqdm

            bars.append(tqdm(desc=name, unit=" steps", initial=count - 1))
        for bar in bars:
            bar.set_postfix_str(f"cost {cost:.6g}", refresh=False)
            bar.update()

    try:
        yield step
    finally:
        for bar in bars:
            bar.close()
