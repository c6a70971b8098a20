"""What a heading costs: exact, from a compass that errs, or estimated from odometry, bearings and fixes alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.evaluate.bounds import pose_bound
from coopoc.evaluate.metrics import errors, heading_error, pose_nees
from coopoc.methods.joint_filter import JointFilter
from coopoc.methods.poses.pose_filter import PoseFilter
from coopoc.methods.poses.pose_start import pose_start
from coopoc.methods.track import Track
from coopoc.study.numbers import Number, Where, across, mean, rms, sentence
from coopoc.study.provenance import revision
from coopoc.study.study import Params, Row, Study
from coopoc.study.style import Panel, look
from coopoc.study.tables import Table, crossed
from coopoc.world.body_frames import in_world, turned
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from .lineup import reference
from .scene import CODE
from .views import of

if TYPE_CHECKING:
    from coopoc.study.plot import Plot
    from coopoc.study.results import Results

NONE, ALWAYS, FIRST = "none", "nominal", "first compass"
"""No compass; its whole error taken as white noise of each heading; only its first heading taken."""
COMPASSES, NEIGHBOURS = ("exact", "1", "3", "10", NONE), (0, 2, 10)
SPEEDS, AFTER, SPEED = (0.0, 1.0, 3.0, 10.0, 20.0), (1.0, 3.0, 10.0, 30.0), 10.0
TITLES = {word: "no compass" if word == NONE else f"{word}°".replace("exact°", "exact") for word in COMPASSES}
VEHICLES, WIDTH, AHEAD, BEND, COURSE, DT = 11, 4.0, 10.0, 25.0, 2.0, 0.1
"""Of the convoy: vehicles, m between its two lanes and from row to row, m of a bend, rad of its road, s of a step."""
WHITE, EXACT = np.deg2rad(1.0), np.deg2rad(0.01)
"""rad, white noise of a compass beside its bias, and all the error of one that is exact."""


def convoy(speed: float, seconds: float) -> Fleet:
    """Vehicles in two lanes that wind along at a speed m/s, each heading along its way, also if it stands."""
    t = np.arange(round(seconds / DT) + 1) * DT
    row, lane = np.divmod(np.arange(VEHICLES), 2)
    way = speed * t[:, None] + AHEAD * row
    heading = COURSE + 0.5 * np.sin(way / BEND)
    middle = np.concatenate([heading[:1], (heading[1:] + heading[:-1]) / 2])
    velocity = speed * np.stack([np.cos(middle), np.sin(middle), 0 * middle], axis=2)
    start = turned(np.stack([AHEAD * row, WIDTH * lane, 0.0 * row], axis=1), np.asarray(COURSE))
    steps = np.concatenate([np.zeros((1, VEHICLES, 3)), DT * velocity[1:]])
    position = start + np.cumsum(steps, axis=0)
    return Fleet(tuple(f"v{k}" for k in range(VEHICLES)), t, position, velocity, name="convoy", heading=heading)


def sensors(p: Params) -> Sensors:
    """The paper's noise with the compass of the cell: a bias of its degrees for each vehicle and run, and 1 degree."""
    fix, word = float(p["gnss_std_m"]), str(p["compass"])
    noise = replace(Sensors.paper_training(), gnss_std=(fix, fix, fix), yaw_rate_std=float(p["yaw_rate_std"]))
    if word == NONE:
        return replace(noise, compass=False)
    if word == "exact":
        return replace(noise, heading_std=EXACT)
    return replace(noise, heading_std=WHITE, heading_bias_std=np.deg2rad(float(word)))


def channel(p: Params) -> V2X:
    """The K nearest of the convoy."""
    return V2X(max_neighbours=int(p["max_neighbours"]), radius=float(p["radius_m"]))


@lru_cache(maxsize=1)
def measured(noise: Sensors, v2x: V2X, speed: float, seconds: float, runs: int, seed: int) -> tuple[Recording, Floats]:
    """What all measure, and first headings where there is no compass; first positions are the first fixes."""
    recording = observe(convoy(speed, seconds), noise, v2x, runs=runs, seed=seed, frame="body")
    begin = np.full((runs, VEHICLES, 4), np.nan)
    if not noise.compass:
        begin[..., 3] = pose_start(recording, seconds=seconds)[..., 3]
    return recording, begin


