"""Pictures of nouns: what is drawn is where the numbers say, and wrong arguments are named."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy import stats

import coopoc as co
from coopoc.pictures import ellipses


@pytest.fixture(scope="module")
def seen() -> tuple[co.Fleet, co.Recording]:
    fleet = co.load_fleet("town10").between(0, 60)
    return fleet, co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(4), runs=2, seed=0, observers=[24, 3])


def test_an_ellipse_holds_95_percent() -> None:
    """Independent check: chi-square of SciPy, and points drawn by NumPy."""
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    ax = Figure().add_subplot()
    ellipses(ax, np.array([[3.0, -2.0]]), cov[None], "k")
    (patch,) = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    assert patch.width * patch.height == pytest.approx(4 * stats.chi2.ppf(0.95, 2) * np.sqrt(np.linalg.det(cov)))
    points = np.random.default_rng(0).multivariate_normal([3.0, -2.0], cov, 20_000)
    angle = np.radians(patch.angle)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    along = (points - np.array(patch.center)) @ turn / [patch.width / 2, patch.height / 2]
    assert ((along**2).sum(axis=1) < 1).mean() == pytest.approx(0.95, abs=0.005)


def test_a_recording_shows_its_fixes_and_links(seen: tuple[co.Fleet, co.Recording]) -> None:
    _fleet, recording = seen
    ax = recording.plot(run=1, step=20)
    np.testing.assert_array_equal(ax.lines[7].get_xydata(), recording.gnss[1, :, 7, :2])
    (lines,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    assert len(lines.get_segments()) == int((recording.links.step == 20).sum()) > 0
    again = Figure().add_subplot()
    assert recording.plot(again) is again


def test_a_notebook_shows_a_picture_without_pyplot(seen: tuple[co.Fleet, co.Recording]) -> None:
    """IPython's own formatter makes a PNG of the figure; a plain Figure gives text alone."""
    formatters = pytest.importorskip("IPython.core.formatters")

    shown, _ = formatters.DisplayFormatter().format(seen[1].plot(step=1).figure)
    assert shown["image/png"].startswith(b"\x89PNG")


def test_a_track_shows_paths_and_truth(seen: tuple[co.Fleet, co.Recording]) -> None:
    fleet, recording = seen
    track = co.JointFilter("nominal")(recording, [24, 3])
    ax = track.plot(fleet=fleet, every=20)
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), fleet.position[:, 24, :2])
    np.testing.assert_array_equal(ax.lines[3].get_xydata(), track.x[0, :, 1, :2])
    assert len(ax.patches) == 2 * 3
    assert len(co.GNSS()(recording, [24]).plot().patches) in (0, 60)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"run": 2}, r"run = 2: must be in 0\.\.1"),
        ({"step": -1}, r"step = -1: must be in 0\.\.59"),
        ({"ax": "here"}, r"ax = 'here': must be axes of matplotlib"),
    ],
)
def test_what_cannot_be_drawn_is_named(
    seen: tuple[co.Fleet, co.Recording], options: dict[str, object], message: str
) -> None:
    with pytest.raises(co.InputError, match=message):
        seen[1].plot(**options)  # type: ignore[arg-type]


def test_a_track_names_wrong_arguments(seen: tuple[co.Fleet, co.Recording]) -> None:
    track = co.Kalman()(seen[1], [24])
    for options, message in (({"every": 0}, "every = 0"), ({"fleet": seen[0].between(0, 9)}, "must have 60 steps")):
        with pytest.raises(co.InputError, match=message):
            track.plot(**options)
