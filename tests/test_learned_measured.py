"""Training on measured fixes and odometry: pieces, missing truth and fixes, known noise, and a log from end to end."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from conftest import refused, slow_fixes, without
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from test_learned_engine import loss_and_gradient

import coopoc as co
from coopoc import V2X, Fleet, Sensors, observe
from coopoc.cli import main
from coopoc.learned import GainNet, NoiseParameters, Schedule, Segments, load_method, train_all
from coopoc.learned.checkpoint import read
from coopoc.learned.nets.gain import flatten
from coopoc.learned.recipes import RECIPES
from coopoc.learned.training.clients import Batch
from coopoc.learned.training.drives import MeasuredDrives, measured_clients

NETS = (GainNet(2, 1), NoiseParameters())


def walk(steps=400, vehicles=2, seed=0, every=1):
    """Vehicles that stand by their odometry and move by N(0, 0.2^2) m a step: the noise of both is known exactly."""
    rng, t = default_rng(seed), np.arange(steps) / 10
    position = np.cumsum(rng.normal(0, 0.2, (steps, vehicles, 3)), axis=0)
    fleet = Fleet(tuple(f"v{k}" for k in range(vehicles)), t, position, np.full((steps, vehicles, 3), 1e-9))
    return slow_fixes(observe(fleet, Sensors(gnss_std=(1.5, 1.5, 1.5)), V2X(max_neighbours=0)), every), fleet


def batch(seed=0, steps=30, lanes=4):
    draw = torch.Generator().manual_seed(seed)
    truth = torch.randn((steps, 1, lanes, 3), generator=draw).cumsum(0)
    noise = torch.randn((2, steps, 1, lanes, 3), generator=draw)
    x0 = torch.randn((1, lanes, 3), generator=draw)
    return Batch(truth + noise[0], 10.0 * truth.diff(dim=0, prepend=truth[:1]) + noise[1], truth, x0, 0.1)


def test_pieces_are_what_was_measured_from_a_fix_on():
    """Ten fixes at every seventh step are 70 steps; the next piece begins at the first fix after that."""
    recording, fleet = walk(1700, every=7)
    recording = replace(recording, fix_factor=default_rng(1).uniform(0.5, 9.0, (1700, 2)))
    first = measured_clients(MeasuredDrives(recording, fleet), piece=10)[0]
    pieces = Segments.join([first.training, first.validation])
    for row, at in enumerate(range(0, 22 * 77, 77)):
        origin = recording.gnss[0, at, 0]
        for ours, theirs in ((pieces.gnss, recording.gnss[0]), (pieces.truth, fleet.position)):
            assert_allclose(ours[row], theirs[at : at + 71, 0] - origin, atol=1e-5, equal_nan=True)
        assert_allclose(pieces.velocity[row], recording.velocity[0, at : at + 71, 0], atol=1e-6)
        assert_allclose(pieces.scale[row, :, 0], recording.fix_factor[at : at + 71, 0], rtol=1e-6)
    assert (len(first.training), len(first.validation)) == (17, 5)
    assert first.long.truth.shape[1] == 9 * 70 + 1


def test_pieces_are_shorter_where_a_vehicle_would_have_few():
    """1700 steps with 243 fixes hold twenty pieces of 84 steps, not of 30 fixes; they have 100 at the least."""
    drives = MeasuredDrives(*walk(1700, every=7))
    for piece, steps in ((10, 70), (30, 84), (100, 100)):
        assert measured_clients(drives, piece=piece)[0].training.truth.shape[1] == steps + 1


def test_a_gap_of_the_odometry_is_in_no_piece_and_one_of_the_truth_has_no_loss():
    recording, fleet = walk(vehicles=1)
    velocity, gnss = recording.velocity.copy(), recording.gnss.copy()
    velocity[:, 50:60], gnss[:, 50:60] = np.nan, np.nan
    holed = MeasuredDrives(replace(recording, velocity=velocity, gnss=gnss), without(fleet, (slice(70, 81), 0)))
    (only,) = measured_clients(holed, piece=20)
    pieces = Segments.join([only.training, only.validation])
    assert bool(pieces.velocity.isfinite().all())
    unknown = pieces.truth.isnan().all(-1).sum(1)
    assert unknown.tolist()[:4] == [0, 0, 11, 0]  # from steps 0, 21, 60, 81
    assert int(unknown.sum()) == 11


@pytest.mark.parametrize("net", NETS, ids=lambda net: f"{type(net).__name__}{sum(p.numel() for p in net.parameters())}")
def test_steps_without_a_truth_have_no_loss(net):
    """A truth that ends early: losses and gradients of the drive that ends there, which knows nothing of masks."""
    whole, theta = batch(), flatten([net])
    masked = whole._replace(truth=torch.where(torch.arange(30)[:, None, None, None] < 18, whole.truth, torch.nan))
    short = Batch(whole.gnss[:18], whole.velocity[:18], whole.truth[:18], whole.x0, whole.dt)
    torch.testing.assert_close(net.losses(theta, masked), net.losses(theta, short), rtol=1e-5, atol=1e-6)
    for ours, theirs in zip(loss_and_gradient(net, theta, masked), loss_and_gradient(net, theta, short), strict=True):
        assert bool(ours.isfinite().all())
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_piece_with_little_truth_counts_as_much_as_another():
    """The engine's loss is the mean over pieces of the mean over the known steps of the reference net in torch."""
    net, seen = GainNet(2, 1), batch(1)
    truth = seen.truth.clone()
    truth[10:, 0, 1] = truth[:25, 0, 2] = torch.nan
    x = net.double().rollout(flatten([net]), *(a.double() for a in (seen.gnss, seen.velocity, seen.x0)), seen.dt)
    squares = (x - truth.double()).square().sum(-1)[:, 0]
    loss, _ = loss_and_gradient(net.float(), flatten([net]), seen._replace(truth=truth))
    assert float(loss) == pytest.approx(float(squares.nanmean(0).mean()), rel=1e-5)


