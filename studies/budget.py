"""What accuracy costs in bytes: sent once for a training, or in every second of a drive; and when the two are even."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.study.study import Params, Row, Study
from coopoc.world.v2x import FIX_AND_VELOCITY

from . import lineup, scene, views, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

SOLO = (("gnss", "none"), ("kalman", "fitted"), ("kalman", "nominal"), ("fedokf", "trained"),
        ("fedkalmannet", "trained"), ("recursive", "trained"))  # fmt: skip
SHARED = (("lkf-sa", "identity"), ("lkf-sa", "fitted"), ("joint", "fitted"), ("joint", "nominal"),
          ("split-ci", "nominal"), ("cooperative", "trained"))  # fmt: skip
NEIGHBOURS = (1, 2, 4, 10)
RATES = (1.0, 2.0, 5.0)
CAPS = (100.0, 200.0, 400.0, 800.0)
FREE = {"rate_hz": 0.0, "cap_bytes_per_second": 0.0}
BOUND = ("bound", "bound")
TRAINED = ("fedokf", "recursive", "fedkalmannet")
"""Trained by federation, in the order of their bytes."""


def _grid() -> list[dict[str, Any]]:
    """Solo methods once; the others at each K over every channel, and over the ideal one under rates and caps."""
    alone = {"channel": "ideal", "max_neighbours": 0, **FREE}
    grid = [{**alone, "method": m, "knowledge": known} for m, known in (*SOLO, BOUND)]
    ways = [{"channel": name, "max_neighbours": k, **FREE} for name in scene.CHANNELS for k in NEIGHBOURS]
    ways += [{"channel": "ideal", "max_neighbours": 10, **FREE, "rate_hz": rate} for rate in RATES]
    ways += [{"channel": "ideal", "max_neighbours": 10, **FREE, "cap_bytes_per_second": cap} for cap in CAPS]
    bounded = [way for way in ways if way["channel"] == "ideal" and not way["cap_bytes_per_second"]]
    grid += [{**way, "method": m, "knowledge": known} for way in ways for m, known in SHARED]
    return grid + [{**way, "method": "bound", "knowledge": "bound"} for way in bounded if not way["rate_hz"]]


def cell(p: Params) -> list[Row]:
    """Rows of one method over one channel, with bytes as payload and on air; of the bound, one row per ego."""
    drive, v2x = scene.fleet(p["data"]), scene.channel(p)
    if p["method"] == "bound":
        found = []
        for ego in scene.egos(p["data"], str(p["egos"])):
            bound = bound_rt_le(posterior_bound(drive, scene.sensors(p), ego, v2x))
            near = float(scene.recording({**p, "runs": 1}).neighbours(drive.index(ego)).mean())
            received = near * FIX_AND_VELOCITY.payload / drive.dt
            found.append({"run": 0, "ego": ego, "rt_le_m": bound, "bytes_per_second": received})
        return found
    rows = lineup.rows(p)
    for row in rows:
        row["air_bytes_per_second"] = row["bytes_per_second"]
        row["bytes_per_second"] = row["air_bytes_per_second"] * _payload_share(p)
    return rows


def _payload_share(p: Params) -> float:
    """Of the bytes on air, those that the method adds to what vehicles send anyway."""
    overhead = scene.channel(p).overhead
    if not overhead or p["method"] in {name for name, _ in SOLO}:
        return 1.0
    recording = scene.recording({**p, "runs": 1})
    method = lineup.methods({**p, "train_seeds": 1}, recording)[0][1]
    return float(method.message.size() / method.message.size(overhead))


def ways(results: Results) -> list[dict[str, Any]]:
    """The channels that were run, as selections."""
    frame = results.frame
    names = [name for name in ("channel", "max_neighbours", *FREE) if name in frame]
    return [dict(zip(names, each, strict=True)) for each, _ in frame.groupby(names, sort=False)] if names else []


def _pareto(results: Results) -> Plot | None:
    """RT-LE against payload bytes per second; a training's bytes are spread over hours of driving."""
    from coopoc.study.plot import Plot, canvas, legend, plain_log, strokes

    drawn: list[dict[str, Any]] = []
    with canvas(1, 2, width=8.6, height=3.9, sharey=True, gridspec_kw={"width_ratios": [1.0, 1.3]}) as (
        figure, (left, right),
    ):  # fmt: skip
        for method, known in SOLO:
            error = views.mean(results, {"method": method, "knowledge": known})
            if error is None:
                continue
            names = {"method": method, "knowledge": known}
            total = weights.training_bytes(results.settings, [method])[method] if method in TRAINED else None
            if total is None:
                for panel in (left, right):
                    panel.axhline(error, **{**strokes(names), "marker": ""}, alpha=0.75)
            else:
                left.plot([total / (3600 * hours) for hours in HOURS], [error] * len(HOURS), **strokes(names))
            drawn.append(names)
        for method, known in (*SHARED, BOUND):
            points = [_point(results, {**way, "method": method, "knowledge": known}) for way in ways(results)
                      if way["channel"] == "ideal" and way["max_neighbours"]]  # fmt: skip
            found = sorted(point for point in points if point is not None)
            if found:
                names = {"method": method, "knowledge": known}
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
        "rate and cap; lines: the best for the bytes. Horizontal: what costs no bytes. The bound forgets what newcomers"
        " did before; estimates and sums tell it."
    )
    return Plot(figure, f"{text} {scene.conditions(results.settings)}")


