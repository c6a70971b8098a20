"""Process noise of one run from its definition: a share of the pace that a receiver knows of each vehicle."""

import math

import numpy as np

from coopoc.arrays import Floats
from coopoc.methods.noise_model import NoiseModel
from coopoc.world.inbox import Inbox
from coopoc.world.recording import Recording


def after(square: Floats, u: Floats, seconds: float) -> Floats:
    """(..., 3) m^2/s^2: a first-order lag of 0.5 s, of a velocity at most twice the pace and 10 m/s^2 beyond."""
    most = 4 * square.sum(axis=-1, keepdims=True) + (10 * seconds) ** 2
    own: Floats = u**2 * np.fmin(1.0, most / np.fmax((u**2).sum(axis=-1, keepdims=True), 1e-300))
    return square + seconds / (seconds + 0.5) * (own - square)


def heard(recording: Recording, box: Inbox | None, known: NoiseModel, run: int, ego: int) -> Floats:
    """(T, N, 3) m^2. Of a neighbour the velocities count that were the newest ones held, each until the next one."""
    u, dt = recording.velocity[run], recording.dt
    noise = known.sensors
    if known.process_std is not None or known.fleet is not None or noise is None:
        return np.broadcast_to(known.process_variance(recording), recording.velocity.shape)[run]
    square = np.full(u.shape, np.nan)
    for j in range(u.shape[1]):
        held, longest = set(range(len(u))), math.inf
        if box is not None and j != ego:
            held, longest = (
                set(box.newest[run, recording.links.neighbour[box.link] == j].tolist()),
                recording.v2x.max_age,
            )
        last = -1
        for t in range(len(u)):
            if last < 0 or np.isnan(square[last, j]).any() or (t - last) * dt > longest + 1e-9:
                square[t, j] = u[t, j] ** 2
            else:
                square[t, j] = after(square[last, j], u[last, j], (t - last) * dt)
            if np.isnan(u[t, j]).any():
                square[t, j] = np.nan
            last = t if t in held else last
    if noise.velocity_reading == "speed":
        square = np.repeat(square.sum(axis=-1, keepdims=True), 3, axis=-1)
    found: Floats = (dt * np.maximum(noise.velocity_std_ratio * np.sqrt(square), noise.velocity_floor)) ** 2
    return found
