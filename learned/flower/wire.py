"""Messages: weights and a round number to a client; name, size, losses and weights back."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from coopoc.errors import MissingLibraryError
from coopoc.escapes import visible

if TYPE_CHECKING:
    from flwr.app import RecordDict

LONGEST = 200
"""Characters of a name or a reason in an answer."""
LARGEST_LOSS = 1e12
"""m^2, the largest plausible loss: an error of 1,000 km."""


class MalformedAnswerError(ValueError):
    """An answer of a client that cannot be used; the text quotes no more of it than a number or a version."""


@dataclass(frozen=True, eq=False)
class Report:
    """The answer of a client; nothing else leaves it.

    Args:
        name: of the client.
        pieces: number of its training pieces.
        validation_loss: m^2, of the received weights on its own validation pieces.
        training_loss: m^2, if it trained.
        weights: (P,) after local training, if it trained.
        failure: reason why local training failed; then there are no weights.
    """

    name: str
    pieces: int
    validation_loss: float
    training_loss: float = math.nan
    weights: Tensor | None = None
    failure: str = ""


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
    """Content of the message of round `number` with the weights theta (P,)."""
    from flwr.app import Array, ArrayRecord, ConfigRecord, RecordDict

    arrays = ArrayRecord({"theta": Array(theta.numpy())})
    return RecordDict({"arrays": arrays, "config": ConfigRecord({"server-round": number})})


def asked(content: RecordDict) -> tuple[Tensor, int]:
    """Weights (P,) and the number of the round in a question."""
    config: Any = content["config"]
    return _theta(content), int(config["server-round"])


def answer(report: Report) -> RecordDict:
    """Content of the answering message, under the names that Flower's own strategies read."""
    from flwr.app import Array, ArrayRecord, ConfigRecord, MetricRecord, RecordDict

    metrics = MetricRecord({"num-examples": report.pieces})
    client = ConfigRecord({"name": report.name, "version": version("coopoc")})
    metrics["validation-loss"] = report.validation_loss
    content = RecordDict({"metrics": metrics, "client": client})
    if report.failure:
        client["failure"] = report.failure
    if report.weights is not None:
        metrics["training-loss"] = report.training_loss
        content["arrays"] = ArrayRecord({"theta": Array(report.weights.numpy())})
    return content


def reported(content: RecordDict) -> Report:
    """The report in an answer, validated; other contents are ignored.

    Raises:
        MalformedAnswerError: a name, a number or weights outside their range, or a client of another version.
        Exception: of any kind, if something is missing or of another type, as clients may send anything.
    """
    metrics: Any = content["metrics"]
    client: Any = content["client"]
    name, failure, pieces = client["name"], reason(client.get("failure", "")), metrics["num-examples"]
    if not (isinstance(name, str) and 0 < len(name) <= LONGEST and name.isprintable()):
        raise MalformedAnswerError(f"a name that is not 1 to {LONGEST} printable characters")
    if not (isinstance(pieces, int) and 1 <= pieces < 2**31):
        raise MalformedAnswerError("a number of pieces that is not in 1..2^31 - 1")
    if (theirs := client.get("version")) != version("coopoc"):
        given = theirs if isinstance(theirs, str) and re.fullmatch(r"[\w.+!-]{1,40}", theirs) else "an unknown version"
        raise MalformedAnswerError(f"made by coopoc {given}, the server has {version('coopoc')}: install the same")
    weights = _theta(content) if "arrays" in content and not failure else None
    training = math.nan if weights is None else _loss(metrics, "training-loss")
    return Report(name, pieces, _loss(metrics, "validation-loss"), training, weights, failure)


def reason(given: object) -> str:
    """What a client says went wrong, in one line that no terminal takes for a command.

    >>> reason("disk\\x1b[2J\\nround 9: done")
    'disk [2J round 9: done'
    """
    return visible(str(given)[:LONGEST])


def size(content: RecordDict) -> int:
    """Bytes of a message's records, without Flower's framing."""
    return sum(record.count_bytes() for record in content.values())


def _loss(metrics: Any, name: str) -> float:
    loss = float(metrics[name])
    if not 0 <= loss <= LARGEST_LOSS:
        raise MalformedAnswerError(f"a {name} of {loss:g} m^2, must be in [0, {LARGEST_LOSS:g}]")
    return loss


def _theta(content: RecordDict) -> Tensor:
    arrays: Any = content["arrays"]
    theta = torch.from_numpy(arrays["theta"].numpy())
    if theta.dtype != torch.float32:
        raise MalformedAnswerError(f"weights in {theta.dtype}, must be torch.float32")
    return theta
