"""The whole fleet compiled: smoother, neighbour search, solo filter, against SciPy, GTSAM, brute force and filterpy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from oracles.whole_fleet import rows
from scipy.optimize import least_squares

from coopoc import V2X, BatchSmoother, Fleet, InputError, Kalman, NoiseModel, Recording, Sensors, observe
from coopoc.world import sensing
from coopoc.world.exchange import exchange
from coopoc.world.links import Links, spherical, to_vector, wrap
from coopoc.world.sensors import stream
from coopoc.world.v2x import Message

S2 = Sensors.paper_scenario2()


def coming_and_going(fleet: Fleet) -> Fleet:
    position, velocity = fleet.position.copy(), fleet.velocity.copy()
    position[:20, 2:5], velocity[:20, 2:5] = np.nan, np.nan
    position[40:, 4:7], velocity[40:, 4:7] = np.nan, np.nan
    return replace(fleet, position=position, velocity=velocity)


def problem(recording: Recording, known: NoiseModel) -> Any:
    """Whitened residuals of run 0 as a function of all positions, written down term by term."""
    steps, vehicles = recording.gnss.shape[1:3]
    motion_std = np.sqrt(np.broadcast_to(known.process_variance(recording), recording.gnss.shape)[0, 1:])
    links, seen = recording.links, recording.relative[0]
    assert known.sensors is not None
    std = known.sensors.relative_std

    def residual(flat: Any) -> Any:
        x = flat.reshape(steps, vehicles, 3)
        d, az, inc = spherical(*(x[links.step, links.neighbour] - x[links.step, links.observer]).T)
        off = np.stack([d - seen[:, 0], wrap(az - seen[:, 1]), wrap(inc - seen[:, 2])], axis=1)
        moved = (np.diff(x, axis=0) - recording.dt * recording.velocity[0, 1:]) / motion_std
        return np.concatenate([((x - recording.gnss[0]) / known.gnss_std).ravel(), moved.ravel(), (off / std).ravel()])

    return residual


def test_the_smoother_is_the_least_squares_solution_of_scipy(crossing: Fleet) -> None:
    """Positions of all vehicles at all steps, and every marginal."""
    recording = observe(crossing.select(range(5)).between(0, 9), S2, V2X(max_neighbours=3))
    known = NoiseModel.nominal(S2)
    track = BatchSmoother(exact_steps=9)(recording, range(5))
    best = least_squares(
        problem(recording, known),
        track.x[0].ravel() + 0.05,
        jac="3-point",
        method="lm",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    assert track.x[0].ravel() == pytest.approx(best.x, abs=1e-6)
    spread = np.linalg.inv(best.jac.T @ best.jac).reshape(*track.x.shape[1:], *track.x.shape[1:])
    assert track.covariance is not None
    for t in range(len(recording.t)):
        for k in range(5):
            assert track.covariance[0, t, k] == pytest.approx(spread[t, k, :, t, k, :], abs=1e-6)


def test_one_exact_step_leaves_less_than_a_millimetre(formation: Fleet) -> None:
    """Converged Gauss-Newton is the maximum a posteriori; its cost is that of one step to 1e-6."""
    recording = observe(formation.between(0, 60), S2, V2X(max_neighbours=10))
    residual = problem(recording, NoiseModel.nominal(S2))
    methods = [BatchSmoother(exact_steps=n, settle=np.inf) for n in (1, 6)]
    once, converged = (method(recording, range(11)).x[0] for method in methods)
    assert np.abs(once - converged).max() < 1e-3
    costs = [float(np.square(residual(x.ravel())).sum()) for x in (once, converged)]
    assert 0 <= costs[0] / costs[1] - 1 < 1e-6


def test_settled_is_converged_gauss_newton_where_one_step_is_not(crossing: Fleet) -> None:
    """Vehicles that pass at little more than the range's own noise."""
    recording = observe(coming_and_going(crossing), S2, V2X(max_neighbours=7), runs=2)

    def away(method: BatchSmoother) -> float:
        return float(np.abs(method(recording, [0, 1, 7]).x - converged).max())

    converged = BatchSmoother(exact_steps=30, settle=np.inf)(recording, [0, 1, 7]).x
    assert away(BatchSmoother(settle=np.inf)) > 1e-3
    assert away(BatchSmoother()) < 1e-3
    close = BatchSmoother(settle=1e-9)
    assert away(close) < 1e-8


def test_what_does_not_settle_is_said(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=3), runs=2)
    assert "2 of 2 runs did not settle within 1e-300 m" in BatchSmoother(settle=1e-300)(recording, [0]).notes
    with pytest.raises(InputError, match=r"settle = 0\.0 m: must be > 0"):
        BatchSmoother(settle=0.0)


