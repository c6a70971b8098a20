"""A cooperative learned gain that nobody tells the noise, against the joint filter that knows it, and message loss."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.evaluate.metrics import nees, nees_inside, rt_le
from coopoc.evaluate.recursion import covariances, stages_of
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method, Track
from coopoc.plugins import find
from coopoc.study.study import Params, Row, Study
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording
from coopoc.world.sensing import find_links, observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

NEIGHBOURS = (0, 2, 6, 10)
LOSSES = (0.0, 0.3, 0.7)
TRAINED = {"cooperative": True, "cooperative-newest": False}
"""Learned methods, whose weights are the same -> whether their messages are sums."""
LINES = (
    ("cooperative", "trained"),
    ("cooperative-newest", "trained"),
    ("joint", "nominal"),
    ("split-ci", "nominal"),
    ("joint", "fitted"),
    ("lkf-sa", "identity"),
)
BOUNDS = (("bound", "star"), ("bound", "with its past"))
RECEIVERS = ("mixed", "changing")
"""Two receivers in five are POOR and the others GOOD; all are POOR in the middle third of the drive and else GOOD."""
GOOD, POOR = 1.5, 5.0
"""m."""


def _grid() -> list[dict[str, Any]]:
    """Every K and loss with receivers that are alike, and receivers that differ at K = 0 and 6; bounds know no loss."""
    alike = {"receivers": "alike"}
    grid: list[dict[str, Any]] = [
        {**alike, "max_neighbours": k, "loss": loss, "method": m, "noise_model": known}
        for loss in LOSSES
        for k in NEIGHBOURS
        for m, known in (*LINES, *(BOUNDS if loss == 0 else ()))
        if k or loss == 0
    ]
    told = [*LINES[:3], ("joint", "told")]
    grid += [
        {"receivers": which, "max_neighbours": k, "loss": 0.0, "method": m, "noise_model": known}
        for which in RECEIVERS
        for k in (0, 6)
        for m, known in told
    ]
    return grid


def key(p: Params) -> dict[str, str]:
    """What changes the numbers of a cell beyond its parameters."""
    return lineup.key({**p, "method": "cooperative" if p["method"] in TRAINED else p["method"]})


def prepare(cells: Iterable[Params], jobs: int = 1) -> None:
    """Train the net that the cells need, once for both kinds of messages."""
    weights.prepare([{**p, "method": "cooperative"} for p in cells if p["method"] in TRAINED], jobs)


def cell(p: Params) -> list[Row]:
    """Rows of one method, K and loss, per training seed, ego and run; of a bound, one row per ego."""
    drive, who = scene.fleet(p["data"]), scene.egos(p["data"], str(p["egos"]))
    if p["method"] == "bound":
        seen = past_bound if p["noise_model"] == "with its past" else posterior_bound
        found = {ego: seen(drive, scene.sensors(p), drive.index(ego), channel(p)) for ego in who}
        return [{"run": 0, "ego": ego, "rt_le_m": bound_rt_le(cov)} for ego, cov in found.items()]
    seen_by_all = recording(p)
    rows: list[Row] = []
    for seed, method in _methods(p, seen_by_all):
        extra = {} if seed is None else {"train_seed": seed}
        rows += _rows(method(seen_by_all, who), drive, who, extra)
    return rows


def _methods(p: Params, seen: Recording) -> list[tuple[int | None, Method]]:
    from coopoc.learned.nets.cooperative import CooperativeGain, NetNoise

    if p["method"] in TRAINED:
        models: list[tuple[int, Any]] = [
            (seed, weights.checkpoint("cooperative", p, seed).model) for seed in weights.seeds(p)
        ]
        return [(seed, CooperativeGain(m, TRAINED[p["method"]], p["method"])) for seed, m in models]
    if p["noise_model"] == "told":
        drive = scene.fleet(p["data"])
        process = NoiseModel.nominal(seen.sensors).process_variance(seen)
        truth = NetNoise("told", seen.sensors, fix=np.square(gnss_std(p, drive))[None], process=process)
        return [(None, find("coopoc.methods", p["method"])(truth))]
    return [(None, find("coopoc.methods", p["method"])(lineup.noise_model(p)))]


def _rows(track: Track, drive: Fleet, who: Sequence[str], extra: Mapping[str, Any]) -> list[Row]:
    columns = {
        "rt_le_m": rt_le(track, drive),
        "bytes_per_second": track.received_bytes / (drive.dt * len(track.t)),
        "nees": nees(track, drive).mean(axis=1),
    }
    columns["nees_inside"] = np.broadcast_to(nees_inside(track, drive), columns["nees"].shape)
    return [
        {"run": r, "ego": ego, **extra, **{name: float(values[r, e]) for name, values in columns.items()}}
        for e, ego in enumerate(who)
        for r in range(len(track.x))
    ]


def channel(p: Params) -> V2X:
    """Neighbourhood and loss of the cell."""
    return V2X(p["max_neighbours"], float(p["radius_m"]), loss=float(p["loss"]), burst=float(p["burst"]))


def gnss_std(p: Params, drive: Fleet) -> Floats:
    """(T, N, 3) m that acts on the cell's fixes."""
    steps, vehicles = len(drive.t), len(drive.ids)
    poor = np.arange(vehicles)[None, :, None] % 5 < 2
    if p["receivers"] == "changing":
        poor = 3 * np.arange(steps)[:, None, None] // steps == 1
    std = np.array(scene.sensors(p).gnss_std) if p["receivers"] == "alike" else np.where(poor, POOR, GOOD)
    return np.broadcast_to(std, (steps, vehicles, 3))


