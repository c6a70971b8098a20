"""Does federated training reach the centralised net, and when? RT-LE after every round (paper, Fig. 3)."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from coopoc import rt_le
from coopoc.arrays import Floats
from coopoc.evaluate.scores import rows_of
from coopoc.evaluate.statistics import Interval
from coopoc.study.cell import Params, Row
from coopoc.study.numbers import Results, Where, mean, ran, seed_means
from coopoc.study.style import CLIENTS, Panel, look

from . import lineup, scene, weights
from .views import Plot, curves, ran_at, table

FEDERATED, CENTRALISED = "fedkalmannet", "centralised"
BOTH = {"method": [FEDERATED, CENTRALISED]}
REACHED_SHARE = 0.03
"""Share of the centralised net's RT-LE within which the federated net has reached it."""


def cell(p: Params) -> list[Row]:
    """RT-LE of one net after every round; of an individual net only at its end.

    It is of the weights that validated best so far, which is what a training that ended there keeps. The centralised
    net's schedule is cut into as many equal parts as there are rounds.
    """
    made, federated = (weights.checkpoint(name, p, p["train_seed"]) for name in (p["method"], FEDERATED))
    last, rounds = (len(net.card["history"]) - 1 for net in (made, federated))
    recording, egos, drive = scene.trial(p)
    alone, start = p["method"] in weights.INDIVIDUAL, lineup.start(p)

    @lru_cache
    def score(row: int) -> Floats:
        return rt_le(made.after(row).method(p["method"], start)(recording, egos), drive)

    rows = []
    for number in (rounds,) if alone else range(rounds + 1):
        at = last if alone else round(number * last / rounds)
        rows += [{"round": number, **row} for row in rows_of({"rt_le_m": score(made.kept(at))}, egos)]
    return rows


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers beyond the parameters: all have the rounds of the federated net."""
    return {**scene.facts(p), "weights": weights.key(p["method"], p), "rounds": weights.key(FEDERATED, p)}


def prepare(cells: Sequence[Params], jobs: int) -> None:
    """Train the missing weights of the cells, and the federated net in any case."""
    weights.prepare([{**p, "method": name} for p in cells for name in (p["method"], FEDERATED)], jobs)


def meaningful(p: Params) -> bool:
    """Seeds that are trained, and clients that are there."""
    return p["train_seed"] in weights.seeds(p) and weights.trainable(p)


def _curve(results: Results, method: str) -> list[float]:
    """Mean RT-LE after every round; empty if the net was not run."""
    rounds = ran_at(results, "round")
    return [*ran({number: mean(results, {"method": method, "round": number}) for number in rounds}).values()]


def _seeds(results: Results, where: Where) -> Interval | None:
    """Mean over training seeds, with the lowest and the highest of them."""
    each = seed_means(results, where)
    return Interval(sum(each) / len(each), min(each), max(each), len(each)) if each else None


def _figure(results: Results) -> "Plot | None":
    rounds = ran_at(results, "round")
    ticks = {number: str(number) for number in rounds if number % 5 == 0}
    panel = Panel({number: {"round": number} for number in rounds}, xlabel="Round", ticks=ticks)
    text = (
        "RT-LE after every round with the weights that validated best so far (mean over training seeds, band from the "
        "lowest to the highest); horizontal: the individual nets at their end."
    )
    lines = [{"method": name, "label": look(name).label} for name in BOTH["method"]]
    ends = [
        {"method": name, "label": look(name).label, "linestyle": ("-", "--", ":", "-.")[k % 4]}
        for k, name in enumerate(weights.INDIVIDUAL)
    ]
    return curves([panel], lines, text, number=_seeds, levels=ends, width=6.4, log=True)(results)


def _clients(results: Results) -> "Plot":
    """The path of each client on one scale, with its number of steps and its range of speeds (paper, Fig. 2)."""
    from coopoc.study.plot import Plot, canvas

    drives: Any = weights.drives(results.settings["clients"])
    truth, shown = getattr(drives, "truth", drives), list(zip(range(1, 7), drives.ids, CLIENTS, strict=False))
    same = {"squeeze": False, "sharex": True, "sharey": True}
    with canvas(1, len(shown), width=2.0 * len(shown) + 0.4, height=2.6, **same) as (figure, (panels,)):
        for panel, (number, name, color) in zip(panels, shown, strict=True):
            column = truth.index(name)
            there = truth.present[:, column]
            x, speed = truth.position[there, column], np.linalg.norm(truth.velocity[there, column], axis=1)
            panel.plot(*x[:, :2].T, color=color)
            panel.plot(*x[0, :2], "ko", ms=3)
            panel.set_title(f"Client {number}: {len(x)} steps\n{speed.min():.1f} to {speed.max():.1f} m/s")
            panel.set(xlabel="East [m]", aspect="equal")
        panels[0].set_ylabel("North [m]")
    return Plot(figure, f"Paths of the clients of {truth.name} from the dot on, steps of {truth.dt:g} s; their speeds.")


def _findings(results: Results) -> list[str]:
    fed, centralised = _curve(results, FEDERATED), _curve(results, CENTRALISED)
    if not (fed and centralised):
        return []
    end = centralised[-1]
    reached = settled([value / end for value in fed])
    within = f"within {100 * REACHED_SHARE:g} % of it"
    when = f"not {within}" if reached is None else f"{within} from round {reached} on"
    text = f"After {len(fed) - 1} rounds: federated {fed[-1]:.3f} m, centralised {end:.3f} m "
    return [f"{text}({100 * (fed[-1] / end - 1):+.1f} %); federated is {when}."]


def settled(ratios: Sequence[float]) -> int | None:
    """First round from which on all ratios are within REACHED_SHARE of 1; None if the last is not.

    >>> settled([1.5, 1.01, 0.9, 1.02, 1.0])
    3
    """
    outside = [number for number, ratio in enumerate(ratios) if not abs(ratio - 1) <= REACHED_SHARE]
    first = outside[-1] + 1 if outside else 0
    return first if first < len(ratios) else None


STUDY = lineup.study(
    "convergence",
    "Does federated training reach the centralised net, and after how many rounds?",
    cell=cell,
    key=key,
    prepare=prepare,
    grid={"method": (FEDERATED, CENTRALISED, *weights.INDIVIDUAL), "train_seed": (0, 1, 2, 3, 4)},
    where=meaningful,
    scored=False,
    settings={
        **scene.DRAWN,
        **scene.WEIGHTS,
        **scene.SOLO,
        "scenario": 1,
        "velocity_ratio": 0.15,
        "runs": 30,
        "train_seeds": 5,
    },
    tables={
        "rounds": table(
            "RT-LE [m] after every round.", rows="round", columns="method", where=BOTH, decimals=3, intervals=False
        )
    },
    figures={"rounds": _figure, "clients": _clients},
    findings=_findings,
    limitations=("The centralised net has no rounds: its schedule is divided into as many equal parts.",),
    metrics={"rt_le_m": "lower"},
)
