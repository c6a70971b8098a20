"""Studies of conditions: late and lost messages, GNSS errors that last, wrong measurements and attacks."""

from collections.abc import Mapping, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

from coopoc import Study
from coopoc.study.numbers import Number, Results, Where, across, listed, mean, ran, rms
from coopoc.study.style import Panel, look

from . import lineup, scene
from .lineup import BOUND, PAST
from .views import curves, of, selections

KALMAN, NET = ("kalman", "nominal"), ("fedkalmannet", "trained")
COOPERATIVE, JOINT, SPLIT, LKF = ((m, "nominal") for m in ("cooperative-filter", "joint", "split-ci", "lkf-sa"))
STAR = ("bound", "star")
"""The bound of filters whose newcomers have no past; PAST is that of messages which bring it along."""


def labelled(*pairs: tuple[str, str]) -> dict[str, Where]:
    """Label -> selection of each method under its noise model; a bound has the name of its information set."""
    return {look(m).label + (f", {k}" if m == "bound" and k != "bound" else ""): of(m, k) for m, k in pairs}


def study(
    name: str,
    question: str,
    cases: Mapping[str, Where],
    pairs: Sequence[tuple[str, str]],
    note: str,
    named: Sequence[str],
    number: Number = mean,
    **options: Any,
) -> Study:
    """A study with conditions down and methods across.

    Args:
        name: of the study.
        question: that it answers.
        cases: title -> condition, as parameters of a cell.
        pairs: methods and noise models.
        note: end of the captions.
        named: titles of the cases that findings name.
        number: of a selection.
        options: other fields of Study.
    """
    methods, rows = labelled(*pairs), [((title,), case) for title, case in cases.items()]

    def findings(results: Results) -> list[str]:
        texts = []
        for title in named:
            each = ran({label: number(results, {**cases[title], **line}) for label, line in methods.items()})
            if each:
                texts.append(f"{title}: {listed(dict(sorted(each.items(), key=itemgetter(1))))}.")
        return texts

    text = f"RT-LE [m]{', rms over runs' * (number is rms)}."
    nees = across(partial(mean, value="nees"), methods)
    usual = {
        "grid": [of(*pair, **case) for case in cases.values() for pair in pairs],
        "shares": tuple(next(iter(cases.values()))),
        "tables": {
            "rt_le": selections(("Condition",), rows, across(number, methods), text, note, decimals=3),
            "nees": selections(("Condition",), rows, nees, "NEES (3 is consistent).", note, decimals=1),
        },
        "findings": findings,
        "metrics": {"rt_le_m": "lower", "nees": 3.0},
    }
    return lineup.study(name, question, **{**usual, **options})


PERFECT = {"latency_s": 0.0, "loss": 0.0, "burst": 1.0}
ONE_BY_ONE, IN_RUNS = (
    {100 * loss: {**PERFECT, "loss": loss, "burst": burst} for loss in (0.1, 0.3, 0.6, 0.9)} for burst in (1.0, 10.0)
)
MESSAGES = {
    "late": ("s", {late: {**PERFECT, "latency_s": late} for late in (0.1, 0.3, 0.5, 1.0)}),
    "lost one by one": ("%", ONE_BY_ONE),
    "lost in runs of 10": ("%", IN_RUNS),
}
"""What happens to messages -> its unit, and channel by how much of it."""
CHANNELS = {
    "in time": PERFECT,
    **{f"{how}, {x:g} {unit}": at for how, (unit, by) in MESSAGES.items() for x, at in by.items()},
}
SENT = (LKF, JOINT, SPLIT, COOPERATIVE)
LATENCY_LOSS = study(
    "latency_loss",
    "How much of the benefit of cooperation remains when messages are late or lost?",
    CHANNELS,
    (KALMAN, *SENT, PAST),
    "K = 6. Late messages are brought forward with the velocity that came with them. What is older than 1 s is "
    "forgotten.",
    ("late, 1 s", "lost one by one, 90 %", "lost in runs of 10, 90 %"),
    grid=[
        of(*KALMAN, **PERFECT, max_neighbours=0),
        of(*PAST, **PERFECT, max_neighbours=6),
        *(of(*pair, **case, max_neighbours=6) for case in CHANNELS.values() for pair in SENT),
    ],
    settings={**scene.TOWN, "runs": 20, "train_seeds": 0},
    figures={
        "rt_le": curves(
            [
                Panel({0.0: PERFECT, **by}, title=how, xlabel="Latency [s]" if unit == "s" else "Lost [%]")
                for how, (unit, by) in MESSAGES.items()
            ],
            [of(*pair) for pair in SENT],
            "RT-LE against latency and loss, K = 6; dashed: the bound of a perfect channel with what newcomers did "
            "before.",
            levels=[{"method": "kalman"}, {"method": "bound"}],
        )
    },
    limitations=("Latency is the same for all messages of a cell, in whole steps of the drive.",),
    metrics={"rt_le_m": "lower"},
)

