"""What may be wrong in a world: kinds of fault, each of which makes another scene of a scene."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy import nan
from numpy.linalg import norm

from coopoc import V2X, Fault, Fleet, Outliers, Recording, Sensors
from coopoc.arrays import Bools, Floats, Ints
from coopoc.world.body_frames import turned
from coopoc.world.sensors import stream
from coopoc.world.spoofing import Spoofing, spoofed

RUNS, EGOS = 4, 2
"""Noise draws and egos of a world."""
Edit = Callable[[Recording], Recording]
Draws = np.random.Generator


class Scene(NamedTuple):
    """A world before its recording: each kind of fault returns another scene, and words for it.

    Attributes:
        fleet: that drives.
        egos: two columns.
        acting: sensors as they are.
        assumed: sensors as methods know them.
        v2x: neighbourhood and channel.
        seed: of the noise.
        edits: what happens to the recording, in this order.
    """

    fleet: Fleet
    egos: tuple[int, ...]
    acting: Sensors
    assumed: Sensors
    v2x: V2X
    seed: int
    edits: tuple[Edit, ...] = ()

    def edited(self, edit: Edit) -> "Scene":
        """The same with one more edit."""
        return self._replace(edits=(*self.edits, edit))

    def sensing(self, stated: bool = False, **more: Any) -> "Scene":
        """The same with other sensors, whose noise methods assume, if `stated`."""
        assumed = replace(self.assumed, **more) if stated else self.assumed
        return self._replace(acting=replace(self.acting, **more), assumed=assumed)

    def outliers(self, **more: Fault) -> "Scene":
        """The same with more outliers."""
        return self.sensing(outliers=replace(self.acting.outliers or Outliers(), **more))

    @property
    def others(self) -> Ints:
        """Columns that are no egos."""
        return np.setdiff1d(np.arange(len(self.fleet.ids)), self.egos)

    def interval(self, rng: Draws, low: float, high: float) -> tuple[Bools, str]:
        """(T,) True during an interval of low to high s that begins after 5 s, and its words."""
        length, t = rng.uniform(low, high), self.fleet.t
        start = rng.uniform(5.0, max(t[-1] - length, 5.0))
        return (t >= start) & (t < start + max(length, self.fleet.dt)), f"{start:.0f} to {start + length:.0f} s"


Made = tuple[Scene, str]


def log_uniform(rng: Draws, low: float, high: float) -> float:
    """A log-uniform draw."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _levels(scene: Scene, rng: Draws) -> Made:
    fix, speed, distance, angle = np.where(
        rng.uniform(size=4) < 0.3, 1.0, [log_uniform(rng, 0.3, 4.0) for _ in range(4)]
    ).tolist()
    acting = scene.acting
    made = scene.sensing(
        gnss_std=tuple(fix * std for std in acting.gnss_std),
        velocity_std_ratio=speed * acting.velocity_std_ratio,
        range_std=distance * acting.range_std,
        azimuth_std=angle * acting.azimuth_std,
        inclination_std=angle * acting.inclination_std,
    )
    words = f"fixes {fix:.2g}, velocities {speed:.2g}, ranges {distance:.2g}, angles {angle:.2g}"
    return made, f"{words} times what is assumed"


def _drift(scene: Scene, rng: Draws, stated: bool) -> Made:
    own, common, lasts = log_uniform(rng, 1.0, 5.0), log_uniform(rng, 0.3, 3.0), log_uniform(rng, 15.0, 120.0)
    made = scene.sensing(stated, gnss_drift_std=own, gnss_common_std=common, gnss_drift_time=lasts)
    return made, f"{own:.2g} m, {common:.2g} m in common, for {lasts:.0f} s"


def _compass(scene: Scene, rng: Draws, stated: bool) -> Made:
    """Headings turn what is measured and where odometry leads by one angle a vehicle and run."""
    std = float(np.deg2rad(log_uniform(rng, 1.0, 8.0)))

    def edit(recording: Recording) -> Recording:
        angle = std * _normals(recording, scene.seed, "heading_bias")  # the draw of the azimuths
        return replace(recording, velocity=turned(recording.velocity, angle[:, None]))

    return scene.sensing(stated, heading_bias_std=std).edited(edit), f"{np.rad2deg(std):.2g}°"


