"""Aggregation rules against Flower's own, scipy and closed forms; compression and guard against their laws."""

from __future__ import annotations

import warnings
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from scipy import optimize, stats
from torch import Tensor

from coopoc import InputError
from coopoc.learned import Schedule
from coopoc.learned.federation.aggregate import RULES, rule
from coopoc.learned.federation.compression import Compression, Float16, Quantised, TopK
from coopoc.learned.federation.guard import screen
from coopoc.learned.federation.means import FedProx, inverse_variance, mean, uniform
from coopoc.learned.federation.robust import GeometricMedian, Krum, TrimmedMean, krum_scores
from coopoc.learned.federation.rule import Rule
from coopoc.learned.federation.server_rules import FedAdam, FedAvgM, Moments

SIZES = torch.tensor([3, 1, 5, 2, 4, 1, 6])


def answers(clients: int = 7, size: int = 40, seed: int = 0) -> Tensor:
    """(C, P) weights in float64."""
    return torch.randn((clients, size), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def combined(which: Rule, weights: Tensor, sizes: Tensor = SIZES, uncertainty: Tensor | None = None) -> Tensor:
    """What a rule makes of one round from zero."""
    theta = torch.zeros_like(weights[0])
    return which(which.start(theta), theta, weights, sizes, torch.ones(len(weights)))[0]


@pytest.fixture(scope="module")
def flower() -> ModuleType:
    """Flower's strategies; its import warns about libraries of its own."""
    pytest.importorskip("flwr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import flwr.serverapp.strategy as strategy
    return strategy


def replies(weights: Tensor, sizes: Tensor) -> list[Any]:
    """Flower's messages with these weights, split into two arrays as a net would be, and numbers of examples."""
    from flwr.app import Array, ArrayRecord, Message, MetricRecord, RecordDict
    from flwr.app.metadata import Metadata

    def content(row: Tensor, count: int) -> RecordDict:
        arrays = ArrayRecord({"a": Array(row[:9].reshape(3, 3).numpy()), "b": Array(row[9:].numpy())})
        return RecordDict({"arrays": arrays, "metrics": MetricRecord({"num-examples": count})})

    def about(node: int) -> Metadata:
        return Metadata(
            run_id=1,
            message_id="",
            src_node_id=node,
            dst_node_id=99,
            reply_to_message_id="",
            group_id="",
            created_at=0.0,
            ttl=60.0,
            message_type="train",
        )

    build: Any = Message
    return [
        build(content(row, int(n)), metadata=about(i)) for i, (row, n) in enumerate(zip(weights, sizes, strict=True))
    ]


def flat(record: Any) -> Tensor:
    """Flower's arrays as one row."""
    return torch.from_numpy(np.concatenate([record[name].numpy().ravel() for name in ("a", "b")]))


@pytest.mark.parametrize(
    ("ours", "theirs", "options"),
    [
        (RULES["mean"], "FedAvg", {}),
        (RULES["median"], "FedMedian", {}),
        (TrimmedMean(0.2), "FedTrimmedAvg", {"beta": 0.2}),
        (TrimmedMean(0.4), "FedTrimmedAvg", {"beta": 0.4}),
        (Krum(1), "Krum", {"num_malicious_nodes": 1}),
        (Krum(2), "Krum", {"num_malicious_nodes": 2}),
        (Krum(2, keep=3), "MultiKrum", {"num_malicious_nodes": 2, "num_nodes_to_select": 3}),
    ],
    ids=lambda value: value.name if isinstance(value, Rule) else str(value),
)
def test_rules_are_those_of_flower(flower: ModuleType, ours: Rule, theirs: str, options: dict[str, Any]) -> None:
    """Against flwr.serverapp.strategy; Flower weighs what Multi-Krum keeps by examples, the paper does not."""
    sizes = torch.ones_like(SIZES) if theirs == "MultiKrum" else SIZES
    for seed in range(5):
        weights = answers(seed=seed)
        record, _ = getattr(flower, theirs)(**options).aggregate_train(1, replies(weights, sizes))
        torch.testing.assert_close(combined(ours, weights, sizes), flat(record), rtol=1e-12, atol=1e-12)


def test_server_momentum_is_that_of_flower(flower: ModuleType) -> None:
    """Five rounds of flwr.serverapp.strategy.FedAvgM."""
    ours, theirs = FedAvgM(0.3, 0.7), flower.FedAvgM(server_learning_rate=0.3, server_momentum=0.7)
    theta = answers()[0]
    state, theirs.current_arrays = ours.start(theta), replies(theta[None], SIZES[:1])[0].content["arrays"]
    for number in range(1, 6):
        weights = answers(seed=number)
        theta, state = ours(state, theta, weights, SIZES, torch.ones(7))
        record, _ = theirs.aggregate_train(number, replies(weights, SIZES))
        torch.testing.assert_close(theta, flat(record), rtol=1e-12, atol=1e-12)


def test_server_adam_is_that_of_flower(flower: ModuleType) -> None:
    """flwr.serverapp.strategy.FedAdam scales its rate by round and starts v at 0: the same from there."""
    theirs = flower.FedAdam(eta=0.05, beta_1=0.8, beta_2=0.95, tau=0.01)
    theta = answers()[0]
    state: tuple[Tensor, ...] = Moments(torch.zeros_like(theta), torch.zeros_like(theta))
    for number in range(1, 6):
        weights = answers(seed=number)
        arrays = replies(theta[None], SIZES[:1])[0].content["arrays"]
        theirs.current_arrays = {name: array.numpy() for name, array in arrays.items()}
        scaled = 0.05 * np.sqrt(1 - 0.95 ** (number + 1.0)) / (1 - 0.8 ** (number + 1.0))
        theta, state = FedAdam(scaled, 0.8, 0.95, 0.01)(state, theta, weights, SIZES, torch.ones(7))
        record, _ = theirs.aggregate_train(number, replies(weights, SIZES))
        torch.testing.assert_close(theta, flat(record), rtol=1e-10, atol=1e-12)


def test_server_adam_starts_as_published() -> None:
    """Algorithm 2 by hand: v starts at tau^2, no bias correction."""
    weights, which = answers(), FedAdam(0.05, 0.9, 0.99, 1e-3)
    change = mean(weights, SIZES)
    by_hand = 0.05 * 0.1 * change / ((0.99 * 1e-6 + 0.01 * change**2).sqrt() + 1e-3)
    torch.testing.assert_close(combined(which, weights), by_hand)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.49])
