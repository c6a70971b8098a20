"""Make the method of a cell by name and noise model, run it, and score every ego."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc import InputError, Study
from coopoc.arrays import Floats, one_of, refuse
from coopoc.paths import given_path
from coopoc.plugins import called, find, holders, in_file, names
from coopoc.study.cell import Params, Row
from coopoc.study.provenance import code_of
from coopoc.study.style import NOT_CAUSAL_SUFFIX
from coopoc.world.sensing import find_links
from coopoc.world.v2x import FIX_AND_VELOCITY

from . import scene, weights

if TYPE_CHECKING:  # they load numba, for which a mistake in --set need not wait
    from coopoc import Method, NoiseModel

COOPERATIVE = ("lkf-sa", "lkf-sa-edge", "msmv-r", "joint")
NOISE_MODELS = ("identity", "nominal", "fitted", "oracle", "none")
"""Of a registered method, "none" of one that assumes nothing."""
BOUND = ("bound", "bound")
"""The bound as (method, noise model)."""
PAST = ("bound", "with its past")
"""The bound of a star whose newcomers bring what they did before, as messages with estimates or sums do."""


def study(name: str, question: str, scored: bool = True, **options: Any) -> Study:
    """A study of methods: cells, keys, training and reference values as most studies have them, but for the options.

    Args:
        name: of the study.
        question: that it answers.
        scored: whether its rows come from `rows`, to which the setting `metric` adds a column.
        options: other fields of Study.
    """
    if scored:
        options["settings"] = {**options["settings"], "metric": ""}
    usual = {
        "cell": cell,
        "tracks": None if "cell" in options else tracks,
        "key": key,
        "prepare": weights.prepare,
        "recipe": weights.described,
        "idle": scene.idle,
        "reference": Path(__file__).parent / "reference" / f"{name}.json",
    }
    return Study(name, question, **{**usual, **options})


def cell(p: Params) -> list[Row]:
    """Rows of the cell's method; of the bound, one row per ego."""
    return bound_rows(p) if p["method"] == "bound" else rows(p)


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers of a cell beyond its parameters: of data, code, and trained or fitted noise.

    Raises:
        InputError: an unknown method or metric, or other settings that no cell can be computed with.
    """
    digests = dict(scene.facts(p))
    if weights.is_trained(p["method"]):
        digests["weights"] = weights.key(p["method"], p)
    elif p["method"] != "bound":
        digests["method"] = _code("coopoc.methods", p["method"])
        if not in_file(p["method"]):
            one_of("noise model", p.get("noise_model", "nominal"), NOISE_MODELS)
    if p.get("metric"):
        digests["metric"] = _code("coopoc.metrics", p["metric"])
    if p.get("noise_model") == "fitted":
        digests["clients"] = weights.drives(p["clients"]).digest
    return digests


@lru_cache
def _code(group: str, name: str) -> str:
    """Hash of the code of a plugin; "" of one of coopoc, which counts in `scene.facts`."""
    plugin, point = find(group, name), holders(group).get(name)
    return "" if point and point.value.startswith("coopoc.") else code_of(plugin)


def noise_model(p: Params) -> "NoiseModel | str":
    """Noise model of the cell's method.

    Raises:
        InputError: an oracle for real data, whose noise is unknown.
    """
    from coopoc import NoiseModel

    if p["noise_model"] == "fitted":
        return weights.fitted(p["clients"], p["velocity_reading"])
    if p["noise_model"] == "oracle":
        if scene.is_real(p["data"]):
            hint = "Take nominal or fitted on real data."
            raise InputError("noise_model", "'oracle'", "is for simulated noise", hint)
        return NoiseModel.oracle(scene.sensors(p), scene.fleet(p["data"]))
    return str(p["noise_model"])


def methods(p: Params) -> "list[tuple[int | None, Method]]":
    """The method of a cell, once per training seed if it is trained.

    Raises:
        InputError: an unknown name.
    """
    name, first = p["method"], start(p)
    if weights.is_trained(name):
        return [(seed, weights.checkpoint(name, p, seed).model.method(name, first)) for seed in weights.seeds(p)]
    method = own(name, noise_model(p))
    if hasattr(method, "x0"):
        method = replace(method, x0=first)
    if p["noise_model"] == "fitted" and not scene.is_real(p["data"]) and hasattr(method, "robust"):
        method = replace(method, robust=False)  # fitted to quieter drives: a gate takes the acting noise for wrong
    return [(None, method)]


def own(name: str, noise: "NoiseModel | str" = "nominal") -> Any:
    """A registered method or "mine.py:NAME" under a noise model.

    Raises:
        InputError: an unknown name, a class that takes no noise model, or what no study can use.
    """
    from coopoc import Message, Method

    shows = "docs/extend.md shows one; its first argument is noise_model."
    method = called("coopoc.methods", name, shows, noise)
    if not (isinstance(method, Method) and isinstance(method.name, str) and isinstance(method.message, Message)):
        raise InputError(
            "method",
            repr(name),
            "must have a name (text), cooperative (a bool) and a Message, and take a recording",
            shows,
        )
    return method


def named_method(name: str) -> "Method":
    """A registered method under the nominal noise model, a shipped learned gain, or "mine.py:NAME".

    Raises:
        InputError: an unknown name.
    """
    if in_file(name) or name in names("coopoc.methods"):
        made: Method = own(name)
        return made
    from coopoc.learned import load_method
    from coopoc.learned.recipes import shipped_weights

    if not given_path(name).is_file():
        one_of("method", name, (*names("coopoc.methods"), *shipped_weights()))
    return load_method(name)


def start(p: Params) -> Floats | None:
    """True first positions (E, 3) m of the egos if the cell starts there, as KalmanNet's published loop does."""
    if scene.start(p) == "gnss":
        return None
    first = scene.fleet(p["data"]).position[0, scene.recording(p).columns(scene.egos(p))]
    refuse("start", first, np.isnan(first), "needs a truth of each ego at the first step", "Take start=gnss.")
    return first