def _scale(scene: Scene, rng: Draws, stated: bool) -> Made:
    std = log_uniform(rng, 0.01, 0.1)

    def edit(recording: Recording) -> Recording:
        scale = 1.0 + std * _normals(recording, scene.seed, "speed_scale")
        return replace(recording, velocity=recording.velocity * scale[:, None, :, None])

    return scene.sensing(stated, speed_scale_std=std).edited(edit), f"{100 * std:.2g} %"


def _normals(recording: Recording, seed: int, sensor: str) -> Floats:
    """(R, N) standard normals, the first of each stream."""
    return np.array([[stream(seed, sensor, r, name).normal() for name in recording.ids] for r in range(RUNS)])


def _slip(scene: Scene, rng: Draws) -> Made:
    """Wheels of the egos and of a third of the others, twice as fast or still."""
    (when, words), factor = scene.interval(rng, 2.0, 10.0), float(rng.choice((0.0, 2.0)))
    who = np.union1d(scene.egos, scene.others[rng.uniform(size=len(scene.others)) < 1 / 3])
    return scene.edited(partial(_times, "velocity", factor, when, who)), f"velocities times {factor:g}, {words}"


def _times(field: str, factor: float, when: Bools, who: Ints | tuple[int, ...], recording: Recording) -> Recording:
    """Fixes or velocities of some vehicles at some steps, times a factor."""
    factors = np.where(when[:, None] & np.isin(np.arange(len(recording.ids)), who), factor, 1.0)
    return replace(recording, **{field: factors[..., None] * getattr(recording, field)})


def _outage(scene: Scene, rng: Draws, start: bool) -> Made:
    """No fix of the egos; from the start on all but the first, which filters begin with, or one in the middle."""
    when, words = scene.interval(rng, 5.0, 30.0)
    if start:
        until = rng.uniform(10.0, 40.0)
        when, words = (scene.fleet.t > 0) & (scene.fleet.t < until), f"until {until:.0f} s"
    return scene.edited(partial(_times, "gnss", nan, when, scene.egos)), words


def _receiver(scene: Scene, rng: Draws, ramp: tuple[float, float] = (0.0, 0.0), start: float | None = None) -> Made:
    """The fixes of the egos are off, each in a direction of its own."""
    size, length = log_uniform(rng, 5.0, 60.0), rng.uniform(*ramp)
    attack = Spoofing(1.0, start=rng.uniform(5.0, 25.0) if start is None else start, ramp=length)
    toward = rng.normal(size=(RUNS, EGOS, 3)) * [1.0, 1.0, 0.3]
    offset = size * toward / norm(toward, axis=-1, keepdims=True)
    moved = attack.size(scene.fleet.t)[:, None, None] * offset[:, None]
    words = f"{size:.0f} m from {attack.start:.0f} s on" + f" over {length:.0f} s" * (length > 0)
    return scene.edited(partial(_shifted, columns=list(scene.egos), offset=moved)), words


def _shifted(recording: Recording, columns: list[int], offset: Floats) -> Recording:
    """Fixes of some vehicles, all off by as much."""
    gnss = recording.gnss.copy()
    gnss[:, :, columns] += offset
    return replace(recording, gnss=gnss)


def _multipath(scene: Scene, rng: Draws) -> Made:
    rate, far, lasts = log_uniform(rng, 0.02, 0.3), log_uniform(rng, 10.0, 80.0), log_uniform(rng, 1.0, 15.0)
    words = f"{100 * rate:.0f} % of the fixes up to {far:.0f} m off for {lasts:.0f} s"
    return scene.outliers(fixes=Fault(rate, (far / 5, far), lasts=lasts)), words


def _nlos(scene: Scene, rng: Draws) -> Made:
    rate, far, lasts = log_uniform(rng, 0.03, 0.5), log_uniform(rng, 1.0, 30.0), float(rng.choice((0.0, 1.0, 5.0)))
    words = f"{100 * rate:.0f} % of the ranges up to {far:.2g} m too long for {lasts:g} s"
    return scene.outliers(ranges=Fault(rate, (far / 5, far), lasts=lasts)), words


