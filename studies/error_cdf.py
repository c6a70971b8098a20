"""Learned gains among themselves and against fair filters: the distribution of the error (paper, Fig. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.study.study import Params, Row, Study

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

CASES = ((1, 0.15), (2, 0.10), (2, 0.15))
"""Scenario and velocity noise: scenario 2 does not state it, so both of the paper's figures are shown."""
CLASSIC = (("gnss", "none"), ("kalman", "identity"), ("kalman", "fitted"), ("kalman", "nominal"), ("kalman", "oracle"))
LINEUP = (*CLASSIC, *((name, "trained") for name in weights.PAPER))
HEADER = (
    "Method",
    "NoiseModel",
    "RT-LE [m]",
    "Seed std [m]",
    "Maximum [m]",
    "Reduction [m]",
    "Reduction / fitted KF's",
    "Worse than GNSS [%]",
)


def cell(p: Params) -> list[Row]:
    """Rows of one method in one case, with the quantiles of its errors."""
    return lineup.rows(p, quantiles=51)


def meaningful(p: Params) -> bool:
    """No net of a client that is not there; of real data, which has its own noise, one case and no oracle."""
    if scene.is_real(p["data"]) and ((p["scenario"], p["velocity_ratio"]) != CASES[0] or p["noise_model"] == "oracle"):
        return False
    return weights.trainable(p)


def case(scenario: int, ratio: float, **more: Any) -> dict[str, Any]:
    """A case as a selection."""
    return {"scenario": scenario, "velocity_ratio": ratio, **more}


def _table(at: dict[str, Any]) -> Any:
    def table(results: Results) -> Table | None:
        from coopoc.study.style import look
        from coopoc.study.tables import Table

        body = []
        gnss = views.mean(results, {**at, "method": "gnss"}, "max_error_m")
        fitted = views.mean(results, {**at, "method": "kalman", "noise_model": "fitted"}, "max_error_m")
        filters = None if gnss is None or fitted is None else gnss - fitted
        for method, known in LINEUP:
            where = {**at, "method": method, "noise_model": known}
            if not views.present(results, where):
                continue
            worst = results.interval("max_error_m", where)
            less = None if gnss is None else gnss - worst.mean
            share = None if less is None or not filters else less / filters
            body.append(
                (
                    look(method).label,
                    known,
                    results.interval("rt_le_m", where),
                    views.seed_std(results, where),
                    worst,
                    less,
                    share,
                    100 * results.interval("worse_than_gnss", where).mean,
                )
            )
        caption = (
            "Errors; reduction: of the mean maximum against GNSS, and its ratio to that of the fitted KF. "
            f"{scene.conditions({**results.settings, **at})}"
        )
        return Table(HEADER, tuple(body), caption, decimals=scene.decimals(results.settings)) if body else None

    return table


def _cdf(at: dict[str, Any]) -> Any:
    def figure(results: Results) -> Plot | None:
        from coopoc.study import figures

        methods = ["gnss", "kalman", "okf", "fedkalmannet", "centralised", "individual1"]
        known = ["none", "identity", "fitted", "oracle", "trained"]
        where = views.present(results, {**at, "method": methods, "noise_model": known}, "error_quantiles_m")
        text = "Distribution of the error over all steps; markers: mean of the per-run maxima."
        caption = f"{text} {scene.conditions({**results.settings, **at})}"
        return figures.cdf(results, where=where, log=True, caption=caption) if where else None

    return figure


def _findings(results: Results) -> Sequence[str]:
    found = [_finding(results, case(*pair)) for pair in CASES[:2]]
    return [sentences for sentences in found if sentences]


def _finding(results: Results, at: dict[str, Any]) -> str:
    """RT-LE of what was run in a case, and what may be said of the federated net; nothing where nothing was run."""
    names = {"federated": "fedkalmannet", "centralised": "centralised", "OKF": "okf"}
    names |= {f"net of client {client}": name for client, name in enumerate(weights.INDIVIDUAL, start=1)}
    found = {words: views.mean(results, {**at, "method": name}) for words, name in names.items()}
    filters = {f"{known} KF": {**at, "method": "kalman", "noise_model": known} for known in ("fitted", "oracle")}
    found |= {words: views.mean(results, where) for words, where in filters.items()}
    if not views.listed(found):
        return ""
    fed, centralised, oracle = (found[words] for words in ("federated", "centralised", "oracle KF"))
    p = {**results.settings, **at}
    text = [scene.heading(p), f"RT-LE: {views.listed(found)}"]
    if fed and centralised:
        text.append(f"Federated against centralised: {100 * (fed / centralised - 1):+.1f} %")
    if fed and found["fitted KF"]:
        net = {**at, "method": "fedkalmannet", "noise_model": "trained"}
        text.append(f"The federated net {views.verdict(results, net, filters['fitted KF'], 'the fitted KF')}")
    if fed and oracle:
        blind = ", which does not know the bias" if scene.acting(p).gnss_bias[1] else ""
        text.append(f"It is {fed / oracle:.2f} times the oracle{blind}")
    return ". ".join(text) + "."


STUDY = Study(
    name="error_cdf",
    question="How do federated, centralised and individual nets compare with each other and a fitted Kalman filter?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=[
        {"scenario": scenario, "velocity_ratio": ratio, "method": method, "noise_model": known}
        for scenario, ratio in CASES
        for method, known in LINEUP
    ],
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "velocity_reading": "axis",
        "start": "gnss",
        "egos": "auto",
        "runs": 100,
        "seed": 0,
        "train_seeds": 5,
    },
    where=meaningful,
    shares=("scenario", "velocity_ratio"),
    tables={f"scenario{s}_{100 * r:g}": _table(case(s, r)) for s, r in CASES},
    figures={f"cdf_scenario{s}_{100 * r:g}": _cdf(case(s, r)) for s, r in CASES},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "The nets and the fitted noise come from vehicles with 1.5 m and 10 %; the noise of the test is another one.",
    ),
    minutes=3,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("error_cdf"),
)
