"""The ledger: training and online cooperation on one axis, as payload and on air, sent once and per receiver."""

import numpy as np
import pytest
from conftest import refused
from numpy.testing import assert_allclose, assert_array_equal

from coopoc import V2X, BatchSmoother, JointFilter, Kalman, Ledger, Sensors, observe
from coopoc.evaluate.ledger import of_track, of_training
from coopoc.world.v2x import NO_MESSAGE

S2 = Sensors.paper_scenario2()


def test_the_ledger_of_a_track_is_its_bytes(crossing):
    """Payload by hand: 32 of 132 B; to a centre as many as were measured."""
    seen, plain = (observe(crossing, S2, V2X(3, overhead=size), runs=2) for size in (100, 0))
    for method in (JointFilter(), BatchSmoother()):
        track, bare = method(seen, [1, 4]), method(plain, [1, 4])
        account = of_track(track, seen, method.message)
        assert account.names == ("c1", "c4")
        assert_array_equal(account.of("on air"), track.received_bytes)
        assert_array_equal(account.of("on air", "broadcast"), track.sent_bytes)
        assert_allclose(account.of(), bare.received_bytes, rtol=1e-12)
        assert_allclose(account.of(way="broadcast"), bare.sent_bytes, rtol=1e-12)
        assert account.rate("on air") == pytest.approx(track.received_bytes.mean() / 6.0)
    alone = of_track(Kalman()(seen, [1]), seen, NO_MESSAGE)
    assert alone.rate() == alone.rate("on air", "broadcast") == 0.0


def test_the_papers_training_costs_as_much_as_an_hour_of_driving():
    """20 rounds of 19,938 weights both ways are 3.2 MB per vehicle: about an hour of a CAM
    stream of 0.9 kB/s, or 15 min of 350 B at 10 Hz."""
    weights = 20 * 4 * 19_938.0
    once = of_training(["a", "b", "server"], [weights] * 3, [weights, weights, 2 * weights], ["server"])
    assert once.per_vehicle() == pytest.approx(3.19e6, rel=1e-3)
    assert once.per_vehicle(way="broadcast") == 1.5 * weights
    for rate, minutes in ((900.0, 59.1), (3500.0, 15.2)):
        moved = np.full((2, 1, 1), 2 * rate)
        assert once.per_vehicle() / Ledger(("a",), np.full(1, 2.0), moved, moved).rate() / 60 == pytest.approx(
            minutes, abs=0.05
        )
    with refused("seconds"):
        once.rate()


def test_a_ledger_refuses_what_does_not_fit():
    none = np.zeros((2, 1, 1))
    with refused("seconds"):
        Ledger(("a",), np.zeros(2), none, none)
    with refused("names"):
        Ledger(("a",), np.zeros(1), none, none, servers=("server",))
    with refused("kind"):
        of_training(["a"], [1.0], [1.0]).of("wire")  # type: ignore[arg-type]
