"""Training of recipes: `train_all` makes every checkpoint that a study needs, or finds it."""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from math import inf, nan, sqrt
from multiprocessing import get_context
from pathlib import Path

import torch

from coopoc import InputError
from coopoc.arrays import listed, whole
from coopoc.paths import given_path, made_folder
from coopoc.plugins import in_file
from coopoc.workers import leave_with, say
from coopoc.world.sensors import VelocityReading

from .checkpoint import Checkpoint, load, read, save
from .federation.federate import federate
from .nets.gain import Gain, flatten
from .nets.okf import NoiseParameters
from .recipes import RECIPES, Job, Setting, job_clients, jobs_of, untrained
from .training.clients import Client, Segments, Start
from .training.drives import Drives, Logged, MeasuredDrives, drives_of
from .training.fit import Judge, fit, fit_okf
from .training.schedule import LINE

LEAST_STD = 1e-6
"""m, of noise that is fitted, and share of a velocity."""


def train_all(
    data: Drives | Logged,
    out: Path | str,
    *,
    seeds: Sequence[int] = range(5),
    starts: Sequence[Start] = ("gnss",),
    readings: Sequence[VelocityReading] = ("axis",),
    recipes: Sequence[str] | None = None,
    aggregate: str | None = None,
    jobs: int = 1,
    progress: bool = True,
    worst: float = inf,
) -> dict[str, Checkpoint]:
    """Train every recipe in every setting, or read it from `out` where the same was trained before.

    Checkpoints are trained side by side on `jobs` cores, each on one. One is reused if its card's key, the hash of all
    that changes the weights, is the same; each is written whole or not at all.

    Args:
        data: the clients' drives: a fleet, such as the bundled "town10-clients", whose measurements are simulated, or a
            log with its truth (`coopoc.read_log`), whose own fixes and odometry train.
        out: folder of the checkpoints.
        seeds: of the settings; every combination with starts and readings is trained.
        starts: of the filter, "gnss" or "true".
        readings: of "10 % of the velocity", "axis" or "speed".
        recipes: names, or "mine.py:NAME" of a Recipe or a net; default all of `RECIPES`.
        aggregate: rule of the federations by name or path, default that of the recipe.
        jobs: processes; the weights do not depend on it.
        progress: bars on stderr that name the stage.
        worst: times the error of a Kalman filter with fitted noise, on the pieces that validate, above which nothing is
            saved.

    Returns:
        Checkpoints by label, such as "fedkalmannet-gnss-axis-0".

    Raises:
        InputError: an unknown recipe; a log without a truth; a net that is worse than `worst`.
    """
    fleet, out = drives_of(data), given_path(out)
    jobs = whole("jobs", jobs, 1, 10**4)
    arguments = {
        "seeds": seeds,
        "starts": starts,
        "readings": readings,
        "recipes": RECIPES if recipes is None else recipes,
    }
    seeds, starts, readings, recipes = (listed(name, v, f"Give {name}=[...].") for name, v in arguments.items())
    settings = [Setting(seed, start, reading) for reading in readings for start in starts for seed in seeds]
    wanted = [job for name in recipes for setting in settings for job in jobs_of(name, setting, fleet, aggregate)]
    paths = {job: out / f"{job.label}.safetensors" for job in wanted}
    missing = [job for job, path in paths.items() if _key(path) != job.key(fleet)]
    if missing:
        made_folder(out)
    if jobs > 1 and len(missing) > 1:
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            todo = [
                pool.submit(_in_worker, job, fleet, out, worst, k % jobs if progress else None, os.getpid())
                for k, job in enumerate(missing)
            ]
            try:
                for done in todo:
                    done.result()
            finally:
                pool.shutdown(cancel_futures=True)
    else:
        for job in missing:
            _train(job, fleet, out, worst, progress)
    return {job.label: load(path, job.recipe.net if in_file(job.recipe.net) else "") for job, path in paths.items()}


