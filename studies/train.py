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
    aggregate: Annotated[str | None, tyro.conf.arg(metavar="RULE")] = None,
    flower: bool = False,
    rounds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
) -> None:
    """Train a recipe, or find its checkpoint if the same was trained before.

    Example: coopoc train fedkalmannet --seed 0

    Example: coopoc train okf --data "mylog?until=300" --out runs/mylog

    Args:
        recipe: a name such as fedkalmannet (see coopoc list), or mine.py:NAME, a recipe or a net of yours.
        data: fleet of the clients, a name or a path; of a log with its truth the measured fixes and odometry train,
            "mylog?until=300" is its first 300 s.
        out: of the checkpoints.
        seed: of noise, split, start and batches.
        start: of the filter in training: the first fix or the true position.
        reading: of "10 % of the velocity": per axis or of the speed on every axis.
        aggregate: aggregation rule of a federation, a name or mine.py:NAME; default: the recipe's.
        flower: train a federation on Flower's simulation engine, every client in a process of its own.
        rounds: of a federation on Flower; default: the recipe's.
    """
    from coopoc.errors import InputError
    from coopoc.learned.train import train_all

    from .weights import drives

    clients = drives(data)
    if flower:
        from coopoc.learned import flower as engine

        config = {"recipe": recipe, "seed": seed, "start": start, "reading": reading}
        changes = {"rounds": rounds, "aggregate": aggregate}
        changes = {name: value for name, value in changes.items() if value is not None}
        made = engine.train(engine.job_of(config | changes), clients, out)
    elif rounds is not None:
        raise InputError("rounds", rounds, "goes with --flower", "Add --flower, or leave the recipe's rounds.")
    else:
        made = train_all(
            clients, out, seeds=[seed], starts=[start], readings=[reading], recipes=[recipe], aggregate=aggregate
        )
    for label, checkpoint in made.items():
        print(f"{out / label}.safetensors  {checkpoint.card['parameters']} parameters")
    print(f"coopoc: {len(made)} checkpoints are in {out}", file=sys.stderr)
