"""Collaborative training against collaborative decision: RT-LE against neighbours (paper, Fig. 5)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.study.numbers import Where, difference, interval, listed, mean, present, ran, rms, three
from coopoc.study.study import Params
from coopoc.study.style import Panel

from . import lineup, scene
from .lineup import BOUND
from .views import curves, of, table

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

NEIGHBOURS = (0, 1, 2, 3, 4, 6, 8, 10)
TRAINED = ("okf", "fedkalmannet", "centralised")
MODELS = ["identity", "nominal", "fitted"]
FILTERS = ["kalman", "lkf-sa", "lkf-sa-edge", "msmv-r", "joint"]


def _grid() -> list[Params]:
    """Every method at every K."""
    solo = [("gnss", "none"), *((m, "trained") for m in TRAINED), BOUND, *(("kalman", model) for model in MODELS)]
    shared = [(m, model) for m in lineup.COOPERATIVE for model in MODELS]
    return [of(*pair, max_neighbours=k) for k in NEIGHBOURS for pair in (*solo, *shared)]


def _meaningful(p: Params) -> bool:
    """No more neighbours than there are vehicles; no bound for real data, whose noise is unknown; no exact step without
    a noise model."""
    if p["max_neighbours"] >= len(scene.fleet(p["data"]).ids):
        return False
    return not (p["method"] == "bound" and scene.is_real(p["data"])) and not (
        p["method"] == "joint" and p["noise_model"] == "identity"
    )


def _under(*noise_model: str, **more: Any) -> dict[str, Any]:
    """Cells with these noise models, and those of methods that have none."""
    return {"noise_model": [*noise_model, "none", "trained", "bound"], **more}


BOUND_NOTE = "The bound is for the rms over runs of causal estimates, over an ideal channel and without the bias."
k_table = partial(table, intervals=False)


def _sides(results: Results) -> Plot | None:
    """Training against cooperation: identity covariances on the left, fitted ones on the right."""
    x = {k: {"max_neighbours": k} for k in NEIGHBOURS}
    panels = [
        Panel(x, {"noise_model": model}, f"{model.capitalize()} covariances", "Neighbours K")
        for model in ("identity", "fitted")
    ]
    solo = [of("gnss", "none"), *(of(name, "trained") for name in ("fedkalmannet", "centralised", "okf"))]
    shared = [{"method": name} for name in ("kalman", "lkf-sa", "joint")]
    text = (
        "RT-LE against the number of neighbours. Identity covariances are the paper's; fitted ones come from the nets' "
        "training drives. Bands: 95 % intervals."
    )
    options: dict[str, Any] = {"number": _interval, "width": 7.6, "log": True}
    return curves(panels, [*solo, *shared, of(*BOUND)], text, BOUND_NOTE, **options)(results)


def _interval(results: Results, where: Where) -> Any:
    return (mean if where["method"] == "bound" else interval)(results, where)


def findings(results: Results) -> dict[str, str]:
    """The paper's order under identity covariances, and orders under fitted and nominal ones."""
    return {
        "answer": _answer(results),
        "identity": _identity(results),
        "fitted": _fitted(results),
        "nominal": _nominal(results),
    }


def _answer(results: Results) -> str:
    """Which of the two is better at the largest K, with fitted covariances and with the paper's."""
    k = max(_steps(results, "fitted", "joint"), default=0)
    fed, joint, paper = (
        mean(results, _at(*pair, k))
        for pair in (("fedkalmannet", "trained"), ("joint", "fitted"), ("lkf-sa", "identity"))
    )
    if fed is None or joint is None or paper is None:
        return ""
    better = "decide, where messages arrive" if joint < fed else "train"
    return (
        f"While they {better}: with fitted covariances {k} neighbours give {joint:.2f} m, federated training alone "
        f"{fed:.2f} m; with the paper's identity covariances cooperation gives {paper:.2f} m."
    )


def _at(method: str, noise_model: str, k: int) -> dict[str, Any]:
    return of(method, noise_model, max_neighbours=k)


def _steps(results: Results, noise_model: str, *methods: str) -> list[int]:
    """The K >= 1 at which one of the methods was run with this noise model."""
    where = present(results, {"method": list(methods), "noise_model": noise_model})
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
    gap = difference(results, *(_at("lkf-sa", "identity", k) for k in (steps[-1], steps[0])))
    if len(steps) > 1 and gap is not None:
        claim = "falls" if gap.high < 0 else "does NOT fall for certain"
        interval = f", 95 % [{gap.low:+.3g}, {gap.high:+.3g}]" if np.isfinite(gap.high) else " of one ego and run"
        text += f" LKF-SA {claim} from K = {steps[0]} to {steps[-1]}: paired difference {gap.mean:+.3g} m{interval}."
    return text


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
    means = ran({words: mean(results, _at(*pair, steps[-1])) for words, pair in names.items()})
    order = " < ".join(f"{words} {three(value)} m" for value, words in sorted((v, w) for w, v in means.items()))
    return f"Fitted covariances, K = {steps[-1]}: {order}."


def _nominal(results: Results) -> str:
    """With the bound, which is for the rms over runs."""
    steps = _steps(results, "nominal", *lineup.COOPERATIVE)
    if not steps:
        return ""
    names = {"KF alone": ("kalman", "nominal"), "joint filter": ("joint", "nominal"), "bound": BOUND}
    each = ran({words: rms(results, _at(*pair, steps[-1])) for words, pair in names.items()})
    return f"Known covariances, K = {steps[-1]}, rms over runs: {listed(each)}." if each else ""


def ks(steps: Iterable[int]) -> str:
    """[1, 2] as "K = 1, 2"."""
    return "K = " + ", ".join(str(k) for k in sorted(steps))


STUDY = lineup.study(
    "neighbours",
    "What does another neighbour bring online, at what cost, and can collaborative training replace it?",
    grid=_grid(),
    where=_meaningful,
    settings={
        **scene.TOWN,
        **scene.WEIGHTS,
        "runs": 30,
        "train_seeds": 5,
    },
    shares=("max_neighbours",),
    tables={
        **{
            f"rt_le_{model}": k_table(f"RT-LE [m] against K, {model} noise model.", BOUND_NOTE, where=_under(model))
            for model in ("identity", "fitted", "nominal")
        },
        "nees": k_table(
            "NEES against K (3 is consistent), nominal noise model.",
            value="nees",
            where=_under("nominal", method=FILTERS),
            best=None,
        ),
    },
    figures={"rt_le": _sides},
    findings=findings,
    limitations=(
        "Azimuth and inclination are in the world frame, which assumes known headings.",
        "MSMV-R is a reconstruction; no variant of MSMV that we tried is flat in K like the paper's curve.",
        "The nets and the fitted noise model come from solo drives with 1.5 m and 10 %; the test noise differs.",
    ),
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
