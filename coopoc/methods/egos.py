"""The loop of filters of a star: each ego opens its inbox, hands arguments to its kernel, and fills its Track."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from ..kernels.compiling.waiting import clock
from ..kernels.geometry import components
from ..kernels.stars.messages import ACCELERATION_STD, FIX_GROWTH, FORGOTTEN, Assumptions, Measurements
from ..workers import progress_bar
from ..world.inbox import Inbox, inbox
from ..world.recording import UNLIKELY, Recording, Vehicles, check_recording
from .doubts import doubts
from .noise_model import NoiseModel
from .track import Method, Track, needs_fix


class Estimate(NamedTuple):
    """One ego throughout: position (R, T, 3) m, covariance (R, T, 3, 3) m^2 and its neighbours (R, L, 3) m by link, NaN
    where it does not estimate them; or at one step or some, a slice: (R, 3), (R or 1, 3, 3), and the neighbours of its
    links there. Extras at all steps by name: (R, T, 1), or by link (R, k)."""

    x: Floats
    covariance: Floats
    neighbours: Floats
    step: int | slice = slice(None)
    links: Ints | None = None
    extras: Mapping[str, Floats] = MappingProxyType({})


def follow_egos(
    method: Method,
    recording: Recording,
    egos: Vehicles,
    follow: Callable[[int, Inbox], Iterable[Estimate]],
    notes: Sequence[str] = (),
) -> Track:
    """Track of the egos from what `follow(column, inbox)` yields, every step once in any order; bytes counted.

    Args:
        notes: of the Track; `follow` may add some.

    Raises:
        InputError: an ego that is unknown, no observer of this recording, absent at times, or without a first fix.
    """
    began = clock()
    columns = check_recording(recording).columns(egos, needs_fix(method))
    shape = (recording.runs, len(recording.t), len(columns), 3)
    x, cov = np.empty(shape), np.empty((*shape, 3))
    ends = np.cumsum([0, *(len(recording.links.of(ego)) for ego in columns)])
    neighbours = np.full((recording.runs, ends[-1], 3), np.nan)
    received, sent = np.zeros((2, recording.runs, len(columns)))
    extras: dict[str, list[Floats]] = {}
    with progress_bar(total=len(columns) * len(recording.t), desc=method.name, unit="step", delay=2.0) as bar:
        for e, ego in enumerate(columns):
            messages = inbox(recording, ego, method.message)
            received[:, e], sent[:, e] = messages.received_bytes, messages.sent_bytes
            if messages.newest.max(initial=-2) == -1 and method.message.numbers and not recording.landmarks:
                notes = (*notes, f"{UNLIKELY}{recording.ids[ego]} uses no message: all are lost, too many or too old")
            for result in follow(ego, messages):
                x[:, result.step, e], cov[:, result.step, e] = result.x, result.covariance
                here = slice(None) if result.links is None else np.searchsorted(messages.link, result.links)
                neighbours[:, ends[e] : ends[e + 1]][:, here] = result.neighbours
                for name, values in result.extras.items():
                    extras.setdefault(name, []).append(values)
                bar.update(1 if isinstance(result.step, int) else len(recording.t[result.step]))
    absent = np.logical_and.accumulate(np.isnan(x[..., 0]).any(0))  # a later NaN is an error
    notes = (*notes, *doubts(recording, columns, x, cov, getattr(method, "noise_model", "nominal"), neighbours, notes))
    for array in (x, cov, neighbours):
        array.flags.writeable = False  # so that the Track need not copy them
    seconds = clock() - began
    whole = {name: np.concatenate(values, -1) for name, values in extras.items()}
    late = absent if absent.any() and not needs_fix(method) else None
    counted = received, sent, seconds, neighbours, notes
    return Track(recording.t, tuple(columns), x, cov, *counted, extras=whole, ids=recording.ids, absent=late)


def filter_stars(
    method: Method,
    recording: Recording,
    egos: Vehicles,
    noise_model: NoiseModel,
    kernel: Callable[[Measurements, Assumptions], tuple[Floats, Floats, Floats]],
    sent: Floats | None = None,
    **assumed: Any,
) -> Track:
    """Track of the egos by a kernel that filters a whole drive of a star: position, covariance and neighbours.

    Args:
        noise_model: of the filter.
        kernel: of `measurements` and `assumptions`.
        sent: positions in messages, `broadcast` of `measurements`.
        assumed: fields that differ from those of `assumptions`.
    """

    def run(ego: int, inbox: Inbox) -> Iterator[Estimate]:
        assumed_noise = assumptions(recording, noise_model, ego, inbox)._replace(**assumed)
        yield Estimate(*kernel(measurements(recording, ego, inbox, sent), assumed_noise))

    return follow_egos(method, recording, egos, run, noise_model.notes)


def measurements(recording: Recording, ego: int, inbox: Inbox, broadcast: Floats | None = None) -> Measurements:
    """Measurements and messages of one ego, as `coopoc.kernels.stars.messages.Measurements`.

    Args:
        recording: of all vehicles.
        ego: column.
        inbox: its messages.
        broadcast: (R, T, N, 3) m, position in a message; None for the fix.
    """
    gnss = recording.gnss
    return Measurements(
        gnss,
        recording.velocity,
        gnss if broadcast is None else broadcast,
        components(recording.usable_relative, inbox.link),
        recording.links.neighbour[inbox.link],
        inbox.start,
        inbox.newest,
        inbox.fresh,
        1 + int(np.diff(inbox.start).max(initial=0)),
        int(ego),
        recording.dt,
    )


def assumptions(recording: Recording, noise_model: NoiseModel, ego: int, inbox: Inbox | None) -> Assumptions:
    """The noise that a filter assumes, as `kernels.stars.messages.Assumptions`: a message holds a fix and a velocity.

    Args:
        recording: of all vehicles.
        noise_model: of the filter.
        ego: column.
        inbox: its messages; None where it is alone.
    """
    process = noise_model.process_variance(recording, [ego], inbox)
    fixes = np.ascontiguousarray(noise_model.fix_variance(recording))
    return Assumptions(process, fixes, fixes, FIX_GROWTH, *relative_noise(noise_model), FORGOTTEN, ACCELERATION_STD)


def relative_noise(noise_model: NoiseModel) -> tuple[Floats, float]:
    """(3,) m, rad, rad and the least range m of relative measurements, or nothing for unit matrices."""
    sensors = noise_model.sensors
    return (np.empty(0), 0.0) if sensors is None else (sensors.relative_std, sensors.min_range)
