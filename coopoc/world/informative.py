"""The most informative message: whose position would lower the bound of the receiver's own position most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from .recording import Recording
from .spherical import vector_cov

UNKNOWN = 1e6
"""m^2, variance of a position of which nothing is known."""


@dataclass(frozen=True, eq=False)
class MostInformative:
    """By how much a message lowers the bound of the ego's position: the trace of its covariance P before and after.

    To who knows the vector to neighbour j with covariance D_j, a fix of j is one of its own with the covariance
    D_j + G_j:

        worth_j = tr P - tr (P^-1 + (D_j + G_j)^-1)^-1 = tr P (P + D_j + G_j)^-1 P.

    G_j is G, that of a fix. A cumulative message holds the fixes of the a steps since the last one heard, as far as the
    sender's filter remembers: G_j = max(G / a, S_j), S_j the variance at which it settles, 1/S = 1/(S + q) + 1/G, with
    q = dt^2 times the variance of its velocity.

    The best is heard, P follows, the next best is sought: greedy. P grows by dt^2 times the variance of the own
    velocity a step, and fuses the own fix (G) and what is heard. D_j is filtered: it grows by the own motion and by
    that of j, of which the newest velocity heard tells, (2n - 1) dt^2 times its variance when it is used for the n-th
    step; by 1e6 m^2 if nothing was heard within `max_age`. Then it fuses the sighting of j, as its measured distance
    and angles say.

    Assumed: fixes are white and come at every step; the vectors D_j depend neither on P nor on each other; what hearing
    j now is worth later does not count.

    Args:
        recording: what is known of noise, distances and velocities. ego: the receiver. link: (M,) of the messages.
        cumulative: what they are. own: (R, 3, 3) m^2, P. vector: (R, N, 3, 3) m^2, D.
        seen: (N,) step at which each was last in sight.
        speed: (R, N, 3) m^2/s^2, variance of the newest velocity heard. last: (R, N) step of it, -1 for none.

    >>> from coopoc import Fleet, Sensors, observe
    >>> place = np.zeros((2, 3, 3)) + [[[0, 0, 0], [9, 0, 0], [0, 25, 0]]]
    >>> seen = observe(Fleet(("a", "b", "c"), [0, 0.1], place, 0 * place), Sensors())
    >>> told = MostInformative.at_first(seen, 0, seen.links.of(0), cumulative=False)
    >>> told.see(0, slice(0, 2))
    >>> int(told.worth(0, slice(0, 2)).argmax())  # the nearer one
    0
    """

    recording: Recording
    ego: int
    link: Ints
    cumulative: bool
    own: Floats
    vector: Floats
    seen: Ints
    speed: Floats
    last: Ints

    @classmethod
    def at_first(cls, recording: Recording, ego: int, link: Ints, cumulative: bool) -> MostInformative:
        """Before anything was seen or heard; whoever was never heard may stand."""
        runs, vehicles = recording.runs, len(recording.ids)
        own, vector = (np.broadcast_to(UNKNOWN * np.eye(3), (*n, 3, 3)).copy() for n in ((runs,), (runs, vehicles)))
        speed = recording.sensors.velocity_floor**2 * np.ones((runs, vehicles, 3))
        seen, last = np.full(vehicles, -2), np.full((runs, vehicles), -1)
        return cls(recording, ego, link, cumulative, own, vector, seen, speed, last)

    def see(self, step: int, span: slice) -> None:
        """Move on by a step, fuse the own fix, and look at who is in sight."""
        sensors, dt, link = self.recording.sensors, self.recording.dt, self.link[span]
        sender = self.recording.links.neighbour[link]
        velocity, fix = self.recording.velocity[:, step, self.ego], self.recording.gnss[:, step, self.ego]
        moved = np.square(dt * sensors.assumed_velocity_std(velocity))
        self.own[:] += _diagonal(moved)
        self._fuse(np.flatnonzero(np.isfinite(fix).all(axis=-1)), _diagonal(np.square(sensors.fix_std)))
        age = step - self.last[:, sender]
        held = (self.last[:, sender] >= 0) & (age * dt <= self.recording.v2x.max_age + 1e-9)
        tracked = held & (self.seen[sender] == step - 1)
        theirs = (2 * age - 1)[..., None] * dt**2 * self.speed[:, sender]
        grown = np.where(tracked[..., None], moved[:, None] + theirs, UNKNOWN)
        std = np.array([sensors.range_std, sensors.world_azimuth_std, sensors.inclination_std])
        look = vector_cov(self.recording.relative[:, link], std, sensors.min_range)
        before = self.vector[:, sender] + _diagonal(grown)
        self.vector[:, sender] = look - look @ np.linalg.solve(before + look, look)
        self.seen[sender] = step

    def worth(self, step: int, span: slice) -> Floats:
        """(R, n) m^2."""
        sender, own = self.recording.links.neighbour[self.link[span]], self.own[:, None]
        fixed = own + self.vector[:, sender] + _diagonal(self._brought(step, sender))
        return np.asarray(np.trace(own @ np.linalg.solve(fixed, own), axis1=-2, axis2=-1))

    def hear(self, step: int, run: Ints, message: Ints) -> None:
        """Fuse what the messages bring, a fix where there was one, and keep the velocities that came with them."""
        sender, seen = self.recording.links.neighbour[self.link[message]], self.recording
        there = self.cumulative | np.isfinite(seen.gnss[run, step, sender]).all(axis=-1)
        brought = self.vector[run, sender] + _diagonal(self._brought(step, sender)[run, np.arange(len(run))])
        self._fuse(run[there], brought[there])
        self.speed[run, sender] = np.square(seen.sensors.assumed_velocity_std(seen.velocity[run, step, sender]))
        self.last[run, sender] = step

    def _brought(self, step: int, sender: Ints) -> Floats:
        """(R, n, 3) m^2, G_j of the senders' messages."""
        fix = np.square(self.recording.sensors.fix_std)
        if not self.cumulative:
            return np.broadcast_to(fix, (self.recording.runs, len(sender), 3))
        age = np.where(self.last[:, sender] >= 0, np.maximum(step - self.last[:, sender], 1), np.inf)[..., None]
        motion = self.recording.dt**2 * self.speed[:, sender]
        return np.maximum(fix / age, np.sqrt(motion**2 / 4 + motion * fix) - motion / 2)

    def _fuse(self, run: Ints, brought: Floats) -> None:
        """P of some runs after one more position of this covariance."""
        own = self.own[run]
        self.own[run] = own - own @ np.linalg.solve(own + brought, own)


def _diagonal(variance: Floats) -> Floats:
    """(..., 3) as diagonal matrices (..., 3, 3)."""
    return np.asarray(variance[..., None] * np.eye(3))
