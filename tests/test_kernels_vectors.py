"""Vectors of runs and small matrices: blocks against NumPy, side by side and alone."""

import os

import numpy as np
import pytest
from numpy.linalg import inv, qr, solve
from numpy.random import default_rng
from shell import python

from coopoc.kernels.compiling.compile import as_written
from coopoc.kernels.compiling.small import inverse, load, store, zeros
from coopoc.kernels.compiling.vectors import LANES
from coopoc.kernels.stars.joint_filter import eliminate, predict, substitute

BLOCKS, NINE = 4, (0,) * 9


@as_written
def solved(a, eta, memory):
    pivot = eliminate(a, a, eta, BLOCKS, BLOCKS, memory)
    substitute(a, eta, BLOCKS, BLOCKS)
    store(memory, 0, pivot)


@as_written
def predicted(a, process, memory):
    predict(a, BLOCKS, BLOCKS, process, memory)


@as_written
def inverted(a):
    store(a, 0, inverse(load(a, 0, zeros(1.0, NINE))))


def test_a_covariance_with_an_unknown_angle_keeps_its_digits():
    """In closed form: variances along three axes; the adjugate had lost the determinant."""
    rng, variances = default_rng(5), np.array([0.4, 0.1, 8.6e8])
    for _ in range(50):
        axes = qr(rng.normal(size=(3, 3)))[0]
        a = (axes * variances @ axes.T).ravel()
        inverted(a)
        assert a == pytest.approx((axes / variances @ axes.T).ravel(), abs=1e-5)


def blockwise(matrix, d):
    return matrix.reshape(BLOCKS, d, BLOCKS, d).swapaxes(1, 2).reshape(-1)


@pytest.mark.parametrize("batched", [False, True])
def test_blocks_against_numpy(batched):
    d, size, rng = 3, 3 * BLOCKS, default_rng(3)
    root = rng.normal(size=(size, size))
    a, eta, process = root @ root.T + np.eye(size), rng.normal(size=size), rng.uniform(0.1, 1.0, size)
    shape = (lambda v: np.repeat(v[:, None], LANES, 1)) if batched else np.copy
    memory = shape(np.zeros(2 * BLOCKS * d**2))
    mine, right = shape(blockwise(a, d)), shape(eta)
    solved(mine, right, memory)
    lanes = [(..., k) for k in range(LANES)] if batched else [...]
    for lane in lanes:
        assert right[lane] == pytest.approx(solve(a, eta), rel=1e-10)
        last = -memory[lane][: d * d].reshape(d, d)
        assert last == pytest.approx(inv(a)[-d:, -d:], rel=1e-10)

    mine = shape(blockwise(a, d))
    predicted(mine, shape(1.0 / process), memory)
    expected = inv(inv(a) + np.diag(process)).reshape(BLOCKS, d, BLOCKS, d).swapaxes(1, 2)
    for lane in lanes:
        found = mine[lane].reshape(BLOCKS, BLOCKS, d, d)
        for i in range(BLOCKS):
            for j in range(i, BLOCKS):
                upper = np.triu_indices(d) if i == j else np.indices((d, d)).reshape(2, -1)
                assert found[i, j][tuple(upper)] == pytest.approx(expected[i, j][tuple(upper)], rel=1e-9, abs=1e-12)


def test_plain_njit_gives_the_same_without_the_private_hooks(tmp_path):
    env = {**os.environ, "COOPOC_PLAIN_NJIT": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    python("-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, "-k", "against_numpy and False", env=env)


def test_angles_side_by_side_are_those_of_atan2():
    """Where all are small, where some are, and where one is missing."""
    import numba

    from coopoc.kernels.compiling.vectors import pack, put, take
    from coopoc.kernels.geometry import angle

    @numba.njit
    def call(sine, cosine, out):  # type: ignore[no-untyped-def]
        put(out, 0, angle(take(sine, 0), pack(cosine[0], cosine[1], cosine[2], cosine[3])))

    for turns in ([0.01, -0.2, 0.1, 0.0], [0.01, 3.0, -1.0, 0.2], [0.1, np.nan, 0.1, -2.0]):
        out = np.empty(4)
        call(np.sin(turns), np.cos(turns), out)
        np.testing.assert_allclose(out, turns, rtol=1e-15)
