"""What says that a method is lost, keeps a net in its plane, and refuses weights that are no use."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import refused, winding

from coopoc import V2X, Kalman, NoiseModel, Recording, Sensors, observe
from coopoc.arrays import Floats
from coopoc.evaluate.scores import scored
from coopoc.learned import GainNet, LearnedGain, recipes, train_all
from coopoc.learned.recipes import Recipe
from coopoc.learned.training.schedule import Schedule
from coopoc.methods.track import far_off
from coopoc.study.tables import lost

FLEET = winding(300, 10.0, 7.0)


def seen(**noise: float) -> Recording:
    return observe(FLEET, Sensors(**noise), V2X(max_neighbours=0), runs=3)  # type: ignore[arg-type]


def test_a_filter_that_leaves_the_fixes_says_so_in_its_notes_and_in_the_table() -> None:
    """Process noise of 1 um a step beside odometry that is a tenth too fast, at 10 m/s: 300 m in five minutes."""
    recording = seen()
    blind = Kalman(NoiseModel("blind", process_std=(1e-6,) * 3, gnss_std=(1e3,) * 3))
    fast = replace(recording, velocity=10.0 * recording.velocity)
    track = blind(fast)
    far = np.linalg.norm(track.x - fast.gnss, axis=-1).max() / np.linalg.norm(fast.sensors.gnss_std)
    assert far > 100
    assert far_off(track.x, fast, [0]).all()
    assert track.notes[0].startswith("diverged in 3 of 3 runs")
    assert not far_off(Kalman()(recording).x, recording, [0]).any()
    assert Kalman()(recording).notes == ()
    columns = scored(blind, fast, FLEET.ids, FLEET)
    assert columns["left_fixes"].tolist() == [[1.0]] * 3

    class Results:
        def select(self, where: object) -> pd.DataFrame:
            return pd.DataFrame({"method": ["kalman"] * 3 + ["joint"], "left_fixes": [1.0, 1.0, 0.0, 0.0]})

    (note,) = lost(Results())  # type: ignore[arg-type]
    assert note.startswith("KF diverged in 2 rows")


def test_no_net_invents_a_height() -> None:
    """Fixes and velocities of a drive in one plane have none: it is held to the last digit, and what moves is not."""
    net, recording = GainNet(4, 1), seen()
    gnss: Floats = recording.gnss.copy()
    gnss[..., 2], gnss[:, 50:60] = 7.0, np.nan
    flat = replace(recording, gnss=gnss, velocity=recording.velocity * [1.0, 1.0, 0.0])
    assert (LearnedGain(net)(flat).x[..., 2] == 7.0).all()
    assert np.ptp(LearnedGain(net)(recording).x[..., 2]) > 0.1


def test_useless_weights_are_not_saved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A net that starts far from a stable gain and takes one tiny step, unless it is asked for."""
    bad = Recipe("centralised", Schedule(epochs=1, learning_rate=1e-9), piece=20, options=(("start_gain", 0.9),))
    monkeypatch.setitem(recipes.RECIPES, "centralised", bad)
    with refused("times that of a Kalman filter with fitted noise"):
        train_all(FLEET, tmp_path, seeds=[0], recipes=["centralised"], progress=False, worst=1.1)
    assert not list(tmp_path.iterdir())
    assert train_all(FLEET, tmp_path, seeds=[0], recipes=["centralised"], progress=False)
