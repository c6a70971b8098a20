"""Card of a generated fleet: where it comes from, how to make it again, and what is in it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.world.fleet import Fleet

from .recipes import Recipe

MAP_LICENCE = "MIT (CARLA project)"
RADIUS, CAP = 30.0, 10


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
        return {
            "map": f"{self.map}, {self.map_licence}",
            "made by": f"{self.command} (SUMO {self.sumo})",
            "sha256": self.sha256,
            "size": f"{self.vehicles} vehicles x {self.steps} steps of {self.dt:g} s",
            "speed": "{min:g}..{max:g} m/s, mean {mean:g}, 5..95 %: {p05:g}..{p95:g}, standing {standing:.0%}".format(
                **self.speed
            ),
            "neighbours": "mean {mean:g} within {radius:g} m (cap {cap:g}), some in {any:.0%} of the steps".format(
                **self.neighbours
            ),
            "height": f"{self.height[0]:g}..{self.height[1]:g} m",
            "acceleration": f"at most {self.acceleration:g} m/s^2",
        }

    def render(self) -> str:
        """The card as a text to read."""
        return "\n".join([self.name, *(f"  {key:<13}{value}" for key, value in self.fields().items())])


def card_of(fleet: Fleet, recipe: Recipe, command: str) -> Card:
    """The card of a fleet that `recipe` made by a command."""
    lengths = sorted(set(recipe.lengths))
    return Card(
        name=recipe.name,
        map=recipe.map,
        map_licence=MAP_LICENCE,
        command=command,
        sumo=version("eclipse-sumo"),
        sha256=fleet.digest,
        recipe=asdict(recipe),
        vehicles=len(fleet.ids),
        steps=lengths[0] if len(lengths) == 1 else list(recipe.lengths),
        dt=fleet.dt,
        speed=speed_statistics(fleet),
        neighbours=neighbour_statistics(fleet),
        height=_rounded([np.nanmin(fleet.position[..., 2]), np.nanmax(fleet.position[..., 2])]),
        acceleration=_rounded([np.nanmax(np.linalg.norm(np.diff(fleet.velocity, axis=0), axis=2)) / fleet.dt])[0],
    )


def speed_statistics(fleet: Fleet) -> dict[str, Any]:
    """Distribution of the speed over all vehicles and steps, m/s; per vehicle too if there are fewer than ten.

    >>> u = np.array([[[3.0, 4, 0]], [[0, 0, 0]]])
    >>> speed_statistics(Fleet(("a",), [0, 0.1], 0 * u, u))["standing"]
    0.5
    """
    speed = np.linalg.norm(fleet.velocity, axis=2)
    values = [np.nanmin(speed), *np.nanpercentile(speed, [5, 95]), np.nanmean(speed), np.nanmax(speed)]
    out: dict[str, Any] = dict(zip(("min", "p05", "p95", "mean", "max"), _rounded(values), strict=True))
    out["standing"] = _rounded([np.mean(speed[fleet.present] < 0.1)])[0]
    if len(fleet.ids) < 10:
        out["per_vehicle"] = [_rounded([np.nanmin(s), np.nanmax(s)]) for s in speed.T]
    return out


def neighbour_statistics(fleet: Fleet, radius: float = RADIUS, cap: int = CAP) -> dict[str, float]:
    """Number of neighbours within `radius` metres, at most `cap`, over all present vehicles and steps.

    >>> x = np.array([[[0.0, 0, 0], [9, 0, 0], [99, 0, 0]]] * 2)
    >>> neighbour_statistics(Fleet(("a", "b", "c"), [0, 0.1], x, 0 * x))["mean"]
    0.667
    """
    counts = np.array([_neighbours(x, radius, cap) for x in fleet.position])
    per_vehicle = np.nanmean(counts, axis=0)
    values = [np.nanmean(counts), np.nanmean(counts[fleet.present] > 0), per_vehicle.min(), per_vehicle.max()]
    keys = ("mean", "any", "lowest_vehicle", "highest_vehicle")
    return {"radius": radius, "cap": cap, **dict(zip(keys, _rounded(values), strict=True))}


def _neighbours(x: Floats, radius: float, cap: int) -> Floats:
    near = np.linalg.norm(x[:, None] - x[None], axis=2) <= radius
    count = np.minimum(near.sum(axis=1) - 1.0, cap)
    return np.where(np.isfinite(x[:, 0]), count, np.nan)


def _rounded(values: Any) -> list[float]:
    return [round(float(v), 3) + 0.0 for v in values]
