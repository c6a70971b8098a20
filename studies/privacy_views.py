"""Tables, figures and findings of the privacy study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.evaluate.statistics import Interval
from coopoc.study.numbers import mean, present
from coopoc.study.tables import pivot
from coopoc.study.style import look
from coopoc.study.tables import Table

from . import scene

if TYPE_CHECKING:
    import pandas as pd

    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

NET, OKF = "fedkalmannet", "okf"
TRAINED = [NET, OKF]
NEAR = 0.10
"""Share of the RT-LE without privacy within which epsilon counts as affordable."""
PROBES = {("client", "gradient"): "single updates", ("aggregate", "loss"): "the aggregate"}
"""Attacks in the figure and the findings: (updates that are seen, score) -> words."""
RT_LE = "RT-LE [m] against the client-level epsilon of the sum of the updates, delta {delta:g}; inf: no privacy."
PRICE = (
    "Clip, noise multiplier z of the sum, the epsilon of a server that sees single updates (no secure aggregation), at "
    "the epsilon of the sum in the first column, delta {delta:g}, and the areas under the ROC curve that no attack on "
    "a client's presence can beat."
)
PROBE = (
    "AUC of the membership probe (0.5: a coin) with 95 % bootstrap intervals over pieces, by what is seen, one "
    "client's updates or the aggregate's, and by what is scored; 0.50 [0.50, 0.50]: the weights diverged."
)


def _rows(results: Results, measure: str, **where: Any) -> Any:
    """Frame of one measure of trained methods; empty if there is none."""
    frame = results.frame
    if "measure" not in frame:
        return frame.iloc[:0]
    frame = frame[(frame["measure"] == measure) & frame["method"].isin(TRAINED)]
    for name, value in where.items():
        frame = frame[frame[name] == value]
    return frame


def _rt_le(results: Results) -> Table | None:
    where = present(results, {"measure": "rt_le", "method": TRAINED})
    if where is None:
        return None
    options: dict[str, Any] = {"best": None, "intervals": False}
    return pivot(results, "epsilon", ["clients", "method"], "rt_le_m", where, scene.caption(results, RT_LE), **options)


def _price(results: Results) -> Table | None:
    frame = _rows(results, "rt_le")
    frame = frame[np.isfinite(frame["epsilon"])] if len(frame) else frame
    if frame.empty:
        return None
    each = frame.groupby(["epsilon", "clients", "method"], sort=False).first().reset_index()
    body = [
        (
            f"{row.epsilon:g}",
            scene.fleet(row.clients).name,
            look(row.method).label,
            f"{row.clip:.3g}",
            f"{row.noise_multiplier:.3g}",
            float(row.ceiling),
            f"{row.epsilon_alone:.3g}",
            float(row.ceiling_alone),
        )
        for row in each.itertuples()
    ]
    header = (
        "Epsilon of the sum",
        "Clients",
        "Method",
        "Clip",
        "z",
        "AUC at most",
        "Epsilon of single updates",
        "AUC at most, single",
    )
    return Table(header, tuple(body), scene.caption(results, PRICE))


def _probe(results: Results) -> Table | None:
    frame = _rows(results, "probe")
    if frame.empty:
        return None
    body, kinds = [], list(dict.fromkeys(zip(frame["seen"], frame["score"], strict=True)))
    for (clients, method, epsilon), part in frame.groupby(["clients", "method", "epsilon"], sort=False):
        known = {(row.seen, row.score): row for row in part.itertuples()}
        entries = [
            Interval(r.auc, r.auc_low, r.auc_high, int(r.members + r.others)) for r in (known[kind] for kind in kinds)
        ]
        body.append((clients, look(method).label, f"{epsilon:g}", *entries, known[kinds[0]].found_at_1_percent))
    titles = [f"{seen}, {score}" for seen, score in kinds]
    header = ("Clients", "Method", "Epsilon", *titles, f"Members found at 1 % false alarms ({titles[0]})")
    return Table(header, tuple(body), scene.caption(results, PROBE))


def places(epsilons: Sequence[float]) -> dict[float, float]:
    """Place of each epsilon on the axis: its logarithm, and no privacy half a decade beyond the last.

    >>> places([1.0, 10.0, math.inf])
    {1.0: 0.0, 10.0: 1.0, inf: 1.5}
    """
    finite = sorted(e for e in epsilons if math.isfinite(e))
    at = {e: float(np.log10(e)) for e in finite}
    return at | ({math.inf: max(at.values(), default=-0.5) + 0.5} if math.inf in epsilons else {})


def _panels(results: Results, measure: str) -> tuple[dict[str, pd.DataFrame], dict[float, float], dict[float, str]]:
    """Rows of a measure by clients, places of each epsilon, and texts of the ticks there."""
    frame = _rows(results, measure)
    if frame.empty:
        return {}, {}, {}
    at = places(list(frame["epsilon"].unique()))
    ticks = {place: f"{e:g}" if math.isfinite(e) else "none" for e, place in at.items()}
    return {clients: frame[frame["clients"] == clients] for clients in dict.fromkeys(frame["clients"])}, at, ticks


def _title(clients: str) -> str:
    return f"{len(scene.fleet(clients).ids)} clients ({clients})"


def _cost(results: Results) -> Plot | None:
    """RT-LE against epsilon, one panel per set of clients."""
    from coopoc.study.lines import Line, Panel, panels

    frames, at, ticks = _panels(results, "rt_le")
    shown = []
    for clients, frame in frames.items():
        lines = []
        for method, part in frame.groupby("method", sort=False):
            seeds = part.groupby(["epsilon", "train_seed"])["rt_le_m"].mean().unstack().sort_index()
            ends = zip(seeds.mean(axis=1), seeds.min(axis=1), seeds.max(axis=1), strict=True)
            points = {at[e]: Interval(*each, seeds.shape[1]) for e, each in zip(seeds.index, ends, strict=True)}
            lines.append(Line({"method": method}, points))
        for method in ("kalman", "bound"):
            level = mean(results, {"measure": "rt_le", "method": method})
            lines.append(Line({"method": method}, level, {"linestyle": "--"}))
        for method in TRAINED:
            level = mean(results, {"measure": "untrained", "method": method, "clients": clients})
            lines.append(Line({"method": method}, level, {"linestyle": ":", "linewidth": 0.8}))
        shown.append(Panel(lines, _title(clients), "Epsilon", ticks))
    text = "Lines: mean over training seeds, egos and runs; bands: lowest to highest seed. Dotted: before training."
    return panels(shown, f"{scene.caption(results, RT_LE)} {text}", 7.6, 3.4, "RT-LE [m]", True, {"kalman": ", fitted"})


def _attack(results: Results) -> Plot | None:
    """AUC against epsilon, one panel per set of clients."""
    from coopoc.study.plot import Plot, canvas, legend, strokes

    frames, at, ticks = _panels(results, "probe")
    if not frames:
        return None
    drawn = list[dict[str, Any]]()
    with canvas(1, len(frames), width=7.6, sharey=True, squeeze=False) as (figure, (axes,)):
        for panel, (clients, frame) in zip(axes, frames.items(), strict=True):
            panel.axhline(0.5, color="#555555", linewidth=0.8)
            pairs = [(method, attack) for method in dict.fromkeys(frame["method"]) for attack in PROBES]
            for shift, (method, (seen, score)) in enumerate(pairs):
                part = frame[(frame["method"] == method) & (frame["seen"] == seen) & (frame["score"] == score)]
                part = part.sort_values("epsilon")
                x = [at[e] + 0.04 * (shift - 1.5) for e in part["epsilon"]]
                ends = np.maximum([part["auc"] - part["auc_low"], part["auc_high"] - part["auc"]], 0.0)
                style = {**strokes({"method": method}), "linestyle": "-" if seen == "client" else ":"}
                panel.errorbar(x, part["auc"], yerr=ends, elinewidth=0.7, **style)
                drawn.append({"method": method})
            panel.set_xticks(list(ticks), list(ticks.values()))
            panel.set(xlabel="Epsilon", title=_title(clients))
        axes[0].set_ylabel("AUC of the probe")
        legend(axes[-1], drawn)
    text = "Solid: one client's updates are seen (gradient); dotted: the aggregate's only (loss)."
    return Plot(figure, f"{scene.caption(results, PROBE)} {text}")


def findings(results: Results) -> dict[str, str]:
    """RT-LE of each method with each set of clients by epsilon, and the AUC of the attacks."""
    return {
        f"{clients}, {method}": _paid(results, {"clients": clients, "method": method})
        for clients in dict.fromkeys(_rows(results, "rt_le").get("clients", ()))
        for method in TRAINED
    }


def _paid(results: Results, where: dict[str, Any]) -> str:
    """The least epsilon at which RT-LE is near that without privacy, and the attacks with and without it."""
    frame = _rows(results, "rt_le", **where)
    means: dict[float, float] = dict(frame.groupby("epsilon")["rt_le_m"].mean()) if len(frame) else {}
    if math.inf not in means or len(means) < 2:
        return ""
    near = affordable({float(e): float(m) for e, m in means.items()})
    enough = "no epsilon that was run" if math.isinf(near) else f"epsilon {near:g}"
    listing = ", ".join(f"{m:.2f} m at {e:g}" for e, m in means.items() if math.isfinite(e))
    text = (
        f"{look(where['method']).label}, {len(scene.fleet(where['clients']).ids)} clients: {means[math.inf]:.2f} m "
        f"without privacy; {listing}. Within {NEAR:.0%} of it: {enough}."
    )
    for (seen, score), words in PROBES.items():
        probe = _rows(results, "probe", **where, seen=seen, score=score).set_index("epsilon")
        if math.inf in probe.index:
            least = min(probe.index)
            free, strict = (
                f"{row.auc:.2f} [{row.auc_low:.2f}, {row.auc_high:.2f}]"
                for row in (probe.loc[math.inf], probe.loc[least])
            )
            text += f" Probe of {words}: AUC {free} without, {strict} at epsilon {least:g}."
    return text


def affordable(means: Mapping[float, float]) -> float:
    """Least epsilon from which on RT-LE stays within NEAR of that without privacy; infinity if there is none.

    >>> affordable({1.0: 3.0, 3.0: 1.05, 10.0: 1.2, 30.0: 1.01, math.inf: 1.0})
    30.0
    """
    least = math.inf
    for epsilon in sorted(means, reverse=True):
        if means[epsilon] > (1 + NEAR) * means[math.inf]:
            break
        least = epsilon
    return least


TABLES = {"rt_le": _rt_le, "price": _price, "probe": _probe}
FIGURES = {"rt_le": _cost, "probe": _attack}
