"""Findings of the study of neighbours, each with its evidence."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.study.numbers import difference, listed, mean, present, ran, three

from . import lineup, scene, weights
from .lineup import of

if TYPE_CHECKING:
    from coopoc.study.results import Results

IDEAL: dict[str, Any] = {"rate_hz": 10.0, "cap_bytes_per_second": 0.0}
"""The channel that passes a message at every step."""


def findings(results: Results) -> dict[str, str]:
    """The paper's order under identity covariances, orders under fitted and known ones, and the transfer of noise."""
    return {
        "identity": _identity(results),
        "fitted": _fitted(results),
        "known": _known(results),
        "transfer": _transfer(results),
    }


def _at(method: str, known: str, k: int) -> dict[str, Any]:
    return of(method, known, **IDEAL, max_neighbours=k)


def _steps(results: Results, known: str, *methods: str) -> list[int]:
    """The K >= 1 at which one of the methods was run with this noise model."""
    where = present(results, {"method": list(methods), "noise_model": known, **IDEAL})
    return sorted(int(k) for k in results.select(where)["max_neighbours"].unique() if k) if where else []


def _identity(results: Results) -> str:
    steps = _steps(results, "identity", "lkf-sa")
    if not steps:
        return ""
    lkf = {k: results.interval("rt_le_m", _at("lkf-sa", "identity", k)).mean for k in steps}
    fed, gnss = (mean(results, _at(m, k, steps[0])) for m, k in (("fedkalmannet", "trained"), ("gnss", "none")))
    ends = {f"LKF-SA ({ks([k])})": lkf[k] for k in (steps[0], steps[-1])}
    text = f"Identity covariances, as the paper's baselines: {listed({'federated': fed, **ends, 'GNSS': gnss})}."
    if fed is not None and gnss is not None:
        holds = [k for k in steps if fed < lkf[k] < gnss]
        parts = {"holds": holds, "does NOT hold": [k for k in steps if k not in holds]}
        verdicts = " and ".join(f"{verb} at {ks(which)}" for verb, which in parts.items() if which)
        text += f" The paper's order, federated < LKF-SA < GNSS, {verdicts}."
    return text + (_fall(results, steps[0], steps[-1]) if len(steps) > 1 else "")


def _fall(results: Results, first: int, last: int) -> str:
    gap = difference(results, *(_at("lkf-sa", "identity", k) for k in (last, first)))
    if gap is None:
        return ""
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
    found = ran({words: mean(results, _at(*which, steps[-1])) for words, which in names.items()})
    order = " < ".join(f"{words} {three(value)} m" for value, words in sorted((v, w) for w, v in found.items()))
    return f"Fitted covariances, K = {steps[-1]}: {order}."


def _known(results: Results) -> str:
    """With the bound, which is for the rms over runs."""
    steps = _steps(results, "nominal", *lineup.COOPERATIVE)
    if not steps:
        return ""
    names = {"KF alone": ("kalman", "nominal"), "joint filter": ("joint", "nominal"), "bound": lineup.BOUND}
    at = {words: _at(*which, steps[-1]) for words, which in names.items()}
    found = {words: _rms(results, where) for words, where in at.items() if present(results, where)}
    return f"Known covariances, K = {steps[-1]}, rms over runs: {listed(found)}." if found else ""


def _rms(results: Results, where: dict[str, Any]) -> float:
    """sqrt(mean over runs RT-LE^2) of each ego with all its runs, averaged over egos, m."""
    return float(np.sqrt((results.values("rt_le_m", where) ** 2).mean(axis=1)).mean())


def _transfer(results: Results) -> str:
    """Fitted relative noise if it is not that of the data: training vehicles without neighbours cannot estimate it."""
    if not _steps(results, "fitted", *lineup.COOPERATIVE):
        return ""
    assumed, acting = weights.fitted(results.settings).sensors, scene.acting(results.settings)
    if assumed is None or (
        np.allclose(assumed.relative_std, acting.relative_std) and assumed.min_range == acting.min_range
    ):
        return ""
    return (
        f"Fitted relative noise is the data sheet's of the training vehicles, {scene.relative(assumed)}, no vehicle "
        f"nearer than {assumed.min_range:g} m; in this data it is {scene.relative(acting)}, down to "
        f"{acting.min_range:g} m."
    )


def ks(steps: Iterable[int]) -> str:
    """[1, 2] as "K = 1, 2"."""
    return "K = " + ", ".join(str(k) for k in sorted(steps))
