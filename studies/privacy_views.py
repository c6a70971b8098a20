"""Tables, figures and findings of the privacy study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import scene, views

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

NET, OKF = "fedkalmannet", "okf"
TRAINED = [NET, OKF]
NEAR = 0.10
"""Share of the RT-LE without privacy within which privacy is called affordable."""
NOTES = {
    "rt_le": "RT-LE [m] against the client-level epsilon of the sum of the updates, delta {delta:g}; inf: no privacy.",
    "price": "Clip, noise multiplier z of the sum, the epsilon of a server that sees single updates (no secure "
    "aggregation), at the epsilon of the sum in the first column, delta {delta:g}, and the areas under the ROC curve "
    "that no attack on a client's presence can beat.",
    "probe": "AUC of the membership probe (0.5: a coin) with 95 % bootstrap intervals over pieces, by what is seen, "
    "one client's updates or the aggregate's, and by what is scored; 0.50 [0.50, 0.50]: the weights diverged.",
}


def _caption(results: Results, name: str) -> str:
    return f"{NOTES[name].format(**results.settings)} {scene.conditions(results.settings)}"


def _each(frame: pd.DataFrame) -> list[Any]:
    """Rows as named tuples, whose fields pandas does not type."""
    return list(frame.itertuples())


def _names(names: Any) -> Any:
    """Names of a group, which pandas does not type."""
    return names


def _rows(results: Results, measure: str, **where: Any) -> pd.DataFrame:
    """Rows of one measure of what was trained; empty if there is none."""
    frame = results.frame
    if "measure" not in frame:
        return frame.iloc[:0]
    frame = frame[(frame["measure"] == measure) & frame["method"].isin(TRAINED)]
    for name, value in where.items():
        frame = frame[frame[name] == value]
    return frame


def _rt_le(results: Results) -> Table | None:
    from coopoc.study.pivot import pivot

    where = views.present(results, {"measure": "rt_le", "method": TRAINED})
    if where is None:
        return None
    return pivot(
        results,
        rows="epsilon",
        columns=["clients", "method"],
        value="rt_le_m",
        where=where,
        best=None,
        decimals=2,
        intervals=False,
        caption=_caption(results, "rt_le"),
    )


def _price(results: Results) -> Table | None:
    from coopoc.study.style import look
    from coopoc.study.tables import Table

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
        for row in _each(each)
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
    return Table(header, tuple(body), _caption(results, "price"))


def _probe(results: Results) -> Table | None:
    from coopoc.evaluate.statistics import Interval
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    frame = _rows(results, "probe")
    if frame.empty:
        return None
    body, kinds = [], list(dict.fromkeys(zip(frame["seen"], frame["score"], strict=True)))
    for names, part in frame.groupby(["clients", "method", "epsilon"], sort=False):
        clients, method, epsilon = _names(names)
        known = {(row.seen, row.score): row for row in _each(part)}
        entries = [
            Interval(r.auc, r.auc_low, r.auc_high, int(r.members + r.others)) for r in (known[kind] for kind in kinds)
        ]
        body.append((clients, look(method).label, f"{epsilon:g}", *entries, known[kinds[0]].found_at_1_percent))
    titles = [f"{seen}, {score}" for seen, score in kinds]
    header = ("Clients", "Method", "Epsilon", *titles, f"Members found at 1 % false alarms ({titles[0]})")
    return Table(header, tuple(body), _caption(results, "probe"))


def places(epsilons: Sequence[float]) -> dict[float, float]:
    """Where each epsilon stands on the axis: its logarithm, and no privacy half a decade beyond the last.

    >>> places([1.0, 10.0, math.inf])
    {1.0: 0.0, 10.0: 1.0, inf: 1.5}
    """
    finite = sorted(e for e in epsilons if math.isfinite(e))
    at = {e: float(np.log10(e)) for e in finite}
    return at | ({math.inf: max(at.values(), default=-0.5) + 0.5} if math.inf in epsilons else {})


def _panels(results: Results, measure: str) -> tuple[pd.DataFrame, list[str], dict[float, float]] | None:
    frame = _rows(results, measure)
    if frame.empty:
        return None
    return frame, list(dict.fromkeys(frame["clients"])), places(list(frame["epsilon"].unique()))


def _ticks(axes: Axes, at: Mapping[float, float]) -> None:
    axes.set_xticks(list(at.values()), [f"{e:g}" if math.isfinite(e) else "none" for e in at])
    axes.set_xlabel("Epsilon")


def _cost(results: Results) -> Plot | None:
    """RT-LE against epsilon, one panel per set of clients."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes
    from coopoc.study.style import words

    found = _panels(results, "rt_le")
    if found is None:
        return None
    frame, fleets, at = found
    drawn: list[Mapping[str, Any]] = []
    with canvas(1, len(fleets), width=7.6, sharey=True, squeeze=False) as (figure, axes):
        for panel, clients in zip(axes[0], fleets, strict=True):
            for method, part in frame[frame["clients"] == clients].groupby("method", sort=False):
                seeds = part.groupby(["epsilon", "train_seed"])["rt_le_m"].mean().unstack().sort_index()
                x = [at[e] for e in seeds.index]
                options = strokes({"method": method})
                panel.plot(x, seeds.mean(axis=1), **options)
                panel.fill_between(
                    x, seeds.min(axis=1), seeds.max(axis=1), color=options["color"], alpha=0.15, linewidth=0
                )
                drawn.append({"method": method})
            drawn += _levels(results, panel, clients, at)
            _ticks(panel, at)
            panel.set_title(f"{len(scene.fleet(clients).ids)} clients ({clients})")
        plain_log(axes[0][0].yaxis)
        axes[0][0].set_ylabel(words("rt_le_m"))
        legend(axes[0][-1], list({str(n["method"]): n for n in drawn}.values()), {"kalman": ", fitted"})
    text = "Lines: mean over training seeds, egos and runs; bands: lowest to highest seed. Dotted: before training."
    return Plot(figure, f"{_caption(results, 'rt_le')} {text}")


