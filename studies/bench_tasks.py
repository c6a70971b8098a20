"""CL-Bench: its tasks, fixed by version. A task is a drive, its noise, its channel and what goes wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from coopoc import V2X, Fleet, Recording, Sensors, load_fleet, observe
from coopoc.arrays import Floats
from coopoc.evaluate.bounds import bound_rt_le, fleet_bound, past_bound, posterior_bound
from coopoc.world.spoofing import spoofed

VERSION = "1"
"""Another set of tasks, seeds, egos or scores is another version."""


@dataclass(frozen=True)
class Task:
    """What a method is tried on.

    Args:
        name: of the task.
        question: that it asks.
        data: bundled fleet.
        sensors: the noise that acts and that methods may know.
        v2x: neighbourhood and channel.
        share: of the vehicles that broadcast false fixes; methods do not know of it.
        seed: of all draws.
        runs: noise draws.
        egos: evenly spaced over the fleet.
    """

    name: str
    question: str
    data: str
    sensors: Sensors
    v2x: V2X
    share: float = 0.0
    seed: int = 2026
    runs: int = 10
    egos: int = 5

    @property
    def columns(self) -> tuple[int, ...]:
        """Egos as columns of the fleet."""
        count = len(load_fleet(self.data).ids)
        return tuple(k * count // self.egos for k in range(self.egos))


WHITE = Sensors.paper_scenario2()
IDEAL = V2X(max_neighbours=6)
TASKS = (
    Task("alone", "No neighbour: the paper's scenario 1, with a bias.", "town10", Sensors.paper_scenario1(), V2X(0)),
    Task("paper", "The paper's scenario 2.", "town10", WHITE, IDEAL),
    Task("elsewhere", "The same in another town with sparser traffic.", "town04", WHITE, IDEAL),
    Task(
        "lasting",
        "GNSS errors that persist and are partly common.",
        "town10",
        replace(WHITE, gnss_std=(1.5, 1.5, 1.5), gnss_drift_std=2.5, gnss_common_std=1.5),
        IDEAL,
    ),
    Task(
        "field", "Messages at a CAM's rate, late and lost.", "town10", WHITE, replace(V2X.cam(6), latency=0.1, loss=0.3)
    ),
    Task("spoofed", "A fifth of the vehicles broadcasts false fixes.", "town10", WHITE, IDEAL, 0.2),
    Task(
        "heading",
        "A compass of 2 deg with a constant error of 3 deg.",
        "town10",
        replace(WHITE, heading_std=float(np.deg2rad(2)), heading_bias_std=float(np.deg2rad(3))),
        IDEAL,
    ),
)
"""The test: parameters of a method are never chosen on it."""
VALIDATION = tuple(replace(task, data="town10-validation", seed=1) for task in TASKS)
"""The same questions on another drive with other draws: parameters may be chosen here."""


@lru_cache(maxsize=2)
def recording(task: Task, everyone: bool) -> tuple[Recording, Fleet]:
    """What a task's vehicles see, and the truth."""
    fleet = load_fleet(task.data)
    egos = None if everyone else list(task.columns)
    seen = observe(fleet, task.sensors, task.v2x, runs=task.runs, seed=task.seed, observers=egos)
    if task.share:
        seen = spoofed(seen, task.share, seed=task.seed, honest=list(task.columns))
    return seen, fleet


@lru_cache(maxsize=64)
def bound(task: Task, information: str) -> float:
    """RT-LE m of the bound over an ideal channel without attack, root mean square over the egos: no method is below it.

    Args:
        task: its drive and noise; a bias is left out.
        information: "solo", "star", "past" (a star whose newcomers bring their past) or "fleet".
    """
    fleet, sensors = load_fleet(task.data), replace(task.sensors, gnss_bias=(0.0, 0.0))
    v2x = V2X(max_neighbours=task.v2x.max_neighbours, radius=task.v2x.radius)
    if information == "fleet":
        whole = fleet_bound(fleet, sensors, v2x)
        found: list[Floats] = [whole[:, ego] for ego in task.columns]
    elif information == "past":
        found = [past_bound(fleet, sensors, ego, v2x) for ego in task.columns]
    else:
        found = [posterior_bound(fleet, sensors, ego, v2x if information == "star" else V2X(0)) for ego in task.columns]
    return float(np.sqrt(np.mean([bound_rt_le(cov) ** 2 for cov in found])))
