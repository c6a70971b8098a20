"""The pose filter with stacked rows, one dense covariance and numerical derivatives."""

import numpy as np
from numpy import array, concatenate, diag, isfinite, zeros
from scipy.linalg import block_diag

from oracles.pace import after

FLAT, UNKNOWN = 1e6, np.pi**2 / 3


def jacobian(f, x, size=1e-6):  # type: ignore[no-untyped-def]
    """Derivatives (M, n) of f at x (n,) by central differences."""
    steps = size * diag(1 + abs(x))
    return np.stack([(f(x + h) - f(x - h)) / (2 * h.sum()) for h in steps], axis=1)


def motion(state, inputs, dt):  # type: ignore[no-untyped-def]
    """State of a member after a step; inputs are forward, left, up and yaw rate."""
    scale, bias = (state[4], state[5]) if len(state) > 4 else (0.0, 0.0)
    turn = dt * (inputs[3] - bias)
    c, s = np.cos(state[3] + turn / 2), np.sin(state[3] + turn / 2)
    slow = state[7:] if len(state) > 7 else 0.0
    u = array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (inputs[:3] - slow) / (1 + scale)
    return concatenate([state[:3] + dt * u, [state[3] + turn], state[4:]])


def end_of(pose, tag):  # type: ignore[no-untyped-def]
    """Where a tag is; what is no member has none."""
    turned = np.exp(1j * [*pose, 0.0][3]) * complex(*tag[:2])
    return np.add(pose[:3], [turned.real, turned.imag, tag[2]])


def spherical(own, other, tags=zeros((2, 3))):  # type: ignore[no-untyped-def]
    """Range between tags, bearing from the heading, inclination."""
    x, y, z = other[:3] - own[:3]
    far = np.linalg.norm(end_of(other, tags[1]) - end_of(own, tags[0]))
    return array([far, np.arctan2(y, x) - own[3], np.arctan2(np.hypot(x, y), z)])


def wrapped(residual, angle):  # type: ignore[no-untyped-def]
    return np.where(angle, np.angle(np.exp(1j * residual)), residual)


def curvature(gap, P):  # type: ignore[no-untyped-def]
    """Variances tr(H P H P) / 2 of range, bearing and inclination of a vector that errs by P."""
    slopes = jacobian(lambda v: jacobian(lambda end: spherical(zeros(4), end), v).ravel(), gap, 1e-3)
    both = slopes.reshape(3, 3, 3) @ P
    return np.einsum("cij,cji->c", both, both) / 2


def update(x, P, h, z, variance, angle, passes=1):  # type: ignore[no-untyped-def]
    """Gauss-Newton steps from one prior (x, P); the first is the extended Kalman filter's."""
    at = x
    for _ in range(passes):
        H = jacobian(h, at)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + diag(variance(at)))
        at = x + K @ (wrapped(z - h(at), angle) - H @ (x - at))
    return at, (np.eye(len(x)) - K @ H) @ P


