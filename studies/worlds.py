"""Worlds: random draws of fleets, sensors, channels and faults, on which a cooperative filter is judged."""

import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy import pi

from coopoc import V2X, Fleet, Recording, Sensors, load_fleet, observe
from coopoc.arrays import Floats, one_of, whole
from coopoc.world.body_frames import turned

from .world_faults import EGOS, KINDS, OF_MOTION, OF_NEIGHBOURS, RUNS, WEIGHTS, Draws, Scene, log_uniform

Split = Literal["test", "validation", "development"]
SPLITS = get_args(Split)
STEP_SECONDS = (0.05, 0.1, 0.1, 0.2, 0.5, 1.0)
"""s between two steps, each as probable as it stands here."""
COUNTS = (0.2, 0.3, 0.3, 0.2)
"""Probability of zero to three kinds of fault."""


class World(NamedTuple):
    """A draw of all that a method may meet in a drive of 40 to 60 s.

    Attributes:
        seed: of the draw within its split.
        recording: what methods see, in four noise draws; it names no fault.
        fleet: the truth.
        egos: two columns, whose own estimates are scored.
        kinds: of fault, in words; none where all is as it is assumed to be.
        text: the world in one line.
    """

    seed: int
    recording: Recording
    fleet: Fleet
    egos: tuple[int, ...]
    kinds: tuple[str, ...]
    text: str


def world(seed: int, split: Split = "test", *, without: Collection[str] = (), everyone: bool = False) -> World:
    """The world of a seed, the same in every process.

    Args:
        seed: 0, 1, ...
        split: "test"; "validation", on which parameters are chosen; "development", which may be looked at. No two
            splits share a draw, and the first shares no town with the others.
        without: kinds of fault that are left out; all other draws stay as they are.
        everyone: whether all vehicles observe, as methods need that estimate a whole fleet; the egos alone else.

    Raises:
        InputError: a seed below 0, another split, an unknown kind.

    >>> found = world(1, "development")
    >>> found.recording.runs, len(found.egos)
    (4, 2)
    """
    seed = whole("seed", seed, 0, 2**30, "Count worlds from 0.")
    key = 3 * seed + SPLITS.index(one_of("split", split, Split))
    for kind in without:
        one_of("without", kind, KINDS)
    scene = _nominal(key, split)
    kinds = [kind for kind in _kinds(_rng(key, "kinds"), scene) if kind not in without]
    texts = [_text(scene)]
    for kind in kinds:
        scene, words = KINDS[kind](scene, _rng(key, kind))
        texts.append(f"{kind}: {words}")
    recording = observe(
        scene.fleet,
        scene.acting,
        scene.v2x,
        runs=RUNS,
        seed=key,
        observers=None if everyone else scene.egos,
        assumed=scene.assumed,
    )
    for edit in scene.edits:
        recording = edit(recording)
    return World(seed, replace(recording, notes=()), scene.fleet, scene.egos, tuple(kinds), "; ".join(texts))


def _rng(key: int, *words: str) -> Draws:
    return np.random.default_rng([key, *(zlib.crc32(word.encode()) for word in words)])


def _kinds(rng: Draws, scene: Scene) -> list[str]:
    """Kinds of fault in the order of KINDS, no two alternatives ("drift, told" and "drift, not told") at once."""
    possible = [kind for kind in KINDS if not (scene.v2x.max_neighbours == 0 and kind in OF_NEIGHBOURS)]
    if scene.fleet.name == "standing":
        possible = [kind for kind in possible if kind not in OF_MOTION]
    weights = np.array([WEIGHTS.get(kind, 1.0) for kind in possible])
    order = rng.choice(len(possible), len(possible), replace=False, p=weights / weights.sum())
    chosen = dict[str, str]()
    for kind in (possible[k] for k in order):
        chosen.setdefault(kind.split(",")[0], kind)
    count = rng.choice(len(COUNTS), p=COUNTS)
    return sorted([*chosen.values()][:count], key=[*KINDS].index)


def _nominal(key: int, split: Split) -> Scene:
    """Fleet, egos, levels that are assumed and act, and an ideal channel."""
    rng = _rng(key, "scene")
    dt, seconds = float(rng.choice(STEP_SECONDS)), rng.uniform(40.0, 60.0)
    t = dt * np.arange(round(seconds / dt) + 1)
    name = str(rng.choice([*DRIVES]))
    before = DRIVES[name](rng, np.append(-dt, t), split)
    ids = tuple(f"v{k}" for k in range(before.shape[1]))
    fleet = Fleet(ids, t, before[1:], np.diff(before, axis=0) / dt, name=name)
    egos = tuple(sorted(rng.choice(len(ids), EGOS, replace=False).tolist()))
    angle = float(np.deg2rad(log_uniform(rng, 0.5, 6.0)))
    sensors = Sensors(
        gnss_std=(log_uniform(rng, 0.5, 5.0),) * 3,
        velocity_std_ratio=log_uniform(rng, 0.02, 0.2),
        range_std=log_uniform(rng, 0.1, 2.0),
        azimuth_std=angle,
        inclination_std=angle,
    )
    v2x = V2X(max_neighbours=int(rng.integers(0, 11)), radius=float(rng.choice((30.0, 30.0, 60.0, 100.0))))
    return Scene(fleet, egos, sensors, sensors, v2x, key)


