"""Generated fleets as files: exact and compact storage, and the card that says where a fleet comes from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib.metadata import version
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
MAP_LICENCE = "MIT (CARLA project)"
RADIUS, CAP = 30.0, 10


def quantise(fleet: Fleet) -> Fleet:
    """The fleet on the grid of 0.1 mm, with u_t = (x_t - x_{t-1})/dt and u_0 := u_1: what `save` keeps exactly.

    >>> x = np.array([[[0.0, 0, 0]], [[0.123456, 0, 0]]])
    >>> quantise(Fleet(("a",), [0, 0.1], x, x)).position[1, 0, 0]
    np.float64(0.1235)
    """
    return _fleet(fleet.ids, _units(fleet.position), fleet.present, fleet.dt, fleet.name)


def save(fleet: Fleet, path: Path) -> None:
    """Write a quantised fleet that starts at t = 0, as second differences; the same fleet gives the same bytes.

    Raises:
        InputError: a fleet that would not come back bit by bit, or a vehicle that comes and goes.
    """
    present, last = fleet.present, fleet.present.sum(axis=0)
    if quantise(fleet).digest != fleet.digest:
        raise InputError("fleet", fleet.name, "must be quantised and start at t = 0", "Pass quantise(fleet).")
    if (present != (np.arange(len(present))[:, None] < last)).any():
        raise InputError("fleet", fleet.name, "must hold vehicles that are present from step 0", "Cut the fleet.")
    units = _units(fleet.position)
    second = np.diff(units, n=2, axis=0) * present[2:, :, None]
    if np.abs(second).max(initial=0) > np.iinfo(np.int16).max:
        raise InputError("fleet", fleet.name, "must not jump by more than 3 m from step to step", "Smooth it first.")
    np.savez_compressed(
        path,
        ids=np.array(fleet.ids),
        dt=np.float64(fleet.dt),
        steps=last.astype(np.int32),
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
    position = np.where(present[..., None], units / round(1 / UNIT), np.nan)
    t = np.arange(len(units)) / round(1 / dt, 6)
    return Fleet(ids, t, position, backward_difference(t, position, ids), name=name)


@dataclass(frozen=True)
class Card:
    """Provenance and statistics of a fleet; `sha256` is Fleet.digest.

    Args:
        name: provenance.
        map: provenance.
        map_licence: provenance.
        command: provenance.
        sumo: provenance.
        sha256: provenance.
        recipe: all fields of the Recipe.
        vehicles: their number.
        steps: their number, one per vehicle if they differ.
        dt: s.
        speed: m/s, over all vehicles: min, p05, mean, p95, max, standing (share below 0.1); [min, max] of each if few.
        neighbours: within 30 m, at most 10: mean, share of steps with one or more, per vehicle lowest and highest mean.
        height: [min, max] m.
        acceleration: largest, m/s^2.
    """

    name: str
    map: str
    map_licence: str
    command: str
    sumo: str
    sha256: str
    recipe: dict[str, Any]
    vehicles: int
    steps: int | list[int]
    dt: float
    speed: dict[str, Any]
    neighbours: dict[str, float]
    height: list[float]
    acceleration: float

    def to_json(self) -> str:
        """The card as its file holds it."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @property
    def source(self) -> str:
        """One line for Fleet.source."""
        return f"simulated with SUMO {self.sumo} on CARLA's {self.map}, seed {self.recipe['seed']}, smoothed"

    def fields(self) -> dict[str, str]:
        """The card in words, field by field."""
        made = {"map": f"{self.map}, {self.map_licence}", "made by": f"{self.command} (SUMO {self.sumo})"}
        return made | in_words(asdict(self)) | {"acceleration": f"at most {self.acceleration:g} m/s^2"}


def in_words(facts: dict[str, Any]) -> dict[str, str]:
    """Size and statistics of a fleet as texts."""
    speed = "{min:g}..{max:g} m/s, mean {mean:g}, 5..95 %: {p05:g}..{p95:g}, standing {standing:.0%}"
    near = "mean {mean:g} within {radius:g} m (cap {cap:g}), some in {any:.0%} of the steps"
    return {
        "sha256": facts["sha256"],
        "size": "{vehicles} vehicles x {steps} steps of {dt:g} s".format(**facts),
        "speed": speed.format(**facts["speed"]),
        "neighbours": near.format(**facts["neighbours"]),
        "height": "{:g}..{:g} m".format(*facts["height"]),
    }


def facts(fleet: Fleet) -> dict[str, Any]:
    """Size and statistics of a fleet: those of a Card.

    >>> x = np.array([[[0.0, 0, 0], [9, 0, 0], [99, 0, 0]]] * 2)
    >>> facts(Fleet(("a", "b", "c"), [0, 0.1], x, 0 * x))["neighbours"]["mean"]
    0.667
    """
    speed = np.linalg.norm(fleet.velocity, axis=2)
    levels = [np.nanmin(speed), *np.nanpercentile(speed, [5, 95]), np.nanmean(speed), np.nanmax(speed)]
    speeds: dict[str, Any] = dict(zip(("min", "p05", "p95", "mean", "max"), _rounded(levels), strict=True))
    speeds["standing"] = _rounded([np.mean(speed[fleet.present] < 0.1)])[0]
    if len(fleet.ids) < 10:
        speeds["per_vehicle"] = [_rounded([np.nanmin(s), np.nanmax(s)]) for s in speed.T]
    near = [np.linalg.norm(x[:, None] - x[None], axis=2) <= RADIUS for x in fleet.position]
    counts = np.where(fleet.present, np.minimum(np.array([n.sum(axis=1) for n in near]) - 1.0, CAP), np.nan)
    each = np.nanmean(counts, axis=0)
    values = _rounded([np.nanmean(counts), np.nanmean(counts[fleet.present] > 0), each.min(), each.max()])
    neighbours = dict(zip(("mean", "any", "lowest_vehicle", "highest_vehicle"), values, strict=True))
    z = fleet.position[..., 2]
    return {
        "sha256": fleet.digest,
        "vehicles": len(fleet.ids),
        "steps": len(fleet.t),
        "dt": fleet.dt,
        "speed": speeds,
        "neighbours": {"radius": RADIUS, "cap": CAP, **neighbours},
        "height": _rounded([np.nanmin(z), np.nanmax(z)]),
    }


def card_of(fleet: Fleet, name: str, map_file: str, recipe: dict[str, Any], steps: list[int], command: str) -> Card:
    """The card of a fleet that a recipe made by a command."""
    return Card(
        name=name,
        map=map_file,
        map_licence=MAP_LICENCE,
        command=command,
        sumo=version("eclipse-sumo"),
        recipe=recipe,
        **facts(fleet) | {"steps": steps[0] if len(set(steps)) == 1 else steps},
        acceleration=_rounded([np.nanmax(np.linalg.norm(np.diff(fleet.velocity, axis=0), axis=2)) / fleet.dt])[0],
    )


def _rounded(values: Any) -> list[float]:
    return [round(float(v), 3) + 0.0 for v in values]