def recording(p: Params) -> Recording:
    """What the vehicles of the cell see; sensors that are told are the rms over fleet and drive."""
    who = scene.egos(p["data"], str(p["egos"]))
    seen = _recording(p["data"], scene.sensors(p), channel(p), int(p["runs"]), int(p["seed"]), who)
    if p["receivers"] == "alike":
        return seen
    drive = scene.fleet(p["data"])
    std = gnss_std(p, drive)
    mean = float(np.sqrt(np.square(std).mean()))
    gnss = drive.position + std / np.array(seen.sensors.gnss_std) * (seen.gnss - drive.position)
    return replace(seen, gnss=gnss, sensors=replace(seen.sensors, gnss_std=(mean, mean, mean)))


@lru_cache(maxsize=2)
def _recording(data: str, noise: Sensors, v2x: V2X, runs: int, seed: int, who: tuple[str, ...]) -> Recording:
    return observe(scene.fleet(data), noise, v2x, runs=runs, seed=seed, observers=who)


def past_bound(drive: Fleet, sensors: Sensors, ego: int, v2x: V2X) -> Floats:
    """`posterior_bound` (T, 3, 3) m^2 of an ego that knows all fixes and velocities of everyone, too.

    Sums since departure tell a new neighbour's past, which a bound that forgets who is not there does not count.
    """
    links = find_links(drive, [ego], v2x.max_neighbours, v2x.radius, sensors.min_range)
    everyone = np.arange(len(drive.ids))
    own = slice(3 * ego, 3 * ego + 3)
    stages = stages_of(drive, sensors, links, [everyone] * len(drive.t))
    return np.stack([cov[own, own] for _, cov in covariances(stages, smoothing=False)])


ALIKE = {"receivers": "alike"}
HEARS = (
    "The learned gain is told no noise of GNSS and velocity; nominal filters know it. Messages of 14 numbers (learned, "
    "split CI) or 8 (the others)."
)
BOUND = (
    "Bounds are for the rms over runs and a channel that loses nothing; with its past, a new neighbour has also told "
    "what it did before, as sums and split CI's estimates do."
)


def _table(value: str, text: str, where: Mapping[str, Any], rows: Sequence[str], **options: Any) -> Any:
    def table(results: Results) -> Table | None:
        from coopoc.study.pivot import pivot

        kept = views.present(results, where, value)
        if kept is None:
            return None
        caption = f"{text} {HEARS} {scene.conditions(results.settings)}"
        return pivot(
            results, rows=rows, columns="max_neighbours", value=value, where=kept, best=None, caption=caption, **options
        )

    return table


def _figure(results: Results) -> Plot | None:
    """RT-LE against K, one panel per loss; K = 0, where nothing can be lost, in all of them."""
    from coopoc.study.plot import Plot, canvas, legend, strokes

    losses = [loss for loss in LOSSES if views.present(results, {**ALIKE, "loss": loss})]
    if not losses:
        return None
    with canvas(1, len(losses), width=2.1 + 2.0 * len(losses), height=3.2, sharey=True, squeeze=False) as (
        figure,
        (panels,),
    ):
        for panel, loss in zip(panels, losses, strict=True):
            drawn = []
            for method, known in (*LINES[:-1], *BOUNDS):
                points = _line(results, method, known, loss)
                if not points:
                    continue
                names = {"method": method, "noise_model": known}
                ks, found = zip(*points, strict=True)
                style = strokes(names) | ({"linestyle": ":"} if known == "with its past" else {})
                panel.plot(ks, [one.mean for one in found], **style)
                if method != "bound":
                    panel.fill_between(
                        ks,
                        [one.low for one in found],
                        [one.high for one in found],
                        alpha=0.12,
                        color=style["color"],
                        linewidth=0,
                    )
                drawn.append(names)
            panel.set(title=f"{100 * loss:g} % of messages lost", xlabel="Neighbours K", xticks=NEIGHBOURS)
        panels[0].set(ylabel="RT-LE [m]", ylim=(0, None))
        legend(panels[-1], drawn)
    text = (
        "RT-LE against the number of neighbours; bands: 95 % intervals over egos, then runs; dotted black: the bound "
        f"with its past. LKF-SA lies far above. {HEARS} {BOUND}"
    )
    return Plot(figure, f"{text} {scene.conditions(results.settings)}")


