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
        recipe: a name such as fedkalmannet (see coopoc list), or FILE.py:NAME of a recipe or a net.
        data: fleet of the clients or a log with its truth, a name or a path; "mylog?until=300" takes 300 s.
        out: folder of the checkpoints.
        seed: seed of noise, split, start and batches.
        start: start of the filter in training, the first fix or the true position.
        reading: reading of "10 % of the velocity", per axis or of the speed on every axis.
        aggregate: aggregation rule, a name or FILE.py:NAME, instead of the recipe's.
        flower: train on Flower's simulation engine, every client in its own process.
        rounds: number of rounds on Flower, instead of the recipe's.
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
