"""The methods of a cell by name and knowledge, and the rows that say how they did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.methods.catalogue import METHODS
from coopoc.methods.cooperative_map import CooperativeMAP
from coopoc.methods.kalman import Kalman
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.plugins import find
from coopoc.study.study import Params, Row
from coopoc.world.recording import Recording
from coopoc.world.sensing import find_links
from coopoc.world.v2x import FIX_AND_VELOCITY

from . import scene, weights
from .scores import Scores, scored

COOPERATIVE = ("lkf-sa", "lkf-sa-edge", "msmv-r", "joint", "cooperative-map")


def key(p: Params) -> dict[str, str]:
    """What changes the numbers of a cell beyond its parameters: data, code, and what was trained or fitted.

    Raises:
        InputError: a method that nobody has, or other settings that no cell can be computed with.
    """
    found = dict(scene.facts(p))
    if p["method"] not in METHODS and not weights.is_trained(p["method"]) and p["method"] != "bound":
        find("coopoc.methods", p["method"])
    if weights.is_trained(p["method"]):
        found["weights"] = weights.key(p["method"], p)
    if p.get("noise_model") == "fitted":
        found["clients"] = scene.fleet(p["clients"]).digest
    return found


def noise_model(p: Params) -> NoiseModel | str:
    """What the cell's method assumes.

    Raises:
        InputError: an oracle for real data, whose noise nobody knows.
    """
    if p["noise_model"] == "fitted":
        return weights.fitted(p)
    if p["noise_model"] == "oracle":
        if scene.is_real(p["data"]):
            raise InputError(
                "noise_model", "'oracle'", "is for simulated noise", "Take nominal or fitted on real data."
            )
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
        together = name == "cooperative" and recording.v2x.max_neighbours > 0
        made = _together if together else _learned
        return [(seed, made(name, p, seed, known)) for seed in weights.seeds(p)]
    method: Method = find("coopoc.methods", name)(noise_model(p))
    if isinstance(method, Kalman):
        method = replace(method, x0=known)
    if isinstance(method, CooperativeMAP):
        method = replace(method, backend=p.get("backend", method.backend))
    return [(None, method)]


def start(p: Params) -> Floats | None:
    """True positions of the egos at the first step if the cell starts there, as KalmanNet's published loop does."""
    if scene.start(p) == "gnss":
        return None
    drive = scene.fleet(p["data"])
    return drive.position[0, [drive.index(i) for i in scene.egos(p["data"], str(p["egos"]))]]


def _learned(name: str, p: Params, seed: int, known: Floats | None) -> Method:
    return weights.checkpoint(name, p, seed).model.method(name, known)


def _together(name: str, p: Params, seed: int, known: Floats | None) -> Method:
    """The gain that tells neighbours its noise: sums where messages are in time, else the newest fix."""
    from coopoc.learned import CooperativeGain

    model: Any = weights.checkpoint(name, p, seed).model
    return CooperativeGain(model, sums=scene.channel(p).latency == 0, name=name)


def rows(p: Params, *, quantiles: int = 0, own: Method | None = None) -> list[Row]:
    """Rows of a cell, one per training seed, ego and run: errors, consistency, bytes, neighbours' errors.

    Args:
        quantiles: of the distances, how many in each row. own: instead of the method that the cell names.
    """
    drive, recording = scene.fleet(p["data"]), scene.recording(p)
    who = scene.egos(p["data"], str(p["egos"]))
    found: list[Row] = []
    for seed, method in [(None, own)] if own else methods(p, recording):
        scores = scored(method, recording, who, drive, quantiles)
        found += _rows(scores, recording, who, {} if seed is None else {"train_seed": seed})
    return found


def bound_rows(p: Params) -> list[Row]:
    """The bound of each ego over an ideal channel, which needs no draws, with what the ego would receive."""
    drive, v2x = scene.fleet(p["data"]), scene.channel(p)
    acting, rate = scene.sensors(p), min(v2x.rate or np.inf, 1 / drive.dt)
    found: list[Row] = []
    for ego in scene.egos(p["data"], str(p["egos"])):
        column = drive.index(ego)
        level = bound_rt_le(posterior_bound(drive, acting, column, v2x))
        near = len(find_links(drive, [column], v2x.max_neighbours, v2x.radius, acting.min_range)) / len(drive.t)
        received = near * FIX_AND_VELOCITY.payload * rate
        sizes = {"bytes_per_second": received, "payload_bytes_per_second": received}
        found.append({"run": 0, "ego": ego, "rt_le_m": level, "neighbours_mean": near, **sizes})
    return found


def _rows(scores: Scores, recording: Recording, who: Sequence[str], extra: dict[str, Any]) -> list[Row]:
    served = len(recording.ids) if recording.observers == tuple(range(len(recording.ids))) else len(who)
    seconds, inside = scores.seconds / scores.runs / served, scores.inside
    found = []
    for e, ego in enumerate(who):
        near = len(recording.links.of(recording.ids.index(ego))) / len(recording.t)
        for r in range(scores.runs):
            row: Row = {"run": r, "ego": ego, **extra, "neighbours_mean": near}
            row |= {name: float(values[r, e]) for name, values in scores.columns.items()}
            if scores.nees is not None:
                row["nees_inside"] = float(inside[e])
            row["seconds"] = seconds
            if scores.quantiles.size:
                row["error_quantiles_m"] = scores.quantiles[r, e].tolist()
            found.append(row)
    return found
