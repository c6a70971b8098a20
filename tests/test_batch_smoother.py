"""The whole-drive smoother against a dense oracle, SciPy's least squares, closed forms, and the laws that it obeys."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import coming_and_going, half_width, refused, standing, textbook, without
from numpy import isfinite
from oracles.batch_smoother import batch_smoother
from scipy.optimize import least_squares

from coopoc import V2X, BatchSmoother, NoiseModel, Sensors, observe
from coopoc.evaluate.bounds import bound_rt_le, fleet_bound
from coopoc.evaluate.metrics import nees, rt_le, share_of_average
from coopoc.methods.batch_smoother import CENTRE, NOT_CAUSAL
from coopoc.methods.noise_model import resolve
from coopoc.world.links import spherical, wrap
from coopoc.world.v2x import Message

S2 = Sensors.paper_scenario2()
SPEED = replace(S2, velocity_reading="speed")
KNOWN = {"nominal": "nominal", "identity": "identity", "fitted": NoiseModel("fitted", S2, (0.3, 0.2, 0.01))}
CHANNELS = {
    "plain": V2X(max_neighbours=3),
    "lossy and late": V2X(max_neighbours=3, loss=0.3, latency=0.2),
    "all": V2X(max_neighbours=20, radius=200.0),
    "none": V2X(max_neighbours=0),
}


def holed(recording, fixes, angles, delays=0):
    """Without shares of the fixes and of ranges and angles; messages up to so many steps later than sent."""
    rng = np.random.default_rng(4)
    gnss, relative, arrival = recording.gnss.copy(), recording.relative.copy(), recording.arrival.copy()
    gone = rng.uniform(size=gnss.shape[:3]) < fixes
    gone[:, 0, [0, 5]] = False
    gnss[gone] = np.nan
    relative[rng.uniform(size=relative.shape) < angles * np.array([0.3, 1.0, 1.0])] = np.nan
    arrival = np.where(arrival >= 0, arrival + rng.integers(0, delays + 1, arrival.shape), -1)
    return replace(recording, gnss=gnss, relative=relative, arrival=arrival)


def drive(crossing, channel, runs=1, gaps=True, absences=True):
    fleet = crossing.select(range(6)).between(0, 14)
    if absences:
        fleet = without(fleet, (slice(4, 9), 1), (slice(6), 2), (slice(9, 14), 3))
    recording = observe(fleet, S2, CHANNELS[channel], runs=runs)
    return holed(recording, 0.5, 0.2, 3 if channel == "lossy and late" else 0) if gaps else recording


def compare(known, recording):
    """Positions and covariances of all vehicles that are there throughout, in every run."""
    model = KNOWN[known]
    noise = resolve(model, recording)
    there = isfinite(recording.velocity).all(axis=(0, 1, 3)) & isfinite(recording.gnss[:, 0]).all(axis=(0, 2))
    egos = np.flatnonzero(there).tolist()
    track = textbook(BatchSmoother(model))(recording, egos)
    for run in range(recording.runs):
        x, P = batch_smoother(recording, noise, run, held(recording.gnss[run]))
        for e, n in enumerate(egos):
            np.testing.assert_allclose(track.x[run, :, e], x[:, n], atol=1e-7, rtol=0)
            assert (
                abs(track.covariance[run, :, e] - P[:, n]) / abs(P[:, n]).max(axis=(-1, -2), keepdims=True)
            ).max() < 1e-6


def held(gnss):
    """Each vehicle's last fix, its first one before that."""
    t = np.maximum.accumulate(np.where(isfinite(gnss[..., 0]), np.arange(len(gnss))[:, None], -1))
    return gnss[np.where(t < 0, isfinite(gnss[..., 0]).argmax(0), t), np.arange(gnss.shape[1])]


@pytest.mark.parametrize("channel", CHANNELS)
def test_gaps_absences_and_channels(channel, crossing):
    compare("nominal", drive(crossing, channel, runs=3))


@pytest.mark.parametrize("known", ["identity", "fitted"])
def test_noise_models(known, crossing):
    compare(known, drive(crossing, "lossy and late", gaps=known == "fitted"))


@pytest.mark.parametrize("runs", [1, 5])
def test_batches_of_runs_without_gaps(runs, crossing):
    compare("nominal", drive(crossing, "plain", runs=runs, gaps=False, absences=False))


