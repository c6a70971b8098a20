"""Generated fleets as files: exact storage as second differences, and the card that says where a fleet comes from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.storage import DAMAGES, unpacked

from .assemble import backward_difference

UNIT = 1e-4
"""Metres per stored unit: a velocity over 0.1 s is then a multiple of 1 mm/s."""
RADIUS, CAP = 30.0, 10
"""m and number of the neighbours that a card counts."""


def quantise(fleet: Fleet) -> Fleet:
    """The fleet on the grid of 0.1 mm, with u_t = (x_t - x_{t-1})/dt and u_0 := u_1: what `save` keeps exactly.

    >>> x = np.array([[[0.0, 0, 0]], [[0.123456, 0, 0]]])
    >>> quantise(Fleet(("a",), [0, 0.1], x, x)).position[1, 0, 0]
    np.float64(0.1235)
    """
    return _fleet(fleet.ids, _units(fleet.position), fleet.present, fleet.dt, fleet.name)


def save(fleet: Fleet, path: Path) -> None:
    """Write a quantised fleet as second differences; the same fleet gives the same bytes.

    Raises:
        InputError: a fleet that would not come back bit by bit.
    """
    last = fleet.present.sum(axis=0)
    units = _units(fleet.position)
    second = np.diff(units, n=2, axis=0) * fleet.present[2:, :, None]
    np.savez_compressed(
        path,
        ids=np.array(fleet.ids),
        dt=np.float64(fleet.dt),
        steps=last.astype(np.int32),
        start=units[:2].astype(np.int32),
        second=second.transpose(1, 2, 0).astype(np.int16),
    )
    if load(path).digest != fleet.digest:
        path.unlink()
        allowed = "must be quantised, start at t = 0, hold vehicles from step 0 on, and not jump by 3 m in a step"
        raise InputError("fleet", fleet.name, allowed, "Pass quantise(fleet).")


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
        reason = next(iter(str(error).splitlines()), type(error).__name__)[:200]
        raise InputError(path.name, reason, "must be a fleet of coopoc data make", "Make it again.") from None
    speed = np.concatenate([np.diff(start, axis=0), second]).cumsum(axis=0)
    units = np.concatenate([start[:1], speed]).cumsum(axis=0)
    return _fleet(ids, units, np.arange(len(units))[:, None] < steps, dt, name)


def _units(position: Floats) -> Ints:
    return np.round(np.nan_to_num(position) / UNIT).astype(np.int64)


def _fleet(ids: tuple[str, ...], units: Ints, present: Bools, dt: float, name: str) -> Fleet:
    position = np.where(present[..., None], units / round(1 / UNIT), np.nan)
    t = np.arange(len(units)) / round(1 / dt, 6)
    return Fleet(ids, t, position, backward_difference(t, position, ids), name=name)


def card_of(fleet_file: Path) -> dict[str, Any]:
    """The card beside a fleet: name, map, map_licence, command, sumo (version), recipe, and its `facts`."""
    card: dict[str, Any] = json.loads(fleet_file.with_suffix(".json").read_text())
    return card


def in_words(facts: dict[str, Any]) -> dict[str, str]:
    """Size and statistics of a fleet as texts, and of a card also where it comes from."""
    made = (
        {
            "map": "{map}, {map_licence}".format(**facts),
            "made by": "{command} (SUMO {sumo})".format(**facts),
        }
        if "map" in facts
        else {}
    )
    near = "mean {mean:g} within {radius:g} m (cap {cap:g}), some in {any:.0%} of the steps"
    return made | {
        "sha256": facts["sha256"],
        "size": "{vehicles} vehicles x {steps} steps of {dt:g} s".format(**facts),
        "speed": "{min:g}..{max:g} m/s, mean {mean:g}, standing {standing:.0%}".format(**facts["speed"]),
        "neighbours": near.format(**facts["neighbours"]),
        "height": "{:g}..{:g} m".format(*facts["height"]),
        "acceleration": "at most {acceleration:g} m/s^2".format(**facts),
    }


def facts(fleet: Fleet) -> dict[str, Any]:
    """Size and statistics of a fleet: speed m/s, neighbours within RADIUS, height m, largest acceleration m/s^2.

    >>> x = np.array([[[0.0, 0, 0], [9, 0, 0], [99, 0, 0]]] * 2)
    >>> facts(Fleet(("a", "b", "c"), [0, 0.1], x, 0 * x))["neighbours"]["mean"]
    0.667
    """
    speed = np.linalg.norm(fleet.velocity, axis=2)[fleet.present]
    near = [np.linalg.norm(x[:, None] - x[None], axis=2) <= RADIUS for x in fleet.position]
    counts = np.minimum(np.array([n.sum(axis=1) for n in near]) - 1.0, CAP)[fleet.present]
    change = np.linalg.norm(np.diff(fleet.velocity, axis=0), axis=2)
    z = fleet.position[fleet.present][:, 2]
    lengths = sorted(set(fleet.present.sum(axis=0).tolist()))
    return {
        "sha256": fleet.digest,
        "vehicles": len(fleet.ids),
        "steps": lengths[0] if len(lengths) == 1 else f"{lengths[0]}..{lengths[-1]}",
        "dt": fleet.dt,
        "speed": _rounded(min=speed.min(), mean=speed.mean(), max=speed.max(), standing=np.mean(speed < 0.1)),
        "neighbours": _rounded(radius=RADIUS, cap=CAP, mean=counts.mean(), any=np.mean(counts > 0)),
        "height": [round(float(z.min()), 3), round(float(z.max()), 3)],
        "acceleration": round(float(np.nanmax(change, initial=0.0)) / fleet.dt, 3),
    }


def _rounded(**values: Any) -> dict[str, float]:
    return {name: round(float(value), 3) + 0.0 for name, value in values.items()}
