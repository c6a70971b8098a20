"""Pose filters, alone and with ten neighbours in one state, beside filterpy's extended Kalman filter on the same work.

    OMP_NUM_THREADS=1 python benchmarks/poses.py               # a Markdown table on stdout, half a minute

One linearisation each, from the same measurements; filterpy's user gives it model and derivatives as NumPy arrays over
all members at once. Times are this thread's own, medians of interleaved rounds, per step and run. A row counts only if
its poses are those of filterpy to 1e-6 m.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from classical import ring
from filterpy.kalman import ExtendedKalmanFilter
from timing import medians, report, rows_of, timed

import coopoc as co
from coopoc.methods.poses.pose_inputs import body_of, first_poses
from coopoc.world.links import wrap

ROUNDS, STEPS, RUNS = 5, 101, 10
NEIGHBOURS = {0: 3, 10: 1}
"""K -> runs that filterpy follows."""
SENSORS = co.Sensors(
    velocity_std_ratio=1e-6,
    velocity_floor=0.5,
    heading_std=0.05,
    yaw_rate_std=0.02,
    range_std=0.5,
    azimuth_std=0.03,
    inclination_std=0.03,
)
"""The noise of velocities is the same at any speed: ours follows past ones, filterpy here the step's own."""
FLAT, UNKNOWN = 1e6, np.pi**2 / 3


def ours(recording: co.Recording) -> Callable[[], Any]:
    """The kernel over all runs; poses (R, T, 4) of the ego."""
    method, members = co.PoseFilter(exact=False, robust=False, lasting=False), list(range(len(recording.ids)))
    begin, links = first_poses(recording, None, members), np.arange(len(recording.links))
    return lambda: method._run_filter(recording, members, links, begin)[0][:, :, 0]


def filterpys(recording: co.Recording, run: int) -> Any:
    """Poses (T, 4) of the ego in one run by filterpy."""
    body, links, dt = body_of(recording), recording.links, recording.dt
    order = np.concatenate([[0], links.neighbour[links.step == 0]])
    n, fixes = len(order), np.concatenate([recording.gnss[run], body.heading[run][..., None]], axis=2)
    ekf = ExtendedKalmanFilter(4 * n, 4 * n)
    ekf.x = fixes[0, order].ravel()
    ekf.P = np.diag(np.tile([FLAT, FLAT, FLAT, UNKNOWN], n))
    own = np.diag(np.tile([*np.square(SENSORS.fix_std), SENSORS.heading_std**2], n))
    noise, same = np.diag(np.tile(np.square(SENSORS.relative_std), n - 1)), np.eye(4 * n)
    block, found = 4 * np.arange(n), np.empty((len(recording.t), 4))
    for t in range(len(recording.t)):
        if t:
            x, u, w = ekf.x.reshape(n, 4), recording.velocity[run, t, order], body.yaw_rate[run, t, order]
            heading = x[:, 3] + dt * w / 2
            c, s, zero, one = np.cos(heading), np.sin(heading), 0 * w, 1 + 0 * w
            R = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(n, 3, 3)
            moved = dt * (R @ u[..., None])[..., 0]
            q = dt**2 * np.maximum(SENSORS.velocity_std_ratio * np.abs(u), SENSORS.velocity_floor) ** 2
            effect = dt * np.stack([-moved[:, 1] / 2, moved[:, 0] / 2, zero, one], axis=1)
            Q = SENSORS.yaw_rate_std**2 * effect[:, :, None] * effect[:, None]
            Q[:, :3, :3] += (R * q[:, None]) @ R.transpose(0, 2, 1)
            F, whole = same.copy(), np.zeros((4 * n, 4 * n))
            F[block, block + 3], F[block + 1, block + 3] = -moved[:, 1], moved[:, 0]
            for k in range(n):
                whole[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = Q[k]
            ekf.x = (x + np.column_stack([moved, dt * w])).ravel()
            ekf.P = F @ ekf.P @ F.T + whole
        z = fixes[t, order].ravel()
        z[3::4] = ekf.x[3::4] + wrap(z[3::4] - ekf.x[3::4])
        ekf.update(z, lambda x: same, lambda x: x, own)
        at = links.step == t
        if n > 1:
            place = np.searchsorted(np.sort(order), links.neighbour[at])
            where = np.argsort(order)[place]
            h, H = rows(ekf.x, where, n)
            z = recording.relative[run, at]
            z = (h + np.column_stack([z[:, 0] - h[:, 0], wrap(z[:, 1:] - h[:, 1:])])).ravel()
            ekf.update(z, lambda x, H=H: H, lambda x, h=h: h.ravel(), noise)
        found[t] = ekf.x[:4]
    return found


def rows(state: Any, others: Any, n: int) -> Any:
    """Ranges, bearings and inclinations (n - 1, 3) of other members from the first, and their derivatives."""
    x = state.reshape(n, 4)
    (dx, dy, dz), count = (x[others, :3] - x[0, :3]).T, len(others)
    flat2 = dx * dx + dy * dy
    flat, r2 = np.sqrt(flat2), flat2 + dz * dz
    r, zero = np.sqrt(r2), 0 * dx
    h = np.stack([r, np.arctan2(dy, dx) - x[0, 3], np.arctan2(flat, dz)], axis=1)
    a = np.stack([dx / r, -dy / flat2, dx * dz / (flat * r2)], axis=1)
    b = np.stack([dy / r, dx / flat2, dy * dz / (flat * r2)], axis=1)
    c = np.stack([dz / r, zero, -flat / r2], axis=1)
    H, row = np.zeros((count, 3, 4 * n)), np.arange(count)
    H[:, :, 0], H[:, :, 1], H[:, :, 2], H[:, 1, 3] = -a, -b, -c, -1.0
    for axis, entry in enumerate((a, b, c)):
        H[row, :, 4 * others + axis] = entry
    return h, H.reshape(3 * count, 4 * n)


def measured() -> list[dict[str, Any]]:
    """Rows {name, us, ratio, right}: time per step and run, over that of filterpy."""
    found = []
    for neighbours, few in NEIGHBOURS.items():
        seen = ring(neighbours, STEPS, RUNS, SENSORS, "body")
        call = ours(seen)
        wanted = np.stack([filterpys(seen, run) for run in range(few)])
        gap = call()[:few] - wanted
        right = bool(max(np.abs(gap[..., :3]).max(), np.abs(wrap(gap[..., 3])).max()) < 1e-6)
        job = f"poses, K = {neighbours}"
        spend = {
            "filterpy": lambda seen=seen, few=few: timed(lambda: [filterpys(seen, r) for r in range(few)]) / few,
            "compiled": lambda call=call: timed(call) / RUNS,
        }
        spent = {name: value / STEPS for name, value in medians(spend, ROUNDS).items()}
        found += rows_of(f"{job}: ", spent, "filterpy", dict.fromkeys(spent, right))
    return found


if __name__ == "__main__":
    print(report(measured()))
