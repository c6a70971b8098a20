"""Federation: laws on gains that are no net; rules against Flower's own, SciPy and closed forms; Byzantine clients."""

import warnings
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import torch
from aggregation import Byzantine
from conftest import refused, winding
from numpy.testing import assert_array_equal
from torch import nn

from coopoc import Sensors
from coopoc.learned import GainNet, Schedule, clients, federate
from coopoc.learned.checkpoint import Checkpoint
from coopoc.learned.federation.federate import Participation
from coopoc.learned.federation.history import Federation, Round, ledger
from coopoc.learned.federation.rules import (
    RULES,
    SERVER,
    Answer,
    Krum,
    Rule,
    Standing,
    TrimmedMean,
    combine,
    rule,
    screen,
)
from coopoc.learned.nets.gain import Gain, flatten
from coopoc.learned.training.fit import Judge


class Steady(Gain):
    """A filter with one constant gain per axis: x <- x + dt u + k (z - x - dt u)."""

    def __init__(self, gain=0.3):
        super().__init__()
        self.gain = nn.Parameter(torch.full((3,), gain))

    @property
    def settings(self):
        return {}

    def losses(self, theta, batch):
        x, error = batch.x0, torch.zeros(batch.x0.shape[:2])
        for fix, speed, truth in zip(batch.gnss, batch.velocity, batch.truth, strict=True):
            x = x + batch.dt * speed
            x = x + theta[:, None] * (fix - x)
            gap = x - truth
            error = error + (gap[..., 0].square() + gap[..., 1].square() + gap[..., 2].square())
        return error / len(batch.truth)

    def method(self, name, x0=None):
        raise NotImplementedError


def drives(count=4):
    """Vehicles that turn, a little apart in their course."""
    return winding(130, vehicles=count)


@pytest.fixture(scope="module")
def four():
    return clients(drives(), piece=10)


def trained(group, rounds=3, model=None, **options: Any):
    """A short federation of constant gains."""
    return federate(
        model or Steady(), group, rounds, **{"local_epochs": 1, "schedule": Schedule(learning_rate=0.02), **options}
    )


@pytest.mark.parametrize(
    "options",
    [{}, {"aggregate": "median", "participation": Participation(0.5)}, {"schedule": Schedule(batch=10**6)}],
    ids=["mean", "median", "all"],
)
def test_the_order_of_the_clients_changes_nothing(four, options):
    """Same seed, same weights, bit for bit, whatever the order of the clients, also of those with few pieces."""
    four = (replace(four[0], training=four[0].training.take([0, 1])), *four[1:])
    one, other = trained(four, seed=3, **options), trained(four[::-1], seed=3, **options)
    for a, b in zip(one.history, other.history, strict=True):
        assert torch.equal(a.weights, b.weights)
        assert (a.sent, a.absent) == (b.sent, b.absent)
    assert not torch.equal(one.history[-1].weights, trained(four, seed=4, **options).history[-1].weights)


@dataclass(frozen=True)
class Faulty(Participation):
    """Participation in which named clients answer wrongly."""

    faults: tuple[tuple[str, str], ...] = ()

    def answer(self, name, theta, weights):
        """NaN, another shape, or a change a thousand times too large."""
        wrong = {"nan": weights + torch.nan, "shape": weights[:-1], "far": theta + 1000 * (weights - theta)}
        return wrong.get(dict(self.faults).get(name, ""), weights)


@pytest.mark.parametrize(
    "faults",
    [{"b": "nan"}, {"b": "shape"}, {"b": "far"}, {"b": "nan", "c": "shape", "d": "far"}],
    ids=lambda faults: "+".join(faults.values()),
)
@pytest.mark.parametrize("number", [1, 4])
def test_bad_answers_are_rejected_and_training_goes_on(number, faults):
    """The result is that of the honest clients alone, bit for bit: among five of them, and beside a single one."""
    group = clients(drives(4 + number), piece=10)
    honest = [client for client in group if client.name not in faults]
    fed = trained(group, 4, participation=Faulty(faults=tuple(faults.items())))
    for row, alone in zip(fed.history[1:], trained(honest, 4).history[1:], strict=True):
        assert set(row.rejected) == set(faults)
        assert torch.equal(row.weights, alone.weights)
    two = trained(group[:2], 4, participation=Faulty(faults=(("b", "far"),)))
    assert all(set(row.rejected) == {"b"} for row in two.history[1:])
    assert all("changes the weights by" in row.rejected["b"] for row in two.history[1:])


