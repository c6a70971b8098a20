"""Road filter of one vehicle with dense matrices: the plane with heading and scale errors, the height beside it."""

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.road import RoadErrors


def road(
    z: Floats, u: Floats, q: Floats, r: Floats, dt: float, errors: RoadErrors, late: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Mean (T, 5) of east, north, heading error, scale error, up, and covariance (T, 5, 5).

    Args:
        z: (T, 3) m, NaN for no fix.
        u: (T, 3) m/s.
        q: (T, 3) m^2, of a step.
        r: (3,) m^2, of a fix.
        dt: s.
        errors: that are assumed.
        late: m^2, what a fix has more.
    """
    keep, lasting = np.exp(-dt / errors.lasts), np.array([errors.heading, errors.scale])
    x, p = np.array([*z[0, :2], 0.0, 0.0, z[0, 2]]), np.diag([*r[:2], *lasting**2, r[2]])
    means, covariances, since, level, common, fixes = [x], [p], 0.0, 1.0, 1.0, 2.0
    measured, plane, height = np.eye(5)[[0, 1, 4]], [0, 1], [2]
    for t in range(1, len(z)):
        b, s = x[2:4]
        turn = np.array([[np.cos(b), -np.sin(b)], [np.sin(b), np.cos(b)]])
        moved = turn @ u[t, :2] * dt
        f = np.diag([1.0, 1.0, keep, keep, 1.0])
        f[:2, 2], f[:2, 3] = (1 + s) * np.array([-moved[1], moved[0]]), moved
        x = np.array([*(x[:2] + (1 + s) * moved), keep * b, keep * s, x[4] + dt * u[t, 2]])
        p = f @ p @ f.T + np.diag([*q[t, :2], *((1 - keep**2) * lasting**2), q[t, 2]])
        since += dt
        if np.isfinite(z[t]).all():
            rho = np.exp(-since / errors.correlation) if errors.correlation else 0.0
            v, white = z[t] - measured @ x, level * r
            marginal = measured @ p @ measured.T + np.diag(white + late)
            weight = np.ones(3)
            for part in (plane, height):
                d2 = v[part] @ np.linalg.solve(marginal[np.ix_(part, part)], v[part]) / len(part)
                weight[part] = max(1.0, d2 / errors.gate**2)
                if part is plane:
                    fixes = min(fixes + 1.0, errors.window)
                    if errors.least < 1.0:
                        common = np.clip(common + (min(d2, 5.0 * common) - common) / fixes, errors.least, 4.0)
                    level = np.clip(level * (1 + (min(d2, 5.0) - 1) / errors.window), 1.0, 400.0)
            noise = np.diag(weight * (white * (1 + 2 * rho / (1 - rho)) + late))
            gain = p @ measured.T @ np.linalg.inv(measured @ p @ measured.T + noise)
            gain[2:4] /= weight[0]
            rest = np.eye(5) - gain @ measured
            x, p, since = x + gain @ v, rest @ p @ rest.T + gain @ noise @ gain.T, 0.0
        means.append(x)
        covariances.append(common * p)
    return np.array(means), np.array(covariances)
