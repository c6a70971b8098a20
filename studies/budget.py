"""What accuracy costs in bytes: sent once for a training, or in every second of a drive; and when the two are even."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from coopoc.study.study import Params, Row, Study

from . import budget_tables, lineup, scene, views, weights
from .budget_tables import CAPS, FREE, SCHEDULED, SCHEDULES, SHARED, TRAINED, under

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

SOLO = (
    ("gnss", "none"),
    ("kalman", "fitted"),
    ("kalman", "nominal"),
    ("fedokf", "trained"),
    ("fedkalmannet", "trained"),
    ("recursive", "trained"),
)
NEIGHBOURS = (1, 2, 4, 10)
RATES = (1.0, 2.0, 5.0)
BOUND = ("bound", "bound")


def _grid() -> list[dict[str, Any]]:
    """Solo methods once; the others at each K over every channel, and over the ideal one under rates and caps; two
    of them under caps with other schedules."""
    alone = {"channel": "ideal", "max_neighbours": 0, **FREE}
    grid = [{**alone, "method": m, "noise_model": known} for m, known in (*SOLO, BOUND)]
    ways = [{"channel": name, "max_neighbours": k, **FREE} for name in scene.CHANNELS for k in NEIGHBOURS]
    ways += [{"channel": "ideal", "max_neighbours": 10, **FREE, "rate_hz": rate} for rate in RATES]
    ways += [{"channel": "ideal", "max_neighbours": 10, **FREE, "cap_bytes_per_second": cap} for cap in CAPS]
    bounded = [way for way in ways if way["channel"] == "ideal" and not way["cap_bytes_per_second"]]
    grid += [{**way, "method": m, "noise_model": known} for way in ways for m, known in SHARED]
    grid += [under(cap, each, m, known) for cap in CAPS for each in SCHEDULES[1:] for m, known in SCHEDULED]
    return grid + [{**way, "method": "bound", "noise_model": "bound"} for way in bounded if not way["rate_hz"]]


def cell(p: Params) -> list[Row]:
    """Rows of one method over one channel; of the bound, one row per ego."""
    return lineup.bound_rows(p) if p["method"] == "bound" else lineup.rows(p)


def _pareto(results: Results) -> Plot | None:
    """RT-LE against payload bytes per second; a training's bytes are spread over hours of driving."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    drawn, ran = list[dict[str, Any]](), choices(results)
    with canvas(1, 2, width=8.6, height=3.9, sharey=True, gridspec_kw={"width_ratios": [1.0, 1.3]}) as (
        figure,
        (left, right),
    ):
        for method, known in SOLO:
            error = views.mean(results, {"method": method, "noise_model": known})
            if error is None:
                continue
            names = {"method": method, "noise_model": known}
            total = weights.training_bytes(results.settings, [method])[method] if method in TRAINED else None
            if total is None:
                for panel in (left, right):
                    panel.axhline(error, **{**strokes(names), "marker": ""}, alpha=0.75)
            else:
                left.plot([total / (3600 * hours) for hours in HOURS], [error] * len(HOURS), **strokes(names))
            drawn.append(names)
        for method, known in (*SHARED, BOUND):
            points = [one for one in ran if (one.where["method"], one.where["noise_model"]) == (method, known)]
            found = sorted((one.size, one.error) for one in points if one.size)
            if found:
                names = {"method": method, "noise_model": known}
                right.plot(*zip(*found, strict=True), **{**strokes(names, thin=True), "linestyle": "none"})
                right.plot(*zip(*front(found), strict=True), **{**strokes(names), "marker": ""})
                drawn.append(names)
        if not drawn:
            return None
        for panel in (left, right):
            plain_log(panel.yaxis)
            plain_log(panel.xaxis)
        left.set(ylabel="RT-LE [m]", xlabel="Training bytes per second of driving", title="decided alone")
        right.set(xlabel="Received while deciding, payload [B/s]", title="decided together")
        legend(right, drawn)
    text = (
        "RT-LE against bytes. Left: what each vehicle sends and receives in training, spread over 1, 10 and 100 hours "
        "of driving (right to left). Right: payload that an ego receives over a channel that loses nothing, at each K, "
        "rate, cap and schedule; lines: the best for the bytes. Horizontal: what costs no bytes. The bound forgets "
        "what newcomers did before; estimates and sums tell it."
    )
    return Plot(figure, f"{text} {scene.conditions(results.settings)}")