def cell(p: Params) -> list[Row]:
    """Rms errors of all vehicles at the end of the drive: a row per run; of the bound one row."""
    fleet, noise, v2x = convoy(float(p["speed"]), float(p["after_s"])), sensors(p), channel(p)
    last = slice(-round(float(p["score_s"]) / DT), None)
    if p["method"] == "bound":
        cov = pose_bound(fleet, noise, v2x)[last]
        square = np.trace(cov[..., :3, :3], axis1=-2, axis2=-1)
        return [{"run": 0, "ego": "all", "rt_le_m": _root(square), "heading_deg": np.rad2deg(_root(cov[..., 3, 3]))}]
    runs = int(p["runs"])
    recording, begin = measured(noise, v2x, float(p["speed"]), float(p["after_s"]), runs, int(p["seed"]))
    track = tracked(p, recording, begin)
    position, rows = errors(track, fleet)[:, last], []
    for run in range(runs):
        row: Row = {"run": run, "ego": "all", "rt_le_m": _root(position[run] ** 2)}
        if track.heading is not None:
            row["heading_deg"] = np.rad2deg(_root(heading_error(track, fleet)[run, last] ** 2))
            row["nees"] = float(pose_nees(track, fleet)[run, last].mean())
        rows.append(row)
    return rows


def tracked(p: Params, recording: Recording, begin: Floats) -> Track:
    """The track of all vehicles by the cell's method."""
    everyone = range(VEHICLES)
    if p["method"] == "joint":
        return JointFilter()(in_world(recording), everyone)
    if p["noise_model"] == FIRST:
        assert recording.body is not None
        heading = recording.body.heading.copy()
        heading[:, 1:] = np.nan
        recording = replace(recording, body=replace(recording.body, heading=heading))
    unit: Any = "fleet" if p["method"] == "pose-fleet" else "solo"
    spread = (*recording.sensors.fix_std, 0.15)
    return PoseFilter(unit, begin=begin, spread=spread)(recording, everyone)


def _root(squares: Floats) -> float:
    return float(np.sqrt(np.mean(squares)))


def key(p: Params) -> Mapping[str, str]:
    """Digest of the code.

    Raises:
        InputError: parameters of which no cell can be made.
    """
    sensors(p), channel(p)
    if not DT <= float(p["score_s"]) <= min(AFTER):
        raise InputError("score_s", p["score_s"], f"must be {DT:g}..{min(AFTER):g} s", "0.5 is the default.")
    return {"code": revision(*CODE)}


def pose(k: int) -> str:
    """The pose filter of one state, or of a vehicle alone."""
    return "pose-fleet" if k else "pose-solo"


def _grid() -> list[Row]:
    """All compasses at one speed after a long drive; without a compass all speeds after all times."""
    cases = [{**DRIVEN, "compass": word} for word in COMPASSES if word != NONE]
    cases += [{"speed": speed, "after_s": after, "compass": NONE} for speed in SPEEDS for after in AFTER]
    rows = []
    for case in cases:
        for k in NEIGHBOURS:
            lines = [(pose(k), ALWAYS), ("bound", "bound")]
            lines += [(pose(k), FIRST)] if case["compass"] not in (NONE, "exact") else []
            lines += [("joint", ALWAYS)] if case["compass"] != NONE else []
            rows += [of(*line, **case, max_neighbours=k) for line in lines]
    return rows


NOTE = (
    "Eleven vehicles in two lanes, fixes of {gnss_std_m:g} m, range 1 m, angles 4°, speed 10 %, yaw rate "
    "{yaw_rate_std:g} rad/s, {runs} runs. A compass has a bias for each vehicle and run, and 1° of white noise."
)
DRIVEN = {"speed": SPEED, "after_s": AFTER[-1]}
heading = partial(rms, value="heading_deg")


def _note(results: Results, text: str) -> str:
    return f"{text} {NOTE.format(**results.settings)}"


def _compasses(results: Results, number: Number, text: str, decimals: int) -> Table | None:
    """Methods and K down, compasses across."""
    rows = []
    for k in NEIGHBOURS:
        for method, model in ((pose(k), ALWAYS), (pose(k), FIRST), ("joint", ALWAYS), ("bound", "bound")):
            label = "Position filter" if method == "joint" else look(method).label
            labels = (k, label, "" if method == "bound" else model)
            rows.append((labels, of(method, model, **DRIVEN, max_neighbours=k)))
    columns = across(number, {TITLES[word]: {"compass": word} for word in COMPASSES})
    text = _note(results, f"{text} after {AFTER[-1]:g} s at {SPEED:g} m/s, by the compass.")
    return crossed(results, ("K", "Method", "Noise model"), rows, columns, text, decimals=decimals)


