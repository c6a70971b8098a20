"""Runs abreast: the same digits as alone, and the algebra of numpy.linalg in every lane."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from coopoc import V2X, Fleet, JointFilter, Knowledge, Recording, Sensors, observe

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
    """Neighbours join and leave, and each run loses other messages. Alone is the kernel of one run."""
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
        method = JointFilter(Knowledge("fitted", S2, std))
        whole, alone = method(recording, [1]), method(some(recording, [1]), [1])
        np.testing.assert_array_equal(alone.x[0], whole.x[1])
        np.testing.assert_array_equal(alone.covariance[0], whole.covariance[1])


def lanes_of(matrices: np.ndarray) -> np.ndarray:
    """(4, 3n, 3n) as blocks on a flat array, the run innermost, what is below the diagonal spoilt."""
    n = matrices.shape[1] // 3
    blocks = matrices.reshape(4, n, 3, n, 3).transpose(1, 3, 2, 4, 0).copy()
    blocks[np.tril_indices(n, -1)] = np.nan
    return blocks.ravel()


@pytest.mark.parametrize("n", [1, 2, 5, 11])
def test_elimination_abreast_is_that_of_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    root, b = rng.normal(size=(4, 3 * n, 6 * n)), rng.normal(size=(4, 3 * n))
    full = root @ root.swapaxes(1, 2)
    a, x = lanes_of(full), b.T.ravel()
    solver()(a, x, n, np.empty(36 * n))
    np.testing.assert_allclose(x.reshape(-1, 4).T, np.linalg.solve(full, b[..., None])[..., 0], rtol=1e-9)


@cache
def solver() -> Any:
    """Vectors can not leave compiled code, so that the last pivot stays there."""
    import numba

    from coopoc.kernels.blocks_abreast import eliminate, substitute

    @numba.njit
    def solve(a, x, n, memory):  # type: ignore[no-untyped-def]
        eliminate(a, a, x, n, n, memory)
        substitute(a, x, n, n)

    return solve


@pytest.mark.parametrize("n", [1, 4, 11])
def test_what_may_move_abreast_is_as_in_covariance_form(n: int) -> None:
    """Against numpy.linalg.inv of covariance + Q."""
    from coopoc.kernels.blocks_abreast import loosen

    rng = np.random.default_rng(n)
    root, q = rng.normal(size=(4, 3 * n, 6 * n)), 10.0 ** rng.uniform(-3, 3, (4, 3 * n))
    full = root @ root.swapaxes(1, 2)
    a = lanes_of(full)
    loosen(a, n, n, (1 / q).T.ravel(), np.empty(72 * n))
    found = a.reshape(n, n, 3, 3, 4).transpose(4, 0, 2, 1, 3).reshape(full.shape)
    expected = np.linalg.inv(np.linalg.inv(full) + q[:, :, None] * np.eye(3 * n))
    upper = np.triu_indices(3 * n)
    np.testing.assert_allclose(found[:, *upper], expected[:, *upper], rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_angles_abreast_are_those_of_atan2() -> None:
    """Where all are small, where some are, and where one is missing."""
    import numba

    from coopoc.kernels.abreast import pack, put, take
    from coopoc.kernels.sighting import angle

    @numba.njit
    def call(sine, cosine, out):  # type: ignore[no-untyped-def]
        put(out, 0, angle(take(sine, 0), pack(cosine[0], cosine[1], cosine[2], cosine[3])))

    for turns in ([0.01, -0.2, 0.1, 0.0], [0.01, 3.0, -1.0, 0.2], [0.1, np.nan, 0.1, -2.0]):
        out = np.empty(4)
        call(np.sin(turns), np.cos(turns), out)
        np.testing.assert_allclose(out, turns, rtol=1e-15)


def test_sine_and_cosine_are_those_of_the_library() -> None:
    from coopoc.kernels.sighting import sine_and_cosine

    turns = np.concatenate([np.linspace(-7, 7, 2001), np.linspace(-1e4, 1e4, 301), np.arange(-8, 9) * math.pi / 4])
    for turn in turns:
        assert sine_and_cosine(turn) == pytest.approx((math.sin(turn), math.cos(turn)), rel=4e-16, abs=1e-300)
    assert np.isnan(sine_and_cosine(np.nan)).all()