@pytest.fixture(scope="module")
def convoy(formation):
    """Six vehicles, 150 steps, 30 runs, noise that the filters model exactly."""
    fleet, v2x = formation.select([0, 1, 2, 3, 5, 8]).between(0, 150), V2X(max_neighbours=3)
    return fleet, observe(fleet, SPEED, v2x, runs=30, seed=3), v2x


def test_it_is_consistent_and_does_not_beat_the_fleets_bound(convoy):
    """NEES gate, and rms RT-LE against the bound beyond its interval (Student t on the runs), and not far above it."""
    fleet, recording, v2x = convoy
    track = BatchSmoother()(recording, [0, 4])
    assert share_of_average(nees(track, fleet).mean(0), 30).min() >= 0.95
    assert track.notes == (NOT_CAUSAL, CENTRE)
    square = (rt_le(track, fleet) ** 2).mean(1)
    cov = fleet_bound(fleet, SPEED, v2x, smoothing=True)
    bound = np.mean([bound_rt_le(cov[:, e]) ** 2 for e in (0, 4)])
    half = half_width(square)
    assert square.mean() + half > bound
    assert square.mean() - half < 1.1 * bound


def test_absent_egos_and_observers_are_named(crossing):
    recording = observe(coming_and_going(crossing), S2)
    assert (BatchSmoother()(recording, [2]).absent[:, 0] >= np.isnan(recording.velocity[0, :, 2, 0])).all()
    with refused("observers"):
        BatchSmoother()(observe(crossing, S2, observers=[0, 3]), [0])
    with refused("numbers"):
        Message("x", numbers=-1)


def problem(recording, known):
    """Whitened residuals of run 0 as a function of all positions, written down term by term."""
    steps, vehicles = recording.gnss.shape[1:3]
    motion_std = np.sqrt(np.broadcast_to(known.process_variance(recording), recording.gnss.shape)[0, 1:])
    links, seen = recording.links, recording.relative[0]
    std = known.sensors.relative_std

    def residual(flat):
        x = flat.reshape(steps, vehicles, 3)
        d, az, inc = spherical(*(x[links.step, links.neighbour] - x[links.step, links.observer]).T)
        off = np.c_[d - seen[:, 0], wrap(az - seen[:, 1]), wrap(inc - seen[:, 2])]
        moved = (np.diff(x, axis=0) - recording.dt * recording.velocity[0, 1:]) / motion_std
        return np.concatenate([((x - recording.gnss[0]) / known.gnss_std).ravel(), moved.ravel(), (off / std).ravel()])

    return residual


solved = partial(least_squares, jac="3-point", method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)


def test_the_smoother_is_the_least_squares_solution_of_scipy(crossing):
    """SciPy's positions of all vehicles at all steps, and every marginal."""
    recording = observe(crossing.select(range(5)).between(0, 9), S2, V2X(max_neighbours=3))
    known = NoiseModel.nominal(S2)
    track = textbook(BatchSmoother())(recording, range(5))
    best = solved(problem(recording, known), track.x[0].ravel() + 0.05)
    assert track.x[0].ravel() == pytest.approx(best.x, abs=1e-6)
    spread = np.linalg.inv(best.jac.T @ best.jac).reshape(*track.x.shape[1:], *track.x.shape[1:])
    for t in range(len(recording.t)):
        for k in range(5):
            assert track.covariance[0, t, k] == pytest.approx(spread[t, k, :, t, k, :], abs=1e-6)


@pytest.mark.parametrize("least", [1e-3, 1e-6, 1e-9])
def test_who_hardly_moves_does_not_drown_the_rest(least, crossing):
    """Motion known to a nanometre, all at rest: SciPy's solution of the whole drive as one point per vehicle."""
    recording = observe(standing(crossing.position[0], 60), replace(S2, velocity_floor=1e-12), V2X(max_neighbours=4))
    known = NoiseModel("fitted", S2, process_std=(least, least, least), gnss_std=(3.0, 3.5, 4.0))
    track = textbook(BatchSmoother(known))(recording, range(8))
    residual = problem(recording, known)
    best = solved(lambda x: residual(np.tile(x, 60)), track.x[0, 0].ravel())
    assert abs(track.x[0] - best.x.reshape(8, 3)).max() < max(2e-3, 30 * least)
