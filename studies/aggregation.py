"""Which rule combines the clients' nets best when they are alike, differ, lie or stay away (the paper's outlook)."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.evaluate.metrics import rt_le
from coopoc.evaluate.statistics import Interval, over_seeds
from coopoc.methods.kalman import Kalman
from coopoc.methods.track import Method
from coopoc.study.study import Params, Row, Study
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

from . import lineup, scene, views
from .federations import CONDITIONS, GRAPHS, RULES, WIRES, fitted, members, trained

if TYPE_CHECKING:
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

LOST = 1e6
"""m, the RT-LE of a net whose estimates left every bound; a mean above a thousandth of it is shown as "diverged"."""
REFERENCES = ("kalman", "bound")
BESIDE = ("centralised", *GRAPHS, "kalman")
"""Methods beside the rules under `iid` and `heterogeneous`."""
METHODS = (*RULES, *BESIDE, *WIRES, "bound")
"""Methods of the grid; other rules by name or path: `--set method=mean,mine.py:RULE`."""
OF_THE_TEST = ("condition", "method", "scenario", "velocity_ratio", "runs", "egos", "data", "seed")
"""Parameters that change no training, and the two that name it."""


def meaningful(p: Params) -> bool:
    """Every rule under every condition in which enough clients take part; other methods where they are compared.

    `uniform` is `mean` where all clients have as many pieces.
    """
    from coopoc.learned.federation.aggregate import rule

    condition, method, asked = str(p["condition"]), str(p["method"]), int(p["members"])
    if condition == "half absent":
        asked //= 2
    if method in BESIDE:
        return condition in ("iid", "heterogeneous")
    if method in (*WIRES, "bound"):
        return condition == "iid"
    return (method != "uniform" or condition == "heterogeneous") and bool(rule(method).least <= asked)


def cell(p: Params) -> list[Row]:
    """Rows of a method under a condition in a scenario: RT-LE of the kept weights and of those of the last round."""
    if p["method"] == "bound":
        return lineup.bound_rows(p)
    recording, who, drive = scene.recording(p), scene.egos(p["data"], str(p["egos"])), scene.fleet(p["data"])
    if p["method"] == "kalman":
        return _rows(rt_le(Kalman(fitted(p))(recording, who), drive), who)
    training = tuple((name, value) for name, value in p.items() if name not in OF_THE_TEST)
    found: list[Row] = []
    for seed, net in enumerate(trained(p["condition"], p["method"], training)):
        kept, last = (_score(one.method(p["method"]), recording, who, drive) for one in (net.kept, net.last))
        more = {
            "train_seed": seed,
            "sent_kb": net.sent / 1e3,
            "received_kb": net.received / 1e3,
            "rejected": net.rejected,
            "idle_rounds": net.idle,
            "train_seconds": net.seconds,
        }
        found += [
            {**row, "last_rt_le_m": end["rt_le_m"], **more}
            for row, end in zip(_rows(kept, who), _rows(last, who), strict=True)
        ]
    return found


def _score(method: Method, recording: Recording, who: Sequence[str], drive: Fleet) -> Floats:
    """RT-LE (R, E) m, at most LOST."""
    try:
        return np.minimum(rt_le(method(recording, who), drive), LOST)
    except InputError as error:
        if error.field != "x":  # the estimates of the track, of which one is not finite
            raise
        return np.full((recording.runs, len(who)), LOST)


def _rows(score: Floats, who: Sequence[str]) -> list[Row]:
    """RT-LE (R, E) as rows."""
    runs = range(len(score))
    return [{"run": r, "ego": ego, "rt_le_m": float(score[r, e])} for e, ego in enumerate(who) for r in runs]


def key(p: Params) -> dict[str, str]:
    """What else changes the numbers: data, code and the library that trains."""
    return {**scene.facts(p), "clients": members(p).digest, "torch": version("torch")}


def _table(scenario: int, value: str, text: str) -> Any:
    """View of methods down, conditions across, for one metric."""

    def table(results: Results) -> Table | None:
        from coopoc.study.style import look
        from coopoc.study.tables import Table

        at = {"scenario": scenario}
        ran = [c for c in CONDITIONS if views.present(results, {**at, "condition": c}, value)]
        body = []
        for method in dict.fromkeys((*METHODS, *results.frame["method"])):
            wheres = [{**at, "condition": c, "method": method} for c in ran]
            row = [_entry(results, value, w) for w in wheres]
            if any(entry is not None for entry in row):
                body.append((look(method).label, *row))
        conditions = scene.conditions({**results.settings, **at})
        told = "; ".join(f"{c}: {CONDITIONS[c]}" for c in ran)
        return (
            Table(
                ("Rule", *(c.capitalize() for c in ran)),
                tuple(body),
                f"{text} {conditions} {told}. {NOTE}",
                best="min",
                along="column",
                decimals=3,
            )
            if body
            else None
        )

    return table


def _entry(results: Results, value: str, where: dict[str, Any]) -> Interval | str | None:
    if views.present(results, where, value) is None:
        return None
    found = results.interval(value, where)
    return found if found.mean < LOST / 1e3 else "diverged"


NOTE = "KF: fitted to the noise that the clients saw; the bound knows the acting noise and no bias."


def _costs(results: Results) -> Table | None:
    """Bytes, seconds and what the server refused."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    columns = {
        "sent_kb": "Sent [kB]",
        "received_kb": "Received [kB]",
        "rejected": "Answers rejected",
        "idle_rounds": "Rounds without change",
        "train_seconds": "Training [s]",
    }
    body: list[Any] = []
    for (condition, method), rows in results.groups(["condition", "method"]):
        if method not in REFERENCES:
            body.append((condition, look(method).label, *(float(rows[name].mean()) for name in columns)))
    text = "Of one client over the whole training, payload only, on average; what the server refused; mean over seeds."
    return Table(("Condition", "Rule", *columns.values()), tuple(body), text, decimals=1) if body else None


