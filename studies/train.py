"""coopoc train: one recipe, one setting, one checkpoint (or one per client). It loads torch only when it is called."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro


def train(
    recipe: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RECIPE")],
    /,
    data: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")] = "town10-clients",
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/weights"),
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    start: Literal["gnss", "true"] = "gnss",
    reading: Literal["axis", "speed"] = "axis",
    flower: bool = False,
    rounds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
) -> None:
    """Train a recipe, or find its checkpoint if the same was trained before.

    Example: coopoc train fedkalmannet --seed 0

    Args:
        recipe: fedkalmannet, centralised, individual or okf.
        data: fleet of the clients, a name or a path.
        out: of the checkpoints.
        seed: of noise, split, start and batches.
        start: of the filter in training: the first fix or the true position.
        reading: of "10 % of the velocity": per axis or of the speed on every axis.
        flower: train a federation on Flower's simulation engine, every client in a process of its own.
        rounds: of a federation on Flower; default: the recipe's.
    """
    from coopoc.errors import InputError
    from coopoc.fleets import load
    from coopoc.learned.recipes import train_all

    fleet = load(data)
    if flower:
        from coopoc.learned import flower as engine

        config = {"recipe": recipe, "seed": seed, "start": start, "reading": reading}
        made = engine.train(engine.job_of(config | ({} if rounds is None else {"rounds": rounds})), fleet, out)
    elif rounds is not None:
        raise InputError("rounds", rounds, "goes with --flower", "Add --flower, or leave the recipe's rounds.")
    else:
        made = train_all(fleet, out, seeds=[seed], starts=[start], readings=[reading], recipes=[recipe])
    for label, checkpoint in made.items():
        print(f"{out / label}.safetensors  {checkpoint.card['parameters']} parameters")
    print(f"coopoc: {len(made)} checkpoints are in {out}", file=sys.stderr)
