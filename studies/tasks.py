"""CL-Bench: its tasks, fixed by version: simulated drives with what goes wrong, logs of real robots, and graphs."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from coopoc import (
    V2X,
    Fault,
    Fleet,
    InputError,
    Outliers,
    PoseFilter,
    Recording,
    Sensors,
    Track,
    bound_rt_le,
    fleet_bound,
    heading_error,
    load_fleet,
    observe,
    pose_nees,
    pose_start,
    posterior_bound,
    read_log,
)
from coopoc.arrays import Floats
from coopoc.data.fetch import bring, cache_folder, holder, public
from coopoc.data.log.residuals import GATE_STDS
from coopoc.evaluate.metrics import errors
from coopoc.evaluate.scores import online_columns
from coopoc.evaluate.statistics import mean_interval
from coopoc.study.cell import Row
from coopoc.world.spoofing import Spoofing, spoofed

from . import pose_drives
from .pose_drives import POSES, hashed, near

VERSION = "2"
"""Another set of tasks, seeds, egos or scores is another version."""


@dataclass(frozen=True)
class Task:
    """What a method is tried on.

    Args:
        name: of the task.
        sensors: the noise that acts and that methods may know.
        v2x: neighbourhood and channel.
        attack: on the vehicles that are no egos; methods do not know of it.
        data: bundled fleet.
        seed: of all draws.
        runs: noise draws.
        egos: evenly spaced over the fleet.
    """

    name: str
    sensors: Sensors
    v2x: V2X = V2X(max_neighbours=6)
    attack: Spoofing = Spoofing(0.0)
    data: str = "town10"
    seed: int = 2026
    runs: int = 10
    egos: int = 5

    @property
    def columns(self) -> list[int]:
        """Egos as columns of the fleet."""
        count = len(load_fleet(self.data).ids)
        return [k * count // self.egos for k in range(self.egos)]


WHITE = Sensors.paper_scenario2()
CAM = replace(V2X.cam(6), latency=0.1, loss=0.3)
BIASED_COMPASS = replace(WHITE, heading_std=float(np.deg2rad(2)), heading_bias_std=float(np.deg2rad(3)))
LASTING_ERRORS = replace(WHITE, gnss_std=(1.5, 1.5, 1.5), gnss_drift_std=2.5, gnss_common_std=1.5)
LONG_RANGES = Outliers(ranges=Fault(0.05, (3.0, 20.0)))
MISTAKEN = replace(WHITE, outliers=replace(LONG_RANGES, angles=Fault(0.01)))
CANYON = replace(WHITE, outliers=Outliers.urban_canyon())
STORM = replace(BIASED_COMPASS, outliers=LONG_RANGES)
FIFTH, LATER = Spoofing(0.2), Spoofing(0.2, start=30.0)
TASKS = (
    Task("alone", Sensors.paper_scenario1(), V2X(0)),
    Task("paper", WHITE),
    Task("elsewhere", WHITE, data="town04"),
    Task("lasting", LASTING_ERRORS),
    Task("field", WHITE, CAM),
    Task("heading", BIASED_COMPASS),
    Task("outliers", MISTAKEN),
    Task("canyon", CANYON),
    Task("spoofed", WHITE, attack=FIFTH),
    Task("spoofed-40", WHITE, attack=Spoofing(0.4)),
    Task("attacked", WHITE, attack=LATER),
    Task("storm", STORM, CAM, FIFTH),
)
"""The test: parameters of a method are never chosen on it."""
VALIDATION = tuple(replace(task, data="town10-validation", seed=1) for task in TASKS)
"""The same questions on another drive with other draws: parameters may be chosen here."""


@lru_cache(maxsize=2)
def recording(task: Task, everyone: bool, remove_outliers: bool = False) -> tuple[Recording, Fleet]:
    """What a task's vehicles see, with what is wrong in it or `remove_outliers` of it, and the truth."""
    fleet = load_fleet(task.data)
    egos = None if everyone else task.columns
    observed = observe(
        fleet, task.sensors, task.v2x, runs=task.runs, seed=task.seed, observers=egos, remove_outliers=remove_outliers
    )
    if task.attack.share:
        observed = spoofed(observed, task.attack, seed=task.seed, honest=task.columns, remove_outliers=remove_outliers)
    return observed, fleet


@lru_cache(maxsize=64)
def bound(task: Task, information: str) -> float:
    """RT-LE m of the bound over an ideal channel, root mean square over the egos: no method is below it.

    Args:
        task: its drive and noise; a bias is left out, and the estimator knows of outliers and an attack.
        information: "solo", "star", "past" (a star with the past of newcomers) or "fleet".
    """
    fleet, sensors = load_fleet(task.data), replace(task.sensors, gnss_bias=(0.0, 0.0))
    v2x = V2X(max_neighbours=task.v2x.max_neighbours, radius=task.v2x.radius)
    clean = None
    if sensors.outliers or task.attack.share:
        runs = 3 if information in ("past", "fleet") else task.runs  # each takes half a minute
        clean, _ = recording(replace(task, v2x=v2x, runs=runs), information == "fleet", remove_outliers=True)
    if information == "fleet":
        bounds = [*np.moveaxis(fleet_bound(fleet, sensors, v2x, recording=clean)[:, task.columns], 1, 0)]
    else:
        near, past = V2X(0) if information == "solo" else v2x, information == "past"
        bounds = [posterior_bound(fleet, sensors, ego, near, past=past, recording=clean) for ego in task.columns]
    return float(np.sqrt(np.mean([bound_rt_le(cov) ** 2 for cov in bounds])))


