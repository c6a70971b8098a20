"""Does federated training reach the centralised net, and when? RT-LE after every round (paper, Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

from coopoc.arrays import Floats
from coopoc.evaluate.metrics import rt_le
from coopoc.study.environment import revision
from coopoc.study.study import Params, Row, Study

from . import scene, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

NETS = ("fedkalmannet", "centralised", "individual1", "individual2", "individual3", "individual4")


def cell(p: Params) -> list[Row]:
    """RT-LE of one net after every round; of an individual net only at its end.

    `rt_le_m` is of the weights that validated best so far, which is what a training that ended there keeps, and
    `raw_rt_le_m` of the weights as they are after the round. The centralised net's schedule is cut into as many equal
    parts as there are rounds.
    """
    from coopoc.learned.method import LearnedGain

    checkpoint = weights.checkpoint(p["method"], p, p["train_seed"])
    rounds, last = int(p["rounds"]), len(checkpoint.card["history"]) - 1
    recording, who, drive = scene.recording(p), scene.egos(p["data"], str(p["egos"])), scene.fleet(p["data"])
    alone = p["method"].startswith("individual")

    @lru_cache
    def score(row: int) -> Floats:
        return rt_le(LearnedGain(checkpoint.after(row))(recording, who), drive)

    found: list[Row] = []
    for number in (rounds,) if alone else range(rounds + 1):
        at = last if alone else round(number * last / rounds)
        raw, kept = score(at), score(checkpoint.kept(at))
        found += [
            {"round": number, "run": r, "ego": ego, "rt_le_m": float(kept[r, e]), "raw_rt_le_m": float(raw[r, e])}
            for e, ego in enumerate(who) for r in range(len(raw))
        ]  # fmt: skip
    return found


def key(p: Params) -> dict[str, str]:
    """What else changes the numbers."""
    return {
        **scene.facts(p), "code": revision("coopoc.world", "coopoc.methods"),
        "weights": weights.key(p["method"], p),
    }  # fmt: skip


def _mean(results: Results, method: str, number: int) -> float:
    return results.interval("rt_le_m", method=method, round=number).mean


def _worst(results: Results, method: str) -> float:
    """Largest mean RT-LE of the raw weights over rounds and training seeds."""
    frame = results.select(method=method)
    return float(frame[frame["round"] > 0].groupby(["round", "train_seed"])["raw_rt_le_m"].mean().max())


def _figure(results: Results) -> Plot:
    from coopoc.study import figures

    last = int(results.settings["rounds"])
    levels = {f"individual {c}": _mean(results, f"individual{c}", last) for c in range(1, 5)}
    return figures.convergence(
        results, where={"method": ["fedkalmannet", "centralised"]}, levels=levels,
        caption="RT-LE after every round with the weights that validated best so far (mean over training seeds, band "
        f"from the lowest to the highest); dashed: individual nets at their end. {scene.conditions(results.settings)}",
    )  # fmt: skip


def _clients(results: Results) -> Plot:
    from coopoc.study import figures

    return figures.paths(scene.fleet(results.settings["clients"]))


def _table(results: Results) -> Table:
    return results.table(
        rows="round", columns="method", value="rt_le_m", where={"method": ["fedkalmannet", "centralised"]}, decimals=3,
        intervals=False, caption=f"RT-LE [m] after every round. {scene.conditions(results.settings)}",
    )  # fmt: skip


def _findings(results: Results) -> Sequence[str]:
    last = int(results.settings["rounds"])
    fed, centralised = _mean(results, "fedkalmannet", last), _mean(results, "centralised", last)
    reached = next((n for n in range(last + 1) if _mean(results, "fedkalmannet", n) <= 1.03 * centralised), None)
    when = f"within 3 % of it from round {reached} on" if reached is not None else "not within 3 % of it"
    gap = f"{100 * (fed / centralised - 1):+.1f} %"
    return [
        f"After {last} rounds: federated {fed:.3f} m, centralised {centralised:.3f} m ({gap}); federated is {when}.",
        f"Weights as they are after a round, not the best so far: the worst of rounds 1 to {last} and seeds is "
        f"{_worst(results, 'fedkalmannet'):.2f} m federated and {_worst(results, 'centralised'):.2f} m centralised.",
        f"Both start at {_mean(results, 'fedkalmannet', 0):.2f} m, the untrained net.",
    ]


STUDY = Study(
    name="convergence",
    question="Does federated training reach the centralised net, and after how many rounds?",
    cell=cell,
    key=key,
    prepare=weights.prepare,
    grid={"method": NETS, "train_seed": (0, 1, 2, 3, 4)},
    where=lambda p: p["train_seed"] < p["train_seeds"],
    settings={
        "data": "town10", "clients": "town10-clients", "weights": "runs/weights", "scenario": 1, "velocity_ratio": 0.15,
        "velocity_reading": "axis", "start": "gnss", "egos": "3", "runs": 30, "seed": 0, "rounds": 20,
        "train_seeds": 5,
    },
    tables={"rounds": _table},
    figures={"clients": _clients, "rounds": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=("A round of the centralised net is a twentieth of its schedule; it has no rounds of its own.",),
    minutes=2,
)  # fmt: skip
