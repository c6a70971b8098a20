"""What may be said of the study of neighbours: claims with their evidence, of what was run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.evaluate.statistics import paired_difference

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.results import Results

IDEAL: dict[str, Any] = {"rate_hz": 10.0, "cap_bytes_per_second": 0.0}
"""The channel that passes a message at every step."""


def findings(results: Results) -> Sequence[str]:
    """The paper's order under identity covariances, the honest one, and what was fitted elsewhere."""
    found = [_paper_order(results), _fitted(results), _known(results), _transfer(results)]
    return [sentence for sentence in found if sentence]


def _at(method: str, known: str, k: int) -> dict[str, Any]:
    return {"method": method, "noise_model": known, **IDEAL, "max_neighbours": k}


def _steps(results: Results, known: str, *methods: str) -> list[int]:
    """The K >= 1 at which one of the methods was run with this knowledge."""
    where = views.present(results, {"method": list(methods), "noise_model": known, **IDEAL})
    return sorted(int(k) for k in results.select(where)["max_neighbours"].unique() if k) if where else []


def _paper_order(results: Results) -> str:
    steps = _steps(results, "identity", "lkf-sa")
    if not steps:
        return ""
    at = [_at("lkf-sa", "identity", k) for k in steps]
    lkf = [results.interval("rt_le_m", where).mean for where in at]
    fed, gnss = (views.mean(results, _at(m, k, steps[0])) for m, k in (("fedkalmannet", "trained"), ("gnss", "none")))
    ends = {f"LKF-SA ({ks([k])})": value for k, value in zip(steps, lkf, strict=True) if k in (steps[0], steps[-1])}
    numbers = {"federated": fed, **ends, "GNSS": gnss}
    text = f"Identity covariances, as the paper's baselines: {views.listed(numbers)}."
    if fed is not None and gnss is not None:
        holds = [k for k, value in zip(steps, lkf, strict=True) if fed < value < gnss]
        parts = {"holds": holds, "does NOT hold": [k for k in steps if k not in holds]}
        told = " and ".join(f"{verb} at {ks(which)}" for verb, which in parts.items() if which)
        text += f" The paper's order, federated < LKF-SA < GNSS, {told}."
    return text + (_fall(results, steps[0], steps[-1]) if len(steps) > 1 else "")


def _fall(results: Results, first: int, last: int) -> str:
    few, many = (results.values("rt_le_m", _at("lkf-sa", "identity", k)) for k in (first, last))
    gap = paired_difference(many, few)
    claim = "falls" if gap.high < 0 else "does NOT fall for certain"
    ends = f", 95 % [{gap.low:+.3g}, {gap.high:+.3g}]" if np.isfinite(gap.high) else " of one ego and run"
    return f" LKF-SA {claim} from K = {first} to {last}: paired difference {gap.mean:+.3g} m{ends}."


def _fitted(results: Results) -> str:
    steps = _steps(results, "fitted", *lineup.COOPERATIVE)
    if not steps:
        return ""
    names = {
        "FedKalmanNet": ("fedkalmannet", "trained"),
        "fitted KF": ("kalman", "fitted"),
        "fitted joint filter": ("joint", "fitted"),
        "fitted LKF-SA": ("lkf-sa", "fitted"),
    }
    found = {words: views.mean(results, _at(*which, steps[-1])) for words, which in names.items()}
    ranked = sorted((value, words) for words, value in found.items() if value is not None)
    order = " < ".join(f"{words} {value:.3g} m" for value, words in ranked)
    return f"Fitted covariances, K = {steps[-1]}: {order}."


def _known(results: Results) -> str:
    """With the bound, which is for the rms over runs."""
    steps = _steps(results, "nominal", *lineup.COOPERATIVE)
    if not steps:
        return ""
    names = {"KF alone": ("kalman", "nominal"), "joint filter": ("joint", "nominal"), "bound": ("bound", "bound")}
    at = {words: _at(*which, steps[-1]) for words, which in names.items()}
    found = {words: _rms(results, where) for words, where in at.items() if views.present(results, where)}
    return f"Known covariances, K = {steps[-1]}, rms over runs: {views.listed(found)}." if found else ""


def _rms(results: Results, where: dict[str, Any]) -> float:
    """sqrt(mean over runs RT-LE^2) of each ego, averaged over egos: what a bound is for."""
    return float(np.sqrt((results.values("rt_le_m", where) ** 2).mean(axis=1)).mean())


def _transfer(results: Results) -> str:
    """Where fitted relative noise is not that of the data: lone training vehicles cannot estimate it."""
    p = results.settings
    if not _steps(results, "fitted", *lineup.COOPERATIVE):
        return ""
    assumed, acting = weights.fitted(p).sensors, scene.acting(p)
    if assumed is None or (
        np.allclose(assumed.relative_std, acting.relative_std) and assumed.min_range == acting.min_range
    ):
        return ""
    return (
        f"Fitted relative noise is the data sheet's of the training vehicles, {scene.relative(assumed)}, nobody nearer "
        f"than {assumed.min_range:g} m; in this data it is {scene.relative(acting)}, down to {acting.min_range:g} m."
    )


def ks(steps: Iterable[int]) -> str:
    """[1, 2] as "K = 1, 2"."""
    return "K = " + ", ".join(str(k) for k in sorted(steps))
