"""The star of an ego and its neighbours in plain NumPy, step by step: newest messages brought forward, measurements."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..kernels.stars.messages import ACCELERATION_STD, FIX_GROWTH, FORGOTTEN
from ..world.inbox import inbox
from ..world.recording import Recording, check_recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .noise_model import NoiseModel, resolve


@dataclass(frozen=True, eq=False)
class StarStep:
    """What an ego knows of the n members of its star at a step, itself first; R runs.

    Args:
        step: t.
        member: (n,) columns.
        previous: (n,) index of each member in the previous star, -1 if it has just joined.
        link: (n-1,) indices into the Recording's links.
        moved: (R, n, 3) m, dt times the newest velocity held, 0 for none.
        process: (R, n, 3) m^2, variance of that motion.
        position: (R, n, 3) m as broadcast, brought forward to this step; 0 if none is held.
        variance: (R, n, 3) m^2 of it, infinite if none is held.
        new: (R, n) True where that position counts: it has not been used before.
        relative: (R, n-1, 3) range m, azimuth rad, inclination rad; NaN where not measured.
    """

    step: int
    member: Ints
    previous: Ints
    link: Ints
    moved: Floats
    process: Floats
    position: Floats
    variance: Floats
    new: Bools
    relative: Floats


def stars(
    recording: Recording,
    ego: int | str,
    noise_model: NoiseModel | str = "nominal",
    message: Message = FIX_AND_VELOCITY,
    *,
    sent: tuple[Floats, Floats] | None = None,
    growth: tuple[float, float] = FIX_GROWTH,
    acceleration_std: float = ACCELERATION_STD,
) -> Iterator[StarStep]:
    """The ego's star at every step of a recording, all runs at once: start a cooperative filter here.

    The newest message that has arrived counts. Its velocity moves its sender until the next one; its position, sent
    `age` steps ago, is brought forward with that velocity and used once. A velocity that serves for the n-th step in a
    row makes the same error n times: the variance of the sum is n^2 of that of one step, so this step adds 2 n - 1 of
    it. Nothing is known of a member without messages.

    Args:
        recording: measurements and messages.
        ego: column or id.
        noise_model: "identity", "nominal" or a NoiseModel.
        message: what each vehicle broadcasts.
        sent: (R, T, N, 3) m and m^2, estimates and variances that are sent in place of fixes.
        growth: of the variance with the age.
        acceleration_std: m/s^2, change of a velocity since it was sent.

    >>> from coopoc import Fleet, Sensors, V2X, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> [star.member.tolist() for star in stars(observe(fleet, Sensors(), V2X()), "a")]
    [[0, 1], [0, 1]]
    """
    assumed_noise, ego = resolve(noise_model, recording), check_recording(recording).columns([ego])[0]
    messages, shape, dt = inbox(recording, ego, message), recording.gnss.shape, recording.dt
    q = np.broadcast_to(assumed_noise.process_variance(recording, [ego], messages), shape)
    r = np.broadcast_to(assumed_noise.fix_variance(recording), shape)
    fixes, variances = sent or (recording.gnss, r)
    variances = np.broadcast_to(variances, shape)
    run, each = np.arange(recording.runs)[:, None], np.ones((recording.runs, 1), int)
    member, newest, uses = np.empty(0, int), 0 * each[:, :0], 0 * each[:, :0]
    for t in range(len(recording.t)):
        here = slice(messages.start[t], messages.start[t + 1])
        before, member = member, np.append(ego, recording.links.neighbour[messages.link[here]])
        same = np.pad(member[:, None] == before, ((0, 0), (0, 1)), constant_values=True)
        previous = np.where(same[:, :-1].any(1), same.argmax(1), -1)
        last, newest = np.append(newest, -2 * each, axis=1), np.append(t * each, messages.newest[:, here], axis=1)
        served = np.append(uses, each, axis=1)[:, previous]
        uses = np.where((previous >= 0) & (last[:, previous] == newest), served + 1, 1)
        held, s = newest >= 0, np.where(newest >= 0, newest, t)
        age = (t - s)[..., None]
        step_variance = q[run, s, member] + (dt**2 * age * acceleration_std) ** 2
        moved = np.where(held[..., None], dt * recording.velocity[run, s, member], 0.0)
        position, variance = fixes[run, s, member] + age * moved, variances[run, s, member]
        variance = variance + age * (growth[0] * age + growth[1]) * step_variance
        position[:, 0], variance[:, 0] = recording.gnss[:, t, ego], r[:, t, ego]
        known_position = held & np.isfinite(position).all(-1)
        yield StarStep(
            t,
            member,
            previous,
            messages.link[here],
            moved,
            np.where(held[..., None], (2 * uses - 1)[..., None] * step_variance, FORGOTTEN),
            np.where(known_position[..., None], position, 0.0),
            np.where(known_position[..., None], variance, np.inf),
            np.append(each > 0, messages.fresh[:, here], axis=1) & known_position,
            recording.relative[:, messages.link[here]],
        )