RANGE_STD = 0.3
"""m assumed of a UWB range, whose errors last: the file's 0.04 m is the error of one."""


LOGGED: Mapping[str, tuple[str, float]] = {
    "robots": ("MRCLAM_Dataset6", 30.0),
    "robots-7": ("MRCLAM_Dataset7", 30.0),
    "uwb": ("tiers.pyfg", 10.0),
    "indoor": ("Indoor_UWB_Input.txt", 3.0),
}
"""What pose filters are tried on: file or folder below that of the data, and s of a block that errors are means of."""


def located(folder: Path | None, name: str) -> Path:
    """The file or folder of that name anywhere below a folder, else among the fetched data.

    Raises:
        InputError: there is none.
    """
    entry = public().get(holder(name))
    folders = [] if folder is None else [folder]
    folders += [entry.folder] if entry and entry.fetched else []
    paths = [path for one in folders if one.is_dir() for path in (one, *sorted(one.rglob(name))) if path.name == name]
    if not paths:
        searched = str(folder or cache_folder())
        raise InputError("data", searched, f"must hold {name}, however deep", bring(name, "Name its folder."))
    return paths[0]


@lru_cache(maxsize=2)
def observed_task(task: str, path: Path) -> tuple[Recording, Fleet, int, Mapping[str, Any]]:
    """Measurements, truth, first step that is scored, and what is known of the start and the noise."""
    if task.startswith("robots"):
        until = 300.0
        drive: Any = pose_drives.source(str(path)).drive(until, near(4))
        start = int(until / drive.truth.dt)
        return pose_drives.thinned(drive.recording, 2, start), drive.truth, start, {"begin": drive.begin}
    if task == "indoor":
        log: Any = read_log(path, truth=path.with_name("Indoor_UWB_GT.txt"), frame="body")
        start = int(0.4 * len(log.recording.t))
        noise = replace(log.recording.sensors, range_std=RANGE_STD)
        begin = pose_start(replace(log.recording.between(0, start), sensors=noise), gate=GATE_STDS)
        return log.recording, log.truth, start, {"begin": begin, "assumed": noise}
    drive = pose_drives.source(str(path)).drive(0.0, near(3))
    if drive.truth is None or drive.truth.heading is None:
        raise InputError("data", str(path), "must hold true poses", "Take the file as it was published.")
    noise = replace(drive.recording.sensors, range_std=RANGE_STD)
    return drive.recording, drive.truth, 0, {"begin": drive.begin, "spread": drive.spread, "assumed": noise}


def pose_row(task: str, folder: Path | None, made: Any) -> Row:
    """RT-LE with its interval over robots and blocks of time, heading error, NEES, bytes and time.

    Args:
        task: that is run.
        folder: of the data, None for those that were fetched.
        made: name in POSES, or a method of one's own; fields `begin`, `spread`, `assumed` are set if it has them.
    """
    file, block_s = LOGGED[task]
    path = located(folder, file)
    recording, fleet, start, assumed = observed_task(task, path)
    if isinstance(made, str):
        made = PoseFilter(**{"lasting": task != "uwb", **assumed, **POSES[made]}, gate=GATE_STDS)
    elif is_dataclass(made):
        own = {field.name for field in fields(made)}
        made = replace(made, **{name: value for name, value in assumed.items() if name in own})  # type: ignore[type-var]
    made(recording.between(0, 3), recording.vehicles)  # compiles
    track = made(recording, recording.vehicles)
    blocks = partial(blocks_of, start=start, length=block_s / fleet.dt)
    row: Row = {"task": task, "data": hashed(path), "rt_le_m": rounded(blocks(errors(track, fleet)[0]).T)}
    if fleet.heading is None:
        row["nees"] = round(np.nanmean(planar(track, fleet)[1][:, start:]), 2)
    elif track.heading is not None:
        row["heading_deg"] = round(float(np.nanmean(np.rad2deg(blocks(heading_error(track, fleet)[0])))), 3)
        row["nees"] = round(np.nanmean(pose_nees(track, fleet)[0, start:]), 2)
    return row | costs(track, recording, made)


def rounded(errors: Floats) -> list[float]:
    """Mean of errors m, (R, E) or (R,), and the ends of its interval."""
    level = mean_interval(errors)
    return [round(value, 4) for value in (level.mean, level.low, level.high)]


def planar(track: Track, fleet: Fleet) -> tuple[Floats, Floats]:
    """Errors (R, T, E, 2) m of a track in the plane, and their NEES (R, T, E), NaN without a covariance."""
    gap = (track.x - fleet.position[:, list(track.egos)])[..., :2]
    if track.covariance is None:
        return gap, np.full(gap.shape[:-1], np.nan)
    return gap, np.einsum("rtei,rteij,rtej->rte", gap, np.linalg.inv(track.covariance[..., :2, :2]), gap)


def costs(track: Track, recording: Recording, method: Any) -> Row:
    """B/s on air that an ego receives, and us of a step."""
    received = round(float(online_columns(track, recording, method)["bytes_per_second"].mean()))
    step = round(1e6 * track.seconds / track.x[..., 0].size, 2)
    return {"received_bytes_per_second": received, "microseconds_per_step": step}


def blocks_of(error: Floats, start: int, length: float) -> Floats:
    """(E, B) root mean square of errors (T, E) over blocks of steps from the start on, of those without a gap."""
    size = max(int(length), 1)
    parts = [error[first : first + size] for first in range(start, len(error) - size + 1, size)]
    return np.array([np.sqrt(np.nanmean(part**2, 0)) for part in parts if np.isfinite(part).any(axis=0).all()]).T
