"""The pose filter with stacked rows, one dense covariance and numerical derivatives."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

FLAT, UNKNOWN = 1e6, np.pi**2 / 3


def jacobian(f, x):  # type: ignore[no-untyped-def]
    """Derivatives (M, n) of f at x (n,) by central differences."""
    steps = 1e-6 * np.diag(1 + np.abs(x))
    return np.stack([(f(x + h) - f(x - h)) / (2 * h.sum()) for h in steps], axis=1)


def motion(state, inputs, dt):  # type: ignore[no-untyped-def]
    """State of a member after a step; inputs are forward, left, up and yaw rate."""
    scale, bias = (state[4], state[5]) if len(state) > 4 else (0.0, 0.0)
    turn = dt * (inputs[3] - bias)
    c, s = np.cos(state[3] + turn / 2), np.sin(state[3] + turn / 2)
    u = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ inputs[:3] / (1 + scale)
    return np.concatenate([state[:3] + dt * u, [state[3] + turn], state[4:]])


def spherical(own, other):  # type: ignore[no-untyped-def]
    """Range, bearing from the heading, inclination."""
    x, y, z = other[:3] - own[:3]
    return np.array([np.sqrt(x * x + y * y + z * z), np.arctan2(y, x) - own[3], np.arctan2(np.hypot(x, y), z)])


def wrapped(residual, angle):  # type: ignore[no-untyped-def]
    return np.where(angle, np.angle(np.exp(1j * residual)), residual)


def update(x, P, h, z, variance, angle, passes=1):  # type: ignore[no-untyped-def]
    """Gauss-Newton steps from one prior (x, P); the first is the extended Kalman filter's."""
    at = x
    for _ in range(passes):
        H = jacobian(h, at)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(variance))
        at = x + K @ (wrapped(z - h(at), angle) - H @ (x - at))
    return at, (np.eye(len(x)) - K @ H) @ P


def pose_filter(seen, noise, begin, spread, options, run):  # type: ignore[no-untyped-def]
    """States (M, d) and covariances (M, d, d) of one run of a joint unit."""
    d, out, covs, past = options.d, [], [], {}
    ratio, floor, of_speed = noise.velocity
    for t in range(len(seen.start) - 1):
        now, prior, blocks, P_old, old = list(range(seen.start[t], seen.start[t + 1])), [], [], None, {}
        if past:
            newest = {seen.member[i]: seen.newest[run, i] for i in now}
            old = {n: at for n, at in past["at"].items() if past["sent"][n] >= 0 or newest.get(n, -1) < 0}
            P_old = past["P"]
        for i in now:
            n, sent = seen.member[i], seen.newest[run, i]
            u = np.append(seen.own[run, sent, n, 4:7], seen.own[run, sent, n, 7])
            if n not in old:
                fix, compass = np.nan_to_num(seen.own[run, sent, n, :3]), np.nan_to_num(seen.own[run, sent, n, 3])
                state = np.concatenate(
                    [fix if sent >= 0 else [0, 0, 0], [compass if sent >= 0 else 0], np.zeros(d - 4)]
                )
                wide = np.array([FLAT] * 3 + [UNKNOWN] + list(noise.lasting[: d - 4]))
                if t == 0:
                    given = np.isfinite(begin[run, n])
                    state[:4][given], wide[:4][given] = begin[run, n][given], np.square(spread)[given]
                prior.append(state), blocks.append((np.eye(d), np.diag(wide), 1))
                continue
            uses = past["uses"][n] + 1 if past["sent"][n] == sent else 1
            state = past["x"][n]
            if sent < 0:
                prior.append(state)
                blocks.append((np.eye(d), np.diag([FLAT] * 3 + [UNKNOWN] + [0.0] * (d - 4)), uses))
                continue
            size = np.full(3, np.linalg.norm(u[:3])) if of_speed else np.abs(u[:3])
            late = (seen.dt * (t - sent) * noise.acceleration) ** 2
            q = (2 * uses - 1) * np.append(np.maximum(ratio * size, floor) ** 2, noise.yaw_rate) + [late, late, late, 0]
            F = jacobian(lambda s, u=u: motion(s, u, seen.dt), state)
            G = jacobian(lambda v, s=state: motion(s, v, seen.dt), u)
            F[4:] *= noise.keep
            moved = motion(state, u, seen.dt)
            moved[4:] *= noise.keep
            fresh = np.append(np.zeros(4), (1 - noise.keep**2) * np.array(noise.lasting))[:d]
            prior.append(moved), blocks.append((F, G @ np.diag(q) @ G.T + np.diag(fresh), uses))
        x, P = np.concatenate(prior), np.zeros((len(now) * d,) * 2)
        for a, i in enumerate(now):
            for b, j in enumerate(now):
                if seen.member[i] in old and seen.member[j] in old:
                    cross = P_old[old[seen.member[i]], :][:, old[seen.member[j]]]
                    P[d * a : d * a + d, d * b : d * b + d] = blocks[a][0] @ cross @ blocks[b][0].T
        P += block_diag(*[block[1] for block in blocks])
        x, P = own(x, P, seen, noise, (run, t, d))
        links = range(seen.first[t], seen.first[t + 1])
        known = [P[d * k, d * k] < FLAT / 2 for k in range(len(now))]
        links = [k for k in links if known[seen.ends[k, 0]] and (seen.ends[k, 1] < 0 or known[seen.ends[k, 1]])]
        if len(links):
            x, P = relative(x, P, seen, noise, (run, links, d), options.passes)
        rows = {seen.member[i]: np.arange(d * k, d * k + d) for k, i in enumerate(now)}
        for r in rows.values():
            out.append(x[r]), covs.append(P[np.ix_(r, r)])
        sent = {seen.member[i]: seen.newest[run, i] for i in now}
        uses = {seen.member[i]: blocks[k][2] for k, i in enumerate(now)}
        past = {"P": P, "at": rows, "x": {n: x[r] for n, r in rows.items()}, "sent": sent, "uses": uses}
    return np.array(out), np.array(covs)


