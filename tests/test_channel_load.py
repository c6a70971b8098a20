"""Channel load: air time that a fleet's messages ask for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from coopoc import Fleet, InputError, channel_load


@pytest.mark.parametrize(("rate", "share"), [(10.0, 1.4), (2.5, 0.35)])
def test_three_hundred_vehicles_saturate_the_channel_at_ten_hertz(rate: float, share: float) -> None:
    """methods.md section 9.4: 300 x 350 B x 10 Hz = 8.4 Mb/s of 6 Mb/s; at 2.5 Hz 2.1 Mb/s, 35 %."""
    jam = np.random.default_rng(0).uniform(-80, 80, (300, 3))
    assert channel_load(jam, 350, rate) == pytest.approx(np.full(300, share))


def test_each_receives_the_messages_in_range(crossing: Fleet) -> None:
    """Against SciPy's distances, with sizes and rates of their own, and someone absent."""
    rng = np.random.default_rng(1)
    size, rate, place = rng.uniform(100, 400, 8), rng.uniform(1, 10, 8), crossing.position.copy()
    place[20:40, 3] = np.nan
    found = channel_load(place, size, rate, carrier_sense=40.0, bit_rate=1e5)
    for t in (0, 25, 59):
        near = cdist(place[t], place[t]) <= 40.0
        wanted = near @ (8 * size * rate / 1e5)
        wanted[np.isnan(place[t, :, 0])] = np.nan
        np.testing.assert_allclose(found[t], wanted)
    assert np.isnan(found).sum() == 20


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"position": np.zeros(3)}, "position"),
        ({"size": -1.0}, "size"),
        ({"rate": [1.0, 2.0]}, "rate = .*must be a number >= 0, or 3"),
        ({"carrier_sense": float("nan")}, "carrier_sense"),
        ({"bit_rate": 0.0}, "bit_rate"),
    ],
)
def test_what_cannot_be_is_named(given: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        channel_load(**{"position": np.zeros((3, 3)), "size": 350.0, "rate": 10.0, **given})
