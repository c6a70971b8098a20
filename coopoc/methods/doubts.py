"""What contradicts the estimates of a track: fixes, the odometer, and what is had of neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..arrays import Floats, Ints
from ..kernels.covariances import DOUBT, TOGETHER, mark_estimates
from ..kernels.gate import FIX_GATE, REJECTED
from ..world.links import spherical, stretches, wrap
from ..world.recording import Recording
from .noise_model import NoiseModel

SECOND = 1.0
"""s between two fixes that are judged together, at least; twice that between two numbers of a neighbour."""
FAR, SURE = "fixes, {}: far from its estimates; it is lost, or rejects them", "covariances, {}: contradicted by fixes"
SLIPS = "odometer, {}: contradicted by fixes; it slips, or they jump"
NEIGHBOURS = "messages, {} and {}: far from estimates", "relative measurements, {} and {}: far from estimates"


def doubts(
    recording: Recording,
    columns: Sequence[int],
    x: Floats,
    cov: Floats | None = None,
    noise_model: NoiseModel | str = "nominal",
    neighbours: Floats | None = None,
) -> tuple[str, ...]:
    """Notes of what contradicts the estimates of some vehicles in any run, and when: TOGETHER numbers in a row.

    Receivers that are rejected or filters that are lost: all fixes are beyond their gate. Covariances: the fixes' mean,
    or their mean square, is farther off than chance allows. Odometers: the fixes move otherwise, again beyond chance.
    Neighbours: all messages, or relative measurements, are beyond REJECTED gates.

    Args:
        recording: of all vehicles, with the noise that methods know.
        columns: (E,) of the vehicles.
        x: (R, T, E, 3) m.
        cov: (R, T, E, 3, 3) m^2; None if none is claimed.
        noise_model: of the method; covariances and neighbours are not judged where it states no noise.
        neighbours: (R, L, 3) m as of Track; None for none.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), np.arange(9), np.zeros((9, 1, 3)), np.zeros((9, 1, 3)))
    >>> doubts(observe(fleet, Sensors()), [0], np.full((1, 9, 1, 3), 1e3))
    ('fixes, a: far from its estimates; it is lost, or rejects them (0 to 4 s)',)
    """
    stated = noise_model.sensors if isinstance(noise_model, NoiseModel) else noise_model != "identity"
    sensors, links, steps, notes = recording.sensors, recording.links, len(recording.t), list[str]()
    claimed = cov if cov is not None and stated else np.zeros((0,) * 5)
    fix = np.square([sensors.gnss_std, (sensors.gnss_drift_std, sensors.gnss_common_std, sensors.gnss_bias[1])])
    fix[1] = fix[1].sum()
    every = max(min(round(SECOND / recording.dt), steps // TOGETHER), 1)
    marks = np.zeros((2, len(columns), steps), np.int64)
    worst = mark_estimates(recording.gnss, x, claimed, np.asarray(columns, dtype=np.int64), fix, every, marks)

    def add(text: str, marked: Ints, *names: int) -> None:
        times = [f"{recording.t[a]:.10g} to {recording.t[b - 1]:.10g}" for a, b in stretches(marked > 0)]
        if times:
            more = f", and {len(times) - 3} times more" * (len(times) > 3)
            notes.append(f"{text.format(*(recording.ids[name] for name in names))} ({', '.join(times[:3])} s{more})")

    first = 0
    for k, ego in enumerate(columns):
        for text, marked in zip((FAR, SURE), marks[:, k], strict=True):
            add(text, marked, ego)
        if recording.body is None and (neighbours is not None or worst[:, k].max() > DOUBT / 3.0):
            add(SLIPS, odometer(recording, ego, fix, every), ego)
        if neighbours is not None and len(claimed):
            own = links.of(ego)
            theirs, first = neighbours[:, first : first + len(own)], first + len(own)
            for kind, j, marked in far_neighbours(recording, own, x[:, :, k], claimed[:, :, k], theirs, fix, 2 * every):
                add(NEIGHBOURS[kind], marked, ego, j)
    return tuple(notes)


def in_fives(steps: Ints) -> Ints:
    """(n, TOGETHER) of steps (T,), but for the last few."""
    return steps[: len(steps) // TOGETHER * TOGETHER].reshape(-1, TOGETHER)


def odometer(recording: Recording, ego: int, fix: Floats, every: int) -> Ints:
    """(T,) 1 where the way between the means of TOGETHER fixes and of the next ones is not the odometer's in a run."""
    sensors, marked = recording.sensors, np.zeros(len(recording.t), np.int64)
    gnss, moved = recording.gnss[:, :, ego], recording.dt * recording.velocity[:, :, ego]
    there = np.flatnonzero(np.isfinite(gnss[..., 0]).all(axis=0))
    at = in_fives(there[np.unique(there // every, return_index=True)[1]])
    begin, end = at[:-1, 0], at[1:, -1]
    way, square = np.cumsum(moved, axis=1), np.cumsum((moved**2).sum(axis=-1), axis=1)
    turn = sensors.speed_scale_std**2 + sensors.heading_std**2 + sensors.heading_bias_std**2
    walk = (sensors.velocity_std_ratio**2 + (end - begin) * turn) * (square[:, end] - square[:, begin])
    walk += (end - begin) * (recording.dt * sensors.velocity_floor) ** 2
    gap = np.diff((gnss - way)[:, at].mean(axis=2), axis=1)
    slip = (gap**2 / (2.0 * (fix[0] / TOGETHER + fix[1]) + walk[..., None])).sum(axis=-1)
    for a, b in zip(begin, end, strict=True):
        marked[a : b + 1] |= (slip[:, begin == a] > DOUBT).any()
    return marked


def far_neighbours(
    recording: Recording, own: Ints, x: Floats, cov: Floats, theirs: Floats, fix: Floats, every: int
) -> Iterable[tuple[int, int, Ints]]:
    """Messages (0) or relative measurements (1), neighbour, and (T,) 1 where TOGETHER of them are all far in a run.

    Args:
        recording: of all vehicles.
        own: (M,) links of the ego.
        x: (R, T, 3) m, its estimates.
        cov: (R, T, 3, 3) m^2.
        theirs: (R, M, 3) m, estimates by link.
        fix: (2, 3) m^2, variances of a fix, what is white and what lasts.
        every: steps from one to the next.
    """
    taken = np.flatnonzero(recording.links.step[own] % every == 0)
    link, theirs, sensors = own[taken], theirs[:, taken], recording.sensors
    step, who = recording.links.step[link], recording.links.neighbour[link]
    gap, std = theirs - x[:, step], np.array([sensors.range_std, sensors.world_azimuth_std, sensors.inclination_std])
    left = recording.relative[:, link] - np.stack(spherical(*np.moveaxis(gap, -1, 0)), axis=-1)
    left[..., 1] = wrap(left[..., 1])
    d, flat = np.linalg.norm(gap, axis=-1), np.hypot(gap[..., 0], gap[..., 1])
    metres = np.stack([np.ones_like(d), flat, d], axis=-1)
    variance = np.trace(cov[:, step], axis1=-2, axis2=-1)[..., None] / 3.0 + fix[1].mean()
    q = np.nansum((metres * left) ** 2 / ((metres * std) ** 2 + variance), axis=-1)
    variance = variance + std[0] ** 2 + (d * std[1])[..., None] ** 2
    message = ((recording.gnss[:, step, who] - theirs) ** 2 / (fix.sum(axis=0) + variance)).sum(axis=-1)
    for kind, far in enumerate((message > REJECTED * FIX_GATE, q > REJECTED * FIX_GATE)):
        for j in np.unique(who[far.any(axis=0)]):
            at, marked = in_fives(np.flatnonzero(who == j)), np.zeros(len(recording.t), np.int64)
            for five in at[far[:, at].all(axis=2).any(axis=0)]:
                marked[step[five[0]] : step[five[-1]] + every] = 1
            yield kind, int(j), marked
