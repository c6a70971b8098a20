"""coopoc data list | show | make | convert."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import tyro

from coopoc.plugins import unknown

from .registry import DATASETS, convert, list_datasets


def list_() -> None:
    """List the bundled fleets, one line each.

    Example: coopoc data list
    """
    from tabulate import tabulate

    print(tabulate(list_datasets(), headers="keys", tablefmt="github"))


def show(name: tyro.conf.Positional[str]) -> None:
    """Show the card of a bundled fleet: map, licence, command, seed, hash, speeds, neighbours.

    Example: coopoc data show town10

    Args:
        name: of the fleet.
    """
    if name not in DATASETS:
        raise unknown("fleet", name, DATASETS)
    print(DATASETS[name].card().render())


def make(recipe: tyro.conf.Positional[str], *, maps: Path, out: Path = Path("fleets"), seed: int | None = None) -> None:
    """Make a fleet with SUMO from an OpenDRIVE map: the same seed gives the same bytes.

    Example: coopoc data make town10 --maps carla_maps

    Args:
        recipe: name of a bundled fleet.
        maps: folder with the .xodr files of CARLA.
        out: folder for the fleet and its card.
        seed: instead of the recipe's.
    """
    from .generate import make as generate

    print(generate(recipe, maps, out, seed).render())
    print(f"written to {out}", file=sys.stderr)


def convert_(
    source: tyro.conf.Positional[str],
    out: tyro.conf.Positional[Path],
    *,
    dt: float | None = None,
    format: str | None = None,
) -> None:
    """Convert a drive to CSV, Parquet or a folder of TUM files.

    Example: coopoc data convert fcd.xml drive.csv --dt 0.1

    Args:
        source: name or path.
        out: .csv, .parquet or a folder.
        dt: s, resample.
        format: of the source, if it is not detected.
    """
    print(f"{convert(source, out, dt, format=format)!r} written to {out}", file=sys.stderr)


COMMANDS: Mapping[str, Callable[..., None]] = {"list": list_, "show": show, "make": make, "convert": convert_}
