"""Messages that arrive late or not at all, alone or in bursts, and the gain of cooperation that remains."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Where, across, mean, ran
from coopoc.study.style import Panel, look

from . import lineup, scene
from .lineup import PAST
from .views import curves, of, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

METHODS = ("kalman", "lkf-sa", "joint", "split-ci", "mhe", "cooperative-filter")
PERFECT = {"latency_s": 0.0, "loss": 0.0, "burst": 1.0}
LATE = {late: {**PERFECT, "latency_s": late} for late in (0.0, 0.1, 0.3, 0.5, 1.0)}
LOST, IN_RUNS = (
    {100 * loss: {**PERFECT, "loss": loss, "burst": burst if loss else 1.0} for loss in (0.0, 0.1, 0.3, 0.6, 0.9)}
    for burst in (1.0, 10.0)
)
CHANNELS: dict[str, tuple[str, dict[float, dict[str, Any]]]] = {
    "late": ("s", LATE),
    "lost one by one": ("%", LOST),
    "lost in runs of 10": ("%", IN_RUNS),
}
"""What happens to messages -> its unit, and channel by how much of it."""
NOTE = (
    "K = 6. The moving horizon puts a late message at its true time; the others bring it forward with the velocity "
    "that came with it. What is older than 1 s is forgotten."
)


def _grid() -> list[Where]:
    """Latency without loss, and loss without latency; the solo filter once."""
    each = [PERFECT, *(channel for _, by in CHANNELS.values() for value, channel in by.items() if value)]
    return [
        of("kalman", "nominal", **PERFECT, max_neighbours=0),
        of(*PAST, **PERFECT, max_neighbours=6),
        *(of(method, "nominal", **channel, max_neighbours=6) for channel in each for method in METHODS[1:]),
    ]


def at(method: str, **channel: Any) -> dict[str, Any]:
    """A selection; the solo filter ran once."""
    return {"method": method} if method == "kalman" else {"method": method, **channel}


def _rows(results: Results) -> list[tuple[tuple[str, str], Where]]:
    """Channels over which a cooperative method was run."""
    rows = [((how, f"{x:g} {unit}"), way) for how, (unit, by) in CHANNELS.items() for x, way in by.items()]
    return [row for row in rows if any(mean(results, at(method, **row[1])) for method in METHODS[1:])]


def _error(results: Results, where: Where) -> float | None:
    return mean(results, at(**where))


def _findings(results: Results) -> dict[str, str]:
    texts = {}
    for how, (unit, by) in CHANNELS.items():
        most, worst = list(by.items())[-1]
        each = ran({method: mean(results, at(method, **worst)) for method in METHODS})
        perfect, alone, left = mean(results, at("joint", **PERFECT)), each.get("kalman"), each.get("joint")
        if alone is not None and perfect is not None and left is not None:
            kept = (alone - left) / (alone - perfect)
            rest = f"keeps {100 * kept:.0f} % of what six neighbours bring" if kept > 0 else "is worse than alone"
            best = min(each, key=lambda method: round(each[method], 4))
            other = "" if best == "joint" else f"; best is {look(best).label}, {each[best]:.2f} m"
            texts[how] = (
                f"{most:g} {unit} {how}: the joint filter {rest} ({left:.2f} m; alone {alone:.2f}, perfect "
                f"{perfect:.2f} m){other}."
            )
    return texts


STUDY = lineup.study(
    "latency_loss",
    "How much of the benefit of cooperation remains when messages are late or lost?",
    grid=_grid(),
    settings={**scene.TOWN, "runs": 20, "train_seeds": 0},
    shares=tuple(PERFECT),
    tables={
        "rt_le": selections(
            ("Messages are", "How much"),
            _rows,
            across(_error, {look(method).label: {"method": method} for method in METHODS}),
            "RT-LE [m].",
            NOTE,
            decimals=3,
        )
    },
    figures={
        "rt_le": curves(
            [
                Panel(by, title=how, xlabel="Latency [s]" if unit == "s" else "Lost [%]")
                for how, (unit, by) in CHANNELS.items()
            ],
            [{"method": method} for method in METHODS[1:]],
            "RT-LE against latency and loss; dashed: the bound of a perfect channel with what newcomers did before.",
            NOTE,
            levels=[{"method": "kalman"}, {"method": "bound"}],
        )
    },
    findings=_findings,
    limitations=("Latency is the same for all messages of a cell, in whole steps of the drive.",),
    metrics={"rt_le_m": "lower"},
)
