"""What the benchmarks share: time of this thread, medians of interleaved rounds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def timed(call: Callable[[], Any]) -> float:
    """Seconds of this thread."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


def medians(spend: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Medians of the reported times, taken one after the other in every round."""
    spent = [[each() for each in spend.values()] for _ in range(rounds)]
    return dict(zip(spend, np.median(spent, axis=0).tolist(), strict=True))
