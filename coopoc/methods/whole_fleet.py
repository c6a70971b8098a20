"""Methods of a centre that has the whole fleet: arguments of their kernels, bytes, the Track."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..arrays import Bools, Floats
from ..kernels.compiling.waiting import clock
from ..world.exchange import Exchange, exchange
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import Message
from .doubts import doubts
from .kalman import fix_noise, solo_filter
from .noise_model import NoiseModel, resolve
from .track import Method, Track

if TYPE_CHECKING:
    from ..kernels.fleets.graph import Assumed, Measured, Pairs

UPLOAD = Message("fix, velocity and relative measurements", 8, per_neighbour=4)
"""To the centre: fix (3), velocity (3), id and time (2); range, two angles and id for each vehicle that is measured."""
DOWNLOAD = Message("estimate and covariance", 11)
"""From the centre: position (3), covariance (6), id and time (2)."""
CENTRE = (
    "needs a centre that every vehicle reaches, at once: loss acts on relative measurements only, delay and a byte cap "
    "on nothing"
)


NEAREST = 0.1
"""Share of a range's standard deviation: angles are no more certain than at this distance, whatever the sensors'
`min_range`. In one place they would weigh so much that all digits are lost."""


class Answer(NamedTuple):
    """Estimates of the fleet at each step.

    Attributes:
        x: (R, T, N, 3) m of all vehicles.
        covariance: (R, T, N, 3, 3) m^2.
        notes: of the Track.
    """

    x: Floats
    covariance: Floats
    notes: tuple[str, ...] = ()


class Moved(NamedTuple):
    """Bytes (R, N) that each vehicle receives and sends over the drive."""

    received_bytes: Floats
    sent_bytes: Floats


def fleet_track(
    method: Method,
    noise_model: NoiseModel | str,
    robust: bool,
    recording: Recording,
    egos: Vehicles,
    solve: Callable[[Measured, Pairs, Assumed, NoiseModel], Answer],
) -> Track:
    """Track of the egos from the whole fleet's estimates.

    Args:
        method: whose Track it is.
        noise_model: as the method was given it.
        robust: gate innovations.
        recording: observed by all vehicles.
        egos: columns or ids.
        solve: the method's kernel.

    Raises:
        InputError: an ego that is unknown, absent at times or without a fix at first; a recording that not all vehicles
            observed.
    """
    began = clock()
    columns = check_recording(recording).columns(egos)
    model = resolve(noise_model, recording)
    met = exchange(recording)
    measured, pairs, assumed = kernel_arguments(recording, met, model, robust)
    answer = solve(measured, pairs, assumed, model)
    x, cov = answer.x.take(columns, axis=2), answer.covariance.take(columns, axis=2)
    moved = centre(recording, method.message)
    return Track(
        recording.t,
        tuple(columns),
        x,
        cov,
        moved.received_bytes[:, columns],
        moved.sent_bytes[:, columns],
        clock() - began,
        notes=model.notes + answer.notes + doubts(recording, columns, x, cov, model),
        ids=recording.ids,
    )


def centre(recording: Recording, upload: Message) -> Moved:
    """Bytes over the drive of every vehicle's `upload` to a centre, and of its answers."""
    links, overhead, present = recording.links, recording.v2x.overhead, np.isfinite(recording.velocity[0, :, :, 0])
    measured = np.zeros(present.shape, dtype=np.int64)
    np.add.at(measured, (links.step, links.observer), 1)
    sent = (present * upload.size(overhead, measured)).sum(axis=0, dtype=float)
    received = present.sum(axis=0) * float(DOWNLOAD.size(overhead))
    runs = np.ones((recording.runs, 1))
    return Moved(runs * received, runs * sent)


def kernel_arguments(
    recording: Recording, met: Exchange, model: NoiseModel, robust: bool
) -> tuple[Measured, Pairs, Assumed]:
    """Arguments of the kernels by name; a pair takes part if its messages arrive and both vehicles are active."""
    from ..kernels.fleets.graph import Assumed, Measured, Pairs
    from ..kernels.geometry import components

    active = located(recording)
    both = active[:, met.step, met.first] & active[:, met.step, met.second]
    columns = (met.first, met.second, met.link, met.link_back, met.start)
    first, second, link, link_back, start = (np.ascontiguousarray(column, dtype=np.int64) for column in columns)
    pairs = Pairs(first, second, link, link_back, start, np.ascontiguousarray(both & (met.arrival >= 0)))
    relative = components(recording.usable_relative, np.arange(len(recording.links)))
    relative = np.concatenate([relative, np.ones((*relative.shape[:2], 3))], axis=2)
    process, fix = model.process_variance(recording), model.fix_variance(recording)
    if robust := robust and model.exact_relative:
        vehicles = range(len(recording.ids))
        fix = fix / model.gnss_variance * solo_filter(recording, vehicles, model, fix_noise(model, robust))[2]
    process, fix = (np.ascontiguousarray(variance, dtype=float) for variance in (process, fix))
    std: Floats = np.zeros(0)
    sensors, min_range = model.sensors, 0.0
    if sensors is not None:
        std, min_range = sensors.relative_std, max(sensors.min_range, NEAREST * sensors.relative_std[0])
    measured = Measured(recording.gnss, recording.velocity, relative, active, recording.dt)
    return measured, pairs, Assumed(process, fix, std, min_range, robust)


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
    return present & (fix >= joined)
