"""Which rule combines nets best when clients are alike, differ, are Byzantine or absent (the paper's outlook).

    coopoc run examples/aggregation.py:STUDY

A study of one's own in one file: docs/extend.md. What it finds stands in docs/federation.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.evaluate.metrics import rt_le
from coopoc.evaluate.scores import rows_of
from coopoc.evaluate.statistics import Interval, over_seeds
from coopoc.learned.federation.federate import Participation
from coopoc.methods.kalman import Kalman
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.studies import lineup, scene
from coopoc.studies.views import TableView, of, selections
from coopoc.study.cell import Params, Row
from coopoc.study.numbers import Where, across, by_seed, interval, listed, mean, paired, seed_means
from coopoc.study.study import Study
from coopoc.study.style import look
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

if TYPE_CHECKING:
    from coopoc.learned.training.clients import Client
    from coopoc.study.plot import Plot
    from coopoc.study.results import Results

RULES = ("mean", "median", "trimmed_mean", "krum", "multi_krum")
BESIDE = ("centralised", "kalman")
"""Methods beside the rules under `iid` and `heterogeneous`."""
METHODS = (*RULES, *BESIDE, "bound")
"""Methods of the grid; other rules by name or path: `--set method=mean,mine.py:RULE`."""
CONDITIONS = {
    "iid": "equal sensors, equal amounts of data",
    "heterogeneous": "GNSS 1, 1.5, 2.5, 4 m times velocity 5, 10, 20 %, all, two thirds or one third of the pieces",
    "poisoned update": "one client sends its update times a negative factor",
    "poisoned data": "one client's reference drive lies beside the true one",
    "half absent": "half of the clients are asked, drawn anew in every round",
}
GNSS_STD, VELOCITY_RATIO, SHARES = (1.0, 1.5, 2.5, 4.0), (0.05, 0.10, 0.20), (1.0, 2 / 3, 1 / 3)
LOST = 1e6
"""m, the RT-LE of a net whose estimates left every bound; a mean above a thousandth of it is shown as "diverged"."""
OF_THE_TEST = ("condition", "method", "scenario", "velocity_ratio", "runs", "egos", "data", "seed")
"""Parameters that change no training, and the two that name it."""


def meaningful(p: Params) -> bool:
    """Every rule under every condition in which enough clients take part; other methods where they are compared."""
    from coopoc.learned.federation.rules import rule

    condition, method = str(p["condition"]), str(p["method"])
    if method in BESIDE:
        return condition in ("iid", "heterogeneous")
    if method == "bound":
        return condition == "iid"
    asked = int(p["members"]) // (2 if condition == "half absent" else 1)
    enough: bool = rule(method).least <= asked
    return enough


def members(p: Params) -> Fleet:
    """The vehicles that train: a number of the fleet of clients, evenly spaced."""
    fleet, count = scene.fleet(p["clients"]), int(p["members"])
    if not 2 <= count <= len(fleet.ids):
        raise InputError("members", count, f"must be 2..{len(fleet.ids)}, the vehicles of the fleet", "Take fewer.")
    return fleet.select([int(k) for k in np.arange(count) * len(fleet.ids) // count])


def noise(p: Params) -> list[Sensors]:
    """Noise of each client: the paper's training noise, or one pair of sensors after the other."""
    paper, count = Sensors.paper_training(p["velocity_reading"]), int(p["members"])
    if p["condition"] != "heterogeneous":
        return [paper] * count
    kinds = [replace(paper, gnss_std=(g,) * 3, velocity_std_ratio=ratio) for ratio in VELOCITY_RATIO for g in GNSS_STD]
    return [kinds[i % len(kinds)] for i in range(count)]


