"""Collaborative training against collaborative decision: RT-LE against neighbours (paper, Fig. 5)."""

from coopoc.study.cell import Params
from coopoc.study.numbers import Results, interval, listed, mean, present, rms
from coopoc.study.style import Panel

from . import lineup, scene, weights
from .lineup import BOUND
from .views import Plot, TableView, curves, of, table

NEIGHBOURS = (0, 1, 2, 3, 4, 6, 8, 10)
TRAINED = ("okf", "fedkalmannet", "centralised")
MODELS = ["identity", "nominal", "fitted"]


def _grid() -> list[Params]:
    """Every method at every K."""
    solo = [("gnss", "none"), *((m, "trained") for m in TRAINED), *(("kalman", model) for model in MODELS)]
    shared = [(m, model) for m in lineup.COOPERATIVE for model in MODELS]
    return [of(*pair, max_neighbours=k) for k in NEIGHBOURS for pair in (*solo, *shared, BOUND)]


def _meaningful(p: Params) -> bool:
    """No more neighbours than there are vehicles; no bound for real data, whose noise is unknown; no exact step without
    a noise model."""
    if p["max_neighbours"] >= len(scene.fleet(p["data"]).ids):
        return False
    return not (p["method"] == "bound" and scene.is_real(p["data"])) and not (
        p["method"] == "joint" and p["noise_model"] == "identity"
    )


BOUND_NOTE = "The bound is for the rms over runs of causal estimates, over an ideal channel and without the bias."


def _table(noise_model: str) -> TableView:
    """RT-LE of cells with a noise model, and of those of methods that have none."""
    text, where = f"RT-LE [m] against K, {noise_model} noise model.", [noise_model, "none", "trained", "bound"]
    return table(text, BOUND_NOTE, where={"noise_model": where}, intervals=False)


def _sides(results: Results) -> "Plot | None":
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
    return curves(
        panels,
        [*solo, *shared, of(*BOUND)],
        text,
        BOUND_NOTE,
        number=lambda rows, where: (mean if where["method"] == "bound" else interval)(rows, where),
        width=7.6,
        log=True,
    )(results)


def findings(results: Results) -> list[str]:
    """Which of training and cooperation is better, and the errors under known covariances beside the bound."""
    k = _most(results, "nominal")
    pairs = {"KF alone": ("kalman", "nominal"), "joint filter": ("joint", "nominal"), "bound": BOUND}
    each = listed({name: rms(results, of(*pair, max_neighbours=k)) for name, pair in pairs.items()})
    return [_answer(results), f"Known covariances, K = {k}, rms over runs: {each}." if each else ""]


def _answer(results: Results) -> str:
    """Which of the two is better at the largest K, with fitted covariances and with the paper's, and their bytes."""
    k = _most(results, "fitted")
    fed, joint, paper = (
        mean(results, of(*pair, max_neighbours=k))
        for pair in (("fedkalmannet", "trained"), ("joint", "fitted"), ("lkf-sa", "identity"))
    )
    if fed is None or joint is None or paper is None:
        return ""
    rate = mean(results, of("joint", "fitted", max_neighbours=k), "payload_bytes_per_second")
    card = weights.checkpoint("fedkalmannet", results.settings, 0).card
    once = sum(row["sent_bytes"] + row["received_bytes"] for row in card["history"]) / len(card["clients"])
    return (
        f"Vehicles should collaborate while they {'decide, where messages arrive' if joint < fed else 'train'}: with "
        f"fitted covariances {k} neighbours give {joint:.2f} m for {rate:,.0f} B/s of messages, federated training "
        f"alone {fed:.2f} m for {once / 1e6:.1f} MB, once; with the paper's identity covariances cooperation gives "
        f"{paper:.2f} m for the same messages."
    )


def _most(results: Results, noise_model: str) -> int:
    """The largest K at which a cooperative method was run with this noise model; 0 for none."""
    where = present(results, {"method": list(lineup.COOPERATIVE), "noise_model": noise_model})
    return int(results.select(where)["max_neighbours"].max()) if where else 0


STUDY = lineup.study(
    "neighbours",
    "What does another neighbour bring online, at what cost, and can collaborative training replace it?",
    grid=_grid(),
    where=_meaningful,
    settings={**scene.TOWN, **scene.WEIGHTS, "runs": 30, "train_seeds": 5},
    shares=("max_neighbours",),
    tables={f"rt_le_{model}": _table(model) for model in ("identity", "fitted", "nominal")},
    figures={"rt_le": _sides},
    findings=findings,
    limitations=(
        "Azimuth and inclination are in the world frame, which assumes known headings.",
        "MSMV-R is a reconstruction; no variant of MSMV that we tried is flat in K like the paper's curve.",
        "The nets and the fitted noise model come from solo drives with 1.5 m and 10 %; the test noise differs.",
    ),
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
