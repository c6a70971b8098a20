"""Block elimination and prediction for any block size, held against NumPy's dense linear algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopoc.arrays import Floats
from coopoc.kernels.compiling.compile import as_written
from coopoc.kernels.compiling.small import store
from coopoc.kernels.compiling.vectors import LANES
from coopoc.kernels.stars.elimination import eliminate, predict, substitute

BLOCKS = 4


@as_written
def solved(a: Floats, eta: Floats, memory: Floats, block: Any, row: Any) -> None:
    pivot = eliminate(a, a, eta, BLOCKS, BLOCKS, memory, block, row)
    substitute(a, eta, BLOCKS, BLOCKS, block, row)
    store(memory, 0, pivot)


@as_written
def predicted(a: Floats, process: Floats, memory: Floats, block: Any, row: Any) -> None:
    predict(a, BLOCKS, BLOCKS, process, memory, block, row)


def blockwise(matrix: Floats, d: int) -> Floats:
    return matrix.reshape(BLOCKS, d, BLOCKS, d).swapaxes(1, 2).reshape(-1)


def drawn(d: int) -> tuple[Floats, Floats, Floats]:
    rng = np.random.default_rng(d)
    root = rng.normal(size=(BLOCKS * d, BLOCKS * d))
    return root @ root.T + np.eye(BLOCKS * d), rng.normal(size=BLOCKS * d), rng.uniform(0.1, 1.0, BLOCKS * d)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("d", [1, 2, 3, 4, pytest.param(6, marks=pytest.mark.slow)])
def test_blocks_of_any_size(d: int, batched: bool) -> None:
    a, eta, process = drawn(d)
    shape = (lambda v: np.repeat(v[:, None], LANES, axis=1)) if batched else np.copy
    block, row, memory = (0.0,) * d**2, (0.0,) * d, shape(np.zeros(2 * BLOCKS * d**2))
    mine, right = shape(blockwise(a, d)), shape(eta)
    solved(mine, right, memory, block, row)
    lanes = [(..., k) for k in range(LANES)] if batched else [...]
    for lane in lanes:
        assert right[lane] == pytest.approx(np.linalg.solve(a, eta), rel=1e-10)
        last = -memory[lane][: d * d].reshape(d, d)
        assert last == pytest.approx(np.linalg.inv(a)[-d:, -d:], rel=1e-10)

    mine = shape(blockwise(a, d))
    predicted(mine, shape(1.0 / process), memory, block, row)
    expected = np.linalg.inv(np.linalg.inv(a) + np.diag(process)).reshape(BLOCKS, d, BLOCKS, d).swapaxes(1, 2)
    for lane in lanes:
        found = mine[lane].reshape(BLOCKS, BLOCKS, d, d)
        for i in range(BLOCKS):
            for j in range(i, BLOCKS):
                upper = np.triu_indices(d) if i == j else np.indices((d, d)).reshape(2, -1)
                assert found[i, j][tuple(upper)] == pytest.approx(expected[i, j][tuple(upper)], rel=1e-9, abs=1e-12)
