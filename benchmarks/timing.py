"""What the benchmarks share: time of this thread, medians of interleaved rounds, the table of a report."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from tabulate import tabulate


def timed(call: Callable[[], Any]) -> float:
    """Seconds of this thread."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


def medians(spend: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Medians of the reported times, taken one after the other in every round."""
    spent = [[each() for each in spend.values()] for _ in range(rounds)]
    return dict(zip(spend, np.median(spent, axis=0).tolist(), strict=True))


def rows_of(job: str, spent: Mapping[str, float], peer: str, right: Mapping[str, bool | None]) -> list[dict[str, Any]]:
    """Rows of a report from seconds by name: each with its ratio to the peer's."""
    return [
        {"name": job + name, "us": 1e6 * s, "ratio": s / spent[peer], "right": right[name]} for name, s in spent.items()
    ]


def report(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table: microseconds, the ratio to the row that each is compared with, whether its answer is right."""
    verdict = {True: "yes", False: "NO", None: "by another way"}
    lines = [[row["name"], row["us"], row["ratio"], verdict[row["right"]]] for row in rows]
    return tabulate(lines, ["", "us", "ratio", "right"], tablefmt="github", floatfmt=("", ".4g", ".3g", ""))
