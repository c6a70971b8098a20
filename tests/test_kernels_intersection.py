"""The compiled fusion of covariance intersection against scipy.optimize and numpy.linalg."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import callable_part
from scipy.optimize import minimize_scalar

from coopoc.kernels.stars import fusion as kernel
from coopoc.kernels.stars.fusion import Fusion

add_up, best_weight, describe, fuse = map(
    callable_part, (kernel.add_up, kernel.best_weight, kernel.describe, kernel.fuse)
)


def covariance(rng: np.random.Generator) -> Any:
    root = rng.normal(size=(3, 3))
    return root @ root.T + 0.1 * np.eye(3)


def packed(full: Any) -> tuple[float, ...]:
    return tuple(full[np.triu_indices(3)].tolist())


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("least_det", [False, True])
def test_a_source_and_the_best_weight_are_those_of_numpy_and_scipy(seed: int, least_det: bool) -> None:
    """Information by numpy.linalg.inv, its derivatives by differences of it, the weight by minimize_scalar."""
    rng = np.random.default_rng(seed)
    parts = [(covariance(rng), covariance(rng)) for _ in range(1 + seed % 4)]
    source, fixed, sums, gap = np.empty((5, 22)), np.zeros(9), np.empty(18), rng.normal(size=(5, 3))
    fix, gap[0] = rng.uniform(0.1, 1.0, 3), 0.0
    fixed[[0, 3, 5]], fixed[6:] = fix, fix * [1.0, -2.0, 3.0]
    fusion = Fusion(source, gap, fixed, sums, np.zeros(3))
    for j, (dependent, independent) in enumerate(parts):
        assert not describe(packed(dependent), packed(independent), True, source, j)

    def pieces(w: float) -> list[Any]:
        return [np.linalg.inv(d / (1 - w if j else w) + i) for j, (d, i) in enumerate(parts)]

    def size(w: float) -> float:
        cov = np.linalg.inv(np.diag(fix) + sum(pieces(w)))
        return float(np.linalg.slogdet(cov)[1] if least_det else np.trace(cov))

    add_up(fusion, len(parts), 0.4)
    total = np.array([packed(np.diag(fix) + sum(pieces(w))) for w in (0.4 - 1e-4, 0.4, 0.4 + 1e-4)])
    assert sums[:6] == pytest.approx(total[1], rel=1e-12)
    assert sums[6:12] == pytest.approx((total[2] - total[0]) / 2e-4, rel=1e-5, abs=1e-6)
    assert sums[12:] == pytest.approx((total[2] - 2 * total[1] + total[0]) / 1e-8, rel=1e-4, abs=1e-4)
    w = best_weight(fusion, len(parts), least_det, False, 0.5)
    best = minimize_scalar(size, bounds=(1e-9, 1 - 1e-9), method="bounded", options={"xatol": 1e-10})
    assert w == pytest.approx(best.x, abs=1e-4)
    assert size(min(w, 1 - 1e-12)) <= best.fun + 1e-9
    dependent, independent = fuse(fusion, len(parts), 0.4)
    each = pieces(0.4)
    cov = np.linalg.inv(np.diag(fix) + sum(each))
    assert fusion.at == pytest.approx(
        cov @ (fixed[6:] + sum(e @ g for e, g in zip(each, gap, strict=False))), abs=1e-12
    )
    wanted = cov @ (np.diag(fix) + sum(e @ i @ e for e, (_, i) in zip(each, parts, strict=True))) @ cov
    assert independent == pytest.approx(packed(wanted), abs=1e-12)
    assert dependent == pytest.approx(packed(cov - wanted), abs=1e-12)