def _train(job: Job, fleet: Drives, out: Path, worst: float, progress: bool) -> None:
    """Train and save a checkpoint."""
    checkpoint = trained(job, fleet, progress)
    ours, theirs = checkpoint.card["validation_m"]
    if ours > worst * theirs:
        allowed = f"must be at most {worst:g} times that of a Kalman filter with fitted noise"
        hint = "Give more data or another recipe; --worse saves it all the same."
        raise InputError(f"validation error of {job.label}", f"{ours / theirs:.2f} times", allowed, hint)
    path = out / f"{job.label}.safetensors"
    if path.is_file() and _key(path) != checkpoint.card["key"]:
        kept = path.rename(path.with_suffix(f".{_key(path)[:8]}{path.suffix}"))
        say(f"what was trained otherwise, or is damaged, is kept as {kept}")
    if untrained_note := checkpoint.card.get("warning"):
        say(f"{job.label}: {untrained_note}")
    save(path, checkpoint)


def trained(job: Job, fleet: Drives, progress: bool = True) -> Checkpoint:
    """The checkpoint of a job, trained now."""
    data = job_clients(job, fleet)
    made = _made(job, data, f"train {job.name}" if progress else None)
    card = {
        **job.card,
        "key": job.key(fleet),
        **({"noise": "measured"} if isinstance(fleet, MeasuredDrives) else {}),
        "fleet": fleet.name,
        "digest": fleet.digest,
        "clients": [client.name for client in data],
        "training_pieces": [len(client.training) for client in data],
        "validation_pieces": [len(client.validation) for client in data],
        "validation_m": errors_beside_fitted_filter(made.model, data),
        **made.card,
    }
    if card.get("best") == 0:
        rate = f"lower learning_rate={job.recipe.schedule.learning_rate:g}"
        card["warning"] = f"no weights validated better than those of the start, which are kept; {rate}"
    return replace(made, card=card)


def errors_beside_fitted_filter(model: Gain, data: Sequence[Client]) -> tuple[float, float]:
    """Rms errors m on validation pieces: of a model, NaN where its loss is less than 0, as a likelihood's, and of a
    Kalman filter with noise fitted on training pieces."""
    training, validation = (_joined(data, part) for part in ("training", "validation"))
    motions = training.truth.diff(dim=1) - training.dt * training.velocity[:, 1:]
    process, gnss = (
        off.square().nanmean((0, 1)).sqrt().nan_to_num(1.0).clip(LEAST_STD)
        for off in (motions, (training.gnss - training.truth) / (1.0 if training.scale is None else training.scale))
    )
    fitted = NoiseParameters().with_logs(torch.stack([process, torch.full((3,), LEAST_STD), gnss]).log())
    ours, theirs = (Judge([[validation]], net)(flatten([net])) for net in (model, fitted))
    return sqrt(ours) if ours >= 0.0 else nan, sqrt(theirs)


def _in_worker(job: Job, fleet: Drives, out: Path, worst: float, line: int | None, parent: int) -> None:
    leave_with(parent)
    LINE.set(line or 0)
    _train(job, fleet, out, worst, line is not None)


def _key(path: Path) -> str:
    """Of a checkpoint that can be read; no key of another one."""
    try:
        return str(read(path)[1].get("key"))
    except InputError:
        return "damaged"


def _joined(data: Sequence[Client], part: str) -> Segments:
    return Segments.join([getattr(c, part) for c in data])


def _made(job: Job, data: Sequence[Client], stage: str | None) -> Checkpoint:
    """The net, its weights along the way, and a card of how it was trained."""
    recipe, seed = job.recipe, job.setting.seed
    if recipe.kind == "federated":
        how = recipe.rounds, recipe.aggregate, recipe.local_epochs, seed, recipe.schedule, stage
        together = federate(untrained(job), data, *how)
        return Checkpoint(together.model, together.card, together.weights)
    training, validation, long = (_joined(data, part) for part in ("training", "validation", "long"))
    if recipe.kind == "okf":
        return Checkpoint(*fit_okf(training, validation, recipe.schedule.epochs, stage))
    done = fit(untrained(job), training, validation, recipe.schedule, seed, stage, long, str(job.client or ""))
    rows = [{name: getattr(row, name) for name in ("step", "training_loss", "validation_loss")} for row in done.history]
    card = {"history": rows, "best": done.best.step, "stopped": done.stopped, "seconds": done.seconds}
    return Checkpoint(done.model, card, torch.stack([row.weights for row in done.history]))