def test_a_client_that_never_answered_does_not_choose_the_weights(four):
    """Its pieces are not finite, so that its loss is infinite in every round; the others' best round is kept."""

    def without_fixes(pieces):
        return replace(pieces, gnss=torch.full_like(pieces.gnss, torch.nan))

    blind = replace(four[0], validation=without_fixes(four[0].validation))
    fed = trained([blind, *four[1:]], 3)
    assert fed.history[1].rejected == {"a": "a validation-loss of inf m^2, must be in [-1e+12, 1e+12]"}
    assert fed.best.number > 0
    fed = trained([replace(blind, training=without_fixes(four[0].training)), *four[1:]], 3)
    assert fed.history[1].rejected == {"a": "loss or gradient not finite at step 1"}
    assert fed.best.number == trained(four[1:], 3).best.number > 0
    assert "a" not in fed.history[1].sent


def test_absent_clients_count_with_their_last_answer(four):
    fed = trained(four, 4, participation=Participation(0.5), seed=1)
    assert torch.equal(flatten([fed.after(1)])[0], fed.history[1].weights)
    for rounds in (5, 0.5):
        with refused(f"rounds = {rounds}"):
            fed.after(rounds)
    for before, row in zip(fed.history, fed.history[1:], strict=False):
        for i, name in enumerate(fed.names):
            assert (row.validation_loss[i] == before.validation_loss[i]) == (name in row.absent)


def test_too_few_answers_for_the_rule_are_said(four):
    fed = trained(clients(drives(5), piece=10), 2, aggregate="krum", participation=Faulty(faults=(("b", "nan"),)))
    assert all(torch.equal(row.weights, fed.history[0].weights) for row in fed.history)
    assert fed.history[1].note == "4 answers accepted, Krum(byzantine=1, keep=1) takes at least 5: weights unchanged"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"aggregate": "krum"}, r"Krum\(byzantine=1, keep=1\) with 4 clients a round: takes at least 5"),
        ({"aggregate": Krum(0, keep=3), "participation": Participation(0.5)}, "with 2 clients a round"),
        ({"rounds": 0}, "rounds = 0"),
        ({"aggregate": lambda weights, sizes: weights.mean(0).numpy()}, "must be a Tensor"),
    ],
)
def test_what_cannot_be_federated_is_said_at_once(four, options, words):
    with refused(words):
        trained(four, **options)


@pytest.mark.parametrize("part", ["training", "validation", "long"])
def test_a_client_has_pieces_of_each_kind(four, part):
    with refused(f"{part} = no piece"):
        replace(four[0], **{part: getattr(four[0], part).take([])})


def test_clients_have_names_of_their_own(four):
    for name in ("a", SERVER):
        with refused("clients = "):
            trained([four[0], replace(four[1], name=name), replace(four[2], name=name)])


def test_the_server_asks_a_share_of_the_clients(four):
    """As many each round, by lots that do not depend on the order of the names; the history names the others."""
    names = [f"v{i}" for i in range(40)]
    given = Participation(share=0.5)
    asked = [given.asked(7, number, names) for number in range(1, 51)]
    assert {len(chosen) for chosen in asked} == {20}
    assert given.asked(7, 3, names[::-1]) == asked[2] != asked[3]
    assert Participation(share=0.01).count(4) == 1
    with refused("share"):
        Participation(share=0.0)
    fed = trained(four, 6, participation=given, seed=2)
    for row in fed.history[1:]:
        assert row.sent.keys() == row.received.keys() == set(fed.names) - row.absent.keys()
        assert set(row.absent.values()) == {"not asked"}
        assert [np.isnan(loss) for loss in row.training_loss] == [name in row.absent for name in fed.names]


def test_the_ledger_counts_every_byte(four):
    """Three weights and one loss up, three weights down, per round in which a client is asked."""
    fed = trained(four, 3, participation=Participation(0.5), seed=1)
    account, air = ledger(fed), ledger(fed, overhead=100)
    assert (account.names, account.servers) == ((*fed.names, SERVER), (SERVER,))
    sent, received = (account.of(way=way)[0] for way in ("broadcast", "per receiver"))
    rounds = np.array([sum(name not in row.absent for row in fed.history[1:]) for name in fed.names])
    assert_array_equal(sent, [*rounds * 16, 3 * 12])  # the server broadcasts
    assert_array_equal(received, [*rounds * 12, rounds.sum() * 16])
    assert_array_equal(air.of("on air", "broadcast")[0] - sent, [*100 * rounds, 300])
    assert_array_equal(air.of("on air")[0] - received, [*100 * rounds, 100 * rounds.sum()])


