"""Federation laws on gains that are no net: order, stacking, participation, guard, compression, privacy, topologies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor, nn

from coopoc import Fleet, InputError, Sensors, load_fleet
from coopoc.arrays import Floats
from coopoc.learned import Client, GainNet, Schedule, clients, federate
from coopoc.learned.federation.compression import Compression, Float16, Quantised, TopK
from coopoc.learned.federation.federated import Plan, federate_many
from coopoc.learned.federation.history import Federation, ledger
from coopoc.learned.federation.local import adapt, local_fit
from coopoc.learned.federation.means import FedProx
from coopoc.learned.federation.participation import Byzantine, Participation, heterogeneous, poisoned
from coopoc.learned.federation.robust import Krum
from coopoc.learned.federation.rule import Rule
from coopoc.learned.federation.server import SERVER, Group, Standing
from coopoc.learned.federation.topology import (
    Complete,
    Mesh,
    Pairs,
    Ring,
    Topology,
    V2XGraph,
    connected,
    disagreement,
    metropolis,
)
from coopoc.learned.nets.gain import Gain
from coopoc.learned.nets.stack import flatten
from coopoc.learned.training.clients import Batch, Noise
from coopoc.learned.training.fit import Judge, pooled
from coopoc.methods.track import Method

PLAIN = Schedule(weight_decay=0.0, mirror=False, clip=1e9)


class Steady(Gain):
    """A filter with one constant gain per axis: x <- x + dt u + k (z - x - dt u)."""

    def __init__(self, gain: float = 0.3) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.full((3,), gain))

    @property
    def settings(self) -> Mapping[str, Any]:
        return {}

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        x, error = batch.x0, torch.zeros(batch.x0.shape[:2])
        for fix, speed, truth in zip(batch.gnss, batch.velocity, batch.truth, strict=True):
            x = x + batch.dt * speed
            x = x + theta[:, None] * (fix - x)
            gap = x - truth
            error = error + (gap[..., 0].square() + gap[..., 1].square() + gap[..., 2].square())
        return error / len(batch.truth)

    def method(self, name: str, x0: Floats | None = None) -> Method:
        raise NotImplementedError


class Bowl(Steady):
    """||theta - b||^2 with b the mean of a piece's truth: the federation's minimiser is the mean of all pieces' b."""

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        return (theta[:, None] - batch.truth.mean(0)).square().sum(-1)


def drives(count: int = 4, steps: int = 130, seed: int = 0) -> Fleet:
    """Vehicles that turn at different speeds."""
    rng, t = np.random.default_rng(seed), np.arange(steps) / 10
    wave = t[:, None] / 4 + rng.uniform(0, 6, count)
    speed = rng.uniform(4, 12, count)
    velocity = np.stack([speed * np.cos(wave), speed * np.sin(wave), 0.1 + 0 * wave], axis=-1)
    return Fleet(tuple(f"c{i}" for i in range(count)), t, np.cumsum(0.1 * velocity, axis=0), velocity)


@pytest.fixture(scope="module")
def four() -> tuple[Client, ...]:
    return clients(drives(), piece=10)


def trained(group: Sequence[Client], rounds: int = 3, model: Gain | None = None, **options: Any) -> Federation:
    """A short federation of constant gains."""
    start = model or Steady()
    return federate(start, group, rounds, **{"local_epochs": 1, "schedule": Schedule(learning_rate=0.02), **options})


EVERYTHING: list[dict[str, Any]] = [
    {},
    {"aggregate": "uncertainty"},
    {"aggregate": "geometric_median", "participation": Participation(0.75, 0.2, 0.5)},
    {"aggregate": "fedadam", "compression": Quantised(6)},
    {"compression": TopK(0.4), "participation": Participation(0.5)},
    {"topology": Ring(), "participation": Participation(1.0, 0.3)},
]


