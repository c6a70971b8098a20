"""make: a Recipe and a folder of OpenDRIVE maps -> a fleet and its card."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from coopoc.arrays import number
from coopoc.errors import InputError
from coopoc.one_file import from_file, in_file
from coopoc.plugins import unknown
from coopoc.world.fleet import Fleet

from . import store, traffic
from .cards import Card, card_of
from .fcd import read_fcd
from .recipes import RECIPES, Recipe
from .smooth import smooth

DROVE, JUMPED = "recipe", "acceleration"
"""Fields of the errors that another seed may avoid."""


def make(
    recipe: str | Recipe,
    map_folder: str | Path,
    out_folder: str | Path,
    seed: int | None = None,
    *,
    tries: int = 1,
    **changes: Any,
) -> Card:
    """Drive a recipe in SUMO and write <name>.npz and <name>.json; the same seed gives the same bytes.

    Args:
        recipe: a Recipe, the name of one in RECIPES, or "mine.py:NAME".
        map_folder: holds the OpenDRIVE file that the recipe names (CARLA's maps: MIT licence, not part of the package).
        out_folder: is created if needed; files of the same name are replaced.
        seed: instead of the recipe's.
        tries: how many seeds are tried, one after the other, until one gives a fleet.
        changes: other fields of the recipe, such as map, cutoff, vehicles.

    Raises:
        InputError: an unknown recipe, a missing map; with the last seed, a vehicle that could not drive or that jumps.
        MissingLibraryError: eclipse-sumo is not installed.
    """
    chosen = replace(_recipe(recipe), **changes)
    chosen = chosen if seed is None else replace(chosen, seed=seed)
    number("tries", tries, 1, 10_000, kind=int, allowed=">= 1", hint="Give the number of seeds.")
    out = Path(out_folder)
    out.mkdir(parents=True, exist_ok=True)
    for last in range(tries - 1, -1, -1):
        try:
            fleet = simulate(chosen, Path(map_folder))
            break
        except InputError as error:
            if error.field not in (DROVE, JUMPED) or not last:
                raise
            chosen = replace(chosen, seed=chosen.seed + 1)
    store.save(fleet, out / f"{chosen.name}.npz")
    card = card_of(fleet, chosen, _command(recipe, chosen, map_folder, changes))
    (out / f"{chosen.name}.json").write_text(card.to_json())
    return card


def _command(recipe: str | Recipe, made: Recipe, map_folder: str | Path, changes: Mapping[str, Any]) -> str:
    """The line that makes the fleet again."""
    if isinstance(recipe, Recipe):
        return "coopoc.data.generate.make(Recipe(**card['recipe']), MAPS, OUT), in Python"
    more = "".join(f" --{name.replace('_', '-')} {value}" for name, value in changes.items())
    return f"coopoc data make {recipe} --maps {map_folder} --seed {made.seed}{more}"


def simulate(recipe: Recipe, map_folder: Path) -> Fleet:
    """The quantised fleet of a recipe: map, routes, SUMO, centres of the vehicles, smoothing, velocities."""
    with tempfile.TemporaryDirectory() as folder, _progress(recipe) as bar:
        network, routes, fcd = (Path(folder) / f for f in ("net.xml", "routes.xml", "fcd.xml"))
        traffic.build_network(map_folder / recipe.map, recipe, network)
        traffic.write_routes(recipe, *traffic.read_streets(network), routes)
        _advance(bar, f"{recipe.name}: SUMO")
        traffic.drive(recipe, network, routes, fcd)
        _advance(bar, f"{recipe.name}: reading")
        raw = read_fcd(fcd, vehicle_length=traffic.VEHICLE_LENGTH)
        _advance(bar, f"{recipe.name}: smoothing")
        fleet = _finish(raw, recipe)
        bar.update()
    return fleet


def _finish(raw: Fleet, recipe: Recipe) -> Fleet:
    ids = sorted(raw.ids)
    steps = max(recipe.lengths)
    position = raw.select(ids).position[:steps]
    if len(ids) < recipe.vehicles or len(position) < steps or np.isnan(position).any():
        raise InputError(
            DROVE,
            f"{recipe.name}, seed {recipe.seed}",
            f"must drive {recipe.vehicles} vehicles through all steps",
            f"{len(ids)} departed; try more seeds (--tries 20), fewer --vehicles, smaller platoons or more warm-up.",
        )
    position = smooth(position, recipe.dt, recipe.cutoff)
    for column, last in enumerate(recipe.lengths):
        position[last:, column] = np.nan
    t = np.arange(steps) * recipe.dt
    fleet = store.quantise(Fleet(tuple(ids), t, position, position, name=recipe.name))
    _refuse_jumps(fleet)
    return fleet


def _refuse_jumps(fleet: Fleet, limit: float = 8.0) -> None:
    acceleration = np.linalg.norm(np.diff(fleet.velocity, axis=0), axis=2) / fleet.dt
    if np.nanmax(acceleration) > limit:
        step, column = np.unravel_index(np.nanargmax(acceleration), acceleration.shape)
        raise InputError(
            JUMPED,
            f"{acceleration[step, column]:.1f} m/s^2 of {fleet.ids[column]} at step {step}",
            f"must stay below {limit} m/s^2",
            "Try more seeds (--tries 20), or a lower cutoff (--cutoff 0.3).",
        )


def _recipe(recipe: str | Recipe) -> Recipe:
    if isinstance(recipe, Recipe):
        return recipe
    if in_file(recipe):
        found = from_file(recipe, "recipe")
        if not isinstance(found, Recipe):
            raise InputError("recipe", repr(recipe), f"is a {type(found).__name__}, no Recipe", "Name a Recipe.")
        return found
    if recipe not in RECIPES:
        raise unknown("recipe", recipe, RECIPES, "Or build a Recipe of your own.")
    return RECIPES[recipe]


def _progress(recipe: Recipe) -> tqdm[Any]:
    return tqdm(total=4, desc=f"{recipe.name}: map", leave=False)


def _advance(bar: tqdm[Any], stage: str) -> None:
    bar.update()
    bar.set_description(stage)
