"""Tables, figure and findings of the study `heading_error`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import mean, present, rms, sentence
from coopoc.study.tables import across, crossed
from coopoc.study.style import look

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

NONE, ALWAYS, FIRST = "none", "nominal", "first compass"
"""No compass; its whole error taken as white noise of each heading; only its first heading taken."""
COMPASSES, NEIGHBOURS = ("exact", "1", "3", "10", NONE), (0, 2, 10)
SPEEDS, AFTER, SPEED = (0.0, 1.0, 3.0, 10.0, 20.0), (1.0, 3.0, 10.0, 30.0), 10.0
TITLES = {word: "no compass" if word == NONE else f"{word}°".replace("exact°", "exact") for word in COMPASSES}
LINES = (("pose", ALWAYS), ("pose", FIRST), ("joint", ALWAYS), ("bound", "bound"))
NOTE = (
    "Eleven vehicles in two lanes, fixes of {gnss_std_m:g} m, range 1 m, angles 4°, speed 10 %, yaw rate "
    "{yaw_rate_std:g} rad/s, {runs} runs. A compass has a bias for each vehicle and run, and 1° of white noise."
)


def _note(results: Results, text: str) -> str:
    return f"{text} {NOTE.format(**results.settings)}"


def at(method: str, known: str, k: int, compass: str, speed: float = SPEED, after: float = AFTER[-1]) -> dict[str, Any]:
    """A selection; "pose" is the pose filter of one state, or of a vehicle alone at K = 0."""
    name = f"pose-{'fleet' if k else 'solo'}" if method == "pose" else method
    where = {"speed": speed, "after_s": after, "compass": compass}
    errs = compass not in (NONE, "exact")
    return {
        **where,
        "max_neighbours": k,
        "method": name,
        "noise_model": ALWAYS if known == FIRST and not errs else known,
    }


def compasses(results: Results, value: str, text: str, decimals: int) -> Table | None:
    """Methods and K down, compasses across."""

    def number(results: Results, where: Mapping[str, Any]) -> float | None:
        return (mean if value == "nees" else rms)(results, at(**where), value)

    labels = {"pose": "Pose filter", "joint": "Position filter", "bound": look("bound").label}
    rows = [
        ((k, labels[method], "" if method == "bound" else known), {"method": method, "known": known, "k": k})
        for k in NEIGHBOURS
        for method, known in LINES
    ]
    columns = across(number, {TITLES[word]: {"compass": word} for word in COMPASSES})
    text = _note(results, f"{text} after {AFTER[-1]:g} s at {SPEED:g} m/s, by the compass.")
    return crossed(results, ("K", "Method", "Noise model"), rows, columns, text, decimals=decimals)


def found(results: Results) -> Table | None:
    """Heading errors without a compass, speeds and K down, times across, the bound beside each."""

    def number(results: Results, where: Mapping[str, Any]) -> float | None:
        return rms(results, at(**where, compass=NONE), "heading_deg")

    rows = [((f"{speed:g}", k), {"speed": speed, "k": k}) for speed in SPEEDS for k in NEIGHBOURS]
    columns = across(
        number,
        {
            f"{after:g} s{' (bound)' * (method == 'bound')}": {"after": after, "method": method, "known": known}
            for after in AFTER
            for method, known in (LINES[0], LINES[-1])
        },
    )
    text = _note(results, "Rms heading error [°] without a compass, after a time.")
    return crossed(results, ("Speed [m/s]", "K"), rows, columns, text, best=None, decimals=1)


def figure(results: Results) -> Plot | None:
    """Left two: heading error over time without a compass, K = 0 and 10. Right: RT-LE over the compass's error."""
    from matplotlib import colormaps

    from coopoc.study.lines import Line, draw
    from coopoc.study.plot import Plot, canvas, legend, plain_log

    if present(results, {"compass": NONE}, "heading_deg") is None:
        return None
    places = dict(enumerate(COMPASSES))
    with canvas(1, 3, width=9.0, height=3.0) as (figure, (alone, together, cost)):
        for axis, k in ((alone, NEIGHBOURS[0]), (together, NEIGHBOURS[-1])):
            for i, speed in enumerate(SPEEDS):
                color = colormaps["viridis"](i / len(SPEEDS))
                for (method, known), style in ((LINES[0], "-"), (LINES[-1], ":")):
                    each = {x: rms(results, at(method, known, k, NONE, speed, x), "heading_deg") for x in AFTER}
                    ran = {x: y for x, y in each.items() if y is not None}
                    label = f"{speed:g} m/s" if style == "-" else None
                    marker = "o" if style == "-" else ""
                    axis.plot(list(ran), list(ran.values()), style, color=color, marker=marker, label=label)
            axis.set(xscale="log", yscale="log", ylim=(0.15, 200), title=f"No compass, K = {k}", xlabel="Time [s]")
            axis.set_xticks(list(AFTER), [f"{x:g}" for x in AFTER])
            axis.minorticks_off()
            plain_log(axis.yaxis)
        alone.set(ylabel="Heading error [°]")
        together.legend()
        drawn = []
        for k in NEIGHBOURS[::2]:
            for method, known in LINES:
                points = {x: rms(results, at(method, known, k, word)) for x, word in places.items()}
                names = {"method": at(method, known, k, NONE)["method"], "noise_model": known}
                drawn += draw(cost, [Line(names, points)])
        cost.set_xticks(list(places), [TITLES[word].replace("no compass", "none") for word in places.values()])
        cost.set(ylabel="RT-LE [m]", xlabel="Compass", title="K = 0 (above) and 10", yscale="log")
        plain_log(cost.yaxis)
        legend(cost, drawn)
    text = "Dotted on the left: the bound."
    return Plot(figure, _note(results, text))


def findings(results: Results) -> dict[str, str]:
    """Sentences by key."""

    def heading(k: int, compass: str, speed: float = SPEED, after: float = AFTER[-1], line: int = 0) -> float | None:
        return rms(results, at(*LINES[line], k, compass, speed, after), "heading_deg")

    def error(k: int, compass: str, line: int = 0) -> float | None:
        return rms(results, at(*LINES[line], k, compass))

    texts = {}
    for k in NEIGHBOURS:
        texts[f"cost, K = {k}"] = sentence(
            "K = {k}, {speed:g} m/s: {exact:.2f} m with an exact heading, {none:.2f} m with one that is estimated; "
            "with a compass of 10° taken as white noise {noise:.2f} m, by its first heading alone {first:.2f} m, and "
            "by a position filter {joint:.2f} m.",
            k=k,
            speed=SPEED,
            exact=error(k, "exact"),
            none=error(k, NONE),
            noise=error(k, "10"),
            first=error(k, "10", 1),
            joint=error(k, "10", 2),
        )
        texts[f"found, K = {k}"] = sentence(
            "Without a compass, K = {k}: heading error after {long:g} s {still:.1f}° standing, {slow:.1f}° at 1 m/s, "
            "{fast:.1f}° at {speed:g} m/s (bound {bound:.1f}°); after {short:g} s {early:.1f}° at {speed:g} m/s.",
            k=k,
            long=AFTER[-1],
            short=AFTER[1],
            speed=SPEED,
            still=heading(k, NONE, 0.0),
            slow=heading(k, NONE, 1.0),
            fast=heading(k, NONE),
            bound=heading(k, NONE, line=-1),
            early=heading(k, NONE, after=AFTER[1]),
        )
    return texts