@pytest.mark.parametrize("options", EVERYTHING, ids=str)
def test_the_order_of_the_clients_changes_nothing(four: tuple[Client, ...], options: dict[str, Any]) -> None:
    """Same seed, same weights, bit for bit, whatever the order of the clients."""
    one, other = trained(four, seed=3, **options), trained(four[::-1], seed=3, **options)
    how: dict[str, Any] = {"rounds": 3, "local_epochs": 1, "schedule": Schedule(learning_rate=0.02), **options}
    together = federate_many([Steady(), Steady()], [four[::-1], four], [8, 3], Plan(**how))[1]
    for a, b, c in zip(one.history, other.history, together.history, strict=True):
        assert torch.equal(a.weights, b.weights)
        assert torch.equal(a.weights, c.weights)
        assert (a.traffic, a.absent) == (b.traffic, b.absent) == (c.traffic, c.absent)
    assert not torch.equal(one.history[-1].weights, trained(four, seed=4, **options).history[-1].weights)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_client_alone_is_its_row_of_the_stack(four: tuple[Client, ...], share: float) -> None:
    """`local_fit` is what `adapt` makes of the client among others, bit for bit."""
    theta = flatten([Steady(0.2 + 0.1 * i) for i in range(4)])
    local = Schedule(epochs=2, epoch="pass", batch=3)
    stacked, (pool, members) = theta.clone(), pooled([c.training for c in four])
    losses, broken = adapt(stacked, Steady(), pool, members, [(5, c.name) for c in four], 2, 6, local, [share] * 4)
    assert not broken
    for row, client in enumerate(four):
        alone, loss, reason = local_fit(Steady(), theta[row], client, 5, 2, 6, local, share)
        assert torch.equal(alone, stacked[row])
        assert (loss, reason) == (float(losses[row]), None)
    assert torch.equal(theta[0], torch.full((3,), 0.2))


def test_a_client_alone_says_why_it_broke(four: tuple[Client, ...]) -> None:
    broken = replace(four[0].training, gnss=torch.full_like(four[0].training.gnss, torch.nan))
    weights, loss, reason = local_fit(
        Steady(), flatten([Steady()])[0], replace(four[0], training=broken), 0, 1, 2, Schedule(epochs=1, epoch="pass")
    )
    assert torch.equal(weights, torch.full((3,), 0.3))
    assert np.isnan(loss)
    assert reason == "loss or gradient not finite at step 1"


def test_the_proximal_term_is_that_of_fedprox(four: tuple[Client, ...]) -> None:
    """Against torch's AdamW and clipping on the loss with mu / 2 ||theta - theta_g||^2 written out."""
    local = Schedule(epochs=2, epoch="pass", batch=100, learning_rate=0.05, proximal=0.7, mirror=False, clip=2.0)
    start = torch.tensor([0.2, 0.5, 0.4])
    ours, _, _ = local_fit(Steady(), start, four[0], 0, 1, 1, local)
    pieces = four[0].training
    steps = -(-2 * len(pieces) // 100)
    theirs = start.clone().requires_grad_()
    optimiser = torch.optim.AdamW([theirs], lr=0.05, weight_decay=0.3)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        loss = Steady().losses(theirs[None], pieces.batch(torch.arange(len(pieces))[None])).mean()
        optimiser.zero_grad()
        (loss + 0.35 * (theirs - start).square().sum()).backward()
        torch.nn.utils.clip_grad_norm_([theirs], 2.0)
        optimiser.step()
        cosine.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-5, atol=1e-7)


def test_fedprox_keeps_clients_near(four: tuple[Client, ...]) -> None:
    """The rule sets the term by itself, as the schedule would."""
    step = [
        float((trained(four, 1, aggregate=rule).history[1].weights - 0.3).norm())
        for rule in ("mean", FedProx(1.0), FedProx(1e3))
    ]
    assert step[0] >= step[1] > step[2]
    by_schedule = trained(four, 1, schedule=Schedule(learning_rate=0.02, proximal=1.0))
    assert torch.equal(by_schedule.history[1].weights, trained(four, 1, aggregate=FedProx(1.0)).history[1].weights)


def test_who_is_asked_and_who_answers() -> None:
    """Exactly the share is asked; dropouts and stragglers come as often as a binomial test allows."""
    names = [f"v{i}" for i in range(40)]
    given = Participation(share=0.5, dropout=0.3, straggle=0.4)
    turns = [turn for number in range(1, 51) for turn in given.turns(7, number, names)]
    asked = [turn for turn in turns if turn.asked]
    assert len(asked) == 50 * 20
    gone = sum(turn.absent is not None for turn in asked)
    slow = [turn.share for turn in asked if 0 < turn.share < 1]
    assert stats.binomtest(gone, 1000, 0.3).pvalue > 0.001
    assert stats.binomtest(len(slow), 1000 - gone, 0.4).pvalue > 0.001
    assert stats.kstest(slow, "uniform").pvalue > 0.001
    assert given.turns(7, 3, names[::-1]) == given.turns(7, 3, names)[::-1]
    assert given.turns(7, 3, names) != given.turns(7, 4, names)
    assert Participation(share=0.01).count(4) == 1