def test_what_cannot_be_learned_from_is_refused():
    recording, fleet = walk(60)
    with refused(r"truth = None: must be a Fleet.*read_log"):
        MeasuredDrives(recording, None)  # type: ignore[arg-type]
    with refused("members and steps"):
        MeasuredDrives(recording, fleet.between(0, 50))
    unknown = without(fleet, (slice(None), 1))
    with refused("truth = none of v1"):
        MeasuredDrives(recording, unknown)
    assert MeasuredDrives(recording, unknown, ids=("v0",)).ids == ("v0",)
    with refused("v0 with 1 pieces of 40"):
        measured_clients(MeasuredDrives(recording, fleet), piece=40)
    with refused("has no vehicle that moves"):
        MeasuredDrives(replace(recording, velocity=0 * recording.velocity), fleet)
    body = observe(fleet, Sensors(), V2X(max_neighbours=0), frame="body")
    with refused("body frames"):
        MeasuredDrives(body, fleet)
    with refused("a log with its truth"):
        train_all(recording, "nowhere")  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two vehicles and a road-side unit for 80 s: odometry at 10 Hz, fixes at 2 Hz that are off by 4 m to the east of
    one vehicle, and the truth of both."""
    rng, rows, truth = default_rng(0), list[Any](), list[Any]()
    for k, name in enumerate("ab"):
        x = np.array([0.0, 9.0 * k])
        for step in range(800):
            velocity = 6 * np.array([np.cos(0.01 * step), np.sin(0.01 * step)])
            x, t = x + 0.1 * velocity, round(0.1 * step, 1)
            truth.append((t, name, *x))
            rows += [(t, name, kind, v) for kind, v in zip(("vx", "vy"), velocity + rng.normal(0, 0.2, 2), strict=True)]
            if step % 5 == 0:
                fix = x + rng.normal(0, (1.0, 3.0), 2)
                rows += [(t, name, kind, v) for kind, v in zip("xy", fix, strict=True)]
    rows += [(0.0, "mast", "x", 50.0), (0.0, "mast", "y", 50.0)]
    folder = tmp_path_factory.mktemp("log")
    pd.DataFrame(rows, columns=["t", "vehicle", "kind", "value"]).to_csv(folder / "measurements.csv")
    pd.DataFrame(truth, columns=["t", "vehicle", "x", "y"]).to_csv(folder / "truth.csv")
    return folder


def test_a_part_of_a_log_by_time(log):
    whole, first, rest = (co.read_log(f"{log}{part}") for part in ("", "?until=30", "?since=30"))
    assert_allclose(np.concatenate([first.recording.t, rest.recording.t]), whole.recording.t)
    assert (len(first.recording.t), len(first.truth.t)) == (300, 300)
    assert_array_equal(co.load_fleet(f"{log}?since=30&until=40").position, whole.truth.position[300:400])
    assert rest.recording.notes[-1] == "from 30 s on"
    assert_array_equal(whole.part(since=30).recording.gnss, rest.recording.gnss)
    with refused(r"must leave two steps of the 79\.9 s"):
        co.read_log(f"{log}?since=90")


def test_a_log_trains_and_its_rest_scores(log, tmp_path, capsys):
    """The command trains on the first part and says how well, and the study follows the rest with these weights, which
    learned from the fixes that y is three times as noisy as x. Other drives do not overwrite them."""
    weights = str(tmp_path / "weights")
    with pytest.raises(SystemExit, match="0"):
        main(["train", "okf", "--data", f"{log}?until=50", "--out", weights])
    said = re.search(r"okf-gnss-axis-0.safetensors  9 parameters\n.* (.*) m on .* (.*) m", capsys.readouterr().out)
    assert float(said[1]) == pytest.approx(float(said[2]), rel=0.1)
    file = Path(weights) / "okf-gnss-axis-0.safetensors"
    card, made = read(file)[1], file.stat().st_mtime_ns
    assert (card["noise"], card["clients"]) == ("measured", ["a", "b"])
    x, y, _ = load_method(file).gnss_std  # type: ignore[attr-defined]
    assert y / x == pytest.approx(3.0, rel=0.25)
    settings = {"data": f"{log}?since=50", "clients": f"{log}?until=50", "weights": weights, "max_neighbours": "0"}
    found = co.run_study(
        "side_by_side", tmp_path, settings=settings | {"method": "gnss,kalman,okf", "noise_model": "fitted"}
    )
    level = found.frame.groupby("method")["rt_le_m"].mean()
    assert file.stat().st_mtime_ns == made
    assert level["okf"] < 0.5 * level["gnss"]
    assert level["okf"] == pytest.approx(level["kalman"], rel=0.4)
    rest = co.read_log(settings["data"])
    alone = co.rt_le(load_method(file)(rest.recording, ["a", "b"]), rest.truth)
    assert_allclose(found.frame[found.frame["method"] == "okf"]["rt_le_m"], alone[0], rtol=1e-9)
    train_all(co.read_log(f"{log}?until=40"), weights, recipes=["okf"], seeds=[0])
    (kept,) = Path(weights).glob("*.*.safetensors")
    assert read(kept)[1] == card


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_trains_on_a_log_and_follows_the_rest(name, log, tmp_path, monkeypatch):
    """A few steps, with fixes at every fifth step, in one plane: losses and estimates stay finite, and weights move."""
    monkeypatch.setitem(
        RECIPES, name, replace(RECIPES[name], schedule=Schedule(epochs=4, batch=2, checks=2), rounds=2, local_epochs=1)
    )
    whole = co.read_log(log)
    first, rest = whole.part(until=65), whole.part(since=65)
    made = train_all(first, tmp_path, recipes=[name], seeds=[0])
    assert len(made) == (2 if name == "individual" else 1)
    for checkpoint in made.values():
        assert np.isfinite(checkpoint.card.get("validation_loss", 0.0)).all()
        assert all(np.isfinite(row["validation_loss"]).all() for row in checkpoint.card.get("history", ()))
        assert checkpoint.history is None or not torch.equal(checkpoint.history[0], checkpoint.history[-1])
        assert co.rt_le(checkpoint.model.method(name)(rest.recording, ["a", "b"]), rest.truth).max() < 10.0
