"""The rounds of a deployed federation as the server saw them, and the checkpoint that it makes of them."""

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
from ..recipes import Job, sensors
from .job import net
from .wire import Report


@dataclass(frozen=True, eq=False)
class Row:
    """A round: `history.Round` with losses m^2, and pieces, by the names of the clients that were heard."""

    number: int
    weights: Tensor
    training_loss: Mapping[str, float] = field(default_factory=dict)
    validation_loss: Mapping[str, float] = field(default_factory=dict)
    pieces: Mapping[str, int] = field(default_factory=dict)
    traffic: Mapping[tuple[str, str], int] = field(default_factory=dict)
    rejected: Mapping[str, str] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    note: str = ""

    def judged(self, reports: Mapping[str, Report], traffic: Mapping[tuple[str, str], int]) -> Row:
        """With what the clients say of its weights, and the bytes of asking them if that was for no other reason."""
        moved = {way: self.traffic.get(way, 0) + traffic.get(way, 0) for way in {**self.traffic, **traffic}}
        return replace(self, validation_loss={name: told.validation_loss for name, told in reports.items()},
                       pieces={name: told.pieces for name, told in reports.items()}, traffic=moved)  # fmt: skip


def federation(rows: Sequence[Row], job: Job, seconds: float) -> Federation:
    """The rounds as `federate` gives them: clients in the order of their names, and what each last reported."""
    sizes = {name: count for row in rows for name, count in row.pieces.items()}
    names, last, history = sorted(sizes), dict.fromkeys(sizes, math.nan), list[Round]()
    for row in rows:
        last |= row.validation_loss
        training = tuple(row.training_loss.get(name, math.nan) for name in names)
        history.append(Round(row.number, row.weights, training, tuple(last[name] for name in names), row.traffic,
                             row.rejected, row.absent, {}, row.note))  # fmt: skip
    made = Federation(net(job), tuple(history), tuple(sizes[name] for name in names), seconds, tuple(names))
    return replace(made, model=made.after(made.best.number))


def checkpoint(rows: Sequence[Row], job: Job, seconds: float) -> Checkpoint:
    """The weights that validated best, those of every round, and a card that says that Flower made them."""
    made = federation(rows, job, seconds)
    card: dict[str, Any] = {
        "recipe": job.name, "settings": asdict(job.recipe) | asdict(job.setting), "noise": asdict(sensors(job.setting)),
        "client": None, "clients": list(made.names), "training_pieces": list(made.sizes),
        "history": [_entry(row) for row in made.history], "best": made.best.number, "seconds": seconds,
        "engine": f"flower {version('flwr')}",
    }  # fmt: skip
    return Checkpoint(made.model, card, torch.stack([row.weights for row in made.history]))


def line(row: Row) -> str:
    """A round in one line, for people."""
    total = sum(row.pieces.values())
    mean = sum(row.pieces[name] * loss for name, loss in row.validation_loss.items()) / total if total else math.nan
    missing = "".join(f"; {name}: {reason}" for name, reason in {**row.rejected, **row.absent}.items())
    return f"round {row.number}: validation {mean:.4f} m^2 over {len(row.validation_loss)} clients{missing} {row.note}"


def _entry(row: Round) -> dict[str, Any]:
    return {"round": row.number, "training_loss": row.training_loss, "validation_loss": row.validation_loss,
            "sent_bytes": row.sent_bytes, "received_bytes": row.received_bytes, "rejected": dict(row.rejected),
            "absent": dict(row.absent), "note": row.note}  # fmt: skip