def test_trimmed_mean_is_that_of_scipy(share: float) -> None:
    for count in (1, 4, 7):
        weights = answers(count)
        theirs = stats.trim_mean(weights.numpy(), share, axis=0)
        np.testing.assert_allclose(combined(TrimmedMean(share), weights, SIZES[:count]), theirs, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 4, 7])
def test_median_is_that_of_numpy(count: int) -> None:
    weights = answers(count)
    np.testing.assert_array_equal(combined(RULES["median"], weights), np.median(weights.numpy(), axis=0))


def test_geometric_median_is_the_least_sum_of_distances() -> None:
    """Against scipy's minimiser of the same sum, weighted, and the closed form of Fermat's point of a square."""
    for seed in range(3):
        points = answers(7, 5, seed)

        def total(x: np.ndarray, points: Tensor = points) -> float:
            return float(SIZES.numpy() @ np.linalg.norm(points.numpy() - x, axis=1))

        found = optimize.minimize(total, points.mean(0).numpy(), method="BFGS", options={"gtol": 1e-9})
        np.testing.assert_allclose(combined(GeometricMedian(), points), found.x, atol=1e-5)
        assert total(combined(GeometricMedian(), points).numpy()) <= found.fun + 1e-9
    corners = torch.tensor([[0.0, 0], [1, 1], [1, 0], [0, 1]], dtype=torch.float64)
    torch.testing.assert_close(
        GeometricMedian().combine(corners, torch.ones(4), torch.ones(4)), torch.full((2,), 0.5, dtype=torch.float64)
    )


def test_geometric_median_on_a_point_and_of_equals() -> None:
    """More than half of the weight in one point makes it the median; equal points have none but themselves."""
    points = torch.tensor([[1.0, 2.0], [5.0, 5.0], [-3.0, 0.0]])
    torch.testing.assert_close(
        combined(GeometricMedian(), points, torch.tensor([5.0, 1.0, 1.0])), points[0], rtol=0, atol=1e-4
    )
    assert torch.equal(combined(GeometricMedian(), points[:1].repeat(4, 1), torch.ones(4)), points[0])


def test_inverse_variance_is_the_best_mean() -> None:
    """The weights that scipy finds for the least variance of an unbiased mean of estimates with v_i / n_i."""
    sizes, loss = SIZES.double(), torch.tensor([0.3, 2.0, 0.5, 1.0, 9.0, 0.1, 1.0], dtype=torch.float64)
    variance = (loss / sizes).numpy()
    one = {"type": "eq", "fun": lambda a: a.sum() - 1}
    best = optimize.minimize(lambda a: a**2 @ variance, np.full(7, 1 / 7), constraints=[one], tol=1e-14).x
    ours = inverse_variance(torch.eye(7, dtype=torch.float64), SIZES, loss)
    np.testing.assert_allclose(ours, best, atol=1e-5)