def _over_time(results: Results) -> Plot | None:
    """Heading error over time without a compass, K = 0 and 10, a line per speed; dotted the bound."""
    from matplotlib import colormaps

    from coopoc.study import figures

    lines: list[Where] = []
    for i, speed in enumerate(SPEEDS):
        look = {"color": colormaps["viridis"](i / len(SPEEDS)), "speed": speed}
        lines += [of(pose(k), ALWAYS, **look, label=f"{speed:g} m/s" * bool(k)) for k in (0, 10)]
        lines += [of("bound", "bound", **look, linestyle=":", marker="")]
    x = {after: {"after_s": after} for after in AFTER}
    panels = [Panel(x, {"compass": NONE, "max_neighbours": k}, f"K = {k}", "Time [s]") for k in (0, 10)]
    caption = _note(results, "Heading error over the time that is driven without a compass; dotted: the bound.")
    options: dict[str, Any] = {"number": heading, "ylabel": "Heading error [°]", "log": True, "logx": True}
    return figures.curves(results, panels, lines, caption, width=7.4, **options)


COST = (
    "K = {k}, {speed:g} m/s: {exact:.2f} m with an exact heading, {none:.2f} m with one that is estimated; with a "
    "compass of 10° taken as white noise {noise:.2f} m, by its first heading alone {first:.2f} m, and by a position "
    "filter {joint:.2f} m."
)
ESTIMATED = (
    "Without a compass, K = {k}: heading error after {long:g} s {still:.1f}° standing, {slow:.1f}° at 1 m/s, "
    "{fast:.1f}° at {speed:g} m/s (bound {bound:.1f}°); after {short:g} s {early:.1f}° at {speed:g} m/s."
)


def _findings(results: Results) -> dict[str, str]:
    texts = {}
    for k in NEIGHBOURS:
        fixed: Where = {"k": k, "speed": SPEED, "long": AFTER[-1], "short": AFTER[1]}
        at = of(pose(k), ALWAYS, **DRIVEN, max_neighbours=k)
        ten = {**at, "compass": "10"}
        texts[f"cost, K = {k}"] = sentence(
            COST,
            **fixed,
            exact=rms(results, {**at, "compass": "exact"}),
            none=rms(results, {**at, "compass": NONE}),
            noise=rms(results, ten),
            first=rms(results, {**ten, "noise_model": FIRST}),
            joint=rms(results, {**ten, "method": "joint"}),
        )
        blind = {**at, "compass": NONE}
        texts[f"estimated, K = {k}"] = sentence(
            ESTIMATED,
            **fixed,
            still=heading(results, {**blind, "speed": 0.0}),
            slow=heading(results, {**blind, "speed": 1.0}),
            fast=heading(results, blind),
            bound=heading(results, {**blind, **of("bound", "bound")}),
            early=heading(results, {**blind, "after_s": AFTER[1]}),
        )
    return texts


STUDY = Study(
    "heading_error",
    "What does an erroneous or unknown heading cost, and how soon does a fleet estimate its headings?",
    cell,
    _grid(),
    settings={"runs": 60, "seed": 0, "radius_m": 60.0, "gnss_std_m": 1.5, "yaw_rate_std": 0.01, "score_s": 0.1},
    key=key,
    shares=("compass", "max_neighbours", "speed", "after_s"),
    tables={
        "compass": partial(_compasses, number=rms, text="RT-LE [m]", decimals=2),
        "nees": partial(
            _compasses, number=partial(mean, value="nees"), text="NEES of a pose (3 is consistent)", decimals=1
        ),
    },
    figures={"heading": _over_time},
    findings=_findings,
    limitations=(
        "One convoy: the value of a bearing depends on its geometry.",
        "A joint state of all vehicles needs a centre; its bound uses all measurements of all vehicles.",
        "Only the last step of a drive is scored; without a compass the initial headings are estimated from all of it.",
    ),
    reference=reference("heading_error"),
    metrics={"rt_le_m": "lower", "heading_deg": "lower", "nees": 3.0},
)
