"""Shipped weights: made from their recipes with their cards, and made again to see that they are the same.

python benchmarks/shipped_weights.py fedokf okf            # largest difference of each from training again
"""

import hashlib
import platform
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from coopoc.data.registry import load_fleet
from coopoc.errors import unknown
from coopoc.evaluate.metrics import nees, rt_le, share_of_average
from coopoc.learned.checkpoint import Checkpoint, load, save
from coopoc.learned.nets.gain import flatten
from coopoc.learned.recipes import RECIPES, WEIGHTS, Job, Setting, jobs_of
from coopoc.learned.train import trained
from coopoc.methods.kalman import Kalman
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

CLIENTS, JUDGES = "town10-clients", "town10-validation"
"""Fleets that the weights are trained on, and that their cards' metrics are of."""
SENSORS = {
    "training noise": Sensors.paper_training(),
    "scenario 1": Sensors.paper_scenario1(),
    "scenario 2, 10 %": Sensors.paper_scenario2(0.10),
    "scenario 2, 15 %": Sensors.paper_scenario2(0.15),
    "scenario 2, 15 % of the speed": replace(Sensors.paper_scenario2(0.15), velocity_reading="speed"),
}
LIMITS = {
    "static": "Trained at 1.5 m and 10 % of each velocity component; at other noise it filters for these.",
}
EVERYWHERE = "Four simulated drives on one flat map at 10 Hz."
WHITE = "White noise without a bias; no outliers and no missing fixes in training."


def jobs(recipe: str) -> dict[str, Job]:
    """Shipped nets of a recipe, by names such as individual1: seed 0, start at the first fix, noise per axis."""
    return {f"{job.name}{job.client or ''}": job for job in jobs_of(recipe, Setting(), load_fleet(CLIENTS))}


def ship(recipes: Sequence[str] = tuple(RECIPES), out: Path = WEIGHTS, progress: bool = True) -> list[Path]:
    """Train recipes and write the weights to `out`, each with its hash, its limits and what it does in validation."""
    paths = []
    for recipe in recipes:
        for name, checkpoint in _made(recipe, progress).items():
            card = {
                **checkpoint.card,
                "sha256": digest(checkpoint),
                "machine": machine(),
                "metrics": metrics(checkpoint.model.method(name)),
                "limits": [LIMITS[RECIPES[recipe].noise], EVERYWHERE, WHITE],
            }
            paths.append(save(out / f"{name}.safetensors", Checkpoint(checkpoint.model, card)))
    return paths


def differences(name: str, folder: Path = WEIGHTS, progress: bool = True) -> dict[str, float]:
    """Train shipped weights again: the largest difference of any of them, by name.

    On the machine and with the versions that the card names they differ by less than 1e-6; elsewhere rounding grows.

    Args:
        name: of weights, such as "individual2", or of a recipe, for all of its weights.
        folder: of the weights.
        progress: bars on stderr.

    Raises:
        InputError: a name that is neither, or weights that are not in the folder.
    """
    recipe = name if name in RECIPES else name.rstrip("0123456789")
    if recipe not in RECIPES or name not in (recipe, *jobs(recipe)):
        raise unknown("weights", name, RECIPES)
    pairs = {
        label: (flatten([checkpoint.model]), flatten([load(folder / f"{label}.safetensors").model]))
        for label, checkpoint in _made(recipe, progress).items()
        if name in (recipe, label)
    }
    return {label: float((again - shipped).abs().max()) for label, (again, shipped) in pairs.items()}


def digest(checkpoint: Checkpoint) -> str:
    """SHA-256 of the weights as one row of float32 bytes."""
    return hashlib.sha256(flatten([checkpoint.model]).float().numpy().tobytes()).hexdigest()


def machine() -> str:
    """The processor, as far as rounding depends on it: architecture, model and vector instructions."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().split("\n\n")[0].splitlines() if info.is_file() else []
    facts = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    names = [facts[name] for name in ("model name", "cpu family", "model") if name in facts] or [platform.processor()]
    return ", ".join([platform.machine(), *names, torch.backends.cpu.get_cpu_capability()])


def _made(recipe: str, progress: bool) -> dict[str, Checkpoint]:
    wanted = jobs(recipe)
    return {name: trained(job, load_fleet(CLIENTS), progress) for name, job in wanted.items()}


def metrics(method: Method, runs: int = 20) -> dict[str, dict[str, float]]:
    """RT-LE m, its multiple of the bias-ignorant oracle filter's and, where a covariance is claimed and no bias acts,
    the share of steps whose NEES is in its 99 % band, by the names of `SENSORS`: means over the validation fleet."""
    fleet, rows = load_fleet(JUDGES), {}
    egos = [i for i, column in enumerate(fleet.present.T) if column.all()]
    for name, sensors in SENSORS.items():
        recording = observe(fleet, sensors, V2X(max_neighbours=0), runs=runs, seed=1)
        track, oracle = method(recording, egos), Kalman(NoiseModel.oracle(sensors, fleet))(recording, egos)
        ours = float(rt_le(track, fleet).mean())
        rows[name] = {"rt_le_m": ours, "times_oracle": ours / float(rt_le(oracle, fleet).mean())}
        if track.covariance is not None and sensors.gnss_bias[1] == 0:
            rows[name]["nees_inside"] = float(share_of_average(nees(track, fleet).mean(axis=0), recording.runs).mean())
    return {name: {key: round(value, 4) for key, value in row.items()} for name, row in rows.items()}


if __name__ == "__main__":
    for each in sys.argv[1:] or RECIPES:
        print(differences(each))