def own(x, P, seen, noise, where):  # type: ignore[no-untyped-def]
    """Compass and fix of every member whose message is new."""
    run, t, d = where
    for k, i in enumerate(range(seen.start[t], seen.start[t + 1])):
        n, sent = seen.member[i], seen.newest[run, i]
        if sent < 0 or not seen.fresh[run, i]:
            continue
        late, u, b = seen.dt * (t - sent), seen.own[run, sent, n, 4:7], d * k
        w, compass, fix = seen.own[run, sent, n, 7], seen.own[run, sent, n, 3], seen.own[run, sent, n, :3]
        if np.isfinite(compass):
            variance = [noise.heading + late**2 * noise.yaw_rate]
            x, P = update(x, P, lambda s, b=b: s[b + 3 : b + 4], np.array([compass + late * w]), variance, [True])
        if np.isfinite(fix).all():
            ratio, floor, of_speed = noise.velocity
            q = np.maximum(ratio * (np.full(3, np.linalg.norm(u)) if of_speed else np.abs(u)), floor).max() ** 2

            def before(s, b=b, u=u, late=late):  # type: ignore[no-untyped-def]
                return s[b : b + 3] - late * motion(np.append(np.zeros(3), s[b + 3]), np.append(u, 0.0), 1.0)[:3]

            x, P = update(x, P, before, fix, np.array(noise.fix) + late**2 * q, [False] * 3)
    return x, P


def relative(x, P, seen, noise, where, passes):  # type: ignore[no-untyped-def]
    """All components that were measured, at once."""
    run, links, d = where

    def h(s):  # type: ignore[no-untyped-def]
        found = []
        for k in links:
            mine, other = s[d * seen.ends[k, 0] :][:4], seen.place[k]
            if seen.ends[k, 1] >= 0:
                other = s[d * seen.ends[k, 1] :][:3]
            found.append(spherical(mine, other)[np.isfinite(seen.relative[run, k])])
        return np.concatenate(found)

    z = np.concatenate([seen.relative[run, k][np.isfinite(seen.relative[run, k])] for k in links])
    kind = np.concatenate([np.flatnonzero(np.isfinite(seen.relative[run, k])) for k in links])
    if not len(z):
        return x, P
    return update(x, P, h, z, np.array(noise.relative)[kind], kind > 0, passes)