HOURS = (1, 10, 100)
PAYLOAD = "payload_bytes_per_second"


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Of points (bytes, error) in order of bytes, those that no cheaper one is as good as.

    >>> front([(1.0, 3.0), (2.0, 4.0), (3.0, 2.0)])
    [(1.0, 3.0), (3.0, 2.0)]
    """
    best: list[tuple[float, float]] = []
    for point in points:
        if not best or point[1] < best[-1][1]:
            best.append(point)
    return best


class Choice(NamedTuple):
    """RT-LE in metres, payload bytes per second, and the selection that has them."""

    error: float
    size: float
    where: Mapping[str, Any]


def choices(results: Results) -> list[Choice]:
    """All that was run over an ideal channel, and the bound."""
    names, found = ["channel", "max_neighbours", *FREE, "method", "noise_model"], list[Choice]()
    known = {*SOLO, *SHARED, BOUND}
    for each, _ in results.frame.groupby(names, sort=False) if set(names) <= set(results.frame) else ():
        where = dict(zip(names, each, strict=True))
        if where["channel"] == "ideal" and (where["method"], where["noise_model"]) in known:
            error = views.mean(results, where)
            if error is not None:
                found.append(Choice(error, views.mean(results, where, PAYLOAD) or 0.0, where))
    return found


def best_under(found: Sequence[Choice], limit: float) -> Choice | None:
    """The best method of them within `limit` bytes per second."""
    able = [one for one in found if one.size <= limit and one.where["method"] != BOUND[0]]
    return min(able, key=lambda one: one.error, default=None)


def _findings(results: Results) -> Sequence[str]:
    from coopoc.study.style import look

    said, found = [], choices(results)
    for limit in (0.0, 300.0, 1000.0, 5000.0):
        best = best_under(found, limit)
        if best is not None:
            error, size, where = best
            how = f"{look(where['method']).label} ({where['noise_model']})"
            at = f", K = {where['max_neighbours']}{_first(where)}, {size:.0f} B/s" if where["max_neighbours"] else ""
            words = f"At most {limit:g} B/s" if limit else "Without a byte while driving"
            said.append(f"{words}: best is {how}{at}, {error:.3f} m{gap(results, where)}.")
    return [*said, *_scheduled(results)]


def gap(results: Results, where: Mapping[str, Any]) -> str:
    """How far a selection is from the bound of its K, rms over rms; nothing where the bound was not run."""
    bound = views.rms(results, {"method": "bound", "max_neighbours": where["max_neighbours"]})
    rms = views.rms(results, where)
    return f", {rms / bound:.2f} times the bound" if bound and rms else ""


def _first(where: Mapping[str, Any]) -> str:
    return "" if where["schedule"] == SCHEDULES[0] else f", {where['schedule']}"


def _scheduled(results: Results) -> list[str]:
    """What a method loses or gains under each cap when others than the nearest are heard first."""
    from coopoc.study.style import look

    said = []
    for method, known in SCHEDULED:
        told = []
        for cap in CAPS:
            errors = [views.mean(results, under(cap, each, method, known)) for each in SCHEDULES]
            if all(error is not None for error in errors):
                told.append(f"at {cap:g} B/s {views.listed(dict(zip(SCHEDULES, errors, strict=True)))}")
        if told:
            said.append(f"Heard first under a cap ({look(method).label}, {known}): {'; '.join(told)}.")
    return said


STUDY = Study(
    name="budget",
    question="What does accuracy cost in bytes, in a training once or in every second of a drive?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=_grid(),
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
        "train_seeds": 3,
    },
    shares=("channel", "max_neighbours", *FREE),
    tables={
        "channels": budget_tables.channels,
        "load": budget_tables.load,
        "schedules": budget_tables.schedules,
        "break_even": budget_tables.even,
        "ledger": budget_tables.ledger,
    },
    figures={"pareto": _pareto},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "A vehicle receives what its K neighbours send; what the others send fills the channel, too.",
        "Under a cap the nearest neighbours are heard first where no other schedule is named.",
        "Numbers count as float32; CAMs quantise positions and velocities instead.",
    ),
    minutes=13,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("budget"),
)
