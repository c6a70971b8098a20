"""Which rule combines nets best when clients are alike, differ, are Byzantine or absent (the paper's outlook)."""

from __future__ import annotations

from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from coopoc.evaluate.scores import bounded_rt_le, rows_of
from coopoc.evaluate.statistics import Interval, over_seeds
from coopoc.methods.kalman import Kalman
from coopoc.study.numbers import Where, interval, listed, mean, per_seed, present, seed_means
from coopoc.study.pivot import across, crossed
from coopoc.study.study import Params, Row, Study
from coopoc.study.style import look
from coopoc.study.tables import Table

from . import lineup, scene
from .federations import CONDITIONS, RULES, fitted, members, trained

if TYPE_CHECKING:
    from coopoc.study.plot import Plot
    from coopoc.study.results import Results

LOST = 1e6
"""m, the RT-LE of a net whose estimates left every bound; a mean above a thousandth of it is shown as "diverged"."""
REFERENCES = ("kalman", "bound")
BESIDE = ("centralised", "kalman")
"""Methods beside the rules under `iid` and `heterogeneous`."""
METHODS = (*RULES, *BESIDE, "bound")
"""Methods of the grid; other rules by name or path: `--set method=mean,mine.py:RULE`."""
OF_THE_TEST = ("condition", "method", "scenario", "velocity_ratio", "runs", "egos", "data", "seed")
"""Parameters that change no training, and the two that name it."""


def meaningful(p: Params) -> bool:
    """Every rule under every condition in which enough clients take part; other methods where they are compared.

    `uniform` is `mean` where all clients have as many pieces.
    """
    from coopoc.learned.federation.rules import rule

    condition, method = str(p["condition"]), str(p["method"])
    if method in BESIDE:
        return condition in ("iid", "heterogeneous")
    if method == "bound":
        return condition == "iid"
    asked = int(p["members"]) // (2 if condition == "half absent" else 1)
    enough: bool = rule(method).least <= asked
    return enough and (method != "uniform" or condition == "heterogeneous")


def cell(p: Params) -> list[Row]:
    """Rows of a method under a condition in a scenario: RT-LE of the kept weights and of those of the last round."""
    if p["method"] == "bound":
        return lineup.bound_rows(p)
    trial = scene.trial(p)
    if p["method"] == "kalman":
        return rows_of({"rt_le_m": bounded_rt_le(Kalman(fitted(p)), *trial, LOST)}, trial[1])
    training = tuple((name, value) for name, value in p.items() if name not in OF_THE_TEST)
    found: list[Row] = []
    for seed, net in enumerate(trained(p["condition"], p["method"], training)):
        kept, last = (bounded_rt_le(one.method(p["method"]), *trial, LOST) for one in (net.kept, net.last))
        columns = {"rt_le_m": kept, "last_rt_le_m": last}
        found += [{**row, "train_seed": seed, **net.costs} for row in rows_of(columns, trial[1])]
    return found


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers beyond the parameters: data, code and the library that trains."""
    return {**scene.facts(p), "clients": members(p).digest, "torch": version("torch")}


def _table(results: Results, scenario: int, value: str, text: str) -> Table | None:
    """Methods down, conditions across, for one metric."""
    at = {"scenario": scenario}
    ran = [c for c in CONDITIONS if present(results, {**at, "condition": c}, value)]
    methods = dict.fromkeys((*METHODS, *results.frame["method"]))

    def number(results: Results, where: Where) -> Interval | str | None:
        found = interval(results, where, value)
        return "diverged" if found and not found.mean < LOST / 1e3 else found

    columns = across(number, {c.capitalize(): {**at, "condition": c} for c in ran})
    conditions = "; ".join(f"{c}: {CONDITIONS[c]}" for c in ran)
    note = "KF: fitted to the noise that the clients saw; the bound knows the acting noise and no bias."
    caption = f"{scene.caption(results, text, **at)} {conditions}. {note}"
    rows = [((look(method).label,), {"method": method}) for method in methods]
    return crossed(results, ("Rule",), rows, columns, caption, best="min", along="column", decimals=3)


def _figure(results: Results) -> Plot | None:
    """Multiples of the mean's RT-LE under iid, one panel per condition, a dot per training seed."""
    from coopoc.study.multiples import multiples

    at = {"scenario": 2}
    whole = mean(results, {**at, "condition": "iid", "method": "mean"})
    if whole is None:
        return None
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    for rule in RULES:
        for condition in CONDITIONS:
            each = seed_means(results, {**at, "condition": condition, "method": rule})
            if each:
                found.setdefault((rule, "none"), {})[condition.capitalize()] = [value / whole for value in each]
    text = "RT-LE of the kept weights as a multiple of the mean's under iid, a dot per training seed."
    return multiples(found, scene.caption(results, text, **at))


def _costs(results: Results) -> Table | None:
    """Bytes, seconds and rejected answers."""
    columns = {
        "sent_kb": "Sent [kB]",
        "received_kb": "Received [kB]",
        "rejected": "Answers rejected",
        "idle_rounds": "Rounds without change",
        "train_seconds": "Training [s]",
    }
    body = [
        (condition, look(method).label, *(float(rows[name].mean()) for name in columns))
        for (condition, method), rows in results.groups(["condition", "method"])
        if method not in REFERENCES
    ]
    text = "Of one client over the whole training, payload only, on average; what the server refused; mean over seeds."
    return Table(("Condition", "Rule", *columns.values()), tuple(body), text, decimals=1) if body else None


def _findings(results: Results) -> dict[str, str]:
    return {
        f"scenario {s}, {c}": _finding(results, {"scenario": s, "condition": c}) for s in (1, 2) for c in CONDITIONS
    }


def _finding(results: Results, at: dict[str, Any]) -> str:
    """RT-LE of the mean under a condition, and which rules are better or worse over all training seeds."""
    if not present(results, {**at, "method": "mean"}):
        return ""
    plain = per_seed(results, {**at, "method": "mean"})
    better, worse = list[str](), list[str]()
    for rule in RULES[1:]:
        if len(plain) > 1 and present(results, {**at, "method": rule}):
            gap = over_seeds(per_seed(results, {**at, "method": rule}) - plain).interval
            (better if gap.high < 0 else worse if gap.low > 0 else []).append(f"{rule} {gap.mean:+.3f} m")
    beside = {
        words: mean(results, {**at, "condition": "iid", "method": method})
        for words, method in (("KF", "kalman"), ("bound", "bound"))
    }
    lists = [", ".join(rules) or "no rule" for rules in (better, worse)]
    return (
        f"Scenario {at['scenario']}, {at['condition']}: {listed({'mean': float(plain.mean()), **beside})}. "
        f"Better than the mean over training seeds (95 %): {lists[0]}; worse: {lists[1]}."
    )


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
        f"scenario{scenario}{end}": partial(_table, scenario=scenario, value=value, text=f"RT-LE [m], {words}.")
        for end, value, words in (
            ("", "rt_le_m", "kept weights"),
            ("_last", "last_rt_le_m", "weights of the last round"),
        )
        for scenario in (1, 2)
    }
    | {
        "costs": _costs,
    },
    figures={"multiples": _figure},
    findings=_findings,
    limitations=(
        "The selected round depends on the reports of all participating clients, the poisoned one included.",
        "Rules have their default parameters, of which some were chosen under iid on town10-validation; krum and "
        "multi_krum expect one bad client.",
        "Intervals of the differences are not corrected for the number of rules that are compared.",
    ),
    minutes=25,
    metrics={"rt_le_m": "lower"},
    reference=lineup.reference("aggregation"),
)
