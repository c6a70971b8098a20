"""What the benchmarks share: time of this thread, medians of interleaved rounds, and a call without the kernels."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from coopoc.kernels.compile import SWITCH


def timed(call: Callable[[], Any]) -> float:
    """Seconds of this thread."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


def medians(spend: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Of what each of them says it has spent, one after the other in every round."""
    spent = [[each() for each in spend.values()] for _ in range(rounds)]
    return dict(zip(spend, np.median(spent, axis=0).tolist(), strict=True))


def plain(call: Callable[[], Any]) -> Any:
    """The call in NumPy."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "numpy"
    try:
        return call()
    finally:
        os.environ.pop(SWITCH)
        if before is not None:
            os.environ[SWITCH] = before
