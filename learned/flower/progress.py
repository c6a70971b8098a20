"""Progress of a deployed federation on disk: written after each round, read by a restarted server."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch

from coopoc.errors import InputError

from .. import checkpoint
from ..federation.rule import State
from ..recipes import REVISION, Job
from .rows import Row

FIELDS = ("number", "training_loss", "validation_loss", "pieces", "rejected", "absent", "note")
"""Fields of a row that JSON holds as they are."""


class Progress(NamedTuple):
    """All that the server carries from round to round: rows, the last of them without its validation losses, the state
    of the rule, and the usual change of the guard."""

    rows: tuple[Row, ...]
    state: State
    usual: float | None


def write(path: Path, job: Job, progress: Progress) -> None:
    """Write a progress file; a reader sees the old file or the new one whole."""
    tensors = {"weights": torch.stack([row.weights for row in progress.rows])}
    tensors |= {f"state{i}": part.contiguous() for i, part in enumerate(progress.state)}
    rows = [
        {name: getattr(row, name) for name in FIELDS} | {"traffic": [[*way, n] for way, n in row.traffic.items()]}
        for row in progress.rows
    ]
    card = {"job": _facts(job), "rows": rows, "usual": progress.usual}
    checkpoint.write(path, tensors, card)


def read(path: Path, job: Job) -> Progress | None:
    """The progress of the same job, or None if there is no file.

    Raises:
        InputError: a file of another job, or one that is damaged.
    """
    if not path.is_file():
        return None
    hint = "Delete it to start anew, or name another `out`."
    try:
        tensors, card = checkpoint.read(path)
        given, weights = card["job"], tensors.pop("weights")
        ways = [{(sender, receiver): n for sender, receiver, n in row.pop("traffic")} for row in card["rows"]]
        rows = [Row(weights=w, traffic=t, **r) for w, t, r in zip(weights, ways, card["rows"], strict=True)]
        state = tuple(tensors[f"state{i}"] for i in range(len(tensors)))
        progress = Progress(tuple(rows), state, card["usual"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("progress", path, f"cannot be read ({type(error).__name__})", hint) from error
    if given != _facts(job):
        raise InputError("progress", path, "must be of the same recipe and setting", hint)
    return progress


def _facts(job: Job) -> Any:
    """All that changes the weights, the drives aside, as JSON has it."""
    facts = {"recipe": asdict(job.recipe), "setting": asdict(job.setting), "revision": REVISION}
    return json.loads(json.dumps(facts | {"torch": torch.__version__}))
