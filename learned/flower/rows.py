"""The rounds of a deployed federation at the server, and their checkpoint."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any

import torch
from torch import Tensor

from ..checkpoint import Checkpoint
from ..federation.history import Federation, Round
from ..recipes import Job, sensors, untrained
from .wire import Report


@dataclass(frozen=True, eq=False)
class Row:
    """A round: `history.Round` with losses m^2, and pieces, by the names of the clients that answered."""

    number: int
    weights: Tensor
    training_loss: Mapping[str, float] = field(default_factory=dict)
    validation_loss: Mapping[str, float] = field(default_factory=dict)
    pieces: Mapping[str, int] = field(default_factory=dict)
    traffic: Mapping[tuple[str, str], int] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    note: str = ""

    def validated(self, reports: Mapping[str, Report], traffic: Mapping[tuple[str, str], int]) -> Row:
        """With the clients' validation losses of its weights, and the bytes of a question for these alone."""
        moved = {way: self.traffic.get(way, 0) + traffic.get(way, 0) for way in {**self.traffic, **traffic}}
        return replace(
            self,
            validation_loss={name: report.validation_loss for name, report in reports.items()},
            pieces={name: report.pieces for name, report in reports.items()},
            traffic=moved,
        )


def federation(rows: Sequence[Row], job: Job, seconds: float) -> Federation:
    """The rounds as `federate` gives them: clients in the order of their names, and the last report of each."""
    sizes = {name: count for row in rows for name, count in row.pieces.items()}
    names, last, history = sorted(sizes), dict.fromkeys(sizes, math.nan), list[Round]()
    for row in rows:
        last |= row.validation_loss
        training = tuple(row.training_loss.get(name, math.nan) for name in names)
        history.append(
            Round(
                row.number,
                row.weights,
                training,
                tuple(last[name] for name in names),
                row.traffic,
                row.rejected,
                row.absent,
                {},
                row.note,
            )
        )
    made = Federation(untrained(job), tuple(history), tuple(sizes[name] for name in names), seconds, tuple(names))
    return replace(made, model=made.after(made.best.number))


def checkpoint(rows: Sequence[Row], job: Job, seconds: float) -> Checkpoint:
    """The selected weights, those of every round, and a card that names Flower as the engine."""
    made = federation(rows, job, seconds)
    card: dict[str, Any] = {
        "recipe": job.name,
        "settings": asdict(job.recipe) | asdict(job.setting),
        "noise": asdict(sensors(job.setting)),
        "client": None,
        "clients": list(made.names),
        "training_pieces": list(made.sizes),
        "history": [row.card for row in made.history],
        "best": made.best.number,
        "seconds": seconds,
        "engine": f"flower {version('flwr')}",
    }
    return Checkpoint(made.model, card, torch.stack([row.weights for row in made.history]))


def line(row: Row) -> str:
    """A round in one line of text."""
    total = sum(row.pieces.values())
    mean = sum(row.pieces[name] * loss for name, loss in row.validation_loss.items()) / total if total else math.nan
    missing = "".join(f"; {name}: {reason}" for name, reason in {**row.rejected, **row.absent}.items())
    return f"round {row.number}: validation {mean:.4f} m^2 over {len(row.validation_loss)} clients{missing} {row.note}"