def test_poisoned_updates(four):
    hurt = trained(four, 6, participation=Byzantine(names=("a",), scale=-20.0))
    kept = trained(four, 6, participation=Byzantine(names=("a",), scale=-20.0), aggregate="median")
    assert not hurt.history[-1].rejected
    losses = [fed.validation_loss(fed.history[-1]) for fed in (kept, hurt)]
    assert losses[0] < losses[1]


def test_a_score_does_not_depend_on_who_is_judged_beside():
    """Bit for bit, with pieces of different number, and equal to the mean of the pieces' losses."""
    whole = clients(drives(3), Sensors(), piece=10)
    group = [replace(c, training=c.training.take(range(n))) for c, n in zip(whole, (8, 4, 2), strict=True)]
    kinds, theta = [[c.training for c in group], [c.long for c in group]], torch.tensor([[0.2], [0.4], [0.6]])
    theta = theta.repeat(1, 3)
    together = Judge(kinds, Steady())(theta)
    for row in range(3):
        alone = Judge([[kind[row]] for kind in kinds], Steady())
        assert torch.equal(alone(theta[row : row + 1])[0], together[row])
        by_hand = [Steady().losses(theta[row : row + 1], batch).mean() for batch, _ in alone.batches]
        torch.testing.assert_close(together[row], torch.stack(by_hand).max())


SIZES = torch.tensor([3, 1, 5, 2, 4, 1, 6])


def answers(clients=7, size=40, seed=0):
    """(C, P) weights in float64."""
    return torch.randn((clients, size), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def combined(which, weights, sizes=SIZES):
    """What a rule makes of one round from zero."""
    return which(torch.zeros_like(weights[0]), weights, sizes)


@pytest.fixture(scope="module")
def flower():
    """Flower's strategies; its import warns about libraries of its own."""
    pytest.importorskip("flwr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import flwr.serverapp.strategy as strategy
    return strategy


def replies(weights, sizes):
    """Flower's messages with these weights, split into two arrays as a net would be, and numbers of examples."""
    from flwr.app import Array, ArrayRecord, Message, MetricRecord, RecordDict
    from flwr.app.metadata import Metadata

    def content(row, count):
        arrays = ArrayRecord({"a": Array(row[:9].reshape(3, 3).numpy()), "b": Array(row[9:].numpy())})
        return RecordDict({"arrays": arrays, "metrics": MetricRecord({"num-examples": count})})

    def about(node):
        return Metadata(1, "", node, 99, "", "", 0.0, 60.0, "train")

    build: Any = Message
    return [
        build(content(row, int(n)), metadata=about(i)) for i, (row, n) in enumerate(zip(weights, sizes, strict=True))
    ]


def flat(record):
    """Flower's arrays as one row."""
    return torch.from_numpy(np.concatenate([record[name].numpy().ravel() for name in "ab"]))


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
def test_rules_are_those_of_flower(flower, ours, theirs, options):
    """Against flwr.serverapp.strategy; Flower weighs what Multi-Krum keeps by examples, the paper does not."""
    sizes = torch.ones_like(SIZES) if theirs == "MultiKrum" else SIZES
    for seed in range(5):
        weights = answers(seed=seed)
        record, _ = getattr(flower, theirs)(**options).aggregate_train(1, replies(weights, sizes))
        torch.testing.assert_close(combined(ours, weights, sizes), flat(record), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", [*RULES, Krum(2)])
def test_a_rule_holds_as_many_byzantine_clients_as_it_tolerates_and_no_more(name):
    """Of ten some send what is far off, together: within the hull of the honest, and far from it with one more."""
    chosen = rule(name)
    most = chosen.tolerated(10)
    assert most == {"median": 4, "trimmed_mean": 2, "krum": 1, "multi_krum": 1}.get(str(name), 2 * (name == Krum(2)))
    for hostile in (most, most + 1, 6):
        weights = torch.cat([torch.randn(10 - hostile, 5), torch.full((hostile, 5), 1e6)])
        moved = float(combined(chosen, weights, torch.ones(10)).abs().max())
        if hostile == most:
            assert moved < 5
    assert moved > 1e4


def test_a_plain_function_is_a_rule():
    weights = answers()
    torch.testing.assert_close(combined(rule(lambda w, n: w[0]), weights), weights[0])
    assert rule(torch.mean).name == "mean"
    assert rule(Krum(2)) == Krum(2)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: TrimmedMean(0.5), "share"),
        (lambda: Krum(-1), "byzantine"),
        (lambda: Krum(1, keep=0), "keep"),
        (lambda: rule("vote"), "aggregation rule"),
    ],
)
def test_impossible_parameters_are_named(make, field):
    with refused(f"^{field} = "):
        make()


