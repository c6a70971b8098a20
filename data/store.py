"""Compact, exact storage of generated fleets: second differences of positions in units of 0.1 mm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.storage import DAMAGES, unpacked

from .rows import backward_difference

UNIT = 1e-4
"""Metres per stored unit: a velocity over 0.1 s is then a multiple of 1 mm/s."""


def quantise(fleet: Fleet) -> Fleet:
    """The fleet on the grid of 0.1 mm, with u_t = (x_t - x_{t-1})/dt and u_0 := u_1: what `save` keeps exactly.

    >>> x = np.array([[[0.0, 0, 0]], [[0.123456, 0, 0]]])
    >>> quantise(Fleet(("a",), [0, 0.1], x, x)).position[1, 0, 0]
    np.float64(0.1235)
    """
    return _fleet(fleet.ids, _units(fleet.position), ~np.isnan(fleet.position[..., 0]), fleet.dt, fleet.name)


def save(fleet: Fleet, path: Path) -> None:
    """Write a quantised fleet that starts at t = 0; the same fleet gives the same bytes.

    Raises:
        InputError: a fleet that would not come back bit by bit, or a vehicle that comes and goes.
    """
    present = fleet.present
    units = _units(fleet.position)
    if quantise(fleet).digest != fleet.digest:
        raise InputError("fleet", fleet.name, "must be quantised and start at t = 0", "Pass quantise(fleet).")
    if (np.diff(present.astype(int), axis=0) > 0).any():
        raise InputError("fleet", fleet.name, "must hold vehicles that are present from step 0", "Cut the fleet.")
    units[1:] = np.where(present[1:, :, None], units[1:], 0)
    second = np.diff(units, n=2, axis=0)
    for column, last in enumerate(present.sum(axis=0)):
        second[max(last - 2, 0) :, column] = 0
    if np.abs(second).max(initial=0) > np.iinfo(np.int16).max:
        raise InputError("fleet", fleet.name, "must not jump by more than 3 m from step to step", "Smooth it first.")
    np.savez_compressed(
        path,
        ids=np.array(fleet.ids),
        dt=np.float64(fleet.dt),
        steps=present.sum(axis=0).astype(np.int32),
        start=units[:2].astype(np.int32),
        second=second.transpose(1, 2, 0).astype(np.int16),
    )


def load(path: Path, name: str = "") -> Fleet:
    """The fleet that `save` wrote, bit by bit.

    Raises:
        InputError: a file that is damaged, or that `save` did not write.
    """
    try:
        stored = unpacked(path)
        ids, steps = tuple(map(str, stored["ids"])), stored["steps"].astype(np.int64)
        second = stored["second"].transpose(2, 0, 1).astype(np.int64)
        start, dt = stored["start"].astype(np.int64), float(stored["dt"])
        fits = second.shape[1:] == start.shape[1:] == (len(ids), 3) and len(start) == 2 and steps.shape == (len(ids),)
        if not (fits and np.isfinite(dt) and dt > 0):
            raise ValueError("arrays that do not fit each other")
    except DAMAGES as error:
        found = next(iter(str(error).splitlines()), type(error).__name__)[:200]
        raise InputError(path.name, found, "must be a fleet of coopoc data make", "Make it again.") from None
    speed = np.concatenate([np.diff(start, axis=0), second]).cumsum(axis=0)
    units = np.concatenate([start[:1], speed]).cumsum(axis=0)
    return _fleet(ids, units, np.arange(len(units))[:, None] < steps, dt, name)


def _units(position: Floats) -> Ints:
    return np.round(np.nan_to_num(position) / UNIT).astype(np.int64)


def _fleet(ids: tuple[str, ...], units: Ints, present: Bools, dt: float, name: str) -> Fleet:
    per_metre, per_second = round(1 / UNIT), round(1 / dt, 6)
    position = np.where(present[..., None], units / per_metre, np.nan)
    t = np.arange(len(units)) / per_second
    return Fleet(ids, t, position, backward_difference(t, position, ids), name=name)