def test_the_history_names_the_absent_and_the_slow(four: tuple[Client, ...]) -> None:
    fed = trained(four, 6, participation=Participation(0.5, 0.3, 0.6), seed=2)
    for row in fed.history[1:]:
        asked = {receiver for sender, receiver in row.traffic if sender == SERVER}
        answered = {sender for sender, receiver in row.traffic if receiver == SERVER}
        assert len(asked) == 2
        assert {name for name, reason in row.absent.items() if reason == "not asked"} == set(fed.names) - asked
        assert {n for n, reason in row.absent.items() if reason == "asked, but did not answer"} == asked - answered
        assert set(row.stragglers) <= answered
        assert [np.isnan(loss) for loss in row.training_loss] == [name not in answered for name in fed.names]
    assert any("of its local steps" in reason for row in fed.history for reason in row.stragglers.values())


def test_a_round_with_nobody_changes_nothing(four: tuple[Client, ...]) -> None:
    for topology in (None, Ring()):
        fed = trained(four, 2, participation=Participation(dropout=1.0), topology=topology)
        assert all(torch.equal(row.weights, fed.history[0].weights) for row in fed.history)
        assert fed.history[1].note == "no client answered: weights unchanged"
        assert fed.best.number == 0
        assert fed.history[1].sent_bytes == 0


def test_a_straggler_makes_a_part_of_its_steps(four: tuple[Client, ...]) -> None:
    """What arrives is `local_fit` with the share that the draw gives."""
    slow = Participation(straggle=1.0)
    fed = trained(four[:1], 1, participation=slow, seed=4)
    (turn,) = slow.turns(4, 1, ["c0"])
    local = Schedule(epochs=1, epoch="pass", learning_rate=0.02)
    assert 0 < turn.share < 1
    alone, _, _ = local_fit(Steady(), fed.history[0].weights, four[0], 4, 1, 1, local, turn.share)
    assert torch.equal(fed.history[1].weights, alone)


@dataclass(frozen=True)
class Faulty(Participation):
    """Participation in which named clients answer wrongly."""

    faults: tuple[tuple[str, str], ...] = ()

    def answer(self, name: str, number: int, theta: Tensor, weights: Tensor) -> Tensor:
        """NaN, another shape, or a change a thousand times too large."""
        wrong = {"nan": weights + torch.nan, "shape": weights[:-1], "far": theta + 1000 * (weights - theta)}
        return wrong.get(dict(self.faults).get(name, ""), weights)


@pytest.mark.parametrize(
    "faults",
    [{"c1": "nan"}, {"c1": "shape"}, {"c1": "far"}, {"c1": "nan", "c2": "shape", "c3": "far"}],
    ids=lambda faults: "+".join(faults.values()),
)
@pytest.mark.parametrize("number", [1, 4])
def test_bad_answers_are_rejected_and_training_goes_on(number: int, faults: dict[str, str]) -> None:
    """The result is that of the honest clients alone, bit for bit: among five of them, and beside a single one."""
    group = clients(drives(4 + number), piece=10)
    honest = [client for client in group if client.name not in faults]
    fed = trained(group, 4, participation=Faulty(faults=tuple(faults.items())))
    for row, alone in zip(fed.history[1:], trained(honest, 4).history[1:], strict=True):
        assert set(row.rejected) == set(faults)
        assert torch.equal(row.weights, alone.weights)
    two = trained(group[:2], 4, participation=Faulty(faults=(("c1", "far"),)))
    assert all(set(row.rejected) == {"c1"} for row in two.history[1:])
    assert all("changes the weights by" in row.rejected["c1"] for row in two.history[1:])


def test_a_client_that_never_answered_does_not_choose_the_weights(four: tuple[Client, ...]) -> None:
    """Its pieces are not finite, so that its loss is infinite in every round; the others' best round is kept."""

    def without_fixes(pieces: Any) -> Any:
        return replace(pieces, gnss=torch.full_like(pieces.gnss, torch.nan))

    broken = replace(four[3], training=without_fixes(four[3].training), validation=without_fixes(four[3].validation))
    fed = trained([*four[:3], broken], 3)
    assert fed.history[1].rejected == {"c3": "loss or gradient not finite at step 1"}
    assert fed.best.number == trained(four[:3], 3).best.number > 0
    assert ("c3", SERVER) not in fed.history[1].traffic


