"""Cost of wrong measurements and of attacks for filters with and without neighbours, trained and not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coopoc.study.numbers import Where, across, mean, ratio, seed_means, sentence

from . import lineup, scene
from .lineup import BOUND
from .views import HEAD, labelled, multiples, of, selections

if TYPE_CHECKING:
    from coopoc.study.results import Results

ALONE = (("kalman", "nominal"), ("fedkalmannet", "trained"))
TOGETHER = (
    ("joint", "nominal"),
    ("lkf-sa", "nominal"),
    ("split-ci", "nominal"),
    ("cooperative-filter", "nominal"),
)
METHODS = (*ALONE, *TOGETHER)


def case(outliers: str = "", share: float = 0.0, start: float = 0.0, collude: bool = False) -> dict[str, Any]:
    """A condition as parameters of a cell."""
    return {"outliers": outliers, "spoofed_share": share, "spoofed_from_s": start, "spoofed_collude": collude}


CLEAN, SPOOFED = "nothing wrong", "20 % spoofed"
CASES = {
    CLEAN: case(),
    "5 % long ranges": case("ranges=0.05"),
    "the same, for 2 s": case("ranges=0.05:2"),
    "5 % wild fixes": case("fixes=0.05:0"),
    "5 % slip": case("odometry=0.05"),
    SPOOFED: case(share=0.2),
    "they collude": case(share=0.2, collude=True),
    "from 30 s on": case(share=0.2, start=30.0),
}
"""Title -> condition."""
SHOWN = ("5 % long ranges", "5 % wild fixes", "5 % slip", SPOOFED)
"""Conditions of the figure."""
NOTE = (
    "Long ranges: 3 to 20 m, each by itself or for 2 s of a pair; wild fixes: 10 to 50 m off, of every vehicle; slip: "
    "speeds wrong by 20 to 100 % of themselves, for 0.5 s; spoofed: fixes 5 to 40 m off on each axis, of vehicles "
    "that are no egos. Methods assume none of it; the bound is that of an estimator which is told what is wrong."
)


def _against_clean(results: Results, where: Where) -> list[float]:
    """RT-LE over that of the same method where nothing is wrong, one per training seed."""
    clean = seed_means(results, {**where, **CASES[CLEAN]})
    return [now / before for now, before in zip(seed_means(results, where), clean, strict=False)]


FINDING = (
    "{what}: the joint filter has {joint:.2f} times its error where nothing is wrong, FedKalmanNet {net:.2f} times, "
    "the Kalman filter {solo:.2f} times."
)


def _findings(results: Results) -> dict[str, str]:
    def times(method: str, known: str, at: Where) -> float | None:
        return ratio(*(mean(results, of(method, known, **of_case)) for of_case in (at, CASES[CLEAN])))

    return {
        title: sentence(
            FINDING,
            what=title[0].upper() + title[1:],
            joint=times("joint", "nominal", at),
            net=times("fedkalmannet", "trained", at),
            solo=times("kalman", "nominal", at),
        )
        for title, at in CASES.items()
        if title != CLEAN
    }


STUDY = lineup.study(
    "robustness",
    "What do wrong measurements and attacks do to filters and to trained gains, alone and with neighbours?",
    grid=[of(*method, **at) for at in CASES.values() for method in (*METHODS, BOUND)],
    settings={
        **scene.TOWN,
        **scene.WEIGHTS,
        "max_neighbours": 6,
        "runs": 10,
        "train_seeds": 1,
    },
    shares=tuple(case()),
    tables={
        "rt_le": selections(HEAD, labelled((*METHODS, BOUND)), across(mean, CASES), "RT-LE [m].", NOTE, decimals=2)
    },
    figures={
        "rt_le": multiples(
            METHODS,
            {title: CASES[title] for title in SHOWN},
            _against_clean,
            "RT-LE as a multiple of the same method's where nothing is wrong.",
            NOTE,
        )
    },
    findings=_findings,
    limitations=(
        "One kind is wrong at a time; CL-Bench's `storm` has several at once.",
        "Velocities and relative measurements of spoofed vehicles stay true.",
    ),
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