def rows(p: Params, quantiles: int = 0) -> list[Row]:
    """Rows of a cell, one per training seed, ego and run: errors, consistency, bytes, neighbours' errors.

    Args:
        p: parameters of the cell.
        quantiles: number of quantiles of the distances in each row.
    """
    from coopoc.evaluate.scores import causal, rows_of, scored
    from coopoc.methods.catalogue import METHODS

    (recording, who, drive), metric = scene.trial(p), p.get("metric", "")
    table = []
    strange = p["method"] not in METHODS and not weights.is_trained(p["method"])
    for seed, method in methods(p):
        columns = scored(method, recording, who, drive, quantiles, metric)
        more: Row = {} if seed is None else {"train_seed": seed}
        if strange:
            more["label"] = method.name + ("" if causal(method, recording, who) else NOT_CAUSAL_SUFFIX)
        table += rows_of(columns, who, **more)
    return table


def bound_rows(p: Params) -> list[Row]:
    """The bound of each ego over an ideal channel, with the bytes that the ego would receive.

    It needs no draws but where there are outliers or an attack: then it is that of an estimator that knows of them,
    the mean over runs. Newcomers bring their past, unless the noise model is that of BOUND or "star". Real data have
    none: the bound is of sensors that measure at every step.
    """
    from coopoc import bound_rt_le, posterior_bound

    past = p.get("noise_model") not in ("bound", "star")
    drive, v2x = scene.fleet(p["data"]), scene.channel(p)
    if scene.is_real(p["data"]):
        return [{"run": 0, "ego": ego} for ego in scene.egos(p)]
    acting, rate = scene.sensors(p), min(v2x.rate or np.inf, 1 / drive.dt)
    clean = scene.recording(p, remove_outliers=True) if acting.outliers or scene.attacking(p) else None
    rows_of_egos = []
    for ego in scene.egos(p):
        column = drive.index(ego)
        level = bound_rt_le(posterior_bound(drive, acting, column, v2x, past=past, recording=clean))
        near = len(find_links(drive, [column], v2x, acting.min_range)) / len(drive.t)
        received = near * FIX_AND_VELOCITY.payload * rate
        row = {"run": 0, "ego": ego, "rt_le_m": level}
        rows_of_egos.append(row | {"bytes_per_second": received, "payload_bytes_per_second": received})
    return rows_of_egos


def tracks(p: Params) -> Iterator[tuple[str, Floats, Floats]]:
    """Name, times s and positions m of each ego's path in each run, as the cell's method estimates it."""
    from coopoc.methods.track import follow

    recording = scene.recording(p)
    for seed, method in methods(p) if p["method"] != "bound" else ():
        for ego in scene.egos(p):
            track = follow(method, recording, [ego])
            there = slice(None) if track.absent is None else ~track.absent[:, 0]
            for run in range(recording.runs):
                name = f"{ego}-run{run}" + (f"-seed{seed}" if seed is not None else "")
                yield name, recording.t[there], track.x[run, there, 0]
