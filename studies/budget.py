"""Accuracy against bytes, sent once for a training or in every second of a drive, and the break-even of the two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from coopoc.study.numbers import listed, mean, ratio, rms
from coopoc.study.style import look
from coopoc.world.v2x import CHANNELS

from . import budget_tables, lineup, scene, weights
from .budget_tables import AXES, CAPS, SCHEDULED, SCHEDULES, SHARED, TRAINED, under, way
from .lineup import PAST, of

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
HOURS = (1, 10, 100)
PAYLOAD = "payload_bytes_per_second"
LIMITS = (0.0, 300.0, 1000.0, 5000.0)
"""B/s, under which the best method is named."""


def _grid() -> list[dict[str, Any]]:
    """Solo methods once; the others at each K over every channel, and over the ideal one under rates and caps; two
    of them under caps with other schedules."""
    channels = [way(name, k) for name in CHANNELS for k in NEIGHBOURS]
    rates = [way("ideal", 10, rate_hz=rate) for rate in RATES]
    caps = [way("ideal", 10, cap_bytes_per_second=cap) for cap in CAPS]
    return [
        *(of(*pair, **way("ideal", 0)) for pair in (*SOLO, PAST)),
        *(of(*pair, **each) for each in (*channels, *rates, *caps) for pair in SHARED),
        *(under(cap, each, *pair) for cap in CAPS for each in SCHEDULES[1:] for pair in SCHEDULED),
        *(of(*PAST, **way("ideal", k)) for k in NEIGHBOURS),
    ]


def _pareto(results: Results) -> Plot | None:
    """RT-LE against payload bytes per second; a training's bytes are spread over hours of driving."""
    from coopoc.study.lines import Line, draw
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    drawn, ran = list[Mapping[str, Any]](), choices(results)
    with canvas(1, 2, width=8.6, height=3.9, sharey=True, gridspec_kw={"width_ratios": [1.0, 1.3]}) as (
        figure,
        (left, right),
    ):
        for pair in SOLO:
            error = mean(results, of(*pair))
            if error is not None and pair[0] in TRAINED:
                total = weights.training_bytes(results.settings, [pair[0]])[pair[0]]
                drawn += draw(left, [Line(of(*pair), {total / (3600 * hours): error for hours in HOURS})])
            else:
                level = [Line(of(*pair), error, {"alpha": 0.75})]
                drawn += draw(left, level) and draw(right, level)
        for pair in SHARED:
            found = sorted((one.size, one.error) for one in ran if _pair(one) == pair and one.size)
            if found:
                right.plot(*zip(*found, strict=True), **{**strokes(of(*pair), thin=True), "linestyle": "none"})
                drawn += draw(right, [Line(of(*pair), dict(front(found)), {"marker": ""})])
        least = min((one.error for one in ran if _pair(one) == PAST), default=None)
        if least is not None:
            drawn += draw(right, [Line(of(*PAST), least)])
        if not drawn:
            return None
        for panel in (left, right):
            plain_log(panel.yaxis)
            plain_log(panel.xaxis)
        left.set(ylabel="RT-LE [m]", xlabel="Training bytes per second of driving", title="solo")
        right.set(xlabel="Received online, payload [B/s]", title="online cooperation")
        legend(right, drawn)
    text = (
        "RT-LE against bytes. Left: what each vehicle sends and receives in training, spread over 1, 10 and 100 hours "
        "of driving (right to left). Right: payload that an ego receives over a channel that loses nothing, at each K, "
        "rate, cap and schedule; lines: the best for the bytes. Horizontal: what costs no bytes. The bound is that of "
        "most neighbours at every step, with what newcomers did before: no message brings more, whatever its bytes."
    )
    return Plot(figure, scene.caption(results, text))


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Of points (bytes, error) in order of bytes, those with a lower error than every cheaper one.

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


def _pair(choice: Choice) -> tuple[str, str]:
    return choice.where["method"], choice.where["noise_model"]


def choices(results: Results) -> list[Choice]:
    """All that was run over an ideal channel, and the bound."""
    names, found = [*AXES, "method", "noise_model"], list[Choice]()
    for each, _ in results.frame.groupby(names, sort=False) if set(names) <= set(results.frame) else ():
        where = dict(zip(names, each, strict=True))
        if where["channel"] == "ideal" and (error := mean(results, where)) is not None:
            found.append(Choice(error, mean(results, where, PAYLOAD) or 0.0, where))
    return [one for one in found if _pair(one) in (*SOLO, *SHARED, PAST)]


def best_under(found: Sequence[Choice], limit: float) -> Choice | None:
    """The best method of them within `limit` bytes per second."""
    able = [one for one in found if one.size <= limit and _pair(one) != PAST]
    return min(able, key=lambda one: one.error, default=None)


def _findings(results: Results) -> dict[str, str]:
    found, ran = {}, choices(results)
    for limit in LIMITS:
        best = best_under(ran, limit)
        if best is not None:
            where, k = best.where, best.where["max_neighbours"]
            first = "" if where["schedule"] == SCHEDULES[0] else f", {where['schedule']}"
            at = f", K = {k}{first}, {best.size:.0f} B/s" if k else ""
            words = f"At most {limit:g} B/s" if limit else "Without a byte while driving"
            how = f"{look(where['method']).label} ({where['noise_model']}){at}"
            found[f"{limit:g} B/s"] = f"{words}: best is {how}, {best.error:.3f} m{gap(results, where)}."
    return found | {f"schedules, {method}": _scheduled(results, method, known) for method, known in SCHEDULED}


def gap(results: Results, where: Mapping[str, Any]) -> str:
    """Ratio of a selection to the bound of its K, rms over rms, in words; empty where the bound was not run."""
    times = ratio(rms(results, where), rms(results, {"method": "bound", "max_neighbours": where["max_neighbours"]}))
    return f", {times:.2f} times the bound" if times else ""


def _scheduled(results: Results, method: str, known: str) -> str:
    """RT-LE of a method under each cap, by the schedule of its neighbours."""
    parts = []
    for cap in CAPS:
        errors = {each: mean(results, under(cap, each, method, known)) for each in SCHEDULES}
        if None not in errors.values():
            parts.append(f"at {cap:g} B/s {listed(errors)}")
    return f"Heard first under a cap ({look(method).label}, {known}): {'; '.join(parts)}." if parts else ""


STUDY = lineup.study(
    "budget",
    "What does accuracy cost in bytes: once for training, or in every second of a drive?",
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "runs": 30, "train_seeds": 3},
    shares=AXES,
    tables={
        "channels": budget_tables.channels,
        "load": budget_tables.load,
        "schedules": budget_tables.schedules,
        "break_even": budget_tables.even,
        "ledger": budget_tables.ledger,
    },
    figures={"pareto": _pareto},
    findings=_findings,
    limitations=(
        "Only messages of the K neighbours are counted; those of other vehicles also occupy the channel.",
        "Under a cap the nearest neighbours' messages pass first unless another schedule is named.",
        "Numbers count as float32; a CAM rounds positions to 6 mm and speeds to 5 mm/s instead.",
    ),
    minutes=13,
    metrics={"rt_le_m": "lower"},
)
