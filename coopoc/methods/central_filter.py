"""The whole-fleet Kalman filter: one state of all vehicles, at a centre that every one of them can reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from ..world.exchange import Exchange, exchange
from ..world.recording import Recording, check_recording
from ..world.v2x import NO_MESSAGE, Message
from .noise_model import NoiseModel
from .options import check_options
from .track import Track
from .whole_fleet import Answer, fleet_track

if TYPE_CHECKING:
    from ..kernels.fleets.fleet_graph import Assumed, Measured, Pairs

UPLOAD = Message("fix, velocity and relative measurements", 8, per_neighbour=4)
"""To the centre: fix (3), velocity (3), id and time (2); range, two angles and id for each vehicle that is measured."""
ANSWER = Message("estimate and covariance", 11)
"""From the centre: position (3), covariance (6), id and time (2)."""
CALL = 20
"""Steps of one call of compiled code."""
CENTRE = (
    "needs a centre that every vehicle reaches; loss and delay act on relative measurements only, a byte cap on neither"
)
BEARINGS = (
    "most ranges are missing: bearings alone are taken at believed distances, whose errors they share, and covariances "
    "are too small; joint and the batch smoother hold"
)


@dataclass(frozen=True, eq=False)
class CentralFilter:
    """Kalman filter of all vehicles in information form, causal: the optimum of the same measurements.

    Lambda = P^-1 + blkdiag(GNSS^-1) + B blkdiag(W_e) B^T over every pair e of the fleet, B its incidence matrix and W_e
    the information of range and angles, linearised where prediction and measurement agree: to four digits the
    accuracy of a converted update followed by an exact Gauss-Newton step, at one solution a step. Cost O(n^3) of the n
    vehicles of a connected component, over others or at earlier steps: between components, covariances are zero.

    A relative measurement reaches the centre if a message gets through between the two vehicles, either way. Bytes are
    those of the way to the centre and back.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
    """

    noise_model: NoiseModel | str = "nominal"
    name: str = "central-filter"
    cooperative: bool = True
    message: Message = UPLOAD

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.central import begin, follow

            runs, steps, vehicles = measured.active.shape
            x, cov = np.full(measured.gnss.shape, np.nan), np.full((*measured.gnss.shape, 3), np.nan)
            most, together = int(np.diff(pairs.start).max()), runs if share_covariance(measured, pairs, assumed) else 1
            with tqdm(total=runs * steps, desc=self.name, unit="step", delay=2.0) as bar:
                for run in range(0, runs, together):
                    memory = begin(vehicles, most, together)
                    for t in range(0, steps, CALL):
                        span = t, min(t + CALL, steps)
                        follow(measured, pairs, assumed, memory, (run, together), span, (x, cov))
                        bar.update(together * (span[1] - t))
            return Answer(x, cov, None, notes)

        relative = check_recording(recording).relative[0]
        alone = np.isnan(relative[:, 0]) & np.isfinite(relative[:, 1])
        notes = (CENTRE, BEARINGS) if 2 * alone.sum() > len(alone) else (CENTRE,)
        met = lambda: centre(recording, self.message)  # noqa: E731
        return fleet_track(self, self.noise_model, recording, egos, met, solve, both_ways=False)


def share_covariance(measured: Measured, pairs: Pairs, assumed: Assumed) -> bool:
    """Whether the covariance is the same in all runs: unit noise, and the same measurements and messages."""
    constant = len(assumed.std) == 0 and len(assumed.process) == len(assumed.fix) == 1
    if not constant or (measured.relative[..., 0] < 0).any() or (measured.relative[..., 1:] == 0).any():
        return False
    alike = (measured.active, pairs.alive, np.isnan(measured.gnss))
    return all(bool((each == each[:1]).all()) for each in alike)


def centre(recording: Recording, upload: Message) -> Exchange:
    """Contacts as over the channel, with the bytes of every vehicle's `upload` to a centre and of its answer."""
    links, overhead, there = recording.links, recording.v2x.overhead, np.isfinite(recording.velocity[0, :, :, 0])
    seen = np.zeros(there.shape, dtype=np.int64)
    np.add.at(seen, (links.step, links.observer), 1)
    sent = (there * upload.size(overhead, seen)).sum(axis=0, dtype=float)
    received = there.sum(axis=0) * float(ANSWER.size(overhead))
    each = np.ones((recording.runs, 1))
    return replace(exchange(recording, NO_MESSAGE), sent_bytes=each * sent, received_bytes=each * received)
