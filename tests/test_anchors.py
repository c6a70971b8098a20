"""Published and independently simulated figures of the paper's scenarios, within 5 %."""

from dataclasses import replace

import numpy as np
import pytest

from coopoc import GNSS, LKFSA, V2X, Kalman, Links, NoiseModel, Sensors, observe
from coopoc.evaluate.metrics import max_error, rt_le

SENSORS = Sensors(gnss_std=(3.5, 3.5, 3.5))


def fixture(fleet, neighbours, ratio=1.0, sensors=SENSORS):
    """Constant process noise, diag(.0707, .0707, .001) m per step, and a start from the fixes alone."""
    recording = observe(fleet, sensors, V2X(max_neighbours=neighbours), runs=40, observers=[0])
    links, late = recording.links, recording.links.step > 0
    recording = replace(
        recording,
        links=Links(links.step[late], links.observer[late], links.neighbour[late]),
        relative=recording.relative[:, late],
        arrival=recording.arrival[:, late],
    )
    noise = np.random.default_rng(7).standard_normal(recording.velocity.shape) * [0.707, 0.707, 0.01]
    return replace(recording, velocity=fleet.velocity + noise * [ratio, ratio, 1.0])


def score(method, recording, fleet):
    """Mean RT-LE over runs from step 1 on: the anchors start at a fix that is not scored."""
    track = method(recording, [0])
    return float(
        rt_le(replace(track, t=track.t[1:], x=track.x[:, 1:], covariance=None), fleet.between(1, len(fleet.t))).mean()
    )


def tuned(ratio=1.0, gnss=3.5):
    return NoiseModel("fitted", SENSORS, process_std=(0.0707 * ratio, 0.0707 * ratio, 0.001), gnss_std=(gnss,) * 3)


@pytest.mark.parametrize(
    ("method", "ratio", "expected"),
    [
        (GNSS(), 1.0, 6.06),
        (Kalman("identity"), 1.0, 4.06),
        (Kalman(tuned()), 1.0, 0.80),
        (Kalman(tuned(1.5)), 1.5, 0.93),
    ],
    ids=["gnss", "identity", "tuned 10 %", "tuned 15 %"],
)
def test_solo_anchors(method, ratio, expected, formation):
    assert score(method, fixture(formation, 0, ratio), formation) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("neighbours", "identity", "weighted"),
    [(1, 3.00, 0.70), (2, 2.48, 0.62), (4, 1.98, 0.51), (6, 1.66, 0.46), (10, 1.35, 0.37)],
)
def test_laplacian_filter_anchors(neighbours, identity, weighted, formation):
    recording = fixture(formation, neighbours)
    pragmatic = NoiseModel("fitted", SENSORS, process_std=(0.07, 0.07, 0.07), gnss_std=(3.5,) * 3)
    assert score(LKFSA("identity"), recording, formation) == pytest.approx(identity, rel=0.05)
    assert score(LKFSA(pragmatic), recording, formation) == pytest.approx(weighted, rel=0.05)


def test_scenario1_anchors(formation):
    """Bias drawn at every sample, 15 %: GNSS 3.38, identity 2.46, tuned 1.42, maxima 8.0 / 5.7 / 3.6 m.

    The last maximum is a 40-run mean of a start-up that varies by 1 m from run to run, so both it and ours have a
    standard error of 0.15 m; the others repeat within 0.1 m.
    """
    sensors = replace(Sensors.paper_scenario1(), gnss_bias_mode="sample")
    assert sensors.gnss_std == (1.8, 1.8, 1.8)
    recording = fixture(formation, 0, 1.5, sensors)
    for method, mean, largest, spread in (
        (GNSS(), 3.38, 8.0, 0.0),
        (Kalman("identity"), 2.46, 5.7, 0.0),
        (Kalman(tuned(1.5, gnss=1.8)), 1.42, 3.6, 0.15),
    ):
        assert score(method, recording, formation) == pytest.approx(mean, rel=0.05)
        assert max_error(method(recording, [0]), formation).mean() == pytest.approx(
            largest, abs=0.05 * largest + 1.5 * spread
        )
