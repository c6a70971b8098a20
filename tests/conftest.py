"""Fleets that tests share."""

import importlib
import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from make_fleet import write_table
from numpy import arange, cos, nan, pi, sin
from numpy.random import default_rng
from scipy import stats

from coopoc import V2X, Fleet, Sensors, load_fleet, observe
from coopoc.data.fetch import public
from coopoc.errors import InputError

collect_ignore = ["fuzz"]
"""Its programs need atheris; what they found is replayed by test_data_fuzz.py."""
MEASURED = os.environ.get("COOPOC_TEST_DATA", "")
"""Folder of measurements of others, with what `coopoc data get` fetches; files are found by name, however deep."""
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])
DESCENTS = pytest.mark.parametrize("backend", ["gauss-newton", "gtsam"])


@cache
def located(name):
    """Path of a file or folder of the measurements."""
    folder = Path(MEASURED)
    return (folder if name == "." else next(iter(sorted(folder.rglob(name))), None)) if MEASURED else None


def measured(name=""):
    """The same, or the whole folder; skips, and says how to get them, where they are absent."""
    if path := located(name or "."):
        return path
    gets = [
        f"run coopoc data get {key}"
        for key, one in public().items()
        if f"/{name}" in f"/{one.opens} /{' /'.join(one.files)}"
    ]
    how = gets[0] if gets and name else "CONTRIBUTING.md says where they are"
    pytest.skip(f"no {name or 'measurements'}: {how}, then set COOPOC_TEST_DATA to the folder of all")


def pytest_terminal_summary(terminalreporter, config):
    """Leave what was skipped, a line a test: `pytest @.pytest_cache/d/skipped/tests` runs that alone."""
    if cache := getattr(config, "cache", None):
        skipped = {report.nodeid for report in terminalreporter.stats.get("skipped", ())}
        (cache.mkdir("skipped") / "tests").write_text("\n".join(sorted(skipped)))


def refused(match):
    """Context in which something is refused, with these words."""
    return pytest.raises(InputError, match=match)


def same_minimum(theirs, ours):
    """Of two solutions: cost to 1e-9, estimates and covariances to 1e-6."""
    assert theirs.cost == pytest.approx(ours.cost, rel=1e-9)
    assert theirs.x == pytest.approx(ours.x, abs=1e-6)
    assert theirs.covariance == pytest.approx(ours.covariance, abs=1e-6)


def half_width(runs):
    """Of the interval in which the mean of runs (R,) lies in 99 % of all cases, by Student's t."""
    return float(stats.t.ppf(0.995, len(runs) - 1) * runs.std(ddof=1) / np.sqrt(len(runs)))


def textbook(method):
    """The method without gates, as its oracle is written."""
    return replace(method, robust=False)


def winding(steps=60, speed=8.0, period=3.0, vehicles=1):
    """Sinuous drives with x_t = x_{t-1} + dt u_t: turning at 1 / period rad/s."""
    t = arange(steps) / 10
    wave = t[:, None] / period + arange(vehicles)
    velocity = speed * np.stack([cos(wave), sin(wave), 0.03 * cos(wave)], axis=-1)
    return Fleet(tuple("abcdefgh"[:vehicles]), t, np.cumsum(0.1 * velocity, 0), velocity)


def moving(letter, t, position):
    """With backward differences as velocity; the first step has that of the second."""
    velocity = np.diff(position, axis=0, prepend=2 * position[:1] - position[1:2]) / 0.1
    return Fleet(tuple(f"{letter}{i}" for i in range(position.shape[1])), t, position, velocity)


def formation_fleet(vehicles=11, steps=901):
    """Rigid formation within 30 m on a gently sinuous path at 10 m/s: ten on a ring (docs/decisions.md)."""
    t = arange(steps) * 0.1
    course = 0.3 * sin(2 * pi * t / 60)
    path = np.cumsum(np.c_[cos(course), sin(course), 0 * t], axis=0)
    around = np.linspace(0, 2 * pi, vehicles - 1, endpoint=False)
    gap = np.linspace(22.0, 22.1, vehicles - 1)
    offset = np.vstack([np.zeros(3), np.c_[gap * cos(around), gap * sin(around), 0 * gap]])
    return moving("v", t, path[:, None] + offset)


def crossing_fleet():
    """Vehicles that cross a square of 60 m at their own heights and speeds: neighbours come and go, z matters."""
    rng, t = default_rng(3), arange(60) * 0.1
    start = rng.uniform(-30, 30, (8, 3)) * [1, 1, 0.1]
    speed = rng.normal(0, 6, (8, 3)) * [1, 1, 0.05]
    wobble = sin(t[:, None, None] + arange(8)[:, None])
    return moving("c", t, start + t[:, None, None] * speed + wobble * [1.0, 0.5, 0.1])


def without(fleet, *away):
    """The fleet whose vehicles are away: (steps, columns)."""
    there = np.ones(fleet.position.shape)
    for steps, columns in away:
        there[steps, columns] = nan
    return replace(fleet, position=there * fleet.position, velocity=there * fleet.velocity)


def coming_and_going(fleet):
    """Vehicles 2 to 4 come late, 4 to 6 leave early."""
    return without(fleet, (slice(len(fleet.t) // 3), slice(2, 5)), (slice(2 * len(fleet.t) // 3, None), slice(4, 7)))


def standing(position, steps=2):
    """Vehicles that stand."""
    where = np.repeat(np.array(position, float)[None], steps, axis=0)
    return Fleet(tuple(f"s{i}" for i in range(len(position))), arange(steps) * 0.1, where, np.zeros_like(where))


def with_masts(fleet, places):
    """And landmarks m0, m1, ... at (M, 3) m."""
    stand = np.broadcast_to(places, (len(fleet.t), *np.shape(places)))
    position, velocity = (np.append(a, b, 1) for a, b in ((fleet.position, stand), (fleet.velocity, 0 * stand)))
    return Fleet((*fleet.ids, *(f"m{k}" for k in range(len(places)))), fleet.t, position, velocity)


def among(many, few):
    """Which links are also those of a recording with fewer neighbours."""
    return np.isin(*[links.step * 10**6 + links.observer * 1000 + links.neighbour for links in (many, few)])


def holed(recording, share=0.3, vehicles=slice(None)):
    """The recording without a share of the fixes; the first ones stay."""
    gnss = recording.gnss.copy()
    gone = default_rng(5).uniform(size=gnss.shape[:3]) < share
    gone[:, 0] = False
    gnss[:, :, vehicles][gone[:, :, vehicles]] = nan
    return replace(recording, gnss=gnss)


def slow_fixes(recording, every=10):
    """A fix at every so many steps: at 1 Hz in data of 10 Hz."""
    return replace(recording, gnss=np.where(arange(len(recording.t))[:, None, None] % every, nan, recording.gnss))


@pytest.fixture(scope="module")
def study():
    """The small study that is installed as a third party's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent / "distribution"))
        yield importlib.import_module("small_study").STUDY


@pytest.fixture(scope="session")
def formation():
    return formation_fleet()


@pytest.fixture(scope="session")
def crossing():
    return crossing_fleet()


@pytest.fixture(scope="session")
def dense(formation):
    """Ten neighbours at 22 m."""
    return observe(formation.between(0, 40), Sensors.paper_scenario2(), V2X(10), runs=4, observers=[0])


@pytest.fixture(scope="session")
def short_town(tmp_path_factory):
    """Path of the first fifteen seconds of the bundled town, for studies that need no more."""
    path = tmp_path_factory.mktemp("town") / "short.csv"
    write_table(load_fleet("town10").between(0, 150), path)
    return str(path)