ERRORS = {
    name: dict(zip(scene.LASTING_SHARES, shares, strict=True))
    for name, shares in {
        "white": (0.0, 0.0),
        "half own": (0.5, 0.0),
        "own": (0.9, 0.0),
        "own and common": (0.45, 0.45),
        "common": (0.0, 0.9),
    }.items()
}
"""Name -> shares of a fix's variance that are time-correlated: of each receiver, and common to all vehicles."""
SOLO, SHARED = (("gnss", "none"), KALMAN, NET), (JOINT, SPLIT, COOPERATIVE, STAR, PAST)
KS = {k: {"max_neighbours": k} for k in (0, 2, 6, 10)}
LASTING_CASES = {f"{name}, K = {k}": {**shares, **at} for name, shares in ERRORS.items() for k, at in KS.items()}
CORRELATED_GNSS = study(
    "correlated_gnss",
    "What is cooperation worth when GNSS errors are time-correlated, so that no solo filter averages them out?",
    LASTING_CASES,
    (*SOLO, *SHARED),
    "Lasting errors are 50 % or 90 % of a fix's variance, {drift_time_s:g} s correlated. All but the cooperative "
    "filter take them as white noise of the same variance. The bounds know how they last: of a star of newcomers "
    "without a past, and of messages which bring it along, as the cooperative filter's do.",
    [title for title in LASTING_CASES if title.endswith("= 10")],
    rms,
    grid=[
        of(*pair, **case)
        for case in LASTING_CASES.values()
        for pair in (SHARED if case["max_neighbours"] else (*SOLO, COOPERATIVE, STAR))
    ],
    settings={**scene.TOWN, **scene.WEIGHTS, "drift_time_s": 60.0, "runs": 30, "train_seeds": 1},
    figures={
        "rms": curves(
            [Panel(KS, case, name, "Neighbours K") for name, case in ERRORS.items()],
            [of(*pair) for pair in SHARED],
            "rms over runs of RT-LE against the number of neighbours; {runs} draws of an error that all vehicles share "
            "scatter about the bound, also below it.",
            number=rms,
            levels=[of(*pair) for pair in SOLO[1:]],
            ylabel="rms RT-LE [m]",
        )
    },
    limitations=(
        "A Gauss-Markov error with one correlation time stands for multipath and atmosphere; real ones depend on the "
        "place and on the satellites in view.",
        "The cooperative filter and the bound treat a returning neighbour as new, although its error was partly known.",
        "Learned gains were trained with white noise.",
    ),
)


def wrong(outliers: str = "", share: float = 0.0, start: float = 0.0, collude: bool = False) -> Where:
    """Outliers and an attack as parameters of a cell."""
    return {"outliers": outliers, "spoofed_share": share, "spoofed_from_s": start, "spoofed_collude": collude}


WRONG = {
    "nothing wrong": wrong(),
    "5 % long ranges": wrong("ranges=0.05"),
    "the same, for 2 s": wrong("ranges=0.05:2"),
    "5 % wild fixes": wrong("fixes=0.05:0"),
    "5 % slip": wrong("odometry=0.05"),
    "20 % spoofed": wrong(share=0.2),
    "they collude": wrong(share=0.2, collude=True),
    "from 30 s on": wrong(share=0.2, start=30.0),
}


ROBUSTNESS = study(
    "robustness",
    "What do wrong measurements and attacks do to filters and to trained gains, alone and with neighbours?",
    WRONG,
    (KALMAN, NET, LKF, JOINT, SPLIT, COOPERATIVE, BOUND),
    "Long ranges: 3 to 20 m, each by itself or for 2 s of a pair; wild fixes: 10 to 50 m off, of every vehicle; slip: "
    "speeds wrong by 20 to 100 % of themselves, for 0.5 s; spoofed: fixes 5 to 40 m off on each axis, of vehicles "
    "that are no egos. Methods assume none of it; the bound is that of an estimator without the wrong measurements.",
    list(WRONG),
    settings={**scene.TOWN, **scene.WEIGHTS, "max_neighbours": 6, "runs": 10, "train_seeds": 1},
    limitations=(
        "One kind is wrong at a time; CL-Bench's `storm` has several at once.",
        "Velocities and relative measurements of spoofed vehicles stay true.",
    ),
)
