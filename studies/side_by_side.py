"""Any methods beside each other, and beside the bound, under conditions of one's own choice."""

from typing import Any

from coopoc.study.numbers import Results, present, ran, rms, sign
from coopoc.study.style import look
from coopoc.study.tables import Table, smooths

from . import lineup, scene
from .views import Plot, TableView, of, table

DEFAULT_METHODS = ("gnss", "kalman", "lkf-sa", "split-ci", "joint", "cooperative-filter", "bound")
CONDITIONS = {
    "channel": "ideal",
    "rate_hz": None,
    "cap_bytes_per_second": None,
    "loss": None,
    "burst": None,
    "latency_s": None,
    "outliers": "",
    "spoofed_share": 0.0,
    "spoofed_from_s": 0.0,
    "spoofed_collude": False,
    "own_share": 0.0,
    "common_share": 0.0,
    "drift_time_s": 60.0,
    "heading_std_deg": 0.0,
    "heading_bias_deg": 0.0,
    "start": "gnss",
}
"""Other conditions: the channel (None: its own), outliers (as `Outliers.named` has them), spoofing, time-correlated
errors, errors of the heading, the start."""

PLAIN = {"best": None, "intervals": False}
"""Options of a table of what is not ranked."""
HELD = "GNSS repeats a fix until the next one, and errs by the way driven since."


def _changed(results: Results) -> str:
    kept, idle = results.settings, scene.idle(results)
    changed = [name for name, usual in CONDITIONS.items() if kept[name] != usual]
    acting, others = [f"{n} {kept[n]}" for n in changed if n not in idle], [n for n in changed if n in idle and kept[n]]
    words = {"With": acting, "Without effect on a log:": others}
    return " ".join(f"{word} {', '.join(names)}." for word, names in words.items() if names)


def _table(text: str, value: str, **options: Any) -> TableView:
    """Methods that have the metric, and K across."""

    def view(results: Results) -> Table | None:
        if value not in results.frame:
            return None
        methods = [*results.with_failed().frame["method"].unique()]  # without those that lack the metric, below
        texts = (text, *([_changed(results)] if _changed(results) else []))
        real = scene.measured(results.settings["data"])
        if real is not None and value in ("rt_le_m", "innovation_m"):
            texts += (
                HELD * (present(results, {"method": ["gnss"]}, value) is not None),
                f"The log: {'; '.join(real.notes[1:])}.",
            )
        rows, where = ("method", "noise_model"), {"method": methods}
        return table(*texts, value=value, rows=rows, where=where, **options)(results)

    return view


def _figure(results: Results) -> "Plot | None":
    from coopoc.study import figures

    if present(results, {}) is None or results.frame["max_neighbours"].nunique() < 2:
        return None
    text = "RT-LE against the number of neighbours; bands: 95 % intervals over egos, then runs."
    caption = scene.caption(results, text, _changed(results)).replace("  ", " ")
    return figures.sweep(results, x="max_neighbours", log=True, caption=caption)


def _findings(results: Results) -> list[str]:
    """The best filter at each K, the largest first, and those alike; smoothers know later measurements and are no
    filters."""
    texts, rows = [], results.frame
    for k in sorted(rows["max_neighbours"].unique(), reverse=True) if len(rows) else ():
        pairs = rows[["method", "noise_model"]].drop_duplicates().to_numpy().tolist()
        each = ran({(m, model): rms(results, of(m, model, max_neighbours=k)) for m, model in pairs})
        bound = next((value for (method, _), value in each.items() if method == "bound"), None)
        ranked = sorted((v, (m, n)) for (m, n), v in each.items() if m != "bound" and not smooths([look(m).label]))
        if ranked:
            (value, (method, model)), *others = ranked
            best = of(method, model, max_neighbours=k)
            same = [look(m).label for _, (m, n) in others if not sign(results, best, of(m, n, max_neighbours=k))]
            near = f" Noise may explain the difference from {', '.join(dict.fromkeys(same))}." * bool(same)
            gap = f", {value / bound:.2f} times the bound" if bound else ""
            named = f" ({model})" if len({model for _, model in each} - {"bound"}) > 1 else ""
            texts.append(f"K = {k}: {look(method).label}{named} has the lowest rms, {value:.3g} m{gap}.{near}")
    return texts


STUDY = lineup.study(
    "side_by_side",
    "How do these methods compare with each other and with the bound?",
    grid={"max_neighbours": (0, 2, 6), "method": DEFAULT_METHODS, "noise_model": ("nominal",)},
    settings={**scene.TOWN, "radius_m": None, **scene.WEIGHTS, **CONDITIONS, "runs": 10, "train_seeds": 1},
    reference=None,
    shares=("max_neighbours",),
    tables={
        "rt_le": _table("RT-LE [m] against K.", "rt_le_m"),
        "nees": _table("NEES against K (3 is consistent; 2 in the plane).", "nees", **PLAIN),
        "in_band": _table("Share of steps whose run-averaged NEES is in its 99 % band.", "nees_inside", **PLAIN),
        "innovation": _table(
            "RMS innovation of the fixes [m] against K: how well a method predicts the next fix.", "innovation_m"
        ),
        "nis": _table("NIS of the fixes per dimension against K (1 is consistent).", "nis", **PLAIN),
        "bytes": _table("Received per ego [B/s].", "bytes_per_second", **PLAIN, decimals=0),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "The bound applies to the rms over runs; it assumes an ideal channel, whatever that of the cells, and that "
        "newcomers bring their past.",
        "Real data have no bound: it assumes sensors that measure at every step.",
        "Methods without a noise model, learned ones among them, give the same result under every noise model.",
    ),
)
