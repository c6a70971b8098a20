"""Moving horizon of one run as dense least squares over all steps so far.

Eliminating the steps before the window is the same as keeping their rows as they were when they left it: the arrival
cost. Relative measurements of the window's steps are rows linear around vectors that every Gauss-Newton step renews.
"""

from typing import Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.world.inbox import Inbox
from coopoc.world.links import spherical, to_vector
from coopoc.world.recording import Recording
from oracles.pace import heard
from oracles.window import UNKNOWN, Row, message, relative_rows, solve_rows

FLAT, STRAYED = 1e6, 0.03
"""m^2, prior variance of a member that joins; m, move of a vector that makes its measurement linear anew."""


class Drive:
    """What one ego knows: the message of each member (vehicle, step), its uses, and the rows that follow from it."""

    def __init__(self, recording: Recording, box: Inbox, noise_model: NoiseModel, run: int, ego: int) -> None:
        self.recording, self.box, self.noise_model, self.run, self.ego = recording, box, noise_model, run, ego
        self.process = heard(recording, box, noise_model, run, ego)
        self.star: list[dict[int, int]] = []
        self.sent: dict[Any, tuple[int, bool, int]] = {}
        for t in range(len(recording.t)):
            links = range(box.start[t], box.start[t + 1])
            self.star.append({ego: -1} | {int(recording.links.neighbour[box.link[k]]): k for k in links})

    def gather(self, t: int, now: int) -> None:
        """The message of each member of step t, as known now, at the step at which it was sent."""
        limit = self.recording.v2x.max_age / self.recording.dt + 1e-9
        for v, k in self.star[t].items():
            sent, fresh = (t, True) if k < 0 else (int(self.box.newest[self.run, k]), bool(self.box.fresh[self.run, k]))
            before = self.sent.get((v, t - 1), (-2, False, 0))[0]
            if k >= 0:
                fresh = 0 <= self.box.arrival[self.run, k] <= now
                held = self.sent[v, t][0] if (v, t) in self.sent else sent
                sent = t if fresh else max(held, before if t - before <= limit else -1)
            joined = next(s for s in range(t, -1, -1) if s == 0 or v not in self.star[s - 1])
            self.sent[v, t] = (sent, fresh, t - max(sent, joined) + 1)  # as if it had been there since it was sent

    def rows(self, t: int, start: Any) -> list[Row]:
        """Fixes, motions and flat priors of step t."""
        rows: list[Row] = []
        for v in self.star[t]:
            sent, fresh, uses = self.sent[v, t]
            fix, variance, moved, step_variance = message(
                self.recording, self.noise_model, self.process, self.run, v, t, sent if sent >= 0 else t
            )
            if sent >= 0 and fresh and np.isfinite(self.recording.gnss[self.run, sent, v]).all():
                rows.append(({(v, t): np.diag(variance**-0.5)}, fix * variance**-0.5, v))
            if t and v in self.star[t - 1]:
                moved, step_variance = (
                    (moved, (2 * uses - 1) * step_variance) if sent >= 0 else (np.zeros(3), np.full(3, UNKNOWN))
                )
                w = np.diag(step_variance**-0.5)
                rows.append(({(v, t): w, (v, t - 1): -w}, moved * step_variance**-0.5, "motion"))
            else:
                rows.append(({(v, t): np.eye(3) * FLAT**-0.5}, start[v, t] * FLAT**-0.5, "prior"))
        return rows

    def expect(self, t: int, x: Any) -> None:
        """Points of a new step: a member that stays moves, one that joins stands where the ego measures it."""
        for v, k in self.star[t].items():
            sent = self.sent[v, t][0]
            moved = self.recording.dt * self.recording.velocity[self.run, sent, v] if sent >= 0 else np.zeros(3)
            if t and v in self.star[t - 1]:
                x[v, t] = x[v, t - 1] + moved
            elif k < 0:
                x[v, t] = self.recording.gnss[self.run, t, v].copy()
            else:
                x[v, t] = x[self.ego, t] + to_vector(self.recording.relative[self.run, self.box.link[k]])

    def converted(self, t: int, x: Any) -> list[Row]:
        """Relative measurements as vectors, their covariances those of the geometry of the points."""
        rows: list[Row] = []
        for v, k in self.star[t].items():
            if k >= 0:
                cov = self.noise_model.relative_cov(np.array(spherical(*(x[v, t] - x[self.ego, t]))))
                w = np.linalg.cholesky(np.linalg.inv(cov)).T
                z = to_vector(self.recording.relative[self.run, self.box.link[k]])
                rows.append(({(v, t): w, (self.ego, t): -w}, w @ z, "relative"))
        return rows

    def exact(self, t: int, x: Any) -> list[Row]:
        """Relative measurements in range and angles, linear at the points."""
        return relative_rows(self.recording, self.box, self.noise_model, self.run, self.ego, x, t)


def moving_horizon(drive: Drive, length: int, exact: bool, sweeps: int) -> Any:
    """Points by (vehicle, step), and the ego's covariances (T, 3, 3), of the newest step.

    Args:
        sweeps: most Gauss-Newton steps after the first, while a vector strays from where its measurement is linear.
    """
    x: dict[Any, Floats] = {}
    linear: dict[int, list[Row]] = {}
    edges: dict[int, list[Row]] = {}
    base: dict[Any, Floats] = {}
    start: dict[Any, Floats] = {}
    points: dict[Any, Floats] = {}
    steps = len(drive.star)
    covs = np.empty((steps, 3, 3))

    def look(t: int, at: Any) -> None:
        edges[t] = drive.exact(t, at)
        base.update({(v, t): at[v, t] - at[drive.ego, t] for v in drive.star[t]})

    def solved(at: Any) -> Any:
        return solve_rows([r for t in linear for r in (*linear[t], *edges[t])], at, 0.0)

    for now in range(steps):
        window = range(max(0, now - length + 1), now + 1)
        for t in window:
            drive.gather(t, now)
        drive.expect(now, x)
        start.update({(v, now): x[v, now] for v in drive.star[now]})
        linear.update({t: drive.rows(t, start) for t in window})
        edges[now] = drive.converted(now, x)
        for count in range(sweeps + 1):
            for t in window if exact else ():
                if count or t < now:
                    look(t, x)
            new, cov = solved(x)
            if exact and count == 0:
                look(now, new)
                new, cov = solved(x)
            x = new
            gaps = [x[v, t] - x[drive.ego, t] - base.get((v, t), np.zeros(3)) for t in window for v in drive.star[t]]
            if not exact or np.abs(gaps).max() <= STRAYED:
                break
        i = 3 * list(x).index((drive.ego, now))
        covs[now] = cov[i : i + 3, i : i + 3]
        points.update({(v, now): x[v, now] for v in drive.star[now]})
    return points, covs