def _line(results: Results, method: str, known: str, loss: float) -> list[tuple[int, Any]]:
    """(K, interval) of a line; without neighbours, and for bounds, that of no loss."""
    points = []
    for k in NEIGHBOURS:
        at = 0.0 if k == 0 or method == "bound" else loss
        where = {**ALIKE, "method": method, "noise_model": known, "max_neighbours": k, "loss": at}
        if views.present(results, where):
            points.append((k, results.interval("rt_le_m", where)))
    return points


def _findings(results: Results) -> Sequence[str]:
    return [sentence for loss in LOSSES for sentence in [_finding(results, loss)] if sentence]


def _finding(results: Results, loss: float) -> str:
    """The learned gain at the largest K that was run, against the joint filter that knows the noise."""
    where = views.present(results, {**ALIKE, "loss": loss, "method": "cooperative"})
    if where is None:
        return ""
    most = int(results.select(where)["max_neighbours"].max())
    at = {**ALIKE, "loss": loss, "max_neighbours": most}
    one, other = ({**at, "method": m, "noise_model": known} for m, known in (LINES[0], LINES[2]))
    if not views.present(results, other):
        return ""
    mine = results.interval("rt_le_m", one).mean
    spread = views.seed_std(results, one)
    seeds = f", seed std {spread:.4f} m" if spread is not None else ""
    verdict = views.verdict(results, one, other, "the joint filter that knows the noise")
    return f"{100 * loss:g} % loss, K = {most}: the cooperative gain has {mine:.3f} m{seeds} and {verdict}."


METHOD = ("loss", "method", "noise_model")
FILTERS = {**ALIKE, "method": list(dict.fromkeys(method for method, _ in LINES))}
STUDY = Study(
    name="cooperative_gain",
    question="Can vehicles that tell each other how large their noise is do without knowing it, and when messages are "
    "lost?",
    cell=cell,
    key=key,
    prepare=prepare,
    grid=_grid(),
    settings={
        "data": "town10",
        "clients": "town10-clients",
        "weights": "runs/weights",
        "scenario": 2,
        "velocity_ratio": 0.15,
        "velocity_reading": "axis",
        "radius_m": 30.0,
        "burst": 1.0,
        "egos": "auto",
        "runs": 30,
        "seed": 0,
        "train_seeds": 3,
    },
    shares=("receivers", "max_neighbours", "loss"),
    tables={
        "rt_le": _table("rt_le_m", f"RT-LE [m] against K. {BOUND}", ALIKE, METHOD, decimals=3),
        "bytes": _table(
            "bytes_per_second", "Payload that an ego receives [B/s].", FILTERS, METHOD, decimals=0, intervals=False
        ),
        "nees": _table("nees", "NEES (3 is consistent).", FILTERS, METHOD, intervals=False),
        "nees_inside": _table(
            "nees_inside",
            "Share of steps whose run-averaged NEES is in its 99 % band (gate: 0.95).",
            FILTERS,
            METHOD,
            intervals=False,
        ),
        "receivers": _table(
            "rt_le_m",
            f"RT-LE [m] where two receivers in five have {POOR:g} m and the others {GOOD:g} m (mixed), and "
            f"where all have {POOR:g} m in the middle third of the drive (changing); nominal filters are told the rms, "
            "'told' ones each fix's own.",
            {"receivers": list(RECEIVERS)},
            ("receivers", "method", "noise_model"),
            decimals=3,
        ),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "The noise of range and angles is the data sheet's: vehicles that train alone show nothing of it.",
        "Messages arrive at the step in which they are sent, or never.",
        "Numbers count as float32; sums of long drives would be restarted before they need more.",
    ),
    minutes=12,
    metrics={"rt_le_m": "lower", "nees": 3.0},
    reference=views.reference("cooperative_gain"),
)