def test_the_converted_smoother_is_gtsams_linear_graph(crossing: Fleet) -> None:
    recording = observe(coming_and_going(crossing), S2, V2X(max_neighbours=4))
    known = NoiseModel.nominal(S2)
    track = BatchSmoother(exact_steps=0)(recording, [0, 1, 7])
    graph, gnss, unit = gtsam.GaussianFactorGraph(), recording.gnss[0], gtsam.noiseModel.Unit.Create(3)
    steps, vehicles = gnss.shape[:2]
    motion_std = np.sqrt(known.process_variance(recording)[0])
    there = np.isfinite(gnss[..., 0])
    for t, k in np.argwhere(there):
        weight = np.diag(1 / np.array(known.gnss_std))
        graph.add(gtsam.JacobianFactor(t * vehicles + k, weight, weight @ gnss[t, k], unit))
        if t and there[t - 1, k]:
            weight = np.diag(1 / motion_std[t, k])
            moved = recording.dt * recording.velocity[0, t, k]
            graph.add(
                gtsam.JacobianFactor((t - 1) * vehicles + k, -weight, t * vehicles + k, weight, weight @ moved, unit)
            )
    vectors, links = to_vector(recording.relative[0]), recording.links
    roots = [rows(v, one, S2, True)[0] for v, one in zip(vectors, recording.relative[0], strict=True)]
    for t, i, j, vector, root in zip(links.step, links.observer, links.neighbour, vectors, roots, strict=True):
        graph.add(gtsam.JacobianFactor(t * vehicles + i, -root, t * vehicles + j, root, root @ vector, unit))
    best = graph.optimize()
    for e, k in enumerate(track.egos):
        wanted = np.stack([best.at(t * vehicles + k) for t in range(steps)])
        np.testing.assert_allclose(track.x[0, :, e], wanted, atol=1e-8)


