"""A cooperative learned gain without a noise model, against the joint filter with one, under message loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.joint_filter import JointFilter
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Method
from coopoc.study.numbers import interval, mean, present, seed_std
from coopoc.study.study import Params, Row
from coopoc.study.style import Panel
from coopoc.world.fleet import Fleet
from coopoc.world.recording import Recording

from . import lineup, scene
from .lineup import PAST
from .views import curves, of, table, verdict

if TYPE_CHECKING:
    from coopoc.study.results import Results

NEIGHBOURS = (0, 2, 6, 10)
LOSSES = (0.0, 0.3, 0.7)
LINES = (
    ("cooperative", "trained"),
    ("joint", "nominal"),
    ("split-ci", "nominal"),
    ("joint", "fitted"),
    ("lkf-sa", "identity"),
)
BOUNDS = (("bound", "star"), PAST)
RECEIVERS = ("mixed", "changing")
"""Two receivers in five are POOR and the others GOOD; all are POOR in the middle third of the drive and else GOOD."""
GOOD, POOR = 1.5, 5.0
"""m."""
ALIKE = {"receivers": "alike"}


def _grid() -> list[dict[str, Any]]:
    """Every K and loss with receivers that are alike, and receivers that differ at K = 0 and 6; bounds know no loss."""
    return [
        *(
            of(*line, **ALIKE, max_neighbours=k, loss=loss)
            for loss in LOSSES
            for k in NEIGHBOURS
            for line in (*LINES, *(BOUNDS if loss == 0 else ()))
            if k or loss == 0
        ),
        *(
            of(*line, receivers=which, max_neighbours=k, loss=0.0)
            for which in RECEIVERS
            for k in (0, 6)
            for line in (*LINES[:2], ("joint", "per-fix"))
        ),
    ]


def cell(p: Params) -> list[Row]:
    """Rows of one method, K and loss, per training seed, ego and run; of a bound, one row per ego."""
    if p["method"] == "bound":
        return lineup.bound_rows(p)
    measured = recording(p)
    return lineup.rows(p, made=_methods(p, measured), measured=measured)


def _methods(p: Params, measured: Recording) -> Sequence[tuple[int | None, Method]]:
    from coopoc.learned.nets.cooperative import NetNoise

    if p["noise_model"] != "per-fix":
        return lineup.methods(p, measured)
    process = NoiseModel.nominal(measured.sensors).process_variance(measured)
    fix = np.square(gnss_std(p, scene.fleet(p["data"])))[None]
    return [(None, JointFilter(NetNoise("per-fix", measured.sensors, fix=fix, process=process)))]


def gnss_std(p: Params, drive: Fleet) -> Floats:
    """(T, N, 3) m that acts on the cell's fixes."""
    steps, vehicles = len(drive.t), len(drive.ids)
    poor = np.arange(vehicles)[None, :, None] % 5 < 2
    if p["receivers"] == "changing":
        poor = 3 * np.arange(steps)[:, None, None] // steps == 1
    std = np.array(scene.sensors(p).gnss_std) if p["receivers"] == "alike" else np.where(poor, POOR, GOOD)
    return np.broadcast_to(std, (steps, vehicles, 3))


def recording(p: Params) -> Recording:
    """Recording of the cell's vehicles; the sensors of differing receivers are the rms over fleet and drive."""
    drawn = scene.recording(p)
    if p["receivers"] == "alike":
        return drawn
    drive = scene.fleet(p["data"])
    std = gnss_std(p, drive)
    mean_std = float(np.sqrt(np.square(std).mean()))
    gnss = drive.position + std / np.array(drawn.sensors.gnss_std) * (drawn.gnss - drive.position)
    return replace(drawn, gnss=gnss, sensors=replace(drawn.sensors, gnss_std=(mean_std,) * 3))