def test_krum_says_how_many_clients_it_needs():
    assert (Krum(1).least, Krum(1, keep=9).least, RULES["median"].least) == (5, 9, 1)


def test_the_guard_remembers_what_is_usual():
    """With two answers the round before decides: a small change of huge weights is still seen as far too large."""
    theta = torch.full((100,), 1e6)
    honest, wrong = theta + 1.0, theta + 1000.0
    assert screen(theta, {"a": honest, "b": wrong})[0] == {}
    assert set(screen(theta, {"a": honest, "b": wrong}, usual=10.0)[0]) == {"b"}
    assert screen(theta, {}, usual=10.0) == ({}, 10.0)
    for start, most in ((torch.full((4,), 3.0), 6.0), (torch.full((4,), 0.1), 1.0)):  # at first |theta|, at least 1
        assert screen(start, {"a": start + 0.499 * most}) == ({}, pytest.approx(0.998 * most))
        assert set(screen(start, {"a": start + 0.501 * most})[0]) == {"a"}
    for far, out in ((199.0, set()), (201.0, {"c"})):  # of three answers the median decides, 2
        steps = {"a": 1.0, "b": 2.0, "c": far}
        assert set(screen(theta[:1], {name: theta[:1] + step for name, step in steps.items()})[0]) == out


def test_the_guard_lets_a_change_in_where_most_changed_nothing():
    theta = torch.ones(3)
    assert screen(theta, {"a": theta, "b": theta, "c": theta + 0.1})[0] == {}
    assert set(screen(theta, {"a": theta, "b": theta, "c": theta + 1e3})[0]) == {"c"}


def test_weights_that_are_not_finite_are_never_taken():
    """Of a rule that divides by zero; the round says why nothing changed."""
    given = {name: Answer(torch.full((2,), 0.1), 1) for name in "ab"}
    done, _, note = combine(rule(lambda w, n: w.sum(0) / 0.0), Standing(torch.zeros(2)), given)
    assert done.theta.tolist() == [0.0, 0.0]
    assert note == "<lambda> gives weights that are not finite: weights unchanged"
    with refused(r"must have the shape \(2,\)"):
        combine(rule(lambda w, n: w), Standing(torch.zeros(2)), given)


def federation(losses):  # type: ignore[type-arg]
    """A history with these losses (rounds, C)."""
    names = tuple(f"c{i}" for i in range(losses.shape[1]))
    rows = [Round(k, torch.zeros(1), (nan,) * len(row), tuple(row)) for k, row in enumerate(losses.tolist())]
    return Federation(GainNet(2, 1), tuple(rows), (5,) * len(names), 0.0, names)


@pytest.mark.parametrize("false", [nan, inf, 1e308, 1e5, 0.0])
@pytest.mark.parametrize("clients", [3, 4, 12])
def test_one_client_cannot_select_the_untrained_round(false, clients):
    """It praises the start and condemns every other round; the others' losses fall from 4 to 1 m^2."""
    curve = np.linspace(4.0, 1.0, 8)[:, None] * np.linspace(0.8, 1.2, clients)
    assert federation(curve).best.number == 7
    curve[:, 0] = [1e-9, *[false] * 7]
    fed = federation(curve)
    card = fed.card | {"training_pieces": fed.sizes, "clients": fed.names}
    assert fed.best.number == Checkpoint(fed.like, card).kept(7) >= 6


def test_honest_reports_select_the_least_mean():
    """Within ten percent of the least median the mean decides, as it did before."""
    curve = 1.0 + 0.04 * np.random.default_rng(3).random((20, 4))
    assert federation(curve).best.number == int(curve.mean(1).argmin())
    assert federation(curve[:, :2]).best.number == int(curve[:, :2].mean(1).argmin())
