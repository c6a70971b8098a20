"""What the oracles of whole-fleet methods share, from the equations: who is there, pairs, rows of measurements."""

import numpy as np

from coopoc.world.links import spherical, to_vector, wrap


class Drive:
    """One run of a recording whose pairs exchange messages by the steps `arrival` (P,), -1 for never."""

    def __init__(self, recording, noise_model, met, arrival, run):  # type: ignore[no-untyped-def]
        self.noise_model, self.met, self.dt, self.arrival = noise_model, met, recording.dt, arrival
        self.gnss, self.velocity, self.relative = (
            values[run] for values in (recording.gnss, recording.velocity, recording.usable_relative)
        )
        self.q, self.r = (
            np.broadcast_to(values, recording.gnss.shape)[run]
            for values in (noise_model.process_variance(recording), noise_model.fix_variance(recording))
        )
        self.steps, self.vehicles = self.gnss.shape[:2]
        self.active = np.zeros((self.steps, self.vehicles), dtype=bool)
        for t, n in np.ndindex(self.active.shape):
            before = t > 0 and self.active[t - 1, n]
            self.active[t, n] = np.isfinite(self.velocity[t, n]).all() and (
                before or np.isfinite(self.gnss[t, n]).all()
            )

    def here(self, t):  # type: ignore[no-untyped-def]
        """Active vehicles of a step."""
        return np.flatnonzero(self.active[t]).tolist()

    def stays(self, t, n):  # type: ignore[no-untyped-def]
        return t > 0 and self.active[t - 1, n]

    def pairs(self, t):  # type: ignore[no-untyped-def]
        """(index, first, second) of those that take part."""
        span = range(self.met.start[t], self.met.start[t + 1])
        ends = [(k, int(self.met.first[k]), int(self.met.second[k])) for k in span if self.arrival[k] >= 0]
        return [(k, i, j) for k, i, j in ends if self.active[t, i] and self.active[t, j]]

    def factor(self, k, vector, converted):  # type: ignore[no-untyped-def]
        """Information and information vector of both measurements of a pair at `vector`."""
        W, eta = np.zeros((3, 3)), np.zeros(3)
        for link, sign in ((self.met.link[k], 1.0), (self.met.link_back[k], -1.0)):
            if link >= 0:
                H, r = rows(sign * vector, self.relative[link], self.noise_model.sensors, converted)
                W, eta = W + H.T @ H, eta + sign * H.T @ r
        return W, eta

    def factor_at_agreement(self, k, vector, cov):  # type: ignore[no-untyped-def]
        """`factor` where belief and converted measurement agree; eta refers to `vector`."""
        W, eta = self.factor(k, vector, True)
        if self.noise_model.sensors is None:
            return W, eta
        shift = np.linalg.solve(np.eye(3) + cov @ W, cov @ eta)
        W, eta = self.factor(k, vector + shift, False)
        return W, eta + W @ shift


def rows(vector, measured, sensors, converted):  # type: ignore[no-untyped-def]
    """Whitened Jacobian and residual of what was measured of range, azimuth, inclination; without sensors, unit rows
    along the three axes of the measured direction."""
    there, least = np.isfinite(measured), max(sensors.min_range, 0.1 * sensors.range_std) if sensors else 0.0
    measured = np.where(there, measured, np.array(spherical(*vector)))
    at = to_vector(measured) if converted or sensors is None else vector
    r = np.linalg.norm(at)
    d = max(r, least)
    far = at * d / r if converted else at  # angles of a measured range near zero are those of the least one
    ground = max(np.hypot(far[0], far[1]), 1e-3 * d)
    J = np.array([at / r, [-far[1] / ground**2, far[0] / ground**2, 0.0], [0.0, 0.0, -ground / d**2]])
    J[2, :2] = far[:2] * far[2] / (ground * d**2)
    if sensors is None:
        J /= np.linalg.norm(J, axis=1)[:, None]
        return J[there], J[there] @ (at - vector)
    J /= sensors.relative_std[:, None]
    off = measured - np.array(spherical(*vector))
    off[1:] = wrap(off[1:])
    residual = J @ (at - vector) if converted else off / sensors.relative_std
    return J[there], residual[there]