def pose_filter(drive, noise, begin, d, passes, run):  # type: ignore[no-untyped-def]
    """States (T, n, d) and covariances (T, n, d, d) of one run in one state, any numbers for members that are away."""
    (steps, members), odometer = drive.active.shape, noise.odometer
    out, covs = zeros((steps, members, d)), zeros((steps, members, d, d))
    extra, lasting = drive.ends[:, 2].max() // d + 1, array(noise.lasting)[: d - 4]  # 0 and offsets of pairs
    x = zeros((members + extra, d))
    P = diag(np.repeat([0.0, 0.3**2 * noise.lasting[2]], [members * d + 1, extra * d - 1]))
    pace = zeros((members, 3))
    keep = array([noise.keep] * 2 + [1] + [noise.keep] * 3)[: d - 4]  # an offset stays
    grown = (lasting * (1 - keep**2)).tolist()
    for t in range(steps):
        F, Q = [], []
        for n in range(members):
            own = drive.own[run, t, n]
            if t and drive.active[t - 1, n] and drive.active[t, n]:
                u, state = own[4:], x[n].copy()
                size = np.sqrt(pace[n].sum() if odometer.of_speed else pace[n])
                pace[n] = after(pace[n], u[:3], drive.dt)
                q = np.append(np.maximum(odometer.ratio * size, odometer.floor) ** 2, noise.yaw_rate)
                F.append(jacobian(lambda s, u=u: motion(s, u, drive.dt), state))
                G = jacobian(lambda v, s=state: motion(s, v, drive.dt), u)
                F[-1][4:] *= keep[:, None]
                Q.append(G @ diag(q) @ G.T + diag([0, 0, 0, 0, *grown]))
                x[n] = motion(state, u, drive.dt)
                x[n, 4:] *= keep
                continue
            F.append(zeros((d, d)))
            pace[n] = own[4:7] ** 2
            wide = array([FLAT] * 3 + [UNKNOWN] + list(lasting))
            x[n] = np.append(np.nan_to_num(own[:4]), zeros(d - 4))
            if t == 0:
                given = isfinite(begin[0][n])
                x[n, :4][given], wide[:4][given] = begin[0][n][given], np.square(begin[1])[given]
            Q.append(diag(wide))
        F, Q = block_diag(*F, np.eye(extra * d)), block_diag(*Q, zeros((extra * d,) * 2))
        P = F @ P @ F.T + Q
        flat = x.ravel()
        for n in np.flatnonzero(drive.active[t]):
            own, b = drive.own[run, t, n], d * n
            if isfinite(own[3]):
                flat, P = update(flat, P, lambda s, b=b: s[b + 3 : b + 4], own[3:4], lambda _: [noise.heading], [True])
            if isfinite(own[:3]).all():
                flat, P = update(flat, P, lambda s, b=b: s[b : b + 3], own[:3], lambda _: noise.fix, [False] * 3)
        links = range(drive.first[t], drive.first[t + 1])
        located = [P[d * k, d * k] < FLAT / 2 for k in range(members)]
        links = [k for k in links if located[drive.ends[k, 0]] and (drive.ends[k, 1] < 0 or located[drive.ends[k, 1]])]
        if len(links):
            flat, P = relative(flat, P, drive, noise, (run, links, d), passes)
        x = flat.reshape(-1, d).copy()
        out[t], covs[t] = x[:members], P.reshape(*x.shape, *x.shape)[np.arange(members), :, np.arange(members)]
    return out, covs


def relative(x, P, drive, noise, where, passes):  # type: ignore[no-untyped-def]
    """All components that were measured, at once."""
    run, links, d = where

    def ends(s, k):  # type: ignore[no-untyped-def]
        other = drive.landmark[k] if drive.ends[k, 1] < 0 else s[d * drive.ends[k, 1] :][:4]
        return s[d * drive.ends[k, 0] :][:d], other

    def h(s):  # type: ignore[no-untyped-def]
        predicted = []
        for k in links:
            mine, other = ends(s, k)
            longer = array([mine[6] + s[d * drive.own.shape[2] + drive.ends[k, 2]], 0, 0]) if d > 6 else 0
            every = spherical(mine, other, drive.tags[drive.ends[k, :2]]) + longer
            predicted.append(every[isfinite(drive.relative[run, k])])
        return concatenate(predicted)

    def variance(s):  # type: ignore[no-untyped-def]
        more = [[0.0] * len(kind)]
        for k in links if passes > 1 else ():
            gap = lambda s, k=k: ends(s, k)[1][:3] - ends(s, k)[0][:3]  # noqa: E731
            to = jacobian(gap, s)
            more.append(curvature(gap(s), to @ P @ to.T)[isfinite(drive.relative[run, k])])
        return array(noise.relative)[kind] + concatenate(more[passes > 1 :])

    z = concatenate([drive.relative[run, k][isfinite(drive.relative[run, k])] for k in links])
    kind = concatenate([np.flatnonzero(isfinite(drive.relative[run, k])) for k in links])
    if not len(z):
        return x, P
    return update(x, P, h, z, variance, kind > 0, passes)
