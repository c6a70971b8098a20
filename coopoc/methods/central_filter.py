"""The whole-fleet Kalman filter: one state of all vehicles, at a centre that hears every one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from ..arrays import Floats, Ints
from ..kernels.compile import use_kernels
from ..world.exchange import Exchange, exchange
from ..world.recording import Recording
from ..world.v2x import NO_MESSAGE, Message
from .knowledge import Knowledge, resolve
from .network import information, network, present
from .star import FORGOTTEN, rows
from .track import Track
from .whole_fleet import brought_forward, contact_arrays, fleet_track

UPLOAD = Message("fix, velocity and sightings", 8, per_neighbour=4)
"""To the centre: fix (3), velocity (3), id and time (2); range, two angles and id for each vehicle that is seen."""
ANSWER = Message("estimate and covariance", 11)
"""From the centre: position (3), covariance (6), id and time (2)."""
CALL = 20
"""Steps of one call of compiled code."""
CENTRE = "needs a centre that hears every vehicle; loss and delay act on sightings only, a cap on bytes on nothing"


@dataclass(frozen=True, eq=False)
class CentralFilter:
    """Kalman filter of all vehicles in information form, causal: what no filter of the same measurements can beat.

    Lambda = P^-1 + blkdiag(GNSS^-1) + B blkdiag(W_e) B^T over every pair e of the fleet, B its incidence matrix and W_e
    the information of range and angles, linearised where prediction and sighting agree (`network`): to four digits the
    accuracy of a converted update followed by an exact Gauss-Newton step, at one solution a step. Cost O(n^3) of the n
    vehicles that ever had to do with each other, over others or at other steps: between the rest, covariances are zero.

    A sighting reaches the centre if a message gets through between the two vehicles, either way. Bytes are those of the
    way to the centre and back.

    Args:
        knowledge: "identity", "nominal" or a Knowledge.
    """

    knowledge: Knowledge | str = "nominal"
    name: str = "central-filter"
    cooperative: bool = True
    message: Message = UPLOAD

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""
        known = resolve(self.knowledge, recording)

        def solve(contacts: Exchange) -> tuple[Floats, Floats]:
            x, cov = (_compiled if use_kernels() else _filter)(recording, contacts, known, self.name)
            return brought_forward(x, cov, recording, known, contacts.delay)

        return fleet_track(self, recording, egos, lambda: centre(recording, self.message), solve, (CENTRE,))


def centre(recording: Recording, upload: Message) -> Exchange:
    """Contacts as over the channel, with the bytes of every vehicle's `upload` to a centre and of its answer."""
    links, overhead, there = recording.links, recording.v2x.overhead, present(recording)
    seen = np.zeros(there.shape, dtype=np.int64)
    np.add.at(seen, (links.step, links.observer), 1)
    sent = (there * upload.size(overhead, seen)).sum(axis=0, dtype=float)
    received = there.sum(axis=0) * float(ANSWER.size(overhead))
    each = np.ones((recording.runs, 1))
    return replace(exchange(recording, NO_MESSAGE), sent_bytes=each * sent, received_bytes=each * received)


def staying(before: Ints, here: Ints) -> tuple[Ints, Ints]:
    """Places in `here` (sorted columns) of those who were there `before` (sorted columns), and their places in it.

    >>> staying(np.array([1, 4, 6]), np.array([0, 4, 6]))
    (array([1, 2]), array([1, 2]))
    """
    places = np.flatnonzero(np.isin(here, before))
    return places, np.searchsorted(before, here[places])


def _compiled(recording: Recording, contacts: Exchange, known: Knowledge, name: str) -> tuple[Floats, Floats]:
    """What `_filter` finds, island by island from compiled code; runs of one covariance share it."""
    from ..kernels.central import begin, follow

    measured, pairs, assumed = contact_arrays(recording, contacts, known, contacts.to_first | contacts.to_second)
    there, most = present(recording), int(np.diff(contacts.start).max(initial=0))
    there = np.concatenate([np.zeros_like(there[:1]), there])
    runs, steps, vehicles = recording.gnss.shape[:3]
    x, cov = np.full_like(recording.gnss, np.nan), np.full((*recording.gnss.shape, 3), np.nan)
    alike = known.sensors is None and len(assumed[0]) == 1 and bool((pairs[-1] == pairs[-1][:1]).all())
    together = runs if alike else 1
    with tqdm(total=runs * steps, desc=name, unit="step", delay=2.0) as bar:
        for run in range(0, runs, together):
            own = begin(vehicles, most, together)
            for t in range(0, steps, CALL):
                end = min(t + CALL, steps)
                follow(measured, pairs, (*assumed, FORGOTTEN), there, *own, (run, together), (t, end), x, cov)
                bar.update(together * (end - t))
    return x, cov


