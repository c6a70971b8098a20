"""A heading that is wrong: what it turns, and what it costs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coopoc import V2X, Fleet, Sensors, observe, run_study
from coopoc.methods.noise_model import NoiseModel
from coopoc.studies.views import of
from coopoc.study import numbers
from coopoc.world.links import wrap

NOISE = Sensors(heading_std=0.05)
BIAS = Sensors(heading_bias_std=0.05)


def test_a_heading_turns_all_that_is_seen_at_a_step_alike(crossing: Fleet) -> None:
    """Against the same draws without it: azimuths of one observer and step move by one number, nothing else moves."""
    v2x, plain = V2X(4, 80.0), observe(crossing, Sensors(), V2X(4, 80.0), runs=30)
    for sensors, per_step in ((NOISE, True), (BIAS, False)):
        seen = observe(crossing, sensors, v2x, runs=30)
        np.testing.assert_array_equal(seen.gnss, plain.gnss)
        np.testing.assert_array_equal(seen.relative[..., [0, 2]], plain.relative[..., [0, 2]])
        turned, mine = wrap(seen.relative[..., 1] - plain.relative[..., 1]), plain.links.of(2)
        steps = plain.links.step[mine]
        for t in np.unique(steps):
            assert np.ptp(turned[:, mine[steps == t]], axis=1) == pytest.approx(np.zeros(30), abs=1e-9)
        assert (np.ptp(turned[:, mine], axis=1) > 1e-3).all() == per_step
        assert turned.std() == pytest.approx(0.05, rel=0.2)


def test_nominal_knowledge_adds_the_heading_to_the_azimuth() -> None:
    both = replace(NOISE, heading_bias_std=0.12, azimuth_std=0.0)
    known = NoiseModel.nominal(replace(both, azimuth_std=1e-12))
    assert known.sensors is not None
    assert known.sensors.azimuth_std == pytest.approx(0.13)
    assert NoiseModel.nominal(Sensors()).sensors == Sensors()


@pytest.mark.slow
def test_the_study_shows_what_a_heading_costs(tmp_path: Path) -> None:
    wanted = {"runs": 4, "speed": "0.0,10.0", "after_s": "3.0,30.0", "max_neighbours": "0,2", "compass": "exact,3,none"}
    results = run_study("heading_error", tmp_path, settings=wanted, progress=False)
    pose, first, joint = ("pose-fleet", "nominal"), ("pose-fleet", "first compass"), ("joint", "nominal")
    at = {"speed": 10.0, "after_s": 30.0, "max_neighbours": 2}
    exact, estimated, noise, once, turned = (
        numbers.mean(results, of(*line, **at, compass=compass)) or np.nan
        for line, compass in ((pose, "exact"), (pose, "none"), (pose, "3"), (first, "3"), (joint, "3"))
    )
    assert exact < estimated < noise < turned
    assert once < noise
    for k, method, least, most in ((0, "pose-solo", 60.0, 180.0), (2, "pose-fleet", 0.3, 4.0), (2, "bound", 0.3, 4.0)):
        still = numbers.rms(
            results,
            {"method": method, "max_neighbours": k, "compass": "none", "speed": 0.0, "after_s": 3.0},
            "heading_deg",
        )
        assert still is not None
        assert least < still < most
    assert "Position filter" in (tmp_path / "heading_error" / "tables" / "compass.md").read_text()
