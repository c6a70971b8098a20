"""Runs side by side: the same digits as alone, and the algebra of numpy.linalg in every lane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coopoc import V2X, Fleet, JointFilter, NoiseModel, Recording, Sensors, observe

pytest.importorskip("numba")
S2 = Sensors.paper_scenario2()
CHANNELS = [V2X(max_neighbours=4), V2X(max_neighbours=7, loss=0.3, latency=0.2), V2X(max_neighbours=3, loss=1.0)]


def some(recording: Recording, runs: list[int]) -> Recording:
    """Some of the runs."""
    axes = ("gnss", "velocity", "relative", "arrival")
    return replace(recording, **{name: getattr(recording, name)[runs] for name in axes})


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("method", [JointFilter(), JointFilter(exact=False), JointFilter("identity")], ids=str)
def test_a_run_is_to_the_bit_what_it_is_alone(crossing: Fleet, channel: V2X, method: JointFilter) -> None:
    """Neighbours join and leave, and each run loses other messages. A run that is left over is repeated."""
    recording = observe(crossing, S2, channel, runs=6)
    whole = method(recording, [0, 3])
    for runs in ([0], [5], [3, 1], [4, 2, 0], [5, 4, 3, 2, 1]):
        part = method(some(recording, runs), [0, 3])
        np.testing.assert_array_equal(part.x, whole.x[runs])
        np.testing.assert_array_equal(part.covariance, whole.covariance[runs])
        np.testing.assert_array_equal(part.neighbours, whole.neighbours[runs])


def test_the_same_with_process_noise_of_every_size(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=4, loss=0.2), runs=3)
    for std in ((0.3, 0.2, 0.01), (1e-60, 1e-30, 1e-60)):
        method = JointFilter(NoiseModel("fitted", S2, std))
        whole, alone = method(recording, [1]), method(some(recording, [1]), [1])
        np.testing.assert_array_equal(alone.x[0], whole.x[1])
        np.testing.assert_array_equal(alone.covariance[0], whole.covariance[1])


def test_angles_side_by_side_are_those_of_atan2() -> None:
    """Where all are small, where some are, and where one is missing."""
    import numba

    from coopoc.kernels.compiling.vectors import pack, put, take
    from coopoc.kernels.stars.relative import angle

    @numba.njit
    def call(sine, cosine, out):  # type: ignore[no-untyped-def]
        put(out, 0, angle(take(sine, 0), pack(cosine[0], cosine[1], cosine[2], cosine[3])))

    for turns in ([0.01, -0.2, 0.1, 0.0], [0.01, 3.0, -1.0, 0.2], [0.1, np.nan, 0.1, -2.0]):
        out = np.empty(4)
        call(np.sin(turns), np.cos(turns), out)
        np.testing.assert_allclose(out, turns, rtol=1e-15)
