"""Collaborative training against collaborative decision: RT-LE against neighbours and against bytes (paper, Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights
from .claims import IDEAL, findings, ks

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


def _grid() -> list[dict[str, Any]]:
    """Every method at every K over an ideal channel, then the cooperative ones at K = 10 under rates and byte caps."""
    pairs = [("gnss", "none"), *((m, "trained") for m in TRAINED), ("bound", "bound")]
    pairs += [("kalman", k) for k in ("identity", "nominal", "fitted")]
    shared = [(m, k) for m in lineup.COOPERATIVE for k in ("identity", "nominal", "fitted")]
    grid = [
        {"max_neighbours": k, **IDEAL, "method": m, "noise_model": known}
        for k in NEIGHBOURS
        for m, known in [*pairs, *shared]
    ]
    grid += [{"max_neighbours": k, **IDEAL, "method": "cooperative-map-5", "noise_model": "nominal"} for k in WINDOWED]
    tight = [{"rate_hz": rate, "cap_bytes_per_second": 0.0} for rate in RATES_HZ]
    tight += [{"rate_hz": 10.0, "cap_bytes_per_second": cap} for cap in CAPS]
    budget = [(m, k) for m, k in shared if m in ("lkf-sa", "joint")]
    grid += [{"max_neighbours": 10, **t, "method": m, "noise_model": known} for t in tight for m, known in budget]
    return grid


def _meaningful(p: Params) -> bool:
    """No more neighbours than there are vehicles; no bound for real data, whose noise nobody knows; no exact step
    without a noise model."""
    if p["max_neighbours"] >= len(scene.fleet(p["data"]).ids):
        return False
    return not (p["method"] == "bound" and scene.is_real(p["data"])) and not (
        p["method"] == "joint" and p["noise_model"] == "identity"
    )


def cell(p: Params) -> list[Row]:
    """Rows of one method at one K and budget; of the bound, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def _of(*noise_model: str, **more: Any) -> dict[str, Any]:
    """Cells over the ideal channel with these kinds of knowledge, and those that have none."""
    return {"noise_model": [*noise_model, "none", "trained", "bound"], **IDEAL, **more}


FILTERS = ["kalman", "lkf-sa", "lkf-sa-edge", "msmv-r", "joint"]
NEES = "NEES against K (3 is consistent), nominal noise model."
INSIDE = "Share of steps whose run-averaged NEES is in the 99 % band (gate: 0.95), nominal noise model."
BOUND = "The bound is for the rms over runs of causal estimates, over an ideal channel and without the bias."


def _caption(results: Results, text: str, where: dict[str, Any]) -> str:
    bounded = "bound" in results.select(where)["method"].values
    return f"{text} {scene.conditions(results.settings)}" + (f" {BOUND}" if bounded else "")


def _table(known: str) -> Any:
    return _against_k("rt_le_m", _of(known), f"RT-LE [m] against K, {known} knowledge.")


def _against_k(value: str, wanted: dict[str, Any], text: str, rows: Sequence[str] = ("method",), **options: Any) -> Any:
    """View of methods down, K across."""

    def table(results: Results) -> Table | None:
        from coopoc.study.pivot import pivot

        where = views.present(results, wanted, value)
        if where is None:
            return None
        return pivot(
            results,
            rows=rows,
            columns="max_neighbours",
            value=value,
            where=where,
            intervals=False,
            decimals=scene.decimals(results.settings),
            caption=_caption(results, text, where),
            **options,
        )

    return table


def _budget(results: Results) -> Table | None:
    """None where there are no ten vehicles."""
    from coopoc.study.pivot import pivot

    wanted = {"method": ["lkf-sa", "joint"], "max_neighbours": 10, "noise_model": ["identity", "nominal", "fitted"]}
    where = views.present(results, wanted)
    if where is None:
        return None
    return pivot(
        results,
        rows=["rate_hz", "cap_bytes_per_second"],
        columns=["method", "noise_model"],
        value="rt_le_m",
        where=where,
        intervals=False,
        caption=_caption(results, "RT-LE [m] at K = 10 under rates and caps (0: no cap).", where),
    )


def _sweep(known: str) -> Any:
    def figure(results: Results) -> Plot | None:
        from coopoc.study import figures

        where = views.present(results, _of(known))
        if where is None:
            return None
        text = f"RT-LE against the number of neighbours, {known} knowledge; bands: 95 % intervals over egos, then runs."
        return figures.sweep(results, x="max_neighbours", where=where, log=True, caption=_caption(results, text, where))

    return figure


def _pareto(results: Results) -> Plot | None:
    """None where nobody receives anything."""
    from coopoc.study import figures

    chosen = ["gnss", "kalman", "okf", "fedkalmannet", "lkf-sa", "joint", "bound"]
    known = ["fitted", "identity", "none", "trained", "bound"]
    where = views.present(results, {"method": chosen, "noise_model": known})
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


STUDY = Study(
    name="neighbours",
    question="What does another neighbour buy while deciding, at what cost, and does training together replace it?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=_grid(),
    where=_meaningful,
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "egos": "auto",
        "runs": 30,
        "seed": 0,
        "train_seeds": 5,
        "backend": "gauss-newton",
    },
    shares=("max_neighbours", "rate_hz", "cap_bytes_per_second"),
    tables={
        "rt_le_identity": _table("identity"),
        "rt_le_fitted": _table("fitted"),
        "rt_le_nominal": _table("nominal"),
        "budget": _budget,
        "nees": _against_k("nees", _of("nominal", method=FILTERS), NEES, best=None),
        "nees_inside": _against_k("nees_inside", _of("nominal", method=FILTERS), INSIDE, best=None),
        "neighbours_errors": _against_k(
            "neighbour_rt_le_m",
            _of("identity", "fitted", method=FILTERS[1:], max_neighbours=list(NEIGHBOURS[1:])),
            "Error of what the egos think of their neighbours [m].",
            rows=("method", "noise_model"),
        ),
    },
    figures={
        "rt_le_identity": _sweep("identity"),
        "rt_le_fitted": _sweep("fitted"),
        "bytes": _pareto,
        "innovations": _innovations,
    },
    findings=findings,
    recipe=weights.described,
    limitations=(
        "Azimuth and inclination are in the world frame: the heading that turns a bearing into an azimuth is known.",
        "MSMV-R is a reconstruction; no reading of MSMV that we tried is flat in K as the paper's curve is.",
        "The nets and the fitted noise come from vehicles that drive alone with 1.5 m and 10 %; the noise of the test "
        "is another one.",
    ),
    minutes=5,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("neighbours"),
)
