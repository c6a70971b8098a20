"""The pose smoother against one solve of the same factors, a hand-written loop on GTSAM's smoother, and the filter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from oracles.pose_smoother import by_hand

import coopoc as co
from coopoc.methods.poses.pose_factors import PoseRun, pose_subgraph
from coopoc.methods.poses.pose_smoother import PoseSmoother
from coopoc.optimize import Problem, solve
from coopoc.world.body_frames import true_heading

NOISE = co.Sensors(
    gnss_std=(1.5, 1.5, 1.5),
    heading_std=0.05,
    yaw_rate_std=0.02,
    velocity_reading="speed",
    range_std=0.3,
    azimuth_std=0.02,
    inclination_std=0.02,
)


def recording(steps: int = 30, gaps: bool = True, runs: int = 1) -> tuple[co.Recording, co.Fleet]:
    """Three vehicles that wind along at 10 m/s and two masts; a share of all that is measured is missing."""
    t = 0.1 * np.arange(steps)
    course = 0.5 * np.sin(0.3 * t[:, None] + 0.4 * np.arange(3))
    velocity = 10 * np.stack([np.cos(course), np.sin(course), 0 * course], axis=2)
    position = np.array([[0.0, 0, 0], [8, 3, 0], [16, 0, 0]]) + np.cumsum(0.1 * velocity, axis=0)
    masts = np.broadcast_to([[0.0, 12, 0], [20, -9, 0]], (steps, 2, 3))
    moving = np.append(velocity, 0 * masts, axis=1)
    fleet = co.Fleet(("a", "b", "c", "m", "n"), t, np.append(position, masts, axis=1), moving)
    v2x = co.V2X(max_neighbours=4, radius=60.0)
    seen = co.observe(fleet, NOISE, v2x, runs=runs, seed=3, frame="body", landmarks=["m", "n"])
    if not gaps:
        return seen, fleet
    rng, body = np.random.default_rng(4), seen.body
    assert body is not None
    gnss, heading, relative = seen.gnss.copy(), body.heading.copy(), seen.relative.copy()
    relative[..., 2] = np.pi / 2
    relative[..., :2][rng.random(relative[..., :2].shape) < 0.3] = np.nan
    gnss[:, 1:, :3][rng.random((runs, steps - 1, 3)) < 0.6] = np.nan
    heading[:, 1:][rng.random(heading[:, 1:].shape) < 0.6] = np.nan
    return replace(seen, gnss=gnss, relative=relative, body=co.Body(body.yaw_rate, heading)), fleet


def pieces(seen: co.Recording, smoother: PoseSmoother) -> Iterator[Problem]:
    """Those that the smoother is fed with."""
    drive = PoseRun(seen, 0, seen.sensors, np.full((len(seen.ids), 4), np.nan), np.array(smoother.spread))
    known: dict[str, np.ndarray] = {}
    for step, found in enumerate(smoother.estimates(seen)):
        piece = pose_subgraph(drive, step, known)
        marks = zip(piece.names[len(piece.poses) :], piece.x0[len(piece.poses) :], strict=True)
        known = {name: x for name, x in known.items() if "@" not in name} | dict(marks)
        known |= dict(zip(found.names, found.x, strict=True))
        yield piece


def joined(parts: list[Problem]) -> Problem:
    """All factors of some pieces between the nodes of all of them."""
    names = list(dict.fromkeys(name for part in parts for name in part.names))
    place = {name: k for k, name in enumerate(names)}
    factors, x0 = [], np.zeros((len(names), 6))
    for part in parts:
        at = np.array([place[name] for name in part.names])
        x0[at] = part.x0
        factors += [replace(factor, nodes=at[factor.nodes]) for factor in part.factors]
    poses = [k for k, name in enumerate(names) if "@" in name]
    return Problem(tuple(names), tuple(factors), x0, dimension=2, poses=poses)


def test_an_endless_lag_is_one_solve_of_all_that_was_measured() -> None:
    """Gauss-Newton on all factors at once, with ranges, bearings, both, fixes, compasses and landmarks among them."""
    seen, _ = recording()
    smoother = PoseSmoother(np.inf, threshold=1e-9, passes=8)
    parts = list(pieces(seen, smoother))
    assert {f.kind for part in parts for f in part.factors} == {
        "relative_pose_log",
        "position",
        "pose",
        "range",
        "bearing",
        "body_spherical",
    }
    whole = solve(joined(parts))
    *_, newest = smoother.estimates(seen)
    place = [whole.names.index(name) for name in newest.names]
    assert newest.names == ("a@29", "b@29", "c@29")
    assert newest.x == pytest.approx(whole.x[place], abs=1e-5)  # Cholesky of odometry to 1e-3 m
    assert newest.covariance == pytest.approx(whole.covariance[place], rel=1e-4)


def test_a_lag_gives_what_gtsams_smoother_gives() -> None:
    """GTSAM's own incremental fixed-lag smoother and factors, by a plain loop."""
    seen, _ = recording(60)
    smoother = PoseSmoother(1.55)
    ours = np.array([found.x[:, :2] for found in smoother.estimates(seen)])
    theirs = by_hand(list(pieces(seen, smoother)), 1.55, seen.dt)
    assert np.abs(ours - theirs).max() < 1e-9


