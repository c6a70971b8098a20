"""Any methods beside each other, and beside the bound, under conditions of one's own choice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

METHODS = ("gnss", "kalman", "lkf-sa", "split-ci", "joint", "cooperative-map", "bound")


def cell(p: Params) -> list[Row]:
    """Rows of one method at one K; of the bound, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def _table(value: str, text: str, **options: Any) -> Any:
    def table(results: Results) -> Table | None:
        from coopoc.study.pivot import pivot

        where = views.present(results, {}, value)
        if where is None:
            return None
        ran = [str(name) for name in results.frame.dropna(subset=[value])["method"].unique()]
        return pivot(
            results,
            rows=["method", "noise_model"],
            columns="max_neighbours",
            value=value,
            where={"method": ran},
            caption=_caption(results, text),
            **options,
        )

    return table


def _caption(results: Results, text: str) -> str:
    kept = results.settings
    differs = [f"{name} {kept[name]}" for name, usual in CONDITIONS.items() if kept[name] != usual]
    also = f" With {', '.join(differs)}." if differs else ""
    return f"{text}{also} {scene.conditions(kept)}"


def _figure(results: Results) -> Plot | None:
    from coopoc.study import figures

    if views.present(results, {}) is None or results.frame["max_neighbours"].nunique() < 2:
        return None
    text = "RT-LE against the number of neighbours; bands: 95 % intervals over egos, then runs."
    return figures.sweep(results, x="max_neighbours", log=True, caption=_caption(results, text))


def _findings(results: Results) -> Sequence[str]:
    from coopoc.study.style import look

    found = []
    for k in results.frame["max_neighbours"].unique() if len(results.frame) else ():
        each = {
            (m, known): views.rms(results, {"method": m, "noise_model": known, "max_neighbours": k})
            for m, known in results.frame[["method", "noise_model"]].drop_duplicates().to_numpy()
        }
        bound = next((value for (method, _), value in each.items() if method == "bound"), None)
        ranked = sorted((value, pair) for pair, value in each.items() if value is not None and pair[0] != "bound")
        if ranked:
            value, (method, known) = ranked[0]
            gap = f", {value / bound:.2f} times the bound" if bound else ""
            found.append(f"K = {k}: the lowest rms is {look(method).label}'s ({known}), {value:.3g} m{gap}.")
    return found


CONDITIONS: dict[str, Any] = {
    "channel": "ideal",
    "rate_hz": 0.0,
    "cap_bytes_per_second": 0.0,
    "loss": None,
    "burst": None,
    "latency_s": None,
    "spoofed_share": 0.0,
    "own_share": 0.0,
    "common_share": 0.0,
    "drift_time_s": 60.0,
    "heading_std_deg": 0.0,
    "heading_bias_deg": 0.0,
    "start": "gnss",
}
"""What else may be set: the channel (None: its own), what attacks, what lasts, how well the heading is known."""

STUDY = Study(
    name="side_by_side",
    question="How do these methods do beside each other and beside the bound?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid={"max_neighbours": (0, 2, 6), "method": METHODS, "noise_model": ("nominal",)},
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        **CONDITIONS,
        "backend": "gauss-newton",
        "egos": "auto",
        "runs": 10,
        "seed": 0,
        "train_seeds": 1,
    },
    shares=("max_neighbours",),
    tables={
        "rt_le": _table("rt_le_m", "RT-LE [m] against K."),
        "nees": _table("nees", "NEES against K (3 is consistent).", best=None, intervals=False),
        "bytes": _table("bytes_per_second", "Received per ego [B/s].", best=None, intervals=False, decimals=0),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "The bound is for the rms over runs over an ideal channel, whatever the channel of the cells.",
        "Methods that know nothing of noise, or learned it, are the same under every knowledge.",
    ),
    minutes=1,
)
