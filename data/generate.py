"""make: a Recipe and a folder of OpenDRIVE maps -> a fleet and its card."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from coopoc.errors import InputError
from coopoc.plugins import unknown
from coopoc.world.fleet import Fleet

from . import store, traffic
from .cards import Card, card_of
from .fcd import read_fcd
from .recipes import RECIPES, Recipe
from .smooth import smooth


def make(recipe: str | Recipe, map_folder: str | Path, out_folder: str | Path, seed: int | None = None) -> Card:
    """Drive a recipe in SUMO and write <name>.npz and <name>.json; the same seed gives the same bytes.

    Args:
        recipe: a Recipe, or the name of one in RECIPES.
        map_folder: holds the OpenDRIVE file that the recipe names (CARLA's maps: MIT licence, not part of the package).
        out_folder: is created if needed; files of the same name are replaced.
        seed: instead of the recipe's.

    Raises:
        InputError: an unknown recipe, a missing map, a vehicle that could not drive or that jumps.
        MissingLibraryError: eclipse-sumo is not installed.
    """
    chosen = _recipe(recipe) if seed is None else replace(_recipe(recipe), seed=seed)
    out = Path(out_folder)
    out.mkdir(parents=True, exist_ok=True)
    fleet = simulate(chosen, Path(map_folder))
    store.save(fleet, out / f"{chosen.name}.npz")
    card = card_of(fleet, chosen)
    (out / f"{chosen.name}.json").write_text(card.to_json())
    return card


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
            "recipe",
            f"{recipe.name}, seed {recipe.seed}",
            f"must drive {recipe.vehicles} vehicles through all steps",
            f"{len(ids)} departed; use another seed, fewer vehicles, smaller platoons or a longer warm-up.",
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
            "acceleration",
            f"{acceleration[step, column]:.1f} m/s^2 of {fleet.ids[column]} at step {step}",
            f"must stay below {limit} m/s^2",
            "Use another seed or a lower cutoff.",
        )


def _recipe(recipe: str | Recipe) -> Recipe:
    if isinstance(recipe, Recipe):
        return recipe
    if recipe not in RECIPES:
        raise unknown("recipe", recipe, RECIPES, "Or build a Recipe of your own.")
    return RECIPES[recipe]


def _progress(recipe: Recipe) -> tqdm[Any]:
    return tqdm(total=4, desc=f"{recipe.name}: map", leave=False)


def _advance(bar: tqdm[Any], stage: str) -> None:
    bar.update()
    bar.set_description(stage)
