"""Does federated training reach the centralised net, and when? RT-LE after every round (paper, Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

from coopoc.arrays import Floats
from coopoc.evaluate.metrics import rt_le
from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.learned.checkpoint import Checkpoint
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

FEDERATED, CENTRALISED = "fedkalmannet", "centralised"
NEAR = 0.03
"""Share of the centralised net's RT-LE within which the federated net has reached it."""


def cell(p: Params) -> list[Row]:
    """RT-LE of one net after every round; of an individual net only at its end.

    `rt_le_m` is of the weights that validated best so far, which is what a training that ended there keeps, and
    `raw_rt_le_m` of the weights as they are after the round. The centralised net's schedule is cut into as many equal
    parts as there are rounds.
    """
    checkpoint = weights.checkpoint(p["method"], p, p["train_seed"])
    rounds, last = (len(c.card["history"]) - 1 for c in (_federated(p), checkpoint))
    recording, who, drive = scene.recording(p), scene.egos(p["data"], str(p["egos"])), scene.fleet(p["data"])
    alone, start = p["method"] in weights.INDIVIDUAL, lineup.start(p)

    @lru_cache
    def score(row: int) -> Floats:
        return rt_le(checkpoint.after(row).method(p["method"], start)(recording, who), drive)

    found: list[Row] = []
    for number in (rounds,) if alone else range(rounds + 1):
        at = last if alone else round(number * last / rounds)
        raw, kept = score(at), score(checkpoint.kept(at))
        found += [
            {"round": number, "run": r, "ego": ego, "rt_le_m": float(kept[r, e]), "raw_rt_le_m": float(raw[r, e])}
            for e, ego in enumerate(who)
            for r in range(len(raw))
        ]
    return found


def _federated(p: Params) -> Checkpoint:
    """The federated net, whose rounds all others are counted in."""
    return weights.checkpoint(FEDERATED, p, p["train_seed"])


def key(p: Params) -> dict[str, str]:
    """What else changes the numbers: all have the rounds of the federated net."""
    return {**scene.facts(p), "weights": weights.key(p["method"], p), "rounds": weights.key(FEDERATED, p)}


def prepare(cells: Sequence[Params], jobs: int) -> None:
    """Train what the cells need, and the federated net in any case."""
    weights.prepare([{**p, "method": name} for p in cells for name in (p["method"], FEDERATED)], jobs)


def meaningful(p: Params) -> bool:
    """Seeds that are trained, and clients that are there."""
    return p["train_seed"] in weights.seeds(p) and weights.trainable(p)


def _curve(results: Results, method: str) -> list[float]:
    """Mean RT-LE after every round; empty if the net was not run."""
    where = views.present(results, {"method": method})
    rounds = sorted(results.select(where)["round"].unique()) if where else []
    return [results.interval("rt_le_m", method=method, round=number).mean for number in rounds]


def _conditions(results: Results) -> str:
    return scene.conditions({**results.settings, "train_seeds": results.frame["train_seed"].nunique()})


def _figure(results: Results) -> Plot | None:
    from coopoc.study import figures

    where = views.present(results, {"method": [FEDERATED, CENTRALISED]})
    if where is None:
        return None
    ends = {f"individual {c}": _curve(results, name) for c, name in enumerate(weights.INDIVIDUAL, start=1)}
    return figures.convergence(
        results,
        where=where,
        levels={name: curve[-1] for name, curve in ends.items() if curve},
        caption="RT-LE after every round with the weights that validated best so far (mean over training seeds, band "
        f"from the lowest to the highest); dashed: individual nets at their end. {_conditions(results)}",
    )


def _clients(results: Results) -> Plot:
    from coopoc.study import figures

    drives = scene.fleet(results.settings["clients"])
    shown = drives.select(drives.ids[: len(weights.INDIVIDUAL)])
    few = f" The first {len(shown.ids)} of {len(drives.ids)} clients." if len(shown.ids) < len(drives.ids) else ""
    return figures.paths(shown, caption=f"Paths and speeds of {drives.name}; a dot marks each start.{few}")


def _table(results: Results) -> Table | None:
    from coopoc.study.pivot import pivot

    where = views.present(results, {"method": [FEDERATED, CENTRALISED]})
    if where is None:
        return None
    return pivot(
        results,
        rows="round",
        columns="method",
        value="rt_le_m",
        where=where,
        decimals=3,
        intervals=False,
        caption=f"RT-LE [m] after every round. {_conditions(results)}",
    )


def _findings(results: Results) -> Sequence[str]:
    fed, centralised = _curve(results, FEDERATED), _curve(results, CENTRALISED)
    found = []
    if fed and centralised:
        last, end = len(fed) - 1, centralised[-1]
        reached = settled([value / end for value in fed])
        when = f"not within {100 * NEAR:g} % of it"
        if reached is not None:
            when = f"within {100 * NEAR:g} % of it from round {reached} on"
        gap = f"{100 * (fed[-1] / end - 1):+.1f} %"
        found.append(
            f"After {last} rounds: federated {fed[-1]:.3f} m, centralised {end:.3f} m ({gap}); federated is {when}."
        )
    names = {"federated": FEDERATED, "centralised": CENTRALISED}
    worst = views.listed({words: _worst(results, name) for words, name in names.items()})
    if worst:
        found += [
            f"Weights as they are after a round, not the best so far, the worst of any round and seed: {worst}.",
            f"The untrained net: {(fed or centralised)[0]:.2f} m.",
        ]
    return found


def settled(ratios: Sequence[float]) -> int | None:
    """First round from which on all ratios are within NEAR of 1; None if the last is not.

    >>> settled([1.5, 1.01, 0.9, 1.02, 1.0])
    3
    """
    outside = [number for number, ratio in enumerate(ratios) if not abs(ratio - 1) <= NEAR]
    first = outside[-1] + 1 if outside else 0
    return first if first < len(ratios) else None


def _worst(results: Results, method: str) -> float | None:
    """Largest mean RT-LE of the raw weights over rounds and training seeds; None if the net was not run."""
    where = views.present(results, {"method": method})
    if where is None:
        return None
    frame = results.select(where)
    return float(frame[frame["round"] > 0].groupby(["round", "train_seed"])["raw_rt_le_m"].mean().max())


STUDY = Study(
    name="convergence",
    question="Does federated training reach the centralised net, and after how many rounds?",
    cell=cell,
    key=key,
    prepare=prepare,
    grid={"method": (FEDERATED, CENTRALISED, *weights.INDIVIDUAL), "train_seed": (0, 1, 2, 3, 4)},
    where=meaningful,
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 1,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "start": "gnss",
        "egos": "auto",
        "runs": 30,
        "seed": 0,
        "train_seeds": 5,
    },
    tables={"rounds": _table},
    figures={"clients": _clients, "rounds": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "The centralised net has no rounds: its schedule is cut into equal parts, as many as the federated net has.",
    ),
    minutes=2,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("convergence"),
)
