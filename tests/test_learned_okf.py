"""OptimisedKF: recovers known noise, equals filterpy's filter, and its covariance is calibrated."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import holed, refused
from numpy.testing import assert_allclose
from oracles.pace import after
from oracles.solo import filterpys
from test_learned_measured import walk

from coopoc import Fleet, Sensors, observe
from coopoc.learned import NoiseParameters, OptimisedKF, clients
from coopoc.learned.nets.okf import scan
from coopoc.learned.training.clients import Batch
from coopoc.learned.training.fit import fit_okf


@pytest.mark.parametrize("start", ["gnss", "true"])
def test_recovers_the_noise_of_a_linear_problem(start):
    """Known: 0.2 m per step and 1.5 m; the loss fixes the ratio, the innovations fix the scale."""
    (client,) = clients(walk(8100, 1)[1], Sensors(), piece=100, start=start)  # type: ignore[arg-type]
    model, card = fit_okf(client.training, client.validation, steps=120)
    method = model.method("okf")
    assert_allclose(method.process_std, 0.2, rtol=0.12)
    assert_allclose(method.gnss_std, 1.5, rtol=0.05)
    assert card["validation_loss"][-1] < card["validation_loss"][0]


@pytest.mark.slow
def test_recovers_the_share_of_the_velocity():
    """Known: 10 % of each velocity component (the "axis" reading of the paper's training noise)."""
    t = np.arange(8100) / 10
    velocity = np.stack([9 * np.cos(t / 9), 9 * np.sin(t / 9), 4 * np.cos(t / 5)], axis=-1)[:, None]
    (client,) = clients(Fleet(("a",), t, np.cumsum(0.1 * velocity, 0), velocity), Sensors.paper_training())
    found = fit_okf(client.training, client.validation, steps=150)[0].method("okf")
    assert_allclose(found.velocity_ratio, 0.1, rtol=0.2)
    assert_allclose(found.gnss_std, 1.5, rtol=0.05)


def test_equals_filterpy():
    """Where fixes are missing or state their deviations, too; so do the estimates and innovations that are trained."""
    method = OptimisedKF((0.1, 0.2, 0.05), (0.1, 0.05, 0.0), (1.5, 2.0, 0.7))
    velocity = np.random.default_rng(0).normal(0, 8, (50, 1, 3))
    rec = holed(observe(Fleet(("a",), np.arange(50) / 10, np.cumsum(0.1 * velocity, 0), velocity), Sensors()), 0.5)
    rec = replace(rec, velocity=rec.velocity[:, [0, 0, *range(2, 50)]])  # the pace of a piece begins at its first step
    factor = np.random.default_rng(1).uniform(0.5, 9.0, (50, 1))
    rec = replace(rec, fix_factor=factor)
    track, r = method(rec), np.diag(np.square(method.gnss_std))
    given = (torch.tensor(a[0, 1:, None]) for a in (rec.gnss, rec.velocity, rec.gnss))
    stds = torch.tensor([[method.process_std, method.velocity_ratio, method.gnss_std]], dtype=torch.float64)
    ours, normalised = scan(
        stds, Batch(*given, torch.tensor(rec.gnss[:, :1, 0]), 0.1, False, torch.tensor(factor[:, None, None]))
    )
    theirs = filterpys(rec.gnss[0, 0, 0], factor[0] ** 2 * r, 0.1)
    before, square = rec.velocity[0, 0, 0], rec.velocity[0, 0, 0] ** 2
    for step in range(1, 50):
        u = rec.velocity[0, step, 0]
        square, before = after(square, before, 0.1), u
        moved = 0.1 * np.array(method.velocity_ratio) * np.sqrt(square)
        theirs.predict(u=u, Q=np.diag(np.square(method.process_std) + moved**2))
        fix = rec.gnss[0, step, 0]
        theirs.update(None if np.isnan(fix[0]) else fix, factor[step] ** 2 * r)
        assert_allclose(track.x[0, step, 0], theirs.x, atol=1e-10)
        assert_allclose(track.covariance[0, step, 0], theirs.P, atol=1e-10)
        assert_allclose(ours[step - 1, 0, 0], theirs.x, atol=1e-9)
        if np.isfinite(fix[0]):
            assert_allclose(normalised[step - 1, 0, 0], theirs.y / np.sqrt(np.diag(theirs.S)), atol=1e-9)


def test_pieces_without_a_fix_do_not_lower_the_scale():
    (client,) = clients(walk(900, 1)[1], Sensors(), piece=20)
    seen, net = client.training, NoiseParameters()
    blind = replace(seen, gnss=seen.gnss.clone().index_fill(1, torch.arange(1, 21), torch.nan))
    ours, theirs = (net.calibrate(parts).logs.detach() for parts in ([seen, blind], [seen]))
    assert_allclose(ours, theirs, atol=1e-5)


def test_noise_that_cannot_be_is_refused():
    with refused("gnss_std"):
        OptimisedKF((0.1, 0.1, 0.1), (0, 0, 0), (1.5, 0.0, 1.5))
    with refused("process_std"):
        replace(OptimisedKF((0.1, 0.1, 0.1), (0, 0, 0), (1.5, 1.5, 1.5)), process_std=(0.1, -1, 0.1))