def flat_error(track: co.Track, fleet: co.Fleet) -> np.ndarray:
    """(R, T, E) m in the plane; heights are those of the start."""
    return np.linalg.norm(track.x[..., :2] - fleet.position[None, :, list(track.egos), :2], axis=-1)


def test_it_is_at_least_as_accurate_as_the_filter_and_its_covariance_holds() -> None:
    """The truth; both take the same measurements, and the filter linearises each once."""
    seen, fleet = recording(60, gaps=False, runs=6)
    track, peer = PoseSmoother(2.05)(seen, [0, 2]), co.PoseFilter("fleet")(seen, [0, 2])
    assert flat_error(track, fleet).mean() < 1.02 * flat_error(peer, fleet).mean()
    assert track.heading is not None
    assert track.covariance is not None
    turn = np.abs(track.heading - true_heading(fleet)[:, [0, 2]])
    assert turn[:, 20:].mean() < 0.5 * NOISE.heading_std
    gap = track.x[..., :2] - fleet.position[None, :, [0, 2], :2]
    nees = np.einsum("rtei,rteij,rtej->rte", gap, np.linalg.inv(track.covariance[..., :2, :2]), gap).mean()
    assert 1.2 < nees < 2.8  # 2 degrees of freedom, some 40 independent values
    assert track.sent_bytes == pytest.approx(peer.sent_bytes)


def test_a_vehicle_may_join_and_leave() -> None:
    """It is in the piece of each step at which it is there, and an ego's track goes on."""
    seen, fleet = recording(20, gaps=False)
    velocity, gnss, body = seen.velocity.copy(), seen.gnss.copy(), seen.body
    assert body is not None
    away = np.r_[0:5, 15:20]
    rate, heading = body.yaw_rate.copy(), body.heading.copy()
    for values in (velocity, gnss, rate, heading):
        values[:, away, 1] = np.nan
    links = seen.links
    there = ~(np.isin(links.step, away) & ((links.observer == 1) | (links.neighbour == 1)))
    kept = co.Links(links.step[there], links.observer[there], links.neighbour[there])
    broadcasts = seen.broadcasts.copy()
    broadcasts[away, 1] = False
    part = replace(
        seen,
        velocity=velocity,
        gnss=gnss,
        body=co.Body(rate, heading),
        links=kept,
        relative=seen.relative[:, there],
        arrival=seen.arrival[:, there],
        broadcasts=broadcasts,
    )
    names = [found.names for found in PoseSmoother().estimates(part)]
    assert [len(each) for each in names] == [2] * 5 + [3] * 10 + [2] * 5
    assert flat_error(PoseSmoother()(part, ["a"]), fleet).max() < 1.5
    heading[:, 5, 1] = np.nan
    with pytest.raises(co.InputError, match="b joins at step 5 without fix and compass"):
        list(PoseSmoother().estimates(replace(part, body=co.Body(rate, heading))))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lag": -1.0}, "lag = -1"),
        ({"threshold": 0.0}, "threshold = 0"),
        ({"passes": 0}, "passes = 0"),
        ({"spread": (1.0, 1.0, 1.0, 0.0)}, "spread"),
    ],
)
def test_what_cannot_be_is_refused(options: dict, words: str) -> None:
    with pytest.raises(co.InputError, match=words):
        PoseSmoother(**options)


def test_a_recording_in_the_world_frame_is_refused() -> None:
    _, fleet = recording(5)
    with pytest.raises(co.InputError, match="must be in body frames"):
        PoseSmoother()(co.observe(fleet, NOISE))