def _text(scene: Scene) -> str:
    assumed, fleet = scene.assumed, scene.fleet
    return (
        f"{fleet.name}, {len(fleet.ids)} vehicles, {fleet.t[-1]:.0f} s in steps of {fleet.dt:g} s, "
        f"K = {scene.v2x.max_neighbours} within {scene.v2x.radius:g} m, fixes {assumed.gnss_std[0]:.2g} m, velocities "
        f"{100 * assumed.velocity_std_ratio:.2g} %, ranges {assumed.range_std:.2g} m, "
        f"angles {np.rad2deg(assumed.azimuth_std):.2g}°"
    )


# Drives: positions (T, N, 3) m at times t s


def _town(rng: Draws, t: Floats, split: Split) -> Floats:
    town = _loaded(str(rng.choice(("town10", "town04"))) if split == "test" else "town10-validation")
    start = (rng.uniform(1.5, town.t[-1] - t[-1] - town.dt) + t) / town.dt
    step = start.astype(int)
    share = (start - step)[:, None, None]
    position: Floats = (1.0 - share) * town.position[step] + share * town.position[step + 1]
    return position


_loaded = lru_cache(load_fleet)


def _column(rng: Draws, travelled: Floats, gap: tuple[float, float]) -> Floats:
    """Vehicles behind one another on a straight road of two lanes in any direction, from distances (T, N) m."""
    count = travelled.shape[1]
    along = travelled - np.cumsum(rng.uniform(*gap, count))
    across = 3.5 * rng.integers(0, 2, count) + 0.3 * np.sin(along / 40.0 + rng.uniform(0, 6, count))
    return turned(np.stack([along, across, rng.uniform(-0.04, 0.04) * along], -1), np.array(rng.uniform(-pi, pi)))


def _platoon(rng: Draws, t: Floats, _: Split) -> Floats:
    count, speed, period = int(rng.integers(4, 11)), rng.uniform(6.0, 30.0), rng.uniform(15.0, 40.0)
    wave = 0.2 * speed * period / (2 * pi) * np.sin(2 * pi * (t[:, None] / period + 0.03 * np.arange(count)))
    return _column(rng, speed * t[:, None] + wave, (8.0, 25.0))


def _stop_and_go(rng: Draws, t: Floats, _: Split) -> Floats:
    count, speed, period = int(rng.integers(4, 11)), rng.uniform(4.0, 14.0), rng.uniform(12.0, 30.0)
    fine = np.linspace(t[0] - 30.0, t[-1], 4000)
    share = np.clip(0.5 + 1.2 * np.sin(2 * pi * fine / period), 0.0, 1.0)
    travelled = np.append(0.0, np.cumsum(share[1:])) * speed * (fine[1] - fine[0])
    reacts = rng.uniform(0.5, 2.0) * np.arange(count)  # the wave runs backwards
    return _column(rng, np.interp(t[:, None] - reacts, fine, travelled), (8.0, 20.0))


def _circle(rng: Draws, t: Floats, _: Split) -> Floats:
    count, radius, speed = int(rng.integers(4, 11)), rng.uniform(12.0, 45.0), rng.uniform(3.0, 12.0)
    ring = radius + rng.uniform(-3.0, 3.0, count)
    angle = speed / radius * t[:, None] + 2 * pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count
    return _points(rng, ring * np.cos(angle), ring * np.sin(angle))


def _crossing(rng: Draws, t: Floats, _: Split) -> Floats:
    count = int(rng.integers(8, 17))
    speed, passes = rng.uniform(4.0, 12.0, count), np.sort(rng.uniform(0.0, t[-1], count))
    along, side = speed * (t[:, None] - passes), rng.uniform(2.0, 6.0, count)
    return turned(_points(rng, along, side), np.broadcast_to(pi / 2 * rng.integers(0, 4, count), along.shape))


def _standing(rng: Draws, t: Floats, _: Split) -> Floats:
    count = int(rng.integers(3, 11))
    grid = np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)
    position = rng.uniform(5.0, 9.0) * rng.permutation(grid)[:count] + rng.uniform(-1.0, 1.0, (count, 2))
    return _points(rng, *np.broadcast_to(position.T[:, None], (2, len(t), count)))


def _points(rng: Draws, x: Floats, y: Floats) -> Floats:
    """(T, N, 3) of x (T, N) and a y that broadcasts, at heights that are drawn."""
    return np.stack(np.broadcast_arrays(x, y, rng.uniform(-2.0, 2.0, x.shape[1])), axis=-1)


DRIVES: Mapping[str, Callable[[Draws, Floats, Split], Floats]] = {
    "town": _town,
    "platoon": _platoon,
    "circle": _circle,
    "stop and go": _stop_and_go,
    "crossing": _crossing,
    "standing": _standing,
}