def test_inverse_variance_of_equals_is_the_mean_and_the_infinite_do_not_count() -> None:
    weights, bad = answers(), torch.tensor([1.0, torch.inf, 1.0, torch.nan, 1.0, 1.0, 1.0])
    torch.testing.assert_close(inverse_variance(weights, SIZES, torch.full((7,), 0.4)), mean(weights, SIZES))
    good = bad.isfinite()
    torch.testing.assert_close(inverse_variance(weights, SIZES, bad), mean(weights[good], SIZES[good]))
    torch.testing.assert_close(inverse_variance(weights, SIZES, torch.full((7,), torch.nan)), mean(weights, SIZES))
    certain = torch.tensor([1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    floored = mean(weights, SIZES * torch.where(certain == 0, 100, 1))  # FLOOR of the median, and no client alone
    torch.testing.assert_close(inverse_variance(weights, SIZES, certain), floored)


@pytest.mark.parametrize("name", sorted(RULES))
def test_every_rule_keeps_what_all_agree_on(name: str) -> None:
    """Law: equal answers give themselves; the adaptive servers move towards them."""
    theta, target = torch.zeros(6), torch.full((6,), 0.5)
    which = RULES[name]
    after, _ = which(which.start(theta), theta, target.repeat(7, 1), SIZES, torch.ones(7))
    if name in ("fedavgm", "fedadam"):
        assert (after > 0).all()
        assert (after <= target).all()
    else:
        torch.testing.assert_close(after, target)


@pytest.mark.parametrize("name", ["median", "trimmed_mean", "krum", "multi_krum", "geometric_median"])
def test_robust_rules_ignore_one_byzantine_client(name: str) -> None:
    """One of seven sends 1e6: the result stays in the hull of the honest, the mean does not."""
    weights = answers()
    weights[3] = 1e6
    honest = weights[[0, 1, 2, 4, 5, 6]]
    found = combined(RULES[name], weights, torch.ones(7))
    assert ((found <= honest.max(0).values) & (found >= honest.min(0).values)).all()
    assert combined(RULES["mean"], weights).max() > 1e4


def test_fedavgm_without_momentum_and_fedprox_at_the_server_are_the_mean() -> None:
    weights = answers()
    torch.testing.assert_close(combined(FedAvgM(1.0, 0.0), weights), mean(weights, SIZES))
    torch.testing.assert_close(combined(FedProx(), weights), mean(weights, SIZES))
    assert FedProx(0.3).local(Schedule()).proximal == 0.3
    assert FedProx(0.3).local(Schedule(proximal=0.1)).proximal == 0.1


def test_a_plain_function_is_a_rule() -> None:
    weights = answers()
    torch.testing.assert_close(combined(rule(lambda w, n, v: w[0]), weights), weights[0])
    assert rule(uniform).name == "uniform"
    assert rule(Krum(2)) == Krum(2)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: TrimmedMean(0.5), "share"),
        (lambda: Krum(-1), "byzantine"),
        (lambda: Krum(1, keep=0), "keep"),
        (lambda: GeometricMedian(smoothing=0.0), "smoothing"),
        (lambda: GeometricMedian(iterations=0), "iterations"),
        (lambda: FedAvgM(momentum=1.0), "momentum"),
        (lambda: FedAvgM(rate=0.0), "rate"),
        (lambda: FedAdam(tau=0), "tau"),
        (lambda: FedAdam(beta2=1.0), "beta2"),
        (lambda: FedProx(-1.0), "mu"),
        (lambda: rule("vote"), "aggregation rule"),
        (lambda: TopK(0.0), "share"),
        (lambda: Quantised(1), "bits"),
        (lambda: Quantised(17), "bits"),
        (lambda: Schedule(proximal=-1.0), "proximal"),
    ],
)
def test_impossible_parameters_are_named(make: Any, field: str) -> None:
    with pytest.raises(InputError, match=f"^{field} = "):
        make()


def test_krum_says_how_many_clients_it_needs() -> None:
    with pytest.raises(InputError, match=r"4 with byzantine = 1: Krum needs more than 2 f \+ 2 = 4 clients"):
        krum_scores(answers(4), 1)
    assert (Krum(1).least, Krum(1, keep=9).least, RULES["median"].least) == (5, 9, 1)


UPDATE = answers(1, 19_938, seed=9)[0].float() * 1e-2


