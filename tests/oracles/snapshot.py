"""The snapshot of a star: the window of one step."""

from __future__ import annotations

from typing import Any

from coopoc.methods.noise_model import NoiseModel
from coopoc.world.inbox import Inbox
from coopoc.world.recording import Recording
from oracles.window import window


def snapshot(recording: Recording, box: Inbox, known: NoiseModel, run: int, ego: int, step: int, x: Any) -> Any:
    """Minimum and covariance of one step from the points x."""
    return window(recording, box, known, run, ego, [step], x)
