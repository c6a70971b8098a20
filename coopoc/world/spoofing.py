"""Attack: a share of the vehicles broadcasts fixes that are off by a constant, as a spoofed or lying receiver does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import number
from ..errors import InputError
from .recording import Recording
from .sensors import stream

MOST = 1e9
"""m, no offset is larger."""


def spoofed(
    recording: Recording,
    share: float,
    low: float = 5.0,
    high: float = 40.0,
    seed: int = 0,
    honest: Sequence[int | str] = (),
) -> Recording:
    """The recording with the fixes of spoofed vehicles moved: gnss' = gnss + o, o ~ U(low, high) on each axis.

    In each run every vehicle that is not `honest` is spoofed with probability `share`, and keeps its offset for the
    whole drive. Both draws are keyed by (seed, run, id): a vehicle spoofed at 20 % is spoofed, by the same offset, at
    30 %, and no other noise changes. Velocities and relative measurements stay true. A spoofed vehicle reads
    its own false fix, too: name the egos among the honest ones.

    Args:
        recording: of an honest fleet.
        share: in [0, 1].
        low: m, least offset.
        high: m, largest offset.
        seed: of the attack.
        honest: columns or ids of egos that are never spoofed.

    Raises:
        InputError: a share outside [0, 1], low > high or not finite, seed < 0, an honest vehicle that is no ego.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> seen = observe(fleet, Sensors())
    >>> (spoofed(seen, 1.0, honest=["a"]).gnss - seen.gnss)[0, :, :, 0].round(1)
    array([[ 0. , 14.9],
           [ 0. , 14.9]])
    """
    share = number("share", share, 0, 1, allowed="in [0, 1]", hint="0.2 attacks every fifth vehicle.")
    low, high = (number("low, high", v, -MOST, MOST, allowed="finite", hint="Give metres.") for v in (low, high))
    if low > high:
        raise InputError("low, high", (low, high), "must be finite with low <= high", "Give metres per axis.")
    seed = number("seed", seed, kind=int, allowed=">= 0", hint="Any whole number from 0 on will do.")
    spared = recording.columns(honest) if np.size(honest) else []
    offset = np.zeros((recording.runs, len(recording.ids), 3))
    for run in range(recording.runs):
        for column, name in enumerate(recording.ids):
            draws = stream(seed, "attack", run, name)
            if draws.uniform() < share and column not in spared:
                offset[run, column] = draws.uniform(low, high, 3)
    note = f"{100 * share:g} % of the vehicles spoofed: fixes {low:g} to {high:g} m off on each axis"
    return replace(recording, gnss=recording.gnss + offset[:, None], notes=(*recording.notes, note))