def _mistaken(scene: Scene, rng: Draws) -> Made:
    rate, lasts = log_uniform(rng, 0.01, 0.2), float(rng.choice((0.0, 1.0)))
    return scene.outliers(angles=Fault(rate, lasts=lasts)), f"{100 * rate:.0f} % for {lasts:g} s"


def _long(scene: Scene, rng: Draws, stated: bool) -> Made:
    std = log_uniform(rng, 0.5, 5.0)
    return scene.sensing(stated, range_offset_std=std), f"{std:.2g} m"


def _only(scene: Scene, _: Draws, columns: tuple[int, ...]) -> Made:
    left = np.where(np.isin(range(3), columns), 1.0, nan)
    return scene.edited(lambda noisy: replace(noisy, relative=left * noisy.relative)), "in the whole drive"


def _late(scene: Scene, rng: Draws) -> Made:
    latency = rng.uniform(0.05, 0.8)
    return scene._replace(v2x=replace(scene.v2x, latency=latency)), f"{latency:.2f} s"


def _lost(scene: Scene, rng: Draws) -> Made:
    loss, burst = rng.uniform(0.1, 0.7), log_uniform(rng, 1.0, 20.0)
    rate = min(float(rng.choice((1.0, 2.0, 5.0, 10.0, 20.0))), 1.0 / scene.fleet.dt)
    v2x = replace(scene.v2x, loss=loss, burst=burst, rate=rate)
    return scene._replace(v2x=v2x), f"{100 * loss:.0f} %, {burst:.0f} at once, at {rate:g} Hz"


def _clocks(scene: Scene, rng: Draws) -> Made:
    """Messages of some hold what was a while before the time that they state."""
    who, steps = _some(scene, rng), max(1, round(rng.uniform(0.1, 1.0) / scene.fleet.dt))
    words = f"{len(who)} are {steps * scene.fleet.dt:.2g} s late"
    return scene.edited(partial(delayed, who=who, steps=steps, start=0)), words


def _replay(scene: Scene, rng: Draws) -> Made:
    """From an instant on, messages of some are repeated with new times."""
    who, seconds, begin = _some(scene, rng), rng.uniform(3.0, 20.0), rng.uniform(0.0, 25.0)
    steps, start = round(seconds / scene.fleet.dt), round(begin / scene.fleet.dt)
    words = f"{len(who)} repeat those of {seconds:.0f} s before, from {begin:.0f} s on"
    return scene.edited(partial(delayed, who=who, steps=steps, start=start)), words


def _some(scene: Scene, rng: Draws) -> Ints:
    """Columns of a tenth to a half of the others, one at least."""
    count = max(1, round(rng.uniform(0.1, 0.5) * len(scene.others)))
    return np.sort(rng.permutation(scene.others)[:count])


def delayed(recording: Recording, who: Ints, steps: int, start: int) -> Recording:
    """Fixes and velocities of some as they were so many steps ago, from a step on, wherever they were there then."""
    now = np.arange(len(recording.t))
    then = np.where(now >= start, np.maximum(now - steps, 0), now)
    gnss, velocity = recording.gnss.copy(), recording.velocity.copy()
    there = np.isfinite(velocity[:1, :, who]) & np.isfinite(velocity[:1, then][:, :, who])
    for values in (gnss, velocity):
        values[:, :, who] = np.where(there, values[:, then][:, :, who], values[:, :, who])
    return replace(recording, gnss=gnss, velocity=velocity)


def _liars(scene: Scene, rng: Draws, ramp: tuple[float, float] = (0.0, 0.0), collude: bool = False) -> Made:
    far, begins = log_uniform(rng, 4.0, 60.0), rng.uniform(0.0, 25.0) * rng.integers(0, 2)
    attack = Spoofing(rng.uniform(0.1, 0.5), (far / 4, far), begins, rng.uniform(*ramp), collude)
    words = f"{100 * attack.share:.0f} % up to {far:.0f} m off on each axis, from {begins:.0f} s on"
    words += f" over {attack.ramp:.0f} s" * (attack.ramp > 0)
    return scene.edited(lambda recording: spoofed(recording, attack, scene.seed, scene.egos)), words


