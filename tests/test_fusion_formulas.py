"""Covariance intersection and multidimensional scaling as formulas, against scipy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.covariance_intersection import Belief, intersect
from scipy.linalg import orthogonal_procrustes
from scipy.optimize import least_squares, minimize_scalar
from scipy.sparse.csgraph import shortest_path
from scipy.spatial import procrustes
from scipy.spatial.distance import cdist

from coopoc.methods.scaling import complete, fit, majorise, shape


def covariances(rng: np.random.Generator, *shape: int) -> np.ndarray:
    root = rng.normal(size=(*shape, 3, 3))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(3)


def belief(x: np.ndarray, dependent: np.ndarray, independent: np.ndarray | float = 0.0) -> Belief:
    return Belief(x, dependent, np.broadcast_to(independent, dependent.shape))


# Covariance intersection


@pytest.mark.parametrize("criterion", ["trace", "det"])
def test_fusing_an_estimate_with_itself_changes_nothing(criterion: str) -> None:
    rng = np.random.default_rng(0)
    x, cov = rng.normal(size=(6, 3)), covariances(rng, 6)
    fused, _ = intersect(belief(x, cov), belief(x[:, None], cov[:, None]), criterion=criterion)
    assert fused.x == pytest.approx(x, abs=1e-9)
    assert fused.dependent == pytest.approx(cov, rel=1e-8)
    assert np.abs(fused.independent).max() < 1e-9


@pytest.mark.parametrize("criterion", ["trace", "det"])
def test_the_weight_is_that_of_scipy(criterion: str) -> None:
    """Independent check: scipy.optimize.minimize_scalar on the formula of plain CI, one run at a time."""
    rng = np.random.default_rng(1)
    x, y, a, b = rng.normal(size=(12, 3)), rng.normal(size=(12, 3)), covariances(rng, 12), covariances(rng, 12)
    fused, w = intersect(belief(x, a), belief(y[:, None], b[:, None]), criterion=criterion)
    size = np.trace if criterion == "trace" else np.linalg.det
    for r in range(12):

        def inverse(weight: float, r: int = r) -> np.ndarray:
            return np.linalg.inv(weight * np.linalg.inv(a[r]) + (1 - weight) * np.linalg.inv(b[r]))

        best = minimize_scalar(lambda v: size(inverse(v)), bounds=(0, 1), method="bounded", options={"xatol": 1e-10})
        assert w[r] == pytest.approx(best.x, abs=1e-4)
        assert size(fused.dependent[r]) <= best.fun * (1 + 1e-9)
        expected = inverse(w[r])
        assert fused.dependent[r] == pytest.approx(expected, rel=1e-8)
        mean = w[r] * np.linalg.solve(a[r], x[r]) + (1 - w[r]) * np.linalg.solve(b[r], y[r])
        assert fused.x[r] == pytest.approx(expected @ mean, abs=1e-8)


def test_the_weight_of_least_determinant_has_a_closed_form() -> None:
    """With g the eigenvalues of A B^-1, sum (1 - g) / (w + (1 - w) g) = 0: a quadratic in w in three dimensions."""
    rng = np.random.default_rng(2)
    a, b = covariances(rng, 200), covariances(rng, 200)
    zero = np.zeros((200, 3))
    _, w = intersect(belief(zero, a), belief(zero[:, None], b[:, None]), criterion="det")
    inside = 0
    for r in range(200):
        g = np.linalg.eigvals(np.linalg.solve(b[r], a[r])).real
        lines = [np.array([1 - v, v]) for v in g]
        numerator = sum((1 - g[i]) * np.polymul(lines[(i + 1) % 3], lines[(i + 2) % 3]) for i in range(3))
        found = [root.real for root in np.roots(numerator) if abs(root.imag) < 1e-9 and 0 < root.real < 1]
        inside += len(found)
        ends = 1.0 if np.log(g).sum() < 0 else 0.0
        assert w[r] == pytest.approx(found[0] if found else ends, abs=1e-6)
    assert 50 < inside < 200


def test_split_weight_is_that_of_scipy_with_several_others() -> None:
    rng = np.random.default_rng(3)
    own = Belief(rng.normal(size=(8, 3)), covariances(rng, 8), covariances(rng, 8))
    others = Belief(rng.normal(size=(8, 4, 3)), covariances(rng, 8, 4), covariances(rng, 8, 4))
    used = rng.random((8, 4)) < 0.7
    fused, w = intersect(own, others, used)

    def information(r: int, weight: float) -> list[np.ndarray]:
        mine = np.linalg.inv(own.dependent[r] / weight + own.independent[r])
        return [mine, *np.linalg.inv(others.dependent[r, used[r]] / (1 - weight) + others.independent[r, used[r]])]

    for r in range(8):
        best = minimize_scalar(
            lambda v, r=r: np.trace(np.linalg.inv(sum(information(r, v)))),
            bounds=(1e-9, 1 - 1e-9),
            method="bounded",
            options={"xatol": 1e-10},
        )
        assert w[r] == pytest.approx(best.x, abs=1e-4)
        parts = information(r, min(w[r], 1 - 1e-12))
        cov = np.linalg.inv(sum(parts))
        seen = [own.x[r], *others.x[r, used[r]]]
        assert fused.x[r] == pytest.approx(cov @ sum(i @ y for i, y in zip(parts, seen, strict=True)), abs=1e-6)
        assert fused.dependent[r] + fused.independent[r] == pytest.approx(cov, rel=1e-6, abs=1e-9)
        noise = [own.independent[r], *others.independent[r, used[r]]]
        expected = sum(cov @ i @ c @ i @ cov for i, c in zip(parts, noise, strict=True))
        assert fused.independent[r] == pytest.approx(expected, rel=1e-5, abs=1e-8)


def test_split_without_dependence_is_the_kalman_update() -> None:
    """Independent check: the gain form K = P (P + C)^-1, for the whole error and when only the other one depends."""
    rng = np.random.default_rng(4)
    x, y, p, c = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), covariances(rng, 5), covariances(rng, 5)
    gain = p @ np.linalg.inv(p + c)
    expected = x + np.einsum("rij,rj->ri", gain, y - x)
    for dependent in (0.0, 1.0):
        others = Belief(y[:, None], dependent * c[:, None], (1 - dependent) * c[:, None])
        fused, _ = intersect(Belief(x, 0 * p, p), others)
        assert fused.x == pytest.approx(expected, abs=1e-6)
        assert fused.dependent + fused.independent == pytest.approx(p - gain @ p, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("correlation", [-0.95, 0.0, 0.6, 0.95])
def test_intersection_is_consistent_under_any_correlation(correlation: float) -> None:
    """Monte Carlo: the error of the fused estimate stays below its covariance in every direction; the naive sum's
    does not where the correlation is strong."""
    rng = np.random.default_rng(5)
    a, b = np.diag([1.0, 2.0, 0.5]), np.diag([1.5, 0.8, 0.6])
    common, own = rng.normal(size=(2, 40_000, 3))
    first = common @ np.sqrt(a)
    second = (correlation * common + np.sqrt(1 - correlation**2) * own) @ np.sqrt(b)
    noise = rng.normal(size=(2, 40_000, 3)) * 0.7
    for dependent in (False, True):
        extra = 0.0 if dependent else 0.49
        x, y = (first, second) if dependent else (first + noise[0], second + noise[1])
        shaped = [np.broadcast_to(m, (1, 3, 3)) for m in (a, b)]
        fused, w = intersect(
            belief(np.zeros((1, 3)), shaped[0], extra * np.eye(3)),
            belief(np.zeros((1, 1, 3)), shaped[1][:, None], extra * np.eye(3)),
        )
        cov = (fused.dependent + fused.independent)[0]
        mine = cov @ np.linalg.inv(a / w[0] + extra * np.eye(3))
        error = x @ mine.T + y @ (np.eye(3) - mine).T
        assert np.linalg.eigvalsh(cov - np.cov(error.T)).min() > -0.02 * np.trace(cov)
    naive = np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b))
    mean = first @ (naive @ np.linalg.inv(a)).T + second @ (naive @ np.linalg.inv(b)).T
    assert (np.trace(np.cov(mean.T)) > 1.2 * np.trace(naive)) == (correlation > 0.5)


def test_order_of_neighbours_changes_nothing() -> None:
    """Not even that of the stack: the fusion of k others is one sum."""
    rng = np.random.default_rng(10)
    own = Belief(rng.normal(size=(4, 3)), covariances(rng, 4), covariances(rng, 4))
    others = Belief(rng.normal(size=(4, 5, 3)), covariances(rng, 4, 5), covariances(rng, 4, 5))
    there = intersect(own, Belief(*(part[:, [3, 1, 4, 0, 2]] for part in others)))[0]
    for one, other in zip(intersect(own, others)[0], there, strict=True):
        assert other == pytest.approx(one, abs=1e-7)


# Multidimensional scaling


def test_missing_distances_are_shortest_paths() -> None:
    """Independent check: scipy.sparse.csgraph.shortest_path."""
    rng = np.random.default_rng(6)
    distance = cdist(*[rng.normal(size=(7, 3))] * 2)
    kept = rng.random((7, 7)) < 0.25
    kept[0] = True
    measured = np.where(kept & ~np.eye(7, dtype=bool), distance, np.nan)
    graph = np.where(np.isfinite(measured), measured, 0.0)
    expected = shortest_path(graph, method="D", directed=False)
    direct = np.isfinite(measured) | np.isfinite(measured.T)
    expected = np.where(direct, distance, expected)
    assert complete(measured[None])[0] == pytest.approx(expected)


def test_a_complete_matrix_of_exact_distances_gives_the_shape() -> None:
    """Independent check: scipy.spatial.procrustes finds no disparity, and cdist the same distances."""
    rng = np.random.default_rng(7)
    truth = rng.normal(size=(4, 6, 3))
    found = shape(np.stack([cdist(p, p) for p in truth]))
    for points, where in zip(found, truth, strict=True):
        assert cdist(points, points) == pytest.approx(cdist(where, where), abs=1e-9)
        assert procrustes(where, points)[2] < 1e-12


@pytest.mark.parametrize("mirrored", [False, True])
def test_fit_is_orthogonal_procrustes(mirrored: bool) -> None:
    """Independent check: scipy.linalg.orthogonal_procrustes on centred points; a mirrored shape is turned back."""
    rng = np.random.default_rng(8)
    points = rng.normal(size=(5, 3)) * ([1, 1, -1] if mirrored else 1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    target = points * [1, 1, -1] @ turn + rng.normal(0, 0.1, (5, 3)) + 7.0
    matrix, _ = orthogonal_procrustes(points - points.mean(axis=0), target - target.mean(axis=0))
    expected = (points - points.mean(axis=0)) @ matrix + target.mean(axis=0)
    assert fit(points[None], target[None], np.ones((1, 5)))[0] == pytest.approx(expected, abs=1e-9)
    weighted = fit(points[None], target[None], np.array([[1.0, 1, 1, 1, 0]]))[0]
    assert weighted[:4] == pytest.approx(fit(points[None, :4], target[None, :4], np.ones((1, 4)))[0], abs=1e-9)


def test_majorisation_falls_to_the_minimum_of_least_squares() -> None:
    """Independent check: scipy.optimize.least_squares on the same ranges and anchors; no step raises the cost."""
    rng = np.random.default_rng(9)
    truth = rng.uniform(-15, 15, (5, 3))
    anchor = truth + rng.normal(0, 2.0, truth.shape)
    distance = cdist(truth, truth) + np.triu(rng.normal(0, 0.5, (5, 5)), 1)
    distance = np.triu(distance, 1) + np.triu(distance, 1).T
    weight, anchor_weight = np.full((5, 5), 4.0) - 4.0 * np.eye(5), np.full((5, 3), 0.25) * [1, 1, 0.5]
    pair = np.triu_indices(5, 1)

    def residual(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(5, 3)
        ranges = np.linalg.norm(x[pair[0]] - x[pair[1]], axis=1) - distance[pair]
        return np.concatenate([2.0 * ranges, (np.sqrt(anchor_weight) * (x - anchor)).ravel()])

    x, costs = anchor[None], []
    for _ in range(1500):
        x = majorise(x, distance[None], weight[None], anchor[None], anchor_weight[None], 1)
        costs.append((residual(x.ravel()) ** 2).sum())
    assert (np.diff(costs) <= 1e-9).all()
    best = least_squares(residual, anchor.ravel())
    assert costs[-1] == pytest.approx(2 * best.cost, rel=1e-6)
    assert x[0] == pytest.approx(best.x.reshape(5, 3), abs=1e-3)