@pytest.mark.parametrize("least", [1e-3, 1e-6, 1e-9])
def test_who_hardly_moves_does_not_drown_the_rest(least: float, crossing: Fleet) -> None:
    """Motion known to a nanometre, all at rest: SciPy's solution of the whole drive as one point per vehicle."""
    fleet = replace(crossing, position=np.repeat(crossing.position[:1], 60, axis=0), velocity=0 * crossing.velocity)
    recording = observe(fleet, replace(S2, velocity_floor=1e-12), V2X(max_neighbours=4))
    known = NoiseModel("fitted", S2, process_std=(least, least, least), gnss_std=(3.0, 3.5, 4.0))
    track = BatchSmoother(known, exact_steps=5)(recording, range(8))
    residual = problem(recording, known)
    best = least_squares(
        lambda x: residual(np.tile(x, 60)),
        track.x[0, 0].ravel(),
        jac="3-point",
        method="lm",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    assert np.abs(track.x[0] - best.x.reshape(8, 3)).max() < max(1e-5, 30 * least)


def by_brute_force(fleet: Fleet, observers: Any, most: int, radius: float, min_range: float) -> Links:
    """Every distance of every step, sorted."""
    rows = []
    for t, position in enumerate(fleet.position):
        for observer in observers:
            gap = [float(np.sqrt(np.square(p - position[observer]).sum())) for p in position]
            fits = [(d, k) for k, d in enumerate(gap) if k != observer and min_range <= d <= radius]
            rows += [(t, observer, k) for _, k in sorted(fits)[:most]]
    columns = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    return Links(*columns)


def assert_same_links(fleet: Fleet, observers: Any, most: int, radius: float, min_range: float = 2.0) -> int:
    found = sensing.find_links(fleet, observers, most, radius, min_range)
    wanted = by_brute_force(fleet, observers, most, radius, min_range)
    for name in ("step", "observer", "neighbour"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    return len(found)


@pytest.mark.parametrize("most", [0, 1, 4, 100])
@pytest.mark.parametrize("radius", [0.0, 1e-3, 12.0, 30.0, np.inf])
@pytest.mark.parametrize("observers", [[3], [1, 2, 7], range(8), []])
def test_neighbours_are_those_of_brute_force(crossing: Fleet, most: int, radius: float, observers: Any) -> None:
    fleet = coming_and_going(crossing).between(15, 45)
    count = assert_same_links(fleet, observers, most, radius)
    assert (count > 0) == (most > 0 and radius >= 12 and len(observers) > 0)


def test_neighbours_on_cell_borders_and_at_equal_distances_come_by_column() -> None:
    """A lattice whose spacing is the radius, turned over time, moved far away; in a random order of columns."""
    rng = np.random.default_rng(1)
    lattice = 30.0 * np.stack(np.meshgrid(np.arange(5), np.arange(4), [0.0]), axis=-1).reshape(-1, 3)
    lattice = rng.permutation(lattice)
    position = np.stack([lattice, -lattice, lattice + np.array([1e6, -1e6, 5]), lattice[:, [1, 0, 2]]])
    fleet = Fleet(tuple(f"v{i}" for i in range(20)), 0.1 * np.arange(4), position, 0 * position)
    assert assert_same_links(fleet, range(20), 3, 30.0) > 200
    assert assert_same_links(fleet, range(20), 10, np.hypot(30, 30)) > 300
    assert assert_same_links(fleet, range(20), 4, np.nextafter(30.0, 0)) == 0


def test_blocks_of_steps_and_coarse_cells_change_nothing(crossing: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    far = replace(crossing, position=crossing.position * [5, 1, 1])
    for fleet in (crossing, far):
        monkeypatch.setattr(sensing, "PAIRS", 150)
        monkeypatch.setattr(sensing, "GRID", 7)
        assert assert_same_links(fleet, range(8), 3, 20.0) > 20


def test_draws_are_those_of_their_streams(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=3), runs=2, seed=5)
    links = recording.links
    for link in (0, 100, len(links) - 1):
        t, i, j = (int(a[link]) for a in (links.step, links.observer, links.neighbour))
        draws = stream(5, "relative", 1, crossing.ids[i], crossing.ids[j]).standard_normal((t + 1, 3))
        d, az, inc = spherical(*(crossing.position[t, j] - crossing.position[t, i]))
        wanted = np.array([d, az, inc]) + draws[t] * S2.relative_std
        assert recording.relative[1, link] == pytest.approx([abs(wanted[0]), wrap(wanted[1]), wanted[2]], abs=1e-12)


def test_bytes_and_the_cap_are_each_receivers_own(crossing: Fleet) -> None:
    """Counted pair by pair; under a cap, the nearest come first and the bucket bounds it."""
    message = Message("belief", 9, rounds=2, unicast=True)
    free = exchange(observe(crossing, S2, V2X(max_neighbours=3, loss=0.2), runs=2), message)
    for run in range(2):
        count = np.zeros(8)
        for i, j, a, b in zip(free.first, free.second, free.at_first[run] >= 0, free.at_second[run] >= 0, strict=True):
            count[i] += a
            count[j] += b
        np.testing.assert_array_equal(free.received_bytes[run], count * message.size())
    recording = observe(crossing, S2, V2X(max_neighbours=3, bytes_per_second=800.0), runs=1)
    capped = exchange(recording, message)
    assert (capped.received_bytes <= 800.0 * (5.9 + 1.0) + 1e-9).all()  # 59 steps, and the bucket that was full
    assert 0.2 < 1 - (capped.at_first[0] >= 0).mean() < 0.95
    gap = np.linalg.norm(
        np.diff(crossing.position[capped.step[:, None], np.stack([capped.first, capped.second], 1)], axis=1)[:, 0],
        axis=1,
    )
    checked = 0
    for t, vehicle in np.ndindex(60, 8):
        mine = (capped.step == t) & ((capped.first == vehicle) | (capped.second == vehicle))
        received = np.where(capped.first == vehicle, capped.at_first[0], capped.at_second[0]) >= 0
        sees = ((recording.links.step == t) & (recording.links.observer == vehicle)).sum() == mine.sum()
        if sees and (mine & received).any() and (mine & ~received).any():
            assert gap[mine & received].max() < gap[mine & ~received].min()
            checked += 1
    assert checked > 10


def test_the_solo_filter_is_filterpys(crossing: Fleet) -> None:
    recording = observe(crossing, S2, V2X(max_neighbours=0), runs=2)
    known = NoiseModel.nominal(S2)
    track = Kalman()(recording, [2])
    variance = known.process_variance(recording)
    for run in range(2):
        peer = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
        peer.x, peer.P = recording.gnss[run, 0, 2].copy(), np.diag(known.gnss_variance)
        peer.B, peer.H, peer.R = 0.1 * np.eye(3), np.eye(3), np.diag(known.gnss_variance)
        for t in range(1, 60):
            peer.predict(u=recording.velocity[run, t, 2], Q=np.diag(variance[run, t, 2]))
            peer.update(recording.gnss[run, t, 2])
            assert track.x[run, t, 0] == pytest.approx(peer.x, abs=1e-10)
            assert track.covariance is not None
            assert track.covariance[run, t, 0] == pytest.approx(peer.P, abs=1e-10)