def _filter(recording: Recording, contacts: Exchange, known: Knowledge, name: str) -> tuple[Floats, Floats]:
    """Positions (R, T, N, 3) and covariances (R, T, N, 3, 3), NaN where a vehicle is absent."""
    there = present(recording)
    x, cov = np.full_like(recording.gnss, np.nan), np.full((*recording.gnss.shape, 3), np.nan)
    process = np.broadcast_to(known.process_variance(recording), x.shape)
    spread: Floats = np.empty((recording.runs, 0, 0))
    before = np.array([], dtype=np.int64)
    for t in tqdm(range(len(there)), desc=name, unit="step", delay=2.0):
        here = np.flatnonzero(there[t])
        stays, old = staying(before, here)
        x[:, t, here] = recording.gnss[:, t, here]
        columns = here[stays]
        x[:, t, columns] = x[:, t - 1, columns] + recording.dt * recording.velocity[:, t, columns]
        predicted = _grown(spread, len(here), stays, old, process[:, t, columns])
        x[:, t, here], spread = _update(recording, contacts, known, t, x[:, t], predicted, stays)
        cov[:, t, here] = own_blocks(spread)
        before = here
    return x, cov


def _grown(spread: Floats, n: int, stays: Ints, old: Ints, process: Floats) -> Floats:
    """Predicted covariance (R, 3n, 3n) of the vehicles of a step: nothing is known of those who join."""
    out = np.repeat(FORGOTTEN * np.eye(3 * n)[None], len(spread), axis=0)
    here, there = rows(stays), rows(old)
    out[:, here[:, None], here] = spread[:, there[:, None], there]
    out[:, here, here] += process.reshape(len(process), -1)
    return out


def _update(
    recording: Recording, contacts: Exchange, known: Knowledge, t: int, predicted: Floats, spread: Floats, stays: Ints
) -> tuple[Floats, Floats]:  # fmt: skip
    """Positions (R, n, 3) and their covariance (R, 3n, 3n) after the fixes and sightings of step t.

    Args:
        predicted: (R, N, 3) m, of all columns. spread: (R, 3n, 3n) m^2 of those present.
    """
    columns = np.flatnonzero(np.isfinite(predicted[0, :, 0]))
    runs, n = len(predicted), len(columns)
    place = np.searchsorted(columns, np.arange(predicted.shape[1]))
    span = slice(contacts.start[t], contacts.start[t + 1])
    cov = np.full((*predicted.shape, 3), np.nan)
    cov[:, columns] = own_blocks(spread)
    blocks = spread.reshape(runs, n, 3, n, 3)
    shared = np.moveaxis(blocks[:, place[contacts.first[span]], :, place[contacts.second[span]]], 0, 1)
    graph = network(recording, contacts, t, predicted, cov, known, shared + np.swapaxes(shared, -1, -2))
    alive = (graph.to_first | graph.to_second)[..., None]
    total, pull = information(n, graph.first, graph.second, graph.weight * alive[..., None], graph.pull * alive)
    kept = rows(stays)
    total[:, kept[:, None], kept] += np.linalg.inv(spread[:, kept[:, None], kept])
    total[:, np.arange(3 * n), np.arange(3 * n)] += np.tile(1.0 / known.gnss_variance, n)
    gap = (recording.gnss[:, t, columns] - graph.x) / known.gnss_variance
    after = np.linalg.inv(total)
    moved = after @ (pull + gap.reshape(runs, 3 * n))[..., None]
    return graph.x + moved.reshape(runs, n, 3), after


def own_blocks(spread: Floats) -> Floats:
    """(R, n, 3, 3) diagonal blocks of (R, 3n, 3n)."""
    n = spread.shape[1] // 3
    i = np.arange(n)
    return np.moveaxis(spread.reshape(len(spread), n, 3, n, 3)[:, i, :, i], 0, 1)
