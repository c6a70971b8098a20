"""Collaborative training against collaborative decision: RT-LE against neighbours and against bytes (paper, Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import present
from coopoc.study.tables import pivot
from coopoc.study.study import Params

from . import lineup, scene, weights
from .lineup import BOUND, of
from .neighbours_findings import IDEAL, findings, ks

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

NEIGHBOURS = (0, 1, 2, 3, 4, 6, 8, 10)
RATES_HZ = (5.0, 2.0, 1.0)
WINDOWED = (0, 2)
"""K at which the sliding window is solved, too: one cell of it takes as long as ten others."""
CAPS = (300.0, 600.0, 1200.0)
TRAINED = ("okf", "fedkalmannet", "centralised")
KNOWN = ["identity", "nominal", "fitted"]
BUDGETED = ["lkf-sa", "joint"]


def _grid() -> list[dict[str, Any]]:
    """Every method at every K over an ideal channel, then the cooperative ones at K = 10 under rates and byte caps."""
    solo = [("gnss", "none"), *((m, "trained") for m in TRAINED), BOUND, *(("kalman", known) for known in KNOWN)]
    shared = [(m, known) for m in lineup.COOPERATIVE for known in KNOWN]
    tight = [{**IDEAL, "rate_hz": rate} for rate in RATES_HZ]
    tight += [{**IDEAL, "cap_bytes_per_second": cap} for cap in CAPS]
    return [
        *(of(*pair, max_neighbours=k, **IDEAL) for k in NEIGHBOURS for pair in (*solo, *shared)),
        *(of("cooperative-map-5", "nominal", max_neighbours=k, **IDEAL) for k in WINDOWED),
        *(of(*pair, max_neighbours=10, **way) for way in tight for pair in shared if pair[0] in BUDGETED),
    ]


def _meaningful(p: Params) -> bool:
    """No more neighbours than there are vehicles; no bound for real data, whose noise is unknown; no exact step without
    a noise model."""
    if p["max_neighbours"] >= len(scene.fleet(p["data"]).ids):
        return False
    return not (p["method"] == "bound" and scene.is_real(p["data"])) and not (
        p["method"] == "joint" and p["noise_model"] == "identity"
    )


def _of(*noise_model: str, **more: Any) -> dict[str, Any]:
    """Cells over the ideal channel with these noise models, and those of methods that have none."""
    return {"noise_model": [*noise_model, "none", "trained", "bound"], **IDEAL, **more}


FILTERS = ["kalman", "lkf-sa", "lkf-sa-edge", "msmv-r", "joint"]


def _caption(results: Results, text: str, where: dict[str, Any]) -> str:
    note = " The bound is for the rms over runs of causal estimates, over an ideal channel and without the bias."
    return scene.caption(results, text) + (note if "bound" in results.select(where)["method"].values else "")


def _table(
    results: Results,
    wanted: dict[str, Any],
    text: str,
    value: str = "rt_le_m",
    rows: str | Sequence[str] = "method",
    columns: str | Sequence[str] = "max_neighbours",
    **options: Any,
) -> Table | None:
    """Methods down, K across, unless other rows and columns are named."""
    where = present(results, wanted, value)
    if where is None:
        return None
    shown = {"intervals": False, "decimals": scene.decimals(results.settings), **options}
    return pivot(results, rows, columns, value, where, _caption(results, text, where), **shown)


def _sweep(results: Results, known: str) -> Plot | None:
    from coopoc.study import figures

    where = present(results, _of(known))
    if where is None:
        return None
    text = f"RT-LE against the number of neighbours, {known} noise model; bands: 95 % intervals over egos, then runs."
    return figures.sweep(results, x="max_neighbours", where=where, log=True, caption=_caption(results, text, where))


def _pareto(results: Results) -> Plot | None:
    """None where no ego receives anything."""
    from coopoc.study import figures

    chosen = ["gnss", "kalman", "okf", "fedkalmannet", "lkf-sa", "joint", "bound"]
    where = present(results, {"method": chosen, "noise_model": ["fitted", "identity", "none", "trained", "bound"]})
    if where is None or not (results.select(where)["bytes_per_second"] > 0).any():
        return None
    names = [name for name in weights.trained(results) if name in TRAINED]
    text = f"RT-LE against the payload that an ego receives: {'; '.join(_budgets(results, where))}."
    if names:
        text += " Right: what a vehicle sends and receives in training, once."
    return figures.pareto(
        results,
        along=("max_neighbours", "rate_hz", "cap_bytes_per_second"),
        where=where,
        training=weights.training_bytes(results.settings, names),
        caption=_caption(results, text, where),
    )


def _budgets(results: Results, where: dict[str, Any]) -> list[str]:
    """The channels that were run, each with its K."""
    found = []
    for (rate, cap), rows in results.groups(["rate_hz", "cap_bytes_per_second"], where):
        received = rows[rows["bytes_per_second"] > 0]["max_neighbours"].unique()
        if len(received):
            found.append(f"{ks(received)} at {rate:g} Hz" + (f" and at most {cap:g} B/s" if cap else ""))
    return found


def _innovations(results: Results) -> Plot | None:
    """Real measurements against the truth and the figures that were published for them; None for simulated data."""
    data = results.settings["data"]
    if not scene.is_real(data):
        return None
    from coopoc.data.mrclam import innovations, read_mrclam
    from coopoc.study import figures

    found = innovations(read_mrclam(data))
    return figures.innovations(
        {"Range": (found.range, 0.095, "m"), "Bearing": (found.bearing, 0.007, "rad")},
        caption=f"Innovations of the real robot-to-robot measurements against Vicon, and the Gaussian of 0.095 m and "
        f"0.007 rad; robust standard deviations {found.range_std:.4f} m and {found.bearing_std:.5f} rad.",
    )


NEES: dict[str, Any] = {"wanted": _of("nominal", method=FILTERS), "best": None}
STUDY = lineup.study(
    "neighbours",
    "What does another neighbour bring online, at what cost, and can collaborative training replace it?",
    grid=_grid(),
    where=_meaningful,
    settings={**scene.TOWN, **scene.WEIGHTS, "runs": 30, "train_seeds": 5, "backend": "gauss-newton"},
    shares=("max_neighbours", "rate_hz", "cap_bytes_per_second"),
    tables={
        **{
            f"rt_le_{known}": partial(_table, wanted=_of(known), text=f"RT-LE [m] against K, {known} noise model.")
            for known in ("identity", "fitted", "nominal")
        },
        "budget": partial(
            _table,
            wanted={"method": BUDGETED, "max_neighbours": 10, "noise_model": KNOWN},
            text="RT-LE [m] at K = 10 under rates and caps (0: no cap).",
            rows=["rate_hz", "cap_bytes_per_second"],
            columns=["method", "noise_model"],
        ),
        "nees": partial(_table, value="nees", text="NEES against K (3 is consistent), nominal noise model.", **NEES),
        "nees_inside": partial(
            _table,
            value="nees_inside",
            text="Share of steps whose run-averaged NEES is in the 99 % band (gate: 0.95), nominal noise model.",
            **NEES,
        ),
        "neighbours_errors": partial(
            _table,
            value="neighbour_rt_le_m",
            wanted=_of("identity", "fitted", method=FILTERS[1:], max_neighbours=list(NEIGHBOURS[1:])),
            text="Error of what the egos think of their neighbours [m].",
            rows=("method", "noise_model"),
        ),
    },
    figures={
        "rt_le_identity": partial(_sweep, known="identity"),
        "rt_le_fitted": partial(_sweep, known="fitted"),
        "bytes": _pareto,
        "innovations": _innovations,
    },
    findings=findings,
    limitations=(
        "Azimuth and inclination are in the world frame, which assumes known headings.",
        "MSMV-R is a reconstruction; no variant of MSMV that we tried is flat in K like the paper's curve.",
        "The nets and the fitted noise model come from solo drives with 1.5 m and 10 %; the test noise differs.",
    ),
    minutes=5,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
