"""What crosses the wire: weights and a round number to a client; a name, a count, two losses and weights back."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from coopoc.errors import MissingLibraryError

if TYPE_CHECKING:
    from flwr.app import RecordDict

LONGEST = 200
"""Characters of a name or a reason that are read from an answer."""


@dataclass(frozen=True, eq=False)
class Report:
    """All that leaves a client: its name, how many pieces it trains on, the loss of the weights that it received on its
    own validation pieces, m^2; and, if it was asked to train, the weights (P,) that it made and its training loss, m^2.

    `broke` says why local training came to no end; then there are no weights.
    """

    name: str
    pieces: int
    validation_loss: float
    training_loss: float = math.nan
    weights: Tensor | None = None
    broke: str = ""


def require_flower(needed_for: str) -> None:
    """Import Flower with its telemetry off.

    Raises:
        MissingLibraryError: it is not installed.
    """
    os.environ.setdefault("FLWR_TELEMETRY_ENABLED", "0")
    try:
        import flwr.app  # noqa: F401
    except ImportError:
        raise MissingLibraryError("flwr", needed_for, "'coopoc[flower]'") from None


def question(theta: Tensor, number: int) -> RecordDict:
    """Content of the message that asks in round `number` with the weights theta (P,)."""
    from flwr.app import Array, ArrayRecord, ConfigRecord, RecordDict

    arrays = ArrayRecord({"theta": Array(theta.numpy())})
    return RecordDict({"arrays": arrays, "config": ConfigRecord({"server-round": number})})


def asked(content: RecordDict) -> tuple[Tensor, int]:
    """Weights (P,) and the number of the round in a question."""
    config: Any = content["config"]
    return _theta(content), int(config["server-round"])


def answer(report: Report) -> RecordDict:
    """Content of the message that answers, under the names that Flower's own strategies read."""
    from flwr.app import Array, ArrayRecord, ConfigRecord, MetricRecord, RecordDict

    metrics, client = MetricRecord({"num-examples": report.pieces}), ConfigRecord({"name": report.name})
    metrics["validation-loss"] = report.validation_loss
    content = RecordDict({"metrics": metrics, "client": client})
    if report.broke:
        client["broke"] = report.broke
    if report.weights is not None:
        metrics["training-loss"] = report.training_loss
        content["arrays"] = ArrayRecord({"theta": Array(report.weights.numpy())})
    return content


def reported(content: RecordDict) -> Report:
    """The report in an answer, which any client may have written; more than a report holds is not looked at.

    Raises:
        Exception: of any kind, if something is missing or is not what it should be.
    """
    numbers: Any = content["metrics"]
    words: Any = content["client"]
    pieces, broke = int(numbers["num-examples"]), str(words.get("broke", ""))[:LONGEST]
    if not 1 <= pieces < 2**31:
        raise ValueError("a number of pieces that cannot be")
    losses = float(numbers["validation-loss"]), float(numbers.get("training-loss", math.nan))
    weights = _theta(content) if "arrays" in content and not broke else None
    return Report(str(words["name"])[:LONGEST], pieces, *losses, weights, broke)


def size(content: RecordDict) -> int:
    """Bytes of a message's records, before Flower frames them."""
    return sum(record.count_bytes() for record in content.values())


def _theta(content: RecordDict) -> Tensor:
    arrays: Any = content["arrays"]
    theta = torch.from_numpy(arrays["theta"].numpy())
    if theta.dtype != torch.float32:
        raise TypeError(f"weights in {theta.dtype}")
    return theta
