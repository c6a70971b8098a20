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
    """
    from coopoc.fleets import load
    from coopoc.learned.recipes import train_all

    made = train_all(load(data), out, seeds=[seed], starts=[start], readings=[reading], recipes=[recipe])
    for label, checkpoint in made.items():
        print(f"{out / label}.safetensors  {checkpoint.card['parameters']} parameters")
    print(f"coopoc: {len(made)} checkpoints are in {out}", file=sys.stderr)