def _levels(results: Results, panel: Axes, clients: str, at: Mapping[float, float]) -> list[dict[str, Any]]:
    """Horizontal lines: the fitted Kalman filter, the bound, and the methods before training."""
    from coopoc.study.plot import strokes

    drawn, ends = [], [min(at.values()), max(at.values())]
    for method in ("kalman", "bound"):
        level = views.mean(results, {"measure": "rt_le", "method": method})
        if level is not None:
            panel.plot(ends, [level, level], **{**strokes({"method": method}), "marker": None, "linestyle": "--"})
            drawn.append({"method": method})
    for method in TRAINED:
        level = views.mean(results, {"measure": "untrained", "method": method, "clients": clients})
        if level is not None:
            panel.plot(
                ends, [level, level], **{**strokes({"method": method}, thin=True), "marker": None, "linestyle": ":"}
            )
    return drawn


def _attack(results: Results) -> Plot | None:
    """AUC against epsilon, one panel per set of clients."""
    from coopoc.study.plot import Plot, canvas, legend, strokes

    found = _panels(results, "probe")
    if found is None:
        return None
    frame, fleets, at = found
    styles = {("client", "gradient"): "-", ("aggregate", "loss"): ":"}
    attacks: Any = list(zip(frame["seen"], frame["score"], strict=True))
    frame = frame.assign(attack=attacks)
    frame = frame[frame["attack"].isin(list(styles))]
    with canvas(1, len(fleets), width=7.6, sharey=True, squeeze=False) as (figure, axes):
        for panel, clients in zip(axes[0], fleets, strict=True):
            panel.axhline(0.5, color="#555555", linewidth=0.8)
            here = frame[frame["clients"] == clients]
            for shift, (names, part) in enumerate(here.groupby(["method", "attack"], sort=False)):
                method, attack = _names(names)
                part = part.sort_values("epsilon")
                x = [at[e] + 0.04 * (shift - 1.5) for e in part["epsilon"]]
                spread = np.maximum([part["auc"] - part["auc_low"], part["auc_high"] - part["auc"]], 0.0)
                options = {**strokes({"method": method}), "linestyle": styles[attack]}
                panel.errorbar(x, part["auc"], yerr=spread, elinewidth=0.7, **options)
            _ticks(panel, at)
            panel.set_title(f"{len(scene.fleet(clients).ids)} clients ({clients})")
        axes[0][0].set_ylabel("AUC of the probe")
        legend(axes[0][-1], [{"method": m} for m in dict.fromkeys(frame["method"])])
    text = "Solid: one client's updates are seen (gradient); dotted: the aggregate's only (loss)."
    return Plot(figure, f"{_caption(results, 'probe')} {text}")


def findings(results: Results) -> list[str]:
    """What each method pays with each set of clients, and what the probe finds."""
    from coopoc.study.style import look

    found = []
    for clients in dict.fromkeys(_rows(results, "rt_le").get("clients", ())):
        for method in TRAINED:
            line = _paid(results, {"clients": clients, "method": method})
            if line:
                count = len(scene.fleet(clients).ids)
                found.append(f"{look(method).label}, {count} clients: {line}")
    return found


def _paid(results: Results, where: dict[str, Any]) -> str:
    """The least epsilon at which RT-LE is near that without privacy, and the probe with and without it."""
    frame = _rows(results, "rt_le", **where)
    means: dict[float, float] = dict(frame.groupby("epsilon")["rt_le_m"].mean()) if len(frame) else {}
    if math.inf not in means or len(means) < 2:
        return ""
    free = float(means[math.inf])
    near = affordable({float(e): float(m) for e, m in means.items()})
    told = "no epsilon that was run" if math.isinf(near) else f"epsilon {near:g}"
    listing = ", ".join(f"{m:.2f} m at {e:g}" for e, m in means.items() if math.isfinite(e))
    text = f"{free:.2f} m without privacy; {listing}. Within {NEAR:.0%} of it: {told}."
    for seen, score in (("client", "gradient"), ("aggregate", "loss")):
        probe = _rows(results, "probe", **where, seen=seen, score=score).set_index("epsilon")
        if math.inf in probe.index:
            row, strict = probe.loc[math.inf], probe.loc[min(probe.index)]
            text += (
                f" Probe of {'single updates' if seen == 'client' else 'the aggregate'}: AUC {row.auc:.2f} "
                f"[{row.auc_low:.2f}, {row.auc_high:.2f}] without, {strict.auc:.2f} [{strict.auc_low:.2f}, "
                f"{strict.auc_high:.2f}] at epsilon {min(probe.index):g}."
            )
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
