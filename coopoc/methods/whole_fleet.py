"""The loop of the whole-fleet methods: arrays by name for the kernels, answers that come late, bytes, the Track."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..world.exchange import Exchange
from ..world.recording import Recording, check_recording
from .contradiction import contradicted
from .noise_model import NoiseModel, resolve
from .track import Method, Track

if TYPE_CHECKING:
    from ..kernels.fleets.fleet_graph import Assumed, Measured, Pairs


class Answer(NamedTuple):
    """Estimates of the fleet at each step.

    Attributes:
        x: (R, T, N, 3) m of all vehicles, of any shape.
        covariance: (R, T, N, 3, 3) m^2, of any shape, or None.
        rounds: of messages a step, None if an answer needs all vehicles that pairs connect, 0 if it is never late.
        notes: of the Track.
    """

    x: Floats
    covariance: Floats | None
    rounds: int | None
    notes: tuple[str, ...] = ()


Solve = Callable[["Measured", "Pairs", "Assumed"], Answer]


def fleet_track(
    method: Method,
    noise_model: NoiseModel | str,
    recording: Recording,
    egos: Sequence[int | str],
    contacts: Callable[[], Exchange],
    solve: Solve,
    *,
    both_ways: bool = True,
) -> Track:
    """Track of the egos from the whole fleet's estimates.

    Args:
        method: whose Track it is.
        noise_model: as the method was given it.
        recording: observed by all vehicles.
        egos: columns or ids.
        contacts: makes the pairs in contact.
        solve: the method's kernel.
        both_ways: whether a pair takes part only if the messages of both ways arrive, or if either does.

    Raises:
        InputError: an ego that is unknown, absent at times or without a fix at first; a recording that not all vehicles
            observed.
    """
    from ..kernels.fleets.answers import bring_forward, dead_reckon, newest

    began = time.perf_counter()
    columns = check_recording(recording).columns(egos, missing=True)
    met, known = contacts(), resolve(noise_model, recording)
    arrival = met.both if both_ways else met.either
    measured, pairs, assumed = kernel_arguments(recording, met, known, arrival)
    found = solve(measured, pairs, assumed)
    shape = (recording.runs, len(recording.t), len(columns))
    x = found.x.reshape(recording.gnss.shape).take(columns, axis=2)
    cov = None if found.covariance is None else found.covariance.reshape(*recording.gnss.shape[:3], 9).take(columns, 2)
    if found.rounds != 0 and (arrival > met.step).any():
        rounds = len(recording.ids) if found.rounds is None else found.rounds
        ready = np.where(pairs.alive, arrival, -1)
        held = newest(pairs.first, pairs.second, pairs.start, ready, len(recording.ids), rounds).take(columns, axis=2)
        own = measured._replace(gnss=measured.gnss.take(columns, 2), velocity=measured.velocity.take(columns, 2))
        if cov is None:
            x = dead_reckon(held, x, own)
        else:
            process, fix = (_columns(values, columns) for values in (assumed.process, assumed.fix))
            x, cov = (values.reshape(*shape[:2], -1) for values in (x, cov))
            x, cov = bring_forward(held, x, cov, own, assumed._replace(process=process, fix=fix))
    x, cov = x.reshape(*shape, 3), None if cov is None else cov.reshape(*shape, 3, 3)
    received, sent, seconds = met.received_bytes[:, columns], met.sent_bytes[:, columns], time.perf_counter() - began
    return Track(
        recording.t,
        tuple(columns),
        x,
        cov,
        received,
        sent,
        seconds,
        notes=known.notes + found.notes + contradicted(x, recording, columns),
    )


def kernel_arguments(
    recording: Recording, met: Exchange, known: NoiseModel, arrival: Ints
) -> tuple[Measured, Pairs, Assumed]:
    """Arguments of the kernels by name; a pair takes part if its messages arrive and both vehicles are active."""
    from ..kernels.fleets.fleet_graph import Assumed, Measured, Pairs
    from ..kernels.stars.relative import components

    active = located(recording)
    both = active[:, met.step, met.first] & active[:, met.step, met.second]
    alive = np.ascontiguousarray(both & (arrival >= 0))
    columns = (met.first, met.second, met.link, met.link_back, met.start)
    first, second, link, link_back, start = (np.ascontiguousarray(column, dtype=np.int64) for column in columns)
    pairs = Pairs(first, second, link, link_back, start, alive)
    relative = components(recording.relative, np.arange(len(recording.links)))
    variances = known.process_variance(recording), known.fix_variance(recording)
    process, fix = (np.ascontiguousarray(each, dtype=float) for each in variances)
    sensors = known.sensors
    std, min_range = (sensors.relative_std, sensors.min_range) if sensors else (np.zeros(0), 0.0)
    assumed = Assumed(process, fix, std, min_range)
    return Measured(recording.gnss, recording.velocity, relative, active, recording.dt), pairs, assumed


def located(recording: Recording) -> Bools:
    """(R, T, N) True from a vehicle's first fix on, for as long as it is present.

    A vehicle that has no fix yet has no position to linearise at: until then it takes no part.
    """
    present = np.isfinite(recording.velocity[0, :, :, 0])
    if recording.complete:
        return np.tile(present, (recording.runs, 1, 1))
    step = np.arange(len(present))[:, None]
    before = np.concatenate([np.zeros_like(present[:1]), present[:-1]])
    joined = np.maximum.accumulate(np.where(present & ~before, step, -1))
    fix = np.maximum.accumulate(np.where(np.isfinite(recording.gnss).all(axis=-1), step, -1), axis=1)
    return np.asarray(present & (fix >= joined))


def _columns(values: Floats, columns: Sequence[int]) -> Floats:
    return values.take(columns, axis=2) if values.shape[2] > 1 else values
