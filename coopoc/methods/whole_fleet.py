"""What the whole-fleet methods share: each vehicle's own filter between exchanges, late answers, bytes, the Track."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from ..arrays import Bools, Floats
from ..world.exchange import Exchange
from ..world.recording import Recording
from .kalman import solo_filter
from .knowledge import Knowledge
from .network import Network, network
from .star import sighting_noise
from .track import Method, Track

Solve = Callable[[Exchange], tuple[Floats, Floats | None]]
"""Contacts -> positions (R, T, N, 3) m of all vehicles and covariances (R, T, N, 3, 3) m^2 or None."""
Cooperate = Callable[[Network], tuple[Floats, Floats]]
"""A step's network -> positions (R, n, 3) m and covariances (R, n, 3, 3) m^2 after the exchange."""


def fleet_track(
    method: Method, recording: Recording, egos: Sequence[int | str], contacts: Callable[[], Exchange], solve: Solve,
    notes: tuple[str, ...] = (),
) -> Track:  # fmt: skip
    """Track of the egos, their bytes counted.

    Raises:
        InputError: an ego that is unknown or absent at times; a recording that not all vehicles observed.
    """
    began = time.perf_counter()
    columns = recording.columns(egos)
    recording.require_complete()
    met = contacts()
    x, cov = solve(met)
    return Track(
        recording.t, tuple(columns), x[:, :, columns], None if cov is None else cov[:, :, columns],
        met.received_bytes[:, columns], met.sent_bytes[:, columns], time.perf_counter() - began, notes=notes,
    )  # fmt: skip


def follow_fleet(
    method: Method, recording: Recording, contacts: Exchange, known: Knowledge, cooperate: Cooperate,
    carry_own: bool = True,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Positions (R, T, N, 3) and covariances (R, T, N, 3, 3) of vehicles that each keep a belief of themselves only.

    Each predicts with its velocity and takes its own fix; then those in contact cooperate. The mean that comes out goes
    on to the next step, with the covariance that the vehicle's own filter has without any neighbour: what neighbours
    say step after step is correlated, and a vehicle that keeps no cross-covariances may not count it again as new.

    Args:
        cooperate: its covariances are claimed for the step. carry_own: False carries them on, too, as if independent.
    """
    shape = (recording.runs, len(recording.t), len(recording.ids), 3)
    x, cov = np.full(shape, np.nan), np.full((*shape, 3), np.nan)
    process = np.broadcast_to(known.process_variance(recording), shape)
    carried = cov[:, 0].copy()
    for t in tqdm(range(shape[1]), desc=method.name, unit="step", delay=2.0):
        if t:
            x[:, t], carried = own_step(x[:, t - 1], carried, recording, t, process[:, t], known)
        joins = np.isnan(x[0, t, :, 0])
        x[:, t, joins], carried[:, joins] = recording.gnss[:, t, joins], np.diag(known.gnss_variance)
        graph = network(recording, contacts, t, x[:, t], carried, known)
        cov[:, t] = carried
        if len(graph.first):
            x[:, t, graph.here], cov[:, t, graph.here] = cooperate(graph)
        carried = carried if carry_own else cov[:, t].copy()
    return x, cov


def follow_compiled(
    recording: Recording, contacts: Exchange, known: Knowledge, rounds: int, damping: float = 0.0, rho: float = 0.0
) -> tuple[Floats, Floats]:
    """What `follow_fleet` finds of belief propagation, or with rho > 0 of ADMM, from compiled code."""
    from ..kernels.gossip import follow

    through = contacts.to_first & contacts.to_second
    x, cov = follow(*contact_arrays(recording, contacts, known, through), int(rounds), float(damping), float(rho))
    return x, cov


def contact_arrays(recording: Recording, contacts: Exchange, known: Knowledge, alive: Bools) -> tuple[Any, Any, Any]:
    """The tuples `measured`, `contacts` and `assumed` of `coopoc.kernels.gossip`; `alive` (R, P) are pairs to count."""
    from ..kernels.sighting import unfolded

    numbers = (contacts.first, contacts.second, contacts.sight, contacts.sight_back, contacts.start)
    pairs = (*(np.ascontiguousarray(n, dtype=np.int64) for n in numbers), alive)
    seen = unfolded(recording.relative, np.arange(len(recording.links)))
    variance = np.ascontiguousarray(known.process_variance(recording))
    assumed = (variance, known.gnss_variance, *sighting_noise(known))
    return (recording.gnss, recording.velocity, seen, recording.dt), pairs, assumed


def own_step(
    x: Floats, cov: Floats, recording: Recording, t: int | slice, process: Floats, known: Knowledge
) -> tuple[Floats, Floats]:
    """One Kalman step of each vehicle alone: x += dt u, P += q; K = P (P + R)^-1; x += K (z - x), Joseph's P.

    Args:
        x: (R, ..., N, 3) m. cov: (R, ..., N, 3, 3) m^2. t: step, or the steps of a leading time axis.
        process: (R, ..., N, 3) m^2.
    """
    x = x + recording.dt * recording.velocity[:, t]
    cov = cov + process[..., None] * np.eye(3)
    gain = cov @ np.linalg.inv(cov + np.diag(known.gnss_variance))
    keep = np.eye(3) - gain
    cov = keep @ cov @ np.swapaxes(keep, -1, -2) + (gain * known.gnss_variance) @ np.swapaxes(gain, -1, -2)
    return x + (gain @ (recording.gnss[:, t] - x)[..., None])[..., 0], cov


def brought_forward(
    x: Floats, cov: Floats, recording: Recording, known: Knowledge, delay: int
) -> tuple[Floats, Floats]:
    """What each vehicle believes now if the fleet's answer of each step comes `delay` steps late.

    The answer of step t - delay takes the vehicle's own steps since then: what it measured itself is never late. Before
    the first answer, and where a vehicle was absent at the time of the answer, it goes on alone.
    """
    if not delay:
        return x, cov
    steps = x.shape[1]
    process = np.broadcast_to(known.process_variance(recording), x.shape)
    now, variance = solo_filter(recording.gnss, recording.velocity, process, known.gnss_variance, recording.dt)
    now_cov = variance[..., None] * np.eye(3)
    for k in range(1, min(delay, steps) + 1):
        x, cov = own_step(x[:, : steps - k], cov[:, : steps - k], recording, slice(k, steps), process[:, k:], known)
    met = np.isfinite(x).all(axis=-1)
    now[:, delay:][met], now_cov[:, delay:][met] = x[met], cov[met]
    return now, now_cov
