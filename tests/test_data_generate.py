"""The generator: the same seed gives the same bytes, and wrong recipes are refused."""

import importlib.util
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
from conftest import measured, refused
from numpy import pi
from scipy import signal
from scipy.spatial import cKDTree
from shell import ROOT

from coopoc import load_fleet
from coopoc.data.registry import bundled, card
from coopoc.errors import MissingLibraryError
from coopoc.study.run import run_study

SCRIPT = ROOT / "examples" / "make_fleet.py"
spec = importlib.util.spec_from_file_location("make_fleet", SCRIPT)
assert spec is not None
assert spec.loader is not None
script = sys.modules["make_fleet"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(script)
Recipe, make, smooth = script.Recipe, script.make, script.smooth
TINY = Recipe("tiny", "Town10HD.xodr", vehicles=6, steps=(60, 60, 60, 60, 60, 40), seed=1, platoon=2)
with_sumo = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="eclipse-sumo is not installed: pip install 'coopoc[sumo]'"
)


@with_sumo
def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path):
    one, two = (make(TINY, measured("Town10HD.xodr").parent, tmp_path / name) for name in ("one", "two"))
    other = make(replace(TINY, seed=2), measured("Town10HD.xodr").parent, tmp_path / "other")
    for suffix in ("parquet", "json"):
        assert (tmp_path / "one" / f"tiny.{suffix}").read_bytes() == (tmp_path / "two" / f"tiny.{suffix}").read_bytes()
    assert one == two
    assert other["sha256"] != one["sha256"]
    fleet = load_fleet(tmp_path / "one" / "tiny.parquet")
    assert fleet.digest == one["sha256"]
    assert fleet.present.sum(0).tolist() == [60, 60, 60, 60, 60, 40]
    assert one["speed"]["max"] > 2


@with_sumo
def test_a_bundled_fleet_is_made_again_bit_by_bit(tmp_path):
    """The smallest one here; all four were made again by hand with the SUMO that their cards name."""
    stated = card("town10-clients")
    if version("eclipse-sumo") != stated["sumo"]:
        pytest.skip(f"the bundled fleets were made with eclipse-sumo {stated['sumo']}")
    made = make("town10-clients", measured("Town10HD.xodr").parent, tmp_path)
    assert made == {**stated, "recipe": made["recipe"]}
    assert Recipe(**made["recipe"]) == script.bundled_recipe("town10-clients")


def test_elevation_is_that_of_the_map():
    """Independent check: elevation polynomials of the OpenDRIVE file at its reference lines, without netconvert."""
    points = []
    for road in ElementTree.parse(measured("Town04.xodr")).getroot().iter("road"):
        profile = [[float(e.attrib[k]) for k in "sabcd"] for e in road.iter("elevation")]
        for g in road.iter("geometry"):
            start, a, b, c, d = next(row for row in reversed(profile) if row[0] <= float(g.attrib["s"]) + 1e-9)
            along = float(g.attrib["s"]) - start
            points.append([float(g.attrib["x"]), float(g.attrib["y"]), a + along * (b + along * (c + along * d))])
    lines, x = np.array(points), bundled("town04").position[::10].reshape(-1, 3)
    near = cKDTree(lines[:, :2]).query_ball_point(x[:, :2], 12.0)
    error = [abs(lines[index, 2] - z).min() for index, z in zip(near, x[:, 2], strict=True) if index]
    assert len(error) > 1000, "positions beside the start of a piece of a reference line"
    assert np.percentile(error, 95) < 0.6
    assert np.ptp([z for index, z in zip(near, x[:, 2], strict=True) if index]) > 10


def test_smoothing_halves_the_cutoff_and_keeps_slow_motion():
    """Closed form of the gain, 1/(1 + (f/fc)^6), and the frequency response of sin by its amplitude."""
    t = np.arange(2000) * 0.1
    for f, gain in ((0.05, 1.0), (0.5, 0.5), (1.0, 1 / (1 + 2.0**6))):
        out = smooth(np.sin(2 * pi * f * t), 0.1, 0.5)[500:1500]
        window = signal.windows.hann(1000)
        amplitude = 2 * abs(np.sum(window * out * np.exp(-2j * pi * f * t[500:1500]))) / window.sum()
        assert amplitude == pytest.approx(gain, abs=0.03)


def test_smoothing_solves_the_penalised_least_squares():
    """Independent check: numpy.linalg.lstsq on the stacked problem."""
    x = np.random.default_rng(0).normal(size=(40, 3))
    weight = (2 * pi * 0.5 * 0.1) ** -3
    stacked = np.vstack([np.eye(40), weight * np.diff(np.eye(40), n=3, axis=0)])
    np.testing.assert_allclose(
        smooth(x, 0.1, 0.5), np.linalg.lstsq(stacked, np.vstack([x, np.zeros((37, 3))]), rcond=None)[0], atol=1e-9
    )


@with_sumo
def test_a_missing_map_is_named(tmp_path):
    with refused(r"Town10HD\.xodr"):
        make(TINY, tmp_path, tmp_path)


def test_without_sumo_the_pip_line_is_shown(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingLibraryError, match=r"pip install .*\[sumo\]'"):
        script.program("sumo")


@with_sumo
def test_what_was_made_is_loaded(tmp_path):
    made = tmp_path / "tiny.parquet"
    make(TINY, measured("Town10HD.xodr").parent, tmp_path)
    fleet = load_fleet(made)
    assert load_fleet(f"{made}?format=table").digest == fleet.digest
    settings = {"data": str(made), "method": "kalman", "max_neighbours": "0", "runs": 1}
    assert not run_study("side_by_side", tmp_path / "runs", settings=settings, progress=False).failed