@pytest.mark.parametrize(
    ("compression", "size", "worst"),
    [
        (Float16(), 2 * 19_938, 2**-11 * 0.05),
        (TopK(0.1), 6 * 1994, None),
        (TopK(1.0), 6 * 19_938, 1e-12),
        (Quantised(8), 4 + 19_938, 0.05 / 127),
        (Quantised(3), 4 + 7477, 0.05 / 3),
    ],
    ids=lambda value: value.name if isinstance(value, Rule) else str(value),
)
def test_compression_counts_its_bytes_and_keeps_its_bound(
    compression: Compression, size: int, worst: float | None
) -> None:
    sent, kept = compression.encode(UPDATE, torch.zeros_like(UPDATE), np.random.default_rng(0))
    assert len(sent) == size
    back = compression.decode(sent, len(UPDATE))
    assert back.dtype == torch.float32
    if worst is not None:
        assert float((back - UPDATE).abs().max()) <= worst
    torch.testing.assert_close(back + kept, UPDATE if isinstance(compression, TopK) else back, rtol=0, atol=1e-9)


def test_top_k_sends_the_largest_and_keeps_the_rest_for_later() -> None:
    """Against torch.topk; over many rounds of one update error feedback sends everything on average."""
    rule_, kept, total = TopK(0.25), torch.zeros(40), torch.zeros(40)
    update, none = UPDATE[:40], np.random.default_rng(0)
    first = rule_.decode(rule_.encode(update, kept, none)[0], 40)
    largest = torch.topk(update.abs(), 10)
    assert set(first.nonzero().flatten().tolist()) == set(largest.indices.tolist())
    for _ in range(200):
        sent, kept = rule_.encode(update, kept, none)
        total += rule_.decode(sent, 40)
    torch.testing.assert_close(total / 200, update, rtol=0, atol=float(update.abs().max()) * 8 / 200)


def test_more_than_65536_weights_take_longer_indices() -> None:
    long = torch.randn(70_000, generator=torch.Generator().manual_seed(0))
    sent, kept = TopK(0.01).encode(long, torch.zeros_like(long), np.random.default_rng(0))
    assert len(sent) == 8 * 700
    torch.testing.assert_close(TopK(0.01).decode(sent, 70_000) + kept, long)


def test_quantised_is_unbiased_and_keyed() -> None:
    """Mean of 2000 draws within five standard errors; the same dice give the same bytes."""
    update, code = UPDATE[:50], Quantised(2)
    dice = np.random.default_rng(1)
    drawn = torch.stack([code.decode(code.encode(update, update, dice)[0], 50) for _ in range(2000)])
    error = (drawn.mean(0) - update).abs() / (drawn.std(0) / 2000**0.5).clamp_min(1e-9)
    assert float(error[update.abs() < update.abs().max()].max()) < 5
    one, two = (code.encode(update, update, np.random.default_rng(3))[0] for _ in range(2))
    assert one == two
    zero = torch.zeros(5)
    assert torch.equal(code.decode(code.encode(zero, zero, dice)[0], 5), zero)


def bad(theta: Tensor) -> dict[str, Tensor]:
    """Three answers that cannot be right."""
    return {"nan": theta + torch.nan, "shape": theta[:-1], "far": theta + 10.0 * UPDATE * 100}


@pytest.mark.parametrize("honest", [1, 2, 5])
@pytest.mark.parametrize("which", [("nan",), ("shape",), ("far",), ("nan", "shape", "far")])
def test_the_guard_rejects_what_cannot_be_right_and_nothing_else(honest: int, which: tuple[str, ...]) -> None:
    """A thousand times too large is found among five honest answers as beside one, alone and with other faults."""
    theta = torch.randn(19_938, generator=torch.Generator().manual_seed(2)) * 0.1
    answers_ = {f"honest{i}": theta + UPDATE.roll(i) for i in range(honest)}
    reasons, usual = screen(theta, answers_ | {name: bad(theta)[name] for name in which})
    assert set(reasons) == set(which)
    assert usual == pytest.approx(float(UPDATE.norm()), rel=1e-3)
    words = {
        "nan": "19938 of 19938 weights are not finite",
        "shape": "weights of shape (19937,), the net has (19938,)",
        "far": f"changes the weights by {1000 * float(UPDATE.norm()):.3g}",
    }
    assert all(words[name] in reasons[name] for name in which)


def test_the_guard_remembers_what_is_usual() -> None:
    """With two answers the round before decides: a small change of huge weights is still seen as far too large."""
    theta = torch.full((100,), 1e6)
    honest, wrong = theta + 1.0, theta + 1000.0
    assert screen(theta, {"a": honest, "b": wrong})[0] == {}
    assert set(screen(theta, {"a": honest, "b": wrong}, usual=10.0)[0]) == {"b"}
    assert screen(theta, {}, usual=10.0) == ({}, 10.0)


def test_the_guard_lets_a_change_in_where_most_changed_nothing() -> None:
    theta = torch.ones(3)
    assert screen(theta, {"a": theta, "b": theta, "c": theta + 0.1})[0] == {}
    assert set(screen(theta, {"a": theta, "b": theta, "c": theta + 1e3})[0]) == {"c"}
