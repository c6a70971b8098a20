"""The most informative message: whose position would lower the bound of the receiver's own position most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from .recording import Recording
from .spherical import vector_cov

UNKNOWN = 1e6
"""m^2, variance of a position of which nothing is known."""


@dataclass(frozen=True, eq=False)
class MostInformative:
    """By how much a message lowers the bound of the ego's position: the trace of its covariance P before and after.

    A receiver that knows the vector to neighbour j with covariance D_j gets from a fix of j one of its own with the
    covariance D_j + G_j:

        utility_j = tr P - tr (P^-1 + (D_j + G_j)^-1)^-1 = tr P (P + D_j + G_j)^-1 P.

    G_j is G, that of a fix. A cumulative message holds the fixes of the a steps since the last one received, as far as
    the sender's filter remembers: G_j = max(G / a, S_j), S_j the variance at which it settles, 1/S = 1/(S + q) + 1/G,
    with q = dt^2 times the variance of its velocity.

    The choice is greedy: the best message is received, P follows, the next best is sought. P grows by dt^2 times the
    variance of the own velocity a step, and fuses the own fix (G) and the messages. D_j is filtered: it grows by the
    own motion and by that of j, (2n - 1) dt^2 times the variance of j's newest velocity when it is used for the n-th
    step; by 1e6 m^2 if no message came within `max_age`. Then it fuses the relative measurement of j.

    Assumed: fixes are white and come at every step; the vectors D_j depend neither on P nor on each other; the
    later utility of a message does not count.

    Args:
        recording: what is known of noise, distances and velocities.
        ego: column of the receiver.
        link: (M,) of the messages.
        cumulative: whether a message holds all fixes since the last one.
        own: (R, 3, 3) m^2, P.
        vector: (R, N, 3, 3) m^2, D.
        last_measured: (N,) step of the newest relative measurement of each.
        speed: (R, N, 3) m^2/s^2, variance of the newest velocity received.
        last: (R, N) step of it, -1 for none.

    >>> from coopoc import Fleet, Sensors, observe
    >>> place = np.zeros((2, 3, 3)) + [[[0, 0, 0], [9, 0, 0], [0, 25, 0]]]
    >>> recording = observe(Fleet(("a", "b", "c"), [0, 0.1], place, 0 * place), Sensors())
    >>> schedule = MostInformative.at_first(recording, 0, recording.links.of(0), cumulative=False)
    >>> schedule.measure(0, slice(0, 2))
    >>> int(schedule.utility(0, slice(0, 2)).argmax())  # the nearer one
    0
    """

    recording: Recording
    ego: int
    link: Ints
    cumulative: bool
    own: Floats
    vector: Floats
    last_measured: Ints
    speed: Floats
    last: Ints

    @classmethod
    def at_first(cls, recording: Recording, ego: int, link: Ints, cumulative: bool) -> MostInformative:
        """Before any measurement or message; a vehicle without a message may stand."""
        if recording.body is not None:
            hint = "Take nearest or round robin."
            raise InputError("schedule", "most informative", "is for recordings in the world frame", hint)
        runs, vehicles = recording.runs, len(recording.ids)
        own, vector = (np.broadcast_to(UNKNOWN * np.eye(3), (*n, 3, 3)).copy() for n in ((runs,), (runs, vehicles)))
        speed = recording.sensors.velocity_floor**2 * np.ones((runs, vehicles, 3))
        last_measured, last = np.full(vehicles, -2), np.full((runs, vehicles), -1)
        return cls(recording, ego, link, cumulative, own, vector, last_measured, speed, last)

    def measure(self, step: int, span: slice) -> None:
        """Move on by a step, and fuse the own fix and the relative measurements."""
        sensors, dt, link = self.recording.sensors, self.recording.dt, self.link[span]
        sender = self.recording.links.neighbour[link]
        velocity, fix = self.recording.velocity[:, step, self.ego], self.recording.gnss[:, step, self.ego]
        moved = np.square(dt * sensors.assumed_velocity_std(velocity))
        self.own[:] += _diagonal(moved)
        self._fuse(np.flatnonzero(np.isfinite(fix).all(axis=-1)), _diagonal(np.square(sensors.fix_std)))
        age = step - self.last[:, sender]
        held = (self.last[:, sender] >= 0) & (age * dt <= self.recording.v2x.max_age + 1e-9)
        tracked = held & (self.last_measured[sender] == step - 1)
        theirs = (2 * age - 1)[..., None] * dt**2 * self.speed[:, sender]
        grown = np.where(tracked[..., None], moved[:, None] + theirs, UNKNOWN)
        std = np.array([sensors.range_std, sensors.world_azimuth_std, sensors.inclination_std])
        noise = vector_cov(self.recording.relative[:, link], std, sensors.min_range)
        before = self.vector[:, sender] + _diagonal(grown)
        self.vector[:, sender] = noise - noise @ np.linalg.solve(before + noise, noise)
        self.last_measured[sender] = step

    def utility(self, step: int, span: slice) -> Floats:
        """(R, n) m^2."""
        sender, own = self.recording.links.neighbour[self.link[span]], self.own[:, None]
        fixed = own + self.vector[:, sender] + _diagonal(self._brought(step, sender))
        return np.asarray(np.trace(own @ np.linalg.solve(fixed, own), axis1=-2, axis2=-1))

    def receive(self, step: int, run: Ints, message: Ints) -> None:
        """Fuse the fixes in the messages, and keep the velocities that came with them."""
        sender, recording = self.recording.links.neighbour[self.link[message]], self.recording
        there = self.cumulative | np.isfinite(recording.gnss[run, step, sender]).all(axis=-1)
        brought = self.vector[run, sender] + _diagonal(self._brought(step, sender)[run, np.arange(len(run))])
        self._fuse(run[there], brought[there])
        velocity = recording.velocity[run, step, sender]
        self.speed[run, sender] = np.square(recording.sensors.assumed_velocity_std(velocity))
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