def test_absent_clients_count_with_their_last_answer(four: tuple[Client, ...]) -> None:
    fed = trained(four, 4, participation=Participation(0.5), seed=1)
    for before, row in zip(fed.history, fed.history[1:], strict=False):
        for i, name in enumerate(fed.names):
            assert (row.validation_loss[i] == before.validation_loss[i]) == (name in row.absent)


def test_too_few_answers_for_the_rule_are_said(four: tuple[Client, ...]) -> None:
    group = clients(drives(5), piece=10)
    fed = trained(group, 6, aggregate="krum", participation=Participation(dropout=0.3), seed=1)
    stayed = [row for row in fed.history[1:] if row.note]
    assert {row.note[1:] for row in stayed} == {
        " answers accepted, Krum(byzantine=1, keep=1) takes at least 5: weights unchanged"
    }
    assert len(stayed) < 6
    for before, row in zip(fed.history, fed.history[1:], strict=False):
        assert torch.equal(before.weights, row.weights) == (row.note != "")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"aggregate": "krum"}, r"Krum\(byzantine=1, keep=1\) with 4 clients a round: takes at least 5"),
        ({"aggregate": Krum(0, keep=3), "participation": Participation(0.5)}, "with 2 clients a round"),
        ({"topology": Ring(), "aggregate": "median"}, "aggregate = median"),
        ({"topology": Ring(), "compression": Float16()}, "compression = Float16"),
        ({"topology": Pairs((("c0", "c1"),))}, r"without a path from c0 to \['c2', 'c3'\]"),
        ({"topology": Pairs((("c0", "x"),))}, "pairs = "),
        ({"topology": Pairs((("c0", "c11"),))}, r"pairs = 'c11': must be one of c0, .* Did you mean c1\?"),
        ({"topology": V2XGraph(drives(2), 1e9)}, "vehicle = 'c2'"),
        ({"rounds": 0}, "rounds = 0"),
    ],
)
def test_what_cannot_be_federated_is_said_at_once(
    four: tuple[Client, ...], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        trained(four, **options)


def test_clients_have_names_of_their_own(four: tuple[Client, ...]) -> None:
    for name in ("c0", SERVER):
        with pytest.raises(InputError, match="clients = "):
            trained([four[0], replace(four[1], name=name), replace(four[2], name=name)])


@pytest.mark.parametrize(
    ("field", "options"),
    [("share", {"share": 0.0}), ("dropout", {"dropout": 1.1}), ("straggle", {"straggle": -0.1})],
)
def test_participation_refuses_what_cannot_be(field: str, options: dict[str, float]) -> None:
    with pytest.raises(InputError, match=field):
        Participation(**options)


@pytest.mark.parametrize(
    ("compression", "size"),
    [(None, 12), (Float16(), 6), (TopK(0.4), 12), (Quantised(5), 6)],
)
def test_the_ledger_counts_every_byte(four: tuple[Client, ...], compression: Compression | None, size: int) -> None:
    """Three weights and one loss up, three weights down, per round; who drops out has received and not sent."""
    fed = trained(four, 3, compression=compression, participation=Participation(dropout=0.4), seed=1)
    account, air = ledger(fed), ledger(fed, overhead=100)
    assert account.names == (*fed.names, SERVER)
    assert account.servers == (SERVER,)
    sent, received = (account.of("training", way=way)[0] for way in ("broadcast", "per receiver"))
    rounds = np.array([sum(name not in row.absent for row in fed.history[1:]) for name in fed.names])
    np.testing.assert_array_equal(sent, [*rounds * (size + 4), 3 * 12])  # the server broadcasts
    np.testing.assert_array_equal(received, [3 * 12] * 4 + [rounds.sum() * (size + 4)])
    np.testing.assert_array_equal(air.of("training", "on air", "broadcast")[0] - sent, [*100 * rounds, 300])
    np.testing.assert_array_equal(air.of("training", "on air")[0] - received, [300] * 4 + [100 * rounds.sum()])
    moved = sum(row.sent_bytes + row.received_bytes for row in fed.history)
    assert account.per_vehicle("training") == moved / 4
    assert 0 < min(sent[:4]) < max(sent[:4])


def test_compression_changes_the_weights_as_little_as_it_promises(four: tuple[Client, ...]) -> None:
    """TopK of everything is no compression; what TopK keeps back is sent in the end."""
    plain = trained(four, 1).history[1].weights
    torch.testing.assert_close(trained(four, 1, compression=TopK(1.0)).history[1].weights, plain, rtol=0, atol=1e-7)
    torch.testing.assert_close(trained(four, 1, compression=Float16()).history[1].weights, plain, rtol=0, atol=1e-4)
    bowl: dict[str, Any] = {"schedule": replace(PLAIN, learning_rate=0.05), "model": Bowl(0.0)}
    whole, third = (trained(four, 60, compression=c, **bowl).history[-1].weights for c in (None, TopK(1 / 3)))
    torch.testing.assert_close(third, whole, rtol=0, atol=0.05 * float(whole.abs().max()))


@dataclass(frozen=True)
class Clipped:
    """The simplest protection: every update is clipped to a norm."""

    norm: float

    def protect(self, updates: Tensor, names: Sequence[str], seed: int, number: int) -> Tensor:
        """Scaled down to the norm."""
        assert updates.shape == (len(names), 3)
        return updates * torch.clamp(self.norm / updates.norm(dim=1, keepdim=True), max=1.0)

    def check(self, rule: Rule) -> None:
        """Uniform weights only."""
        if rule.mean_by != "uniform":
            raise InputError("aggregate", rule, 'must be "uniform" with clipping', "Take uniform.")


def test_protection_acts_before_anything_leaves(four: tuple[Client, ...]) -> None:
    """Clipped updates of one client are as long as the clip; compression then acts on what was clipped."""
    for compression in (None, TopK(1.0)):
        fed = trained(four[:1], 4, aggregate="uniform", privacy=Clipped(0.003), compression=compression)
        path = torch.stack([row.weights for row in fed.history])
        torch.testing.assert_close(path.diff(dim=0).norm(dim=1), torch.full((4,), 0.003), rtol=1e-3, atol=0)
    with pytest.raises(InputError, match="uniform"):
        trained(four, privacy=Clipped(1.0))
    with pytest.raises(InputError, match="privacy = "):
        trained(four, privacy=Clipped(1.0), topology=Ring())


def test_a_complete_graph_is_the_uniform_rule(four: tuple[Client, ...]) -> None:
    """Metropolis weights of a complete graph are 1 / C: every client holds the uniform mean."""
    mesh, server = trained(four, 4, topology=Complete()), trained(four, 4, aggregate="uniform")
    for row, other in zip(mesh.history, server.history, strict=True):
        torch.testing.assert_close(row.weights, other.weights, rtol=1e-5, atol=1e-7)
        assert row.disagreement < 1e-6
    assert mesh.own is not None
    torch.testing.assert_close(mesh.own, server.history[-1].weights.expand(4, 3), rtol=1e-5, atol=1e-7)
    assert server.own is None


@pytest.mark.parametrize("topology", [Ring(), Pairs((("c0", "c1"), ("c0", "c2"), ("c0", "c3"), ("c3", "c4")))])
def test_mixing_alone_agrees_as_fast_as_the_graph_allows(topology: Topology) -> None:
    """Without training, k rounds are the k-th power of a doubly stochastic matrix: the mean stays, the rest shrinks
    by its second eigenvalue (numpy)."""
    names = tuple(f"c{i}" for i in range(5))
    mix = metropolis(connected(topology, names))
    np.testing.assert_allclose(mix, mix.T)
    np.testing.assert_allclose(mix.sum(0), 1.0)
    start = torch.randn((5, 7), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    standing = Standing(start.mean(0), start, (), start, (10.0,) * 5)
    mesh, group, present = Mesh(connected(topology, names), Participation()), Group(names, (1,) * 5, 0), Participation()
    for number in range(1, 21):
        held = dict(zip(names, standing.held, strict=True))
        standing, moved = mesh(group, standing, number, present.turns(0, number, names), held, [1.0] * 5)
        assert not moved.rejected
    np.testing.assert_allclose(standing.held, np.linalg.matrix_power(mix, 20) @ start.numpy(), atol=1e-12)
    torch.testing.assert_close(standing.theta, start.mean(0))
    second = np.sort(np.abs(np.linalg.eigvalsh(mix)))[-2]
    assert disagreement(standing.held) <= 2 * second**20 * float((start - start.mean(0)).norm())


def test_a_ring_agrees_where_the_server_ends(four: tuple[Client, ...]) -> None:
    """Quadratics whose minima differ: all clients end at what the uniform rule finds, which no client finds alone."""
    options: dict[str, Any] = {"model": Bowl(0.0), "schedule": replace(PLAIN, learning_rate=0.3)}
    ring, server = trained(four, 80, topology=Ring(), **options), trained(four, 80, aggregate="uniform", **options)
    minima = torch.stack([c.training.truth[:, 1:].mean((0, 1)) for c in four])
    spread, found = disagreement(minima), server.history[-1].weights
    assert ring.own is not None
    assert float((ring.own - found).norm(dim=1).max()) < 0.02 * spread
    assert ring.history[-1].disagreement < 0.01 * max(row.disagreement for row in ring.history)
    assert float((minima - found).norm(dim=1).min()) > 0.1 * spread


def test_bytes_of_a_mesh_are_counted_per_link_and_direction(four: tuple[Client, ...]) -> None:
    fed = trained(four, 2, topology=Ring())
    pairs = [("c0", "c1"), ("c1", "c2"), ("c2", "c3"), ("c3", "c0")]
    assert fed.history[1].traffic == dict.fromkeys([*pairs, *((b, a) for a, b in pairs)], 12)
    account = ledger(fed)
    assert account.servers == ()
    assert account.of("training").tolist() == [[48] * 4]
    assert account.of("training", way="broadcast").tolist() == [[24] * 4]  # one message reaches both neighbours


def test_a_neighbour_that_sends_nonsense_is_not_mixed_in(four: tuple[Client, ...]) -> None:
    for fault in ("nan", "shape", "far"):
        fed = trained(four, 3, topology=Ring(), participation=Faulty(faults=(("c1", fault),)))
        assert all(set(row.rejected) == {"c1"} for row in fed.history[1:])
        assert all(row.weights.isfinite().all() for row in fed.history)
        assert fed.history[-1].disagreement < 1.0


def test_whoever_is_absent_keeps_its_weights(four: tuple[Client, ...]) -> None:
    fed = trained(four, 1, topology=Complete(), participation=Participation(0.5), seed=5)
    assert fed.own is not None
    away = [name in fed.history[1].absent for name in fed.names]
    assert sum(away) == 2
    assert [torch.equal(own, fed.history[0].weights) for own in fed.own] == away


def test_the_training_fleet_is_a_connected_graph_within_the_papers_radius() -> None:
    """Against distances taken pair by pair."""
    fleet = load_fleet("town10-clients")
    links = connected(V2XGraph(fleet, 30.0), fleet.ids)
    for i, j in ((0, 1), (1, 2), (2, 3), (0, 3), (0, 2)):
        gap = np.linalg.norm(fleet.position[:, i] - fleet.position[:, j], axis=-1)
        assert links[i, j] == links[j, i] == (np.nanmin(gap) <= 30.0)


def test_clients_may_differ_in_sensors_and_in_amount() -> None:
    """Each has the noise of its own sensors, its keyed draws, and its part of the pieces."""
    fleet = drives(3, 2100)
    good, poor = Sensors(gnss_std=(0.5, 0.5, 0.5)), Sensors(gnss_std=(4, 4, 4), velocity_std_ratio=0.2)
    found = heterogeneous(fleet, [good, poor, good], [1.0, 0.5, 0.25], piece=20, seed=6)
    whole = clients(fleet, poor, piece=20, seed=6)
    assert [len(c.training) for c in found] == [80, 40, 20]
    assert torch.equal(found[1].training.gnss, whole[1].training.gnss[:40])
    assert torch.equal(found[1].long.gnss, whole[1].long.gnss)
    for client, std in zip(found, (0.5, 4.0, 0.5), strict=True):
        assert float((client.training.gnss - client.training.truth).std()) == pytest.approx(std, rel=0.1)
    for field, sensors, shares in (
        ("sensors", [good], [1, 1, 1]),
        ("shares", [good] * 3, [1, 1]),
        ("shares", [good] * 3, [1, 1, 0]),
    ):
        with pytest.raises(InputError, match=field):
            heterogeneous(fleet, sensors, shares, piece=20)


def test_poisoned_data_and_poisoned_updates(four: tuple[Client, ...]) -> None:
    """A moved truth moves the client's minimum by as much; a turned update is the mirror image of the honest one."""
    shifted = poisoned(four[0], 10.0)
    torch.testing.assert_close(
        shifted.training.truth - four[0].training.truth,
        torch.full_like(shifted.training.truth, 10.0),
        rtol=0,
        atol=1e-5,
    )
    assert torch.equal(shifted.training.gnss, four[0].training.gnss)
    honest, byzantine = trained(four[:1], 1), trained(four[:1], 1, participation=Byzantine(names=("c0",), scale=-1.0))
    torch.testing.assert_close(byzantine.history[1].weights - 0.3, 0.3 - honest.history[1].weights)
    hurt = trained(four, 6, participation=Byzantine(names=("c0",), scale=-20.0))
    kept = trained(four, 6, participation=Byzantine(names=("c0",), scale=-20.0), aggregate="median")
    assert not hurt.history[-1].rejected
    losses = [fed.validation_loss(fed.history[-1]) for fed in (kept, hurt)]
    assert losses[0] < losses[1]


@pytest.mark.slow
@pytest.mark.parametrize("aggregate", ["mean", "multi_krum"])
def test_a_net_is_federated_the_same_way(aggregate: str) -> None:
    """GainNet with all options at once moves, stays finite and repeats to the last bit."""
    group, net = clients(drives(6), piece=10), GainNet(2, 1)
    options: dict[str, Any] = {"participation": Participation(0.9, 0.1, 0.3), "compression": Quantised(8)}
    fed, again = (trained(group, 2, model=net, aggregate=aggregate, seed=1, **options) for _ in range(2))
    path = torch.stack([row.weights for row in fed.history])
    assert path.isfinite().all()
    assert path.diff(dim=0).norm() > 0
    assert torch.equal(path, torch.stack([row.weights for row in again.history]))


@pytest.mark.parametrize("noise", ["static", "fresh", "wide"])
def test_a_score_does_not_depend_on_who_is_judged_beside(noise: Noise) -> None:
    """Bit for bit, with pieces of different number, and equal to the mean of the pieces' losses on one draw."""
    group = heterogeneous(drives(3), [Sensors()] * 3, [1.0, 0.5, 0.2], piece=10, noise=noise)
    kinds, theta = [[c.training for c in group], [c.long for c in group]], torch.tensor([[0.2], [0.4], [0.6]])
    theta = theta.repeat(1, 3)
    together = Judge(kinds, Steady())(theta)
    for row in range(3):
        alone = Judge([[kind[row]] for kind in kinds], Steady())
        assert torch.equal(alone(theta[row : row + 1])[0], together[row])
        by_hand = [Steady().losses(theta[row : row + 1], batch).mean() for batch, _ in alone.batches]
        torch.testing.assert_close(together[row], torch.stack(by_hand).max())
        off = torch.cat([(batch.gnss - batch.truth).flatten() for batch, _ in alone.batches])
        assert noise == "wide" or float(off.std()) == pytest.approx(1.5, rel=0.2)


def test_a_net_alone_is_its_row_of_the_stack(four: tuple[Client, ...]) -> None:
    """The compiled net's gradients do not depend on who is computed beside it: `local_fit` is `adapt`, bit for bit."""
    pytest.importorskip("numba")
    theta = flatten([GainNet(2, 1, seed=i) for i in range(4)])
    stacked, (pool, members) = theta.clone(), pooled([c.training for c in four])
    local = Schedule(epochs=2, epoch="pass")
    losses, _ = adapt(stacked, GainNet(2, 1), pool, members, [(5, c.name) for c in four], 1, 3, local)
    scores = Judge([[c.validation for c in four], [c.long for c in four]], GainNet(2, 1))(stacked)
    for row, client in enumerate(four):
        alone, loss, _ = local_fit(GainNet(2, 1), theta[row], client, 5, 1, 3, local)
        assert torch.equal(alone, stacked[row])
        assert loss == float(losses[row])
        assert Judge([[client.validation], [client.long]], GainNet(2, 1))(alone[None]) == scores[row]
