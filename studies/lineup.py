"""The method of a cell by name and noise model, and its rows, which the studies of methods share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.evaluate.bounds import bound_rt_le, past_bound, posterior_bound
from coopoc.evaluate.scores import rows_of, scored
from coopoc.methods.catalogue import METHODS
from coopoc.methods.kalman import Kalman
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.sliding_window import CooperativeMAP
from coopoc.methods.track import Method
from coopoc.plugins import find
from coopoc.study.study import Params, Row, Study
from coopoc.study.style import look
from coopoc.world.recording import Recording
from coopoc.world.sensing import find_links
from coopoc.world.v2x import FIX_AND_VELOCITY

from . import scene, weights
from .presence import complete, scored_where_present

COOPERATIVE = ("lkf-sa", "lkf-sa-edge", "msmv-r", "joint", "cooperative-map")
BOUND = ("bound", "bound")
"""The bound as (method, noise model)."""
PAST = ("bound", "with its past")
"""The bound of a star whose newcomers bring what they did before, as messages with estimates or sums do."""


def study(name: str, question: str, settings: Mapping[str, Any], scored: bool = True, **options: Any) -> Study:
    """A study of methods: cells, keys, training and reference values as most studies have them, but for the options.

    Args:
        name: of the study.
        question: that it answers.
        settings: of its cells.
        scored: whether its rows come from `rows`, to which the setting `metric` adds a column.
        options: other fields of Study.
    """
    settings = {**settings, "metric": ""} if scored else settings
    usual = {"settings": settings, "cell": cell, "key": key, "prepare": weights.prepare, "recipe": weights.described}
    return Study(name, question, **{**usual, "reference": reference(name), **options})


def reference(name: str) -> Path:
    """File of a study's reference values."""
    return Path(__file__).parent / "reference" / f"{name}.json"


def of(method: str, known: str, /, **at: Any) -> dict[str, Any]:
    """A method under a noise model, as parameters of a cell or as a selection."""
    return {**at, "method": method, "noise_model": known}


HEAD = ("Method", "Noise model")


def labelled(pairs: Iterable[tuple[str, str]], **at: Any) -> list[tuple[tuple[str, str], dict[str, Any]]]:
    """Rows of a table under HEAD: labels and selection of each method under its noise model."""
    return [((look(method).label, known), of(method, known, **at)) for method, known in pairs]


def cell(p: Params) -> list[Row]:
    """Rows of the cell's method; of the bound, one row per ego."""
    return bound_rows(p) if p["method"] == "bound" else rows(p)


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers of a cell beyond its parameters: of data, code, and trained or fitted noise.

    Raises:
        InputError: an unknown method or metric, or other settings that no cell can be computed with.
    """
    found = dict(scene.facts(p))
    if weights.is_trained(p["method"]):
        found["weights"] = weights.key(p["method"], p)
    elif p["method"] not in (*METHODS, "bound"):
        find("coopoc.methods", p["method"])
    if p.get("metric"):
        find("coopoc.metrics", p["metric"])
    if p.get("noise_model") == "fitted":
        found["clients"] = weights.drives(p["clients"]).digest
    return found


def noise_model(p: Params) -> NoiseModel | str:
    """Noise model of the cell's method.

    Raises:
        InputError: an oracle for real data, whose noise is unknown.
    """
    if p["noise_model"] == "fitted":
        return weights.fitted(p)
    if p["noise_model"] == "oracle":
        if scene.is_real(p["data"]):
            hint = "Take nominal or fitted on real data."
            raise InputError("noise_model", "'oracle'", "is for simulated noise", hint)
        return NoiseModel.oracle(scene.sensors(p), scene.fleet(p["data"]))
    if p["noise_model"] == "heading taken as exact":
        return NoiseModel.nominal(replace(scene.sensors(p), heading_std=0.0, heading_bias_std=0.0))
    return str(p["noise_model"])


def methods(p: Params, recording: Recording) -> list[tuple[int | None, Method]]:
    """The method of a cell, once per training seed if it is trained.

    Raises:
        InputError: an unknown name.
    """
    name, known = p["method"], start(p)
    if weights.is_trained(name):
        models: list[tuple[int, Any]] = [(seed, weights.checkpoint(name, p, seed).model) for seed in weights.seeds(p)]
        if name != "cooperative" or recording.v2x.max_neighbours == 0:
            return [(seed, model.method(name, known)) for seed, model in models]
        from coopoc.learned import CooperativeGain

        return [(seed, CooperativeGain(model, name)) for seed, model in models]
    method: Method = find("coopoc.methods", name)(noise_model(p))
    if isinstance(method, Kalman):
        method = replace(method, x0=known)
    if isinstance(method, CooperativeMAP):
        method = replace(method, backend=p.get("backend", method.backend))
    return [(None, method)]


def start(p: Params) -> Floats | None:
    """True first positions (E, 3) m of the egos if the cell starts there, as KalmanNet's published loop does."""
    if scene.start(p) == "gnss":
        return None
    drive = scene.fleet(p["data"])
    if not complete(scene.recording(p), scene.egos(p["data"], str(p["egos"])), drive):
        raise InputError("start", "'true'", "needs egos that are there throughout", "Take start=gnss.")
    return drive.position[0, [drive.index(i) for i in scene.egos(p["data"], str(p["egos"]))]]


def rows(
    p: Params,
    quantiles: int = 0,
    made: Sequence[tuple[int | None, Method]] = (),
    seen: Recording | None = None,
) -> list[Row]:
    """Rows of a cell, one per training seed, ego and run: errors, consistency, bytes, neighbours' errors.

    Args:
        p: parameters of the cell.
        quantiles: number of quantiles of the distances in each row.
        made: methods and their training seeds, instead of the method that the cell names.
        seen: recording, instead of that of the cell.
    """
    recording = scene.recording(p) if seen is None else seen
    who, drive, metric = scene.egos(p["data"], str(p["egos"])), scene.fleet(p["data"]), str(p.get("metric", ""))
    found: list[Row] = []
    for seed, method in made or methods(p, recording):
        score = scored if complete(recording, who, drive) else scored_where_present
        columns = score(method, recording, who, drive, quantiles, metric)
        found += rows_of(columns, who, **({} if seed is None else {"train_seed": seed}))
    return found


def bound_rows(p: Params) -> list[Row]:
    """The bound of each ego over an ideal channel, which needs no draws, with the bytes that the ego would receive.

    The noise model of PAST makes it the bound with the past of newcomers. Real data have none: the bound is of sensors
    that measure at every step.
    """
    bound = past_bound if (p["method"], p.get("noise_model")) == PAST else posterior_bound
    drive, v2x = scene.fleet(p["data"]), scene.channel(p)
    if scene.is_real(p["data"]):
        return [{"run": 0, "ego": ego} for ego in scene.egos(p["data"], str(p["egos"]))]
    acting, rate = scene.acting(p), min(v2x.rate or np.inf, 1 / drive.dt)
    found: list[Row] = []
    for ego in scene.egos(p["data"], str(p["egos"])):
        column = drive.index(ego)
        level = bound_rt_le(bound(drive, acting, column, v2x))
        near = len(find_links(drive, [column], v2x.max_neighbours, v2x.radius, acting.min_range)) / len(drive.t)
        received = near * FIX_AND_VELOCITY.payload * rate
        sizes = {"bytes_per_second": received, "payload_bytes_per_second": received}
        found.append({"run": 0, "ego": ego, "rt_le_m": level, "neighbours_mean": near, **sizes})
    return found