INPUTS = (
    "The learned gain is given no noise of GNSS and velocity; nominal filters know it. Messages of 14 numbers "
    "(learned, split CI) or 8 (the others)."
)
BOUND = (
    "Bounds are for the rms over runs and a channel that loses nothing; with its past, a new neighbour's messages "
    "carry what it measured before, as split CI's estimates do."
)
FILTERS = {**ALIKE, "method": list(dict.fromkeys(method for method, _ in LINES))}
k_table = partial(table, rows=("loss", "method", "noise_model"), best=None)


def _interval(results: Results, where: Any) -> Any:
    return (mean if where["method"] == "bound" else interval)(results, where)


def _panel(loss: float) -> Panel:
    """K = 0, where nothing can be lost, is in all panels."""
    x = {k: {"max_neighbours": k, "loss": loss if k else 0.0} for k in NEIGHBOURS}
    return Panel(x, ALIKE, f"{100 * loss:g} % of messages lost", "Neighbours K")


def _finding(results: Results, loss: float) -> str:
    """The learned gain at the largest K that was run, against the joint filter with the nominal noise model."""
    where = present(results, {**ALIKE, "loss": loss, "method": "cooperative"})
    if where is None:
        return ""
    most = int(results.select(where)["max_neighbours"].max())
    learned, joint = (of(*line, **ALIKE, loss=loss, max_neighbours=most) for line in LINES[:2])
    if not present(results, joint):
        return ""
    level, std = results.interval("rt_le_m", learned).mean, seed_std(results, learned)
    seeds = f", seed std {std:.4f} m" if std is not None else ""
    judged = verdict(results, learned, joint, "the joint filter that knows the noise")
    return f"{100 * loss:g} % loss, K = {most}: the cooperative gain has {level:.3f} m{seeds} and {judged}."


STUDY = lineup.study(
    "cooperative_gain",
    "Can transmitted noise estimates replace known noise parameters, also when messages are lost?",
    cell=cell,
    recipe=None,
    grid=_grid(),
    settings={**scene.TOWN, **scene.WEIGHTS, "burst": 1.0, "runs": 30, "train_seeds": 3},
    shares=("receivers", "max_neighbours", "loss"),
    tables={
        "rt_le": k_table("RT-LE [m] against K.", BOUND, INPUTS, where=ALIKE, decimals=3),
        "bytes": k_table(
            "Payload that an ego receives [B/s].",
            INPUTS,
            value="bytes_per_second",
            where=FILTERS,
            decimals=0,
            intervals=False,
        ),
        "nees": k_table("NEES (3 is consistent).", INPUTS, value="nees", where=FILTERS, intervals=False),
        "nees_inside": k_table(
            "Share of steps whose run-averaged NEES is in its 99 % band (gate: 0.95).",
            INPUTS,
            value="nees_inside",
            where=FILTERS,
            intervals=False,
        ),
        "receivers": k_table(
            f"RT-LE [m] where two receivers in five have {POOR:g} m and the others {GOOD:g} m (mixed), and where "
            f"all have {POOR:g} m in the middle third of the drive (changing); nominal filters know the rms, "
            "'per-fix' ones the noise of each fix.",
            INPUTS,
            where={"receivers": list(RECEIVERS)},
            rows=("receivers", "method", "noise_model"),
            decimals=3,
        ),
    },
    figures={
        "rt_le": curves(
            [_panel(loss) for loss in LOSSES],
            [*(of(*line) for line in LINES[:-1]), *(of(*line, loss=0.0) for line in BOUNDS)],
            "RT-LE against the number of neighbours; bands: 95 % intervals over egos, then runs. LKF-SA is far above.",
            INPUTS,
            BOUND,
            number=_interval,
        )
    },
    findings=lambda results: {f"{100 * loss:g} % loss": _finding(results, loss) for loss in LOSSES},
    limitations=(
        "The noise of range and angles is the nominal one, since solo training drives contain no such measurement.",
        "Messages arrive within the step in which they are sent, or never.",
        "Numbers count as float32.",
    ),
    minutes=12,
    metrics={"rt_le_m": "lower", "nees": 3.0},
)
