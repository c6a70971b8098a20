"""The real logs with odometry, a truth, and fixes or what can stand for them, and the score of a solo filter on each.

F9K, KITTI 00 and comma2k19 are those of `coopoc benchmark` (docs/benchmark.md, "Real roads"). Of MR.CLAM set 6 speeds
are those of wheels, headings Vicon's, and fixes of 0.25 m are drawn once a second; of the Labyrinth (`uwb/indoor`)
speeds and yaw rates are those of wheels, the first heading that of the true way, and a fix is what four ranges say.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import coopoc as co
from coopoc.arrays import Floats
from coopoc.data.mrclam import read_mrclam
from coopoc.studies import roads
from coopoc.studies.tasks import located

FIX = 0.25
"""m, of fixes that are drawn indoors; assumed are 0.6 times as much, as of KITTI's."""


class Log(NamedTuple):
    """Measurements, truth, columns of the vehicles, and s of a block of time."""

    seen: co.Recording
    truth: co.Fleet
    columns: list[int]
    block: float

    def between(self, start: int, stop: int) -> "Log":
        return self._replace(seen=self.seen.between(start, stop), truth=self.truth.between(start, stop))

    @property
    def start(self) -> int:
        """First step that is scored: what is before may calibrate."""
        return int(roads.SHARE * len(self.seen.t))


def real_logs(data: Path) -> dict[str, Log]:
    """Log by name, from the files below a folder."""
    logs = {}
    for task in roads.ROADS:
        seen, truth = roads.seen(task, data)
        logs[task] = Log(seen, truth, [seen.observers[0]], roads.BLOCK)
    return logs | {"MR.CLAM": _mrclam(located(data, "MRCLAM_Dataset6")), "indoor": _labyrinth(data)}


def _mrclam(folder: Path) -> Log:
    log = read_mrclam(folder, dt=0.2)
    steps = np.arange(len(log.fleet.t))
    heading = np.stack([np.interp(steps, steps[np.isfinite(h)], h[np.isfinite(h)]) for h in log.heading.T], 1)
    heading -= 0.5 * np.diff(heading, axis=0, prepend=heading[:1])  # midway of a step
    velocity = log.speed[..., None] * np.stack([np.cos(heading), np.sin(heading), 0 * heading], -1)
    return Log(_recording(log.fleet, velocity), log.fleet, list(range(len(log.fleet.ids))), roads.BLOCK)


def _labyrinth(data: Path) -> Log:
    rows = [line.split() for name in ("Input", "GT") for line in located(data, f"Indoor_UWB_{name}.txt").open()]
    ranges, wheels, true = (
        np.array([row[1:6] for row in rows if row[0] == tag], float) for tag in ("range2", "odom2diff", "point2")
    )
    t, (left, right), half_track = ranges[:, 0], wheels[:, 1:3].T, wheels[:, 4]
    dt = float(np.median(np.diff(t)))
    turned = np.cumsum((right - left) / (2 * half_track)) * dt
    flow = 0.5 * (left + right) * np.exp(1j * turned)
    way = np.interp(t, true[:, 0], true[:, 1]) + 1j * np.interp(t, true[:, 0], true[:, 2])
    first = len(t) // 5
    flow = flow * np.exp(1j * np.angle(np.vdot(np.cumsum(flow)[:first], way[:first] - way[0])))
    fixes = np.full((1, len(t), 1, 3), np.nan)
    for k in range(3, len(t), 4):
        r, anchors, at = ranges[k - 3 : k + 1, 1], ranges[k - 3 : k + 1, 3:5], np.array([1.2, 1.2])
        for _ in range(20):
            far = np.linalg.norm(at - anchors, axis=1)
            at = at + np.linalg.lstsq((at - anchors) / far[:, None], r - far, rcond=None)[0]
        fixes[0, k, 0] = *at, 0.0
    position, velocity = (np.column_stack([c.real, c.imag, 0 * t])[:, None] for c in (way, flow))
    motion = np.diff(position, axis=0, prepend=position[:1]) / dt
    fleet = co.Fleet(("robot",), dt * np.arange(len(t)), position, motion)
    return Log(replace(_recording(fleet, velocity), gnss=fixes), fleet, [0], 3.0)


def _recording(fleet: co.Fleet, velocity: Floats) -> co.Recording:
    """Velocities (T, N, 3) m/s as measured, and white fixes of one draw, each second."""
    known = co.Sensors(gnss_std=(0.6 * FIX,) * 3)
    drawn = co.observe(fleet, replace(known, gnss_std=(FIX,) * 3), co.V2X(max_neighbours=0), seed=2026)
    kept = (np.arange(len(fleet.t)) % round(1 / fleet.dt) == 0)[:, None, None]
    return replace(drawn, gnss=np.where(kept, drawn.gnss, np.nan), velocity=velocity[None], sensors=known)


Filter = Callable[[co.Recording, co.Fleet, Sequence[int]], tuple[Floats, Floats]]
"""(measurements, truth, columns) -> positions (N, T, 2) m and covariances (N, T, 2, 2) m^2; the truth is not used."""


def scored(log: Log, made: Filter) -> Floats:
    """(N, 2) of each vehicle RT-LE m in the plane, the mean over blocks, and the mean NEES, both from `start` on."""
    (seen, _, columns, block), start = log, log.start
    size = int(min(block / seen.dt, (len(seen.t) - start) / 4))
    square, nees = np.full((2, len(columns), len(seen.t)), np.nan)
    for begin, stop in seen.stretches(columns[0]):
        if stop > start:
            part = log.between(begin, stop)
            x, p = made(*part[:3])
            gap = x - part.truth.position[:, columns, :2].swapaxes(0, 1)
            square[:, begin:stop] = np.square(gap).sum(-1)
            nees[:, begin:stop] = np.einsum("nti,ntij,ntj->nt", gap, np.linalg.inv(p), gap)
    parts = [square[:, k : k + size] for k in range(start, len(seen.t) - size + 1, size)]
    blocks = [np.sqrt(np.nanmean(part, 1)) for part in parts if np.isfinite(part).any()]
    return np.stack([np.mean(blocks, 0), np.nanmean(nees[:, start:], 1)], 1)
