"""Accuracy against bytes, sent once for a training or in every second of a drive."""

from functools import partial
from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Results, Where, across, difference, interval, mean, present
from coopoc.study.style import look
from coopoc.world.channels import CHANNELS

from . import lineup, scene
from .lineup import PAST
from .views import Plot, of, selections

if TYPE_CHECKING:
    import pandas as pd

TRAINED = ("fedokf", "fedkalmannet")
"""Trained by federation, in the order of their bytes."""
SOLO = (("gnss", "none"), ("kalman", "fitted"), ("kalman", "nominal"), *((name, "trained") for name in TRAINED))
SHARED = (
    ("lkf-sa", "identity"),
    ("lkf-sa", "fitted"),
    ("joint", "fitted"),
    ("joint", "nominal"),
    ("split-ci", "nominal"),
    ("cooperative-filter", "nominal"),
)
SCHEDULED = SHARED[3:]
"""Which of them run under every schedule."""
NEIGHBOURS = (1, 2, 4, 10)
MOST_NEIGHBOURS = NEIGHBOURS[-1]
RATES = (1.0, 2.0, 5.0)
CAPS = (100.0, 200.0, 400.0, 800.0)
SCHEDULES = ("nearest", "round robin")
IDEAL_CHANNEL = {"rate_hz": None, "cap_bytes_per_second": None, "schedule": SCHEDULES[0]}
AXES = ("channel", "max_neighbours", *IDEAL_CHANNEL)
"""Parameters of a channel."""
CHANNEL_LABELS = {"ideal": "ideal, 10 Hz", "cam": "CAM, 2.2 Hz", "bsm": "BSM, 10 Hz", "cpm": "CPM, 5 Hz"}
PAYLOAD = "payload_bytes_per_second"
BYTE_LIMITS = (0.0, 300.0, 1000.0, 5000.0)
"""B/s, under which the best method is named."""


def over(channel: str, k: int, **limits: Any) -> Where:
    """A channel as parameters or as a selection; its own rate, no cap and the nearest first, but for the limits."""
    return {"channel": channel, "max_neighbours": k, **IDEAL_CHANNEL, **limits}


def under(cap: float, schedule: str, method: str, noise_model: str) -> Where:
    """The selection of a method under a cap and a schedule."""
    return of(method, noise_model, **over("ideal", MOST_NEIGHBOURS, cap_bytes_per_second=cap, schedule=schedule))


def _grid() -> list[Where]:
    """Solo methods once; the others at each K over every channel, and over the ideal one under rates and caps; some
    of them under caps with the other schedule."""
    channels = [over(name, k) for name in CHANNELS for k in NEIGHBOURS]
    rates = [over("ideal", MOST_NEIGHBOURS, rate_hz=rate) for rate in RATES]
    caps = [over("ideal", MOST_NEIGHBOURS, cap_bytes_per_second=cap) for cap in CAPS]
    return [
        *(of(*pair, **over("ideal", 0)) for pair in (*SOLO, PAST)),
        *(of(*pair, **each) for each in (*channels, *rates, *caps) for pair in SHARED),
        *(under(cap, SCHEDULES[1], *pair) for cap in CAPS for pair in SCHEDULED),
        *(of(*PAST, **over("ideal", k)) for k in NEIGHBOURS),
    ]


def _figure(results: Results) -> "Plot | None":
    from coopoc.study import figures

    where = present(results, {"channel": "ideal"})
    if where is None:
        return None
    text = (
        "RT-LE against the payload that an ego receives over a channel that loses nothing, at each K, rate, cap and "
        "schedule; lines: the best for the bytes. Horizontal: methods that receive nothing, and the bound of most "
        "neighbours at every step with what newcomers did before: no message brings more, whatever its bytes."
    )
    return figures.pareto(results, scene.caption(results, text), PAYLOAD, where=where)


def choices(results: Results) -> "pd.DataFrame":
    """Mean RT-LE m and payload B/s of all methods that were run over an ideal channel.

    >>> import pandas as pd
    >>> from coopoc.study.results import Results
    >>> len(choices(Results("budget", "?", (), {}, pd.DataFrame({"method": ["okf"]}), pd.DataFrame(), 0, {})))
    0
    """
    rows, names = results.frame, [*AXES, "method", "noise_model"]
    if not {*names, PAYLOAD} <= set(rows):
        return rows.iloc[:0]
    ideal = rows[(rows["channel"] == "ideal") & (rows["method"] != "bound")].fillna({PAYLOAD: 0.0})
    return ideal.groupby(names, sort=False, dropna=False)[["rt_le_m", PAYLOAD]].mean().reset_index()


def _findings(results: Results) -> list[str]:
    texts, each = [], choices(results)
    for limit in BYTE_LIMITS if len(each) else ():
        if len(within := each[each[PAYLOAD] <= limit]):
            best = within.sort_values("rt_le_m", kind="stable").iloc[0]
            at = f", K = {best['max_neighbours']}, {best['schedule']}, {best[PAYLOAD]:.0f} B/s" if best[PAYLOAD] else ""
            words = f"At most {limit:g} B/s" if limit else "Without a byte while driving"
            texts.append(
                f"{words}: best is {look(best['method']).label} ({best['noise_model']}){at}, {best['rt_le_m']:.3f} m."
            )
    return texts


def _rate(results: Results, where: Where, value: str = PAYLOAD) -> int | None:
    rate = mean(results, where, value)
    return None if rate is None else round(rate)


METHOD_ROWS = [
    ((CHANNEL_LABELS[name], look(pair[0]).label, pair[1]), of(*pair, **over(name, MOST_NEIGHBOURS)))
    for name in CHANNELS
    for pair in SHARED
]
"""Each method over each channel: labels and selection."""
BY_SCHEDULE = {name: {"schedule": name} for name in SCHEDULES}
STUDY = lineup.study(
    "budget",
    "What does accuracy cost in bytes: once for training, or in every second of a drive?",
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "runs": 30, "train_seeds": 3},
    shares=AXES,
    tables={
        "channels": selections(
            ("Channel", "Method", "Noise model"),
            METHOD_ROWS,
            {"RT-LE [m]": mean, "Payload [B/s]": _rate, "On air [B/s]": partial(_rate, value="bytes_per_second")},
            f"K = {MOST_NEIGHBOURS} over field channels (CAM, BSM, CPM): rate, latency, bursts of loss, and what a "
            "message carries anyway. Payload is what a method adds.",
            decimals=3,
        ),
        "schedules": selections(
            ("Cap [B/s]", "Method"),
            [((int(cap), look(pair[0]).label), under(cap, SCHEDULES[0], *pair)) for cap in CAPS for pair in SCHEDULED],
            {
                **across(interval, BY_SCHEDULE),
                "Difference": across(
                    lambda rows, where: difference(rows, where, {**where, "schedule": SCHEDULES[0]}), BY_SCHEDULE
                )[SCHEDULES[1]],
            },
            "RT-LE [m] when an ego receives no more than the cap, by schedule; differences are paired, with 95 % "
            f"intervals. K = {MOST_NEIGHBOURS} at 10 Hz.",
            best="min",
            decimals=3,
        ),
    },
    figures={"pareto": _figure},
    findings=_findings,
    limitations=(
        "Only messages of the K neighbours are counted; those of other vehicles also occupy the channel.",
        "Under a cap the nearest neighbours' messages pass first unless another schedule is named.",
        "Numbers count as float32; a CAM rounds positions to 6 mm and speeds to 5 mm/s instead.",
    ),
    metrics={"rt_le_m": "lower"},
)