HOURS = (1, 10, 100)
BYTES = ("bytes_per_second", "air_bytes_per_second")


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


def _point(results: Results, where: dict[str, Any]) -> tuple[float, float] | None:
    error, size = views.mean(results, where), views.mean(results, where, "bytes_per_second")
    return None if error is None or not size else (size, error)


def _channels(results: Results) -> Table | None:
    """RT-LE, payload and bytes on air of each method over each channel, at the largest K that was run."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    body: list[tuple[Any, ...]] = []
    most = max((way["max_neighbours"] for way in ways(results)), default=0)
    for name in scene.CHANNELS:
        for method, known in SHARED:
            where = {"channel": name, "max_neighbours": most, **FREE, "method": method, "knowledge": known}
            if most and (error := views.mean(results, where)) is not None:
                sizes = [_whole(views.mean(results, where, kind)) for kind in BYTES]
                body.append((WORDS[name], look(method).label, known, error, *sizes))
    header = ("Channel", "Method", "Knowledge", "RT-LE [m]", "Payload [B/s]", "On air [B/s]")
    text = (
        f"K = {most} over channels as they are in the field: rate, latency, loss in bursts, and what a message carries "
        f"anyway. Payload is what a method adds. {scene.conditions(results.settings)}"
    )
    return Table(header, tuple(body), text, decimals=3) if body else None


WORDS = {"ideal": "ideal, 10 Hz", "cam": "CAM, 2.2 Hz", "bsm": "BSM, 10 Hz", "cpm": "CPM, 5 Hz"}


def _whole(value: float | None) -> int | None:
    return None if value is None else round(value)


def _even(results: Results) -> Table | None:
    """Hours of driving after which deciding together has moved as many bytes as a training, per method and channel."""
    from coopoc.study.style import look
    from coopoc.study.tables import Table

    ran = [name for name in TRAINED if views.present(results, {"method": name})]
    most = max((way["max_neighbours"] for way in ways(results)), default=0)
    if not ran or not most:
        return None
    total, body = weights.training_bytes(results.settings, ran), list[tuple[Any, ...]]()
    for channel in scene.CHANNELS:
        for method, known in SHARED:
            where = {"channel": channel, "max_neighbours": most, **FREE, "method": method, "knowledge": known}
            rate = views.mean(results, where, "bytes_per_second")
            if rate and known in ("nominal", "trained"):
                body.append((WORDS[channel], look(method).label, round(rate),
                             *(_time(total[name] / rate) for name in ran)))  # fmt: skip
    header = ("Channel", "Deciding", "Payload [B/s]",
              *(f"{look(name).label}, {total[name] / 1e3:,.0f} kB" for name in ran))  # fmt: skip
    text = (
        f"Driving time after which deciding together (K = {most}) has moved as many bytes as each training moved per "
        f"vehicle, once. {scene.conditions(results.settings)}"
    )
    return Table(tuple(header), tuple(body), text) if body else None


def _time(seconds: float) -> str:
    """
    >>> _time(5), _time(600), _time(7300)
    ('5 s', '10 min', '2.0 h')
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def best_under(results: Results, limit: float) -> tuple[float, float, Mapping[str, Any]] | None:
    """Error, bytes per second and selection of what is best on an ideal channel within `limit` bytes per second."""
    found: list[tuple[float, float, Mapping[str, Any]]] = []
    for way in ways(results):
        for method, known in (*SOLO, *SHARED):
            where = {**way, "method": method, "knowledge": known}
            error, size = views.mean(results, where), views.mean(results, where, "bytes_per_second")
            if way["channel"] == "ideal" and error is not None and (size or 0.0) <= limit:
                found.append((error, size or 0.0, where))
    return min(found, key=lambda one: one[0]) if found else None


def _findings(results: Results) -> Sequence[str]:
    from coopoc.study.style import look

    said = []
    for limit in (0.0, 300.0, 1000.0, 5000.0):
        best = best_under(results, limit)
        if best is not None:
            error, size, where = best
            how = f"{look(where['method']).label} ({where['knowledge']})"
            at = f", K = {where['max_neighbours']}, {size:.0f} B/s" if where["max_neighbours"] else ""
            words = f"At most {limit:g} B/s" if limit else "Without a byte while driving"
            said.append(f"{words}: best is {how}{at}, {error:.3f} m.")
    return said


STUDY = Study(
    name="budget",
    question="What does accuracy cost in bytes, in a training once or in every second of a drive?",
    cell=cell,
    key=lineup.key,
    prepare=weights.prepare,
    grid=_grid(),
    settings={
        "data": "town10", "clients": "town10-clients", "weights": "runs/weights", "scenario": 2, "velocity_ratio": 0.15,
        "velocity_reading": "axis", "radius_m": 30.0, "egos": "auto", "runs": 30, "seed": 0, "train_seeds": 3,
    },
    shares=("channel", "max_neighbours", *FREE),
    tables={"channels": _channels, "break_even": _even},
    figures={"pareto": _pareto},
    findings=_findings,
    recipe=weights.described,
    limitations=(
        "A vehicle receives what its K neighbours send; what the others send fills the channel, too.",
        "Under a cap the nearest neighbours are heard first.",
        "Numbers count as float32; CAMs quantise positions and velocities instead.",
    ),
    minutes=10,
    metrics={"rt_le_m": "lower"},
    reference=views.reference("budget"),
)  # fmt: skip