def _findings(results: Results) -> Sequence[str]:
    return [said for s in (1, 2) for c in CONDITIONS if (said := _finding(results, {"scenario": s, "condition": c}))]


def _finding(results: Results, at: dict[str, Any]) -> str:
    """RT-LE of the mean under a condition, and which rules are better or worse over all training seeds."""
    plain = _seeds(results, {**at, "method": "mean"})
    if plain is None:
        return ""
    better, worse = list[str](), list[str]()
    for rule in RULES[1:]:
        other = _seeds(results, {**at, "method": rule})
        if other is not None and len(plain) > 1:
            gap = over_seeds(other - plain).interval
            told = f"{rule} {gap.mean:+.3f} m"
            (better if gap.high < 0 else worse if gap.low > 0 else []).append(told)
    beside = {"KF": views.mean(results, {**at, "condition": "iid", "method": "kalman"})}
    beside["bound"] = views.mean(results, {**at, "condition": "iid", "method": "bound"})
    text = f"Scenario {at['scenario']}, {at['condition']}: {views.listed({'mean': float(plain.mean()), **beside})}. "
    return text + f"Better than the mean over training seeds (95 %): {_or_none(better)}; worse: {_or_none(worse)}."


def _or_none(told: Sequence[str]) -> str:
    return ", ".join(told) or "no rule"


def _seeds(results: Results, where: dict[str, Any]) -> Floats | None:
    """(S, E, R) RT-LE of a method by training seed."""
    if views.present(results, where) is None:
        return None
    seeds = sorted(results.select(where)["train_seed"].unique())
    return np.array([results.values("rt_le_m", {**where, "train_seed": seed}) for seed in seeds])


STUDY = Study(
    name="aggregation",
    question="Which rule should combine the clients' nets when they are alike, differ, lie or stay away?",
    cell=cell,
    key=key,
    grid={"condition": tuple(CONDITIONS), "method": METHODS, "scenario": (1, 2)},
    where=meaningful,
    shares=("condition", "method"),
    settings={
        "data": "town10",
        "clients": "town10-validation",
        "members": 12,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "egos": "auto",
        "runs": 15,
        "seed": 0,
        "train_seeds": 3,
        "rounds": 20,
        "local_epochs": 2,
        "steps": 1500,
        "piece": 100,
        "in_mult": 40,
        "out_mult": 5,
        "radius_m": 30.0,
        "factor": 20.0,
        "offset_m": 10.0,
    },
    tables={
        **{f"scenario{s}": _table(s, "rt_le_m", "RT-LE [m], kept weights.") for s in (1, 2)},
        **{f"scenario{s}_last": _table(s, "last_rt_le_m", "RT-LE [m], weights of the last round.") for s in (1, 2)},
        "costs": _costs,
    },
    findings=_findings,
    limitations=(
        "The kept round is chosen by what all clients that were heard report, the bad one included.",
        "Rules have their default parameters, of which some were chosen under iid on town10-validation; krum and "
        "multi_krum expect one bad client.",
        "Intervals of the differences are not corrected for the number of rules that are compared.",
    ),
    minutes=25,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("aggregation"),
)