def clients(p: Params, seed: int) -> "tuple[Client, ...]":
    """The clients of a condition for one training seed; the one in the middle is the poisoned one.

    The noise of a vehicle is keyed by its name: it is the same as with its sensors for all. Of the training pieces the
    first ceil(share n) remain.
    """
    from coopoc.learned.training import clients as training

    count, acting = int(p["members"]), noise(p)
    shares = [SHARES[i % 3] if p["condition"] == "heterogeneous" else 1.0 for i in range(count)]
    made = {one: training.clients(members(p), one, seed=seed, piece=int(p["piece"])) for one in dict.fromkeys(acting)}
    whole = [made[sensors][i] for i, sensors in enumerate(acting)]
    group = [
        replace(client, training=client.training.take(range(ceil(share * len(client.training)))))
        for client, share in zip(whole, shares, strict=True)
    ]
    if p["condition"] == "poisoned data":
        group[count // 2] = moved(group[count // 2], float(p["offset_m"]))
    return tuple(group)


def moved(client: "Client", offset: float) -> "Client":
    """The client with its reference drive `offset` m beside the true one on every axis."""
    parts = {name: getattr(client, name) for name in ("training", "validation", "long")}
    return replace(client, **{name: replace(part, truth=part.truth + offset) for name, part in parts.items()})


def fitted(p: Params) -> NoiseModel:
    """Noise model fitted to the recordings of all clients with training seed 0."""
    fleet, acting = members(p), noise(p)
    recordings = {sensors: observe(fleet, sensors, V2X(0), seed=0) for sensors in dict.fromkeys(acting)}
    gnss, velocity = (
        np.stack([getattr(recordings[sensors], name)[:, :, i] for i, sensors in enumerate(acting)], axis=2)
        for name in ("gnss", "velocity")
    )
    return NoiseModel.fitted(replace(recordings[acting[0]], gnss=gnss, velocity=velocity), fleet)


@dataclass(frozen=True)
class Byzantine(Participation):
    """Participation with Byzantine clients, which send theta + scale (theta_i - theta).

    Args:
        names: of the Byzantine clients.
        scale: of their updates; negative reverses them.

    References:
        Blanchard et al., NeurIPS 2017, section 5; Bagdasaryan et al., How to Backdoor Federated Learning, AISTATS 2020.

    >>> import torch
    >>> Byzantine(names=("a",), scale=-2.0).answer("a", torch.ones(1), torch.tensor([2.0])).tolist()
    [-1.0]
    """

    names: tuple[str, ...] = ()
    scale: float = -10.0

    def answer(self, name: str, theta: Tensor, weights: Tensor) -> Tensor:
        """Scaled if the client is Byzantine."""
        return theta + self.scale * (weights - theta) if name in self.names else weights


@lru_cache(maxsize=2)
def trained(condition: str, method: str, given: tuple[tuple[str, Any], ...]) -> tuple[Any, ...]:
    """Nets of all training seeds of a method under a condition."""
    from coopoc.learned import GainNet, federate

    p = {**dict(given), "condition": condition, "method": method}
    nets = [GainNet(int(p["in_mult"]), int(p["out_mult"]), seed=seed) for seed in range(int(p["train_seeds"]))]
    groups = [clients(p, seed) for seed in range(len(nets))]
    if method == "centralised":
        return _pooled(p, nets, groups)
    participation = Participation(share=0.5 if condition == "half absent" else 1.0)
    if condition == "poisoned update":
        participation = Byzantine(names=(members(p).ids[int(p["members"]) // 2],), scale=-float(p["factor"]))
    return tuple(
        federate(net, group, int(p["rounds"]), method, int(p["local_epochs"]), seed, participation=participation).model
        for seed, (net, group) in enumerate(zip(nets, groups, strict=True))
    )


def _pooled(p: Params, nets: list[Any], groups: "list[tuple[Client, ...]]") -> tuple[Any, ...]:
    """Nets trained on all pieces in one place."""
    from coopoc.learned import Schedule, Segments, fit

    made = []
    for seed, (net, group) in enumerate(zip(nets, groups, strict=True)):
        parts = ("training", "validation", "long")
        training, validation, long = (Segments.join([getattr(client, part) for client in group]) for part in parts)
        made.append(fit(net, training, validation, Schedule(epochs=int(p["steps"])), seed, long=long).model)
    return tuple(made)


def cell(p: Params) -> list[Row]:
    """Rows of a method under a condition in a scenario."""
    if p["method"] == "bound":
        return lineup.bound_rows(p)
    trial = scene.trial(p)
    if p["method"] == "kalman":
        return rows_of({"rt_le_m": bounded_rt_le(Kalman(fitted(p), robust=False), *trial)}, trial[1])
    training = tuple((name, value) for name, value in p.items() if name not in OF_THE_TEST)
    rows: list[Row] = []
    for seed, net in enumerate(trained(p["condition"], p["method"], training)):
        columns = {"rt_le_m": bounded_rt_le(net.method(p["method"]), *trial)}
        rows += rows_of(columns, trial[1], train_seed=seed)
    return rows


def bounded_rt_le(method: Method, recording: Recording, egos: Sequence[str], drive: Fleet) -> Floats:
    """RT-LE (R, E) m, cut at LOST, which is also that of a method whose estimates are not finite."""
    try:
        return np.fmin(rt_le(method(recording, egos), drive), LOST)
    except InputError as error:
        if error.field != "x":  # the estimates of the track, of which one is not finite
            raise
        return np.full((recording.runs, len(egos)), LOST)


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers beyond the parameters: data, code and the library that trains."""
    return {**scene.facts(p), "clients": members(p).digest, "torch": version("torch")}


def _error(results: "Results", where: Where) -> Interval | str | None:
    each = interval(results, where)
    return "diverged" if each and not each.mean < LOST / 1e3 else each


def _table(scenario: int) -> TableView:
    """Methods down, conditions across."""
    at = {"scenario": scenario}

    def rows(results: "Results") -> Any:
        names = dict.fromkeys((*METHODS, *results.frame.get("method", ())))
        return [((look(method).label,), {"method": method}) for method in names]

    return selections(
        ("Rule",),
        rows,
        across(_error, {name.capitalize(): {**at, "condition": name} for name in CONDITIONS}),
        "RT-LE [m] of the weights that validated best.",
        *(f"{name}: {text};" for name, text in CONDITIONS.items()),
        "KF: fitted to the noise that the clients saw; the bound knows the acting noise and no bias.",
        at=at,
        best="min",
        along="column",
        decimals=3,
    )


def _multiple(results: "Results", where: Where) -> list[float]:
    """RT-LE of each training seed as a multiple of the mean's under iid."""
    whole = mean(results, {"scenario": where["scenario"], "condition": "iid", "method": "mean"})
    each = seed_means(results, {name: value for name, value in where.items() if name != "noise_model"})
    return [value / whole for value in each] if whole else []


def _finding(results: "Results", at: dict[str, Any]) -> str:
    """RT-LE of the mean under a condition, and which rules are better or worse over all training seeds."""
    plain = by_seed(results, {**at, "method": "mean"})
    if not plain:
        return ""
    better, worse = list[str](), list[str]()
    for rule in RULES[1:]:
        seeds = by_seed(results, {**at, "method": rule})
        if len(seeds) == len(plain) > 1:
            gap = over_seeds(np.subtract(*np.split(np.array(paired(results, "rt_le_m", *seeds, *plain)[0]), 2)))
            (better if gap.high < 0 else worse if gap.low > 0 else []).append(f"{rule} {gap.mean:+.3f} m")
    beside = {
        words: mean(results, {**at, "condition": "iid", "method": method})
        for words, method in (("KF", "kalman"), ("bound", "bound"))
    }
    lists = [", ".join(rules) or "no rule" for rules in (better, worse)]
    return (
        f"Scenario {at['scenario']}, {at['condition']}: "
        f"{listed({'mean': mean(results, {**at, 'method': 'mean'}), **beside})}. "
        f"Better than the mean over training seeds (95 %): {lists[0]}; worse: {lists[1]}."
    )


def _multiples(results: "Results") -> "Plot | None":
    """Multiples of each rule under each condition as dots, one per training seed; a line marks the mean under iid."""
    from coopoc.study.plot import Plot, canvas, plain_log, strokes

    where = {name: {"scenario": 2, "condition": name} for name in CONDITIONS}
    drawn = {(rule, name): _multiple(results, of(rule, "none", **at)) for name, at in where.items() for rule in RULES}
    if not any(map(len, drawn.values())):
        return None
    with canvas(1, len(CONDITIONS), sharex=True, sharey=True, squeeze=False, width=11.0, height=2.4) as (
        figure,
        (axes,),
    ):
        for panel, name in zip(axes, CONDITIONS, strict=True):
            panel.axvline(1.0, color="black", linewidth=0.9)
            for row, rule in enumerate(RULES):
                style = {**strokes({"method": rule}), "linestyle": "none", "markersize": 4}
                panel.plot(values := drawn[rule, name], np.full(len(values), row), **style)
            panel.set(title=name.capitalize(), xlabel="× mean under iid")
            plain_log(panel.xaxis)
        axes[0].set(yticks=range(len(RULES)), yticklabels=[look(rule).label for rule in RULES])
        axes[0].invert_yaxis()
    text = "RT-LE of the kept weights as a multiple of the mean's under iid, a dot per training seed."
    return Plot(figure, scene.caption(results, text, scenario=2))


STUDY = Study(
    "aggregation",
    "Which rule should combine the clients' nets when clients are alike, heterogeneous, poisoned or absent?",
    cell=cell,
    key=key,
    grid={"condition": tuple(CONDITIONS), "method": METHODS, "scenario": (1, 2)},
    where=meaningful,
    shares=("condition", "method"),
    settings={
        **scene.DRAWN,
        "clients": "town10-validation",
        "members": 12,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "runs": 15,
        "train_seeds": 3,
        "rounds": 20,
        "local_epochs": 2,
        "steps": 1500,
        "piece": 100,
        "in_mult": 40,
        "out_mult": 5,
        "factor": 20.0,
        "offset_m": 10.0,
    },
    tables={
        "scenario1": _table(1),
        "scenario2": _table(2),
    },
    figures={
        "multiples": _multiples,
    },
    findings=lambda results: [_finding(results, {"scenario": s, "condition": c}) for s in (1, 2) for c in CONDITIONS],
    limitations=(
        "The selected round depends on the reports of all participating clients, the poisoned one included.",
        "Rules have their default parameters, of which some were chosen under iid on town10-validation; krum and "
        "multi_krum expect one bad client.",
        "Intervals of the differences are not corrected for the number of rules that are compared.",
    ),
    metrics={"rt_le_m": "lower"},
    reference=Path(__file__).with_suffix(".json"),
)
