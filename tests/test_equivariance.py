"""Equivariance: a recording that is moved, turned about z, mirrored in y or renumbered gives the track that is."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopoc as co
from coopoc.evaluate.metrics import normalised_innovations
from coopoc.methods.catalogue import METHODS, needs_whole_fleet
from coopoc.optimize import Problem, solve

NOISE = co.Sensors(
    gnss_std=(1.5, 1.5, 2.5), velocity_reading="speed", azimuth_std=0.05, inclination_std=0.05, yaw_rate_std=0.02
)
CHANNEL = co.V2X(max_neighbours=4, radius=60.0, loss=0.2, latency=0.1)
NEAR = {"cooperative-filter": 5e-5}
"""m, where an iteration or a cone solver stops at its own tolerance, of 0.1 mm and less, or of a state of which little
is known beside much, or of an average over hypotheses, whose odds magnify rounding; 1e-6 elsewhere."""


class Change(NamedTuple):
    """y -> -y if `mirrored`, turned about z by `angle` (rad), then moved by `shift` (m); vehicles in `order`."""

    angle: float = 0.0
    mirrored: bool = False
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    order: tuple[int, ...] = tuple(range(8))

    @property
    def matrix(self):  # type: ignore[type-arg]
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([1, -1 if self.mirrored else 1, 1])

    def azimuth(self, angle):  # type: ignore[type-arg]
        turned = (-angle if self.mirrored else angle) + self.angle
        return np.arctan2(np.sin(turned), np.cos(turned))

    def of(self, rec):
        """The recording that the same drive would have given in the changed world."""
        order = np.array(self.order)
        column = np.argsort(order)
        step, observer, neighbour = rec.links.step, column[rec.links.observer], column[rec.links.neighbour]
        rows = np.lexsort((neighbour, observer, step))
        links = co.Links(step[rows], observer[rows], neighbour[rows])
        world, relative = rec.body is None, rec.relative[:, rows].copy()
        side = -1.0 if self.mirrored else 1.0
        relative[..., 1] = self.azimuth(relative[..., 1]) if world else side * relative[..., 1]
        velocity = rec.velocity @ self.matrix.T if world else rec.velocity * [1, side, 1]
        body = rec.body and co.Body(side * rec.body.yaw_rate[:, :, order], self.azimuth(rec.body.heading[:, :, order]))
        return replace(
            rec,
            ids=tuple(rec.ids[k] for k in order),
            gnss=(rec.gnss @ self.matrix.T + self.shift)[:, :, order],
            velocity=velocity[:, :, order],
            links=links,
            relative=relative,
            broadcasts=rec.broadcasts[:, order],
            arrival=rec.arrival[:, rows],
            observers=tuple(int(column[k]) for k in rec.observers),
            body=body,
        )


CHANGES = {
    "translation": Change(shift=(400.0, -250.0, 30.0)),
    "rotation": Change(angle=2.2),
    "permutation": Change(order=(3, 6, 0, 5, 1, 7, 2, 4)),
    "mirrored y": Change(mirrored=True),
}


def assert_equivariant(method, rec, change, near, egos):
    here, there = method(rec, egos), method(change.of(rec), egos)
    assert_allclose(there.x, here.x @ change.matrix.T + change.shift, rtol=0, atol=near)
    if here.covariance is not None:
        turned = change.matrix @ here.covariance @ change.matrix.T
        assert_allclose(there.covariance, turned, rtol=0, atol=10 * near * abs(turned).max())
        nis = normalised_innovations(here, rec), normalised_innovations(there, change.of(rec))
        assert_allclose(*nis, rtol=0, atol=100 * near)
    if here.heading is not None:
        apart = there.heading - change.azimuth(here.heading)
        assert_allclose(np.sin(apart / 2), 0, atol=near)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", METHODS)
def test_every_method_follows_the_world(name, change, crossing):
    """The law itself is the reference: the world has no preferred origin, direction, side or numbering."""
    observers = None if needs_whole_fleet(name) else ["c0", "c3"]
    rec = co.observe(crossing.between(0, 25), NOISE, CHANNEL, runs=2, seed=5, observers=observers)
    assert_equivariant(METHODS[name]("nominal"), rec, CHANGES[change], NEAR.get(name, 1e-6), ("c0", "c3"))


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize(
    "method",
    [
        co.PoseFilter("solo"),
        co.PoseFilter("fleet"),
        co.PoseFilter("fleet", lasting=True),
        co.PoseFilter("fleet", fusion="naive"),
        co.PoseFilter("fleet", fusion="intersection"),
    ],
    ids=lambda m: f"{m.unit}-{m.fusion}" + "-lasting" * (m.lasting is True),
)
def test_every_pose_filter_follows_the_world(method, change, crossing):
    noise = replace(NOISE, velocity_reading="axis")
    rec = co.observe(crossing.between(0, 25), noise, CHANNEL, runs=2, seed=5, frame="body")
    assert_equivariant(method, rec, CHANGES[change], 1e-6, ("c0", "c3"))


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("backend", ["gauss-newton", "gtsam", "casadi", "osqp"])
def test_every_solver_follows_the_world(backend, change, crossing):
    """A star and a window of it; marginals turn with the world."""
    rec, world = co.observe(crossing.between(0, 8), NOISE, CHANNEL, seed=5, observers=["c0"]), CHANGES[change]
    for window in (1, 5):
        here, there = (solve(Problem.from_window(seen, 7, "c0", window), backend) for seen in (rec, world.of(rec)))
        column = [there.names.index(name) for name in here.names]
        assert_allclose(there.position[column], here.position @ world.matrix.T + world.shift, atol=1e-6)
        assert_allclose(there.covariance[column], world.matrix @ here.covariance @ world.matrix.T, rtol=1e-6, atol=1e-7)
        assert there.cost == pytest.approx(here.cost, rel=1e-7)
