"""Clients, fit and federate: pieces, laws, determinism and guards; AdamW against torch's own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import refused, winding, without

import coopoc.learned.training.fit as train
from coopoc import Sensors
from coopoc.learned import GainNet, Schedule, Segments, clients, federate, fit
from coopoc.learned.nets.gain import flatten
from coopoc.learned.training.clients import mirrored
from coopoc.learned.training.schedule import cosine

QUICK = Schedule(epochs=6, batch=2, checks=3)


def drives(lengths=(130, 260)):
    """Drives of these lengths, absent afterwards."""
    return without(
        winding(max(lengths), 9.0, 4.0, len(lengths)), *((slice(length, None), k) for k, length in enumerate(lengths))
    )


def test_pieces_as_in_the_paper():
    """T = 1550, 4600, 1450, 1420 give 15, 45, 14, 14 pieces of 100 steps after a start; 80 % of them train."""
    found = clients(drives((1550, 4600, 1450, 1420)))
    assert [(len(c.training), len(c.validation)) for c in found] == [(12, 3), (36, 9), (11, 3), (11, 3)]
    assert found[0].training.truth.shape == (12, 101, 3)


def test_training_and_validation_pieces_are_disjoint():
    for client in clients(drives(), piece=10):
        used = {row.numpy().tobytes() for row in client.training.gnss}
        kept = {row.numpy().tobytes() for row in client.validation.gnss}
        assert len(used) == len(client.training)
        assert not used & kept


def test_pieces_are_the_noisy_drive():
    fleet, sensors = drives((2100,)), Sensors.paper_training()
    (client,) = clients(fleet, sensors, piece=20)
    pieces = Segments.join([client.training, client.validation])
    assert float((pieces.gnss - pieces.truth).std()) == pytest.approx(1.5, rel=0.03)
    moved = pieces.truth.diff(dim=1) / 0.1
    assert float((pieces.velocity[:, 1:] / moved).std()) == pytest.approx(0.1, rel=0.03)
    assert float(pieces.truth[:, 0].abs().max()) == 0.0


def test_start_at_the_fix_or_the_truth():
    index = torch.arange(4)[None]
    first = {start: clients(drives(), piece=10, start=start)[0].training for start in ("gnss", "true")}
    torch.testing.assert_close(first["gnss"].batch(index).x0[0], first["gnss"].gnss[:4, 0])
    assert float(first["true"].batch(index).x0.abs().max()) == 0.0


def test_mirroring_keeps_motion_and_noise():
    pieces = clients(drives(), piece=10)[0].training
    given = pieces.batch(torch.arange(8)[None])
    seen = mirrored(given, [torch.Generator().manual_seed(2)])
    for a, b in ((given.gnss, seen.gnss), (given.truth, seen.truth)):
        torch.testing.assert_close(a.norm(dim=-1), b.norm(dim=-1))
    steps = torch.cat([pieces.truth[:, :1], pieces.truth.diff(dim=1)], 1)
    exact = replace(pieces, velocity=steps).batch(torch.arange(8)[None])
    moved = mirrored(exact, [torch.Generator().manual_seed(2)]).velocity[1:]
    torch.testing.assert_close(seen.truth.diff(dim=0), moved, atol=1e-4, rtol=0)
    assert not torch.equal(given.truth, seen.truth)


@pytest.mark.parametrize(
    ("field", "options"),
    [("start", {"start": "zero"}), ("piece", {"piece": 1}), ("fleet", {"piece": 100}), ("split", {"split": 1.0})],
)
def test_clients_refuse_what_cannot_be(field, options):
    with refused(field):
        clients(drives((130,)), **options)  # type: ignore[arg-type]


def test_a_vehicle_that_is_never_there_is_named():
    with refused("b with 0 pieces"):
        clients(drives((130, 0)), piece=10)


def test_one_federated_client_is_local_training():
    """Law: federating one client for one round is `fit` on its pieces, bit for bit."""
    (client,) = clients(drives((300,)), piece=10)
    schedule = replace(QUICK, epochs=2, epoch="pass", batch=4)
    local = fit(GainNet(), client.training, client.validation, schedule, 5, name=client.name)
    fed = federate(GainNet(), [client], 1, local_epochs=2, seed=5, schedule=schedule)
    assert torch.equal(fed.history[1].weights, local.history[-1].weights)


def test_same_seed_same_weights_and_another_seed_another_net():
    (client,) = clients(drives((300,)), piece=10)
    nets = [fit(GainNet(seed=s), client.training, client.validation, QUICK, seed=s).model for s in (1, 1, 2)]
    first, again, other = flatten(nets)
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)


def test_training_lowers_the_loss_and_keeps_the_best_weights():
    group = clients(drives((600, 600)), piece=20)
    training, validation = (Segments.join([getattr(c, part) for c in group]) for part in ("training", "validation"))
    found = fit(GainNet(start_gain=0.3), training, validation, Schedule(epochs=60, learning_rate=3e-3))
    assert found.best.validation_loss < 0.85 * found.history[0].validation_loss
    assert torch.equal(flatten([found.model])[0], found.best.weights)


def test_a_pass_sees_every_piece_and_a_step_one_batch():
    draw = np.random.default_rng(0)
    plan = Schedule(epochs=3, epoch="pass", batch=5).plan(10, draw)
    assert plan.shape == (6, 5)
    assert np.bincount(plan.ravel()).tolist() == [3] * 10
    assert Schedule(epochs=7, batch=4).plan(10, draw).shape == (7, 4)
    assert all(len(set(row)) == 4 for row in Schedule(epochs=50, batch=4).plan(10, draw).tolist())
    for epoch in ("step", "pass"):
        assert Schedule(epochs=3, epoch=epoch, batch=10**6).plan(10, draw).shape == (3, 10)


def test_a_net_that_breaks_stops_with_a_reason():
    (client,) = clients(drives((300,)), piece=10)
    broken = replace(client.training, gnss=client.training.gnss.clone().fill_(float("nan")))
    good, bad = (fit(GainNet(), pieces, client.validation, QUICK) for pieces in (client.training, broken))
    assert good.stopped is None
    assert bad.stopped == "loss or gradient not finite at step 1"
    assert torch.equal(flatten([bad.model]), flatten([GainNet()]))
    assert not torch.equal(flatten([good.model]), flatten([GainNet()]))


def test_a_net_without_finite_weights_says_so():
    (client,) = clients(drives((300,)), piece=100)
    theirs = fit(GainNet(start_gain=20.0), client.training, client.validation, replace(QUICK, epochs=2))
    assert theirs.stopped is not None
    assert "finite" in theirs.stopped


def test_a_loss_that_overflows_is_infinite():
    """A loop with gain 3 grows by 2 a step: over 100 steps its squared error is beyond float32."""
    (client,) = clients(drives((300,)), piece=100)
    net = GainNet(start_gain=3.0)
    assert train.Judge([[client.validation]], net)(flatten([net])).tolist() == [np.inf]


def test_rates_fall_as_torchs_cosine():
    optimiser = torch.optim.SGD([torch.zeros(1)], lr=1.0)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 8)
    for factor in cosine(8):
        assert factor == pytest.approx(scheduler.get_last_lr()[0], abs=1e-12)
        optimiser.step()
        scheduler.step()


@pytest.mark.parametrize("field", ["epochs", "batch", "learning_rate", "clip", "checks"])
def test_schedule_refuses_zero(field):
    with refused(field):
        Schedule(**{field: 0})  # type: ignore[arg-type]