def _sybil(scene: Scene, rng: Draws) -> Made:
    """One vehicle beside an ego sends as several: all are measured where it is, and claim to be elsewhere together."""
    fleet, count = scene.fleet, int(rng.integers(1, 5))
    gap = norm(fleet.position[:, scene.others] - fleet.position[:, scene.egos[:1]], axis=-1)
    liar = int(scene.others[np.argmin(gap.mean(0))])
    toward, start = rng.uniform(-1.0, 1.0, (RUNS, 3)), rng.uniform(0.0, 25.0)
    offset = log_uniform(rng, 5.0, 40.0) * toward
    columns = [liar, *range(len(fleet.ids), len(fleet.ids) + count)]
    antennas = rng.normal(0.0, 0.3, (count, 3))
    who = replace(
        fleet,
        ids=(*fleet.ids, *(f"ghost{k}" for k in range(count))),
        position=np.append(fleet.position, fleet.position[:, [liar] * count] + antennas, axis=1),
        velocity=np.append(fleet.velocity, fleet.velocity[:, [liar] * count], axis=1),
    )
    moved = (fleet.t >= start)[:, None, None] * offset[:, None, None]
    made = scene._replace(fleet=who).edited(partial(_shifted, columns=columns, offset=moved))
    return made, f"one as {count + 1}, from {start:.0f} s on"


def _come_and_go(scene: Scene, rng: Draws) -> Made:
    """Two thirds of the others are there during a part of the drive only, or away during it."""
    position, velocity, t = scene.fleet.position.copy(), scene.fleet.velocity.copy(), scene.fleet.t
    who = scene.others[rng.uniform(size=len(scene.others)) < 2 / 3]
    for column in who:
        start, stop = np.sort(rng.uniform(0.0, t[-1], 2))
        away = (t < start) | (t >= stop) if rng.uniform() < 0.5 else (t >= start) & (t < stop)
        away[-1] &= not away.all()
        position[away, column] = velocity[away, column] = nan
    scene = scene._replace(fleet=replace(scene.fleet, position=position, velocity=velocity))
    return scene, f"{len(who)} of {len(scene.others)}"


CREEP = (5.0, 30.0)
"""s, over which an error grows that does not jump."""
KINDS: Mapping[str, Callable[[Scene, Draws], Made]] = {
    "noise levels": _levels,
    "drift, told": partial(_drift, stated=True),
    "drift, not told": partial(_drift, stated=False),
    "compass, told": partial(_compass, stated=True),
    "compass, not told": partial(_compass, stated=False),
    "odometer scale, told": partial(_scale, stated=True),
    "odometer scale, not told": partial(_scale, stated=False),
    "odometer slip": _slip,
    "no fixes": partial(_outage, start=False),
    "no fixes, at first": partial(_outage, start=True),
    "own receiver, jump": _receiver,
    "own receiver, creep": partial(_receiver, ramp=CREEP),
    "own receiver, from the start": partial(_receiver, start=0.0),
    "multipath": _multipath,
    "NLOS": _nlos,
    "mistaken angles": _mistaken,
    "range offset, told": partial(_long, stated=True),
    "range offset, not told": partial(_long, stated=False),
    "measured, ranges only": partial(_only, columns=(0,)),
    "measured, angles only": partial(_only, columns=(1, 2)),
    "measured, inclinations only": partial(_only, columns=(2,)),
    "measured, nothing": partial(_only, columns=()),
    "late messages": _late,
    "lost messages": _lost,
    "come and go": _come_and_go,
    "clock offsets": _clocks,
    "liars, jump": _liars,
    "liars, creep": partial(_liars, ramp=CREEP),
    "liars, collusion": partial(_liars, collude=True),
    "liars, replay": _replay,
    "liars, Sybil": _sybil,
}
"""Kind of fault -> what it makes of a scene; edits happen in this order. Of kinds with the same words before the comma
a world has one at most."""
WEIGHTS = {"noise levels": 10.0}
"""Of a kind among those that are drawn, 1 by default."""
OF_MOTION = {"odometer scale, told", "odometer scale, not told", "odometer slip"}
OF_NEIGHBOURS = {*[*KINDS][[*KINDS].index("NLOS") :]}
"""Kinds that change nothing for a fleet that stands, or without neighbours."""
