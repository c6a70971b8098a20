"""What one vehicle knows at each step of a drive, run by run, from the definition of a message.

A message is sent at a step and holds a position and a velocity. The newest one that has arrived counts; its velocity
moves its sender from then on, and its position is used once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from coopoc import NoiseModel, Recording
from coopoc.arrays import Floats
from coopoc.methods.star import ACCELERATION_STD, FORGOTTEN
from coopoc.world.inbox import Inbox

Growth = Callable[[int, Floats, Floats], Floats]


@dataclass
class Member:
    """A vehicle in the star at a step: where it stood in the last star (None: joins), motion m and its variance m^2
    since then, position m brought forward and its variance m^2 (infinite: not known), whether that is new, and the
    measurement of it (None for the ego)."""

    before: int | None
    moved: Floats
    process: Floats
    position: Floats
    variance: Floats
    new: bool
    relative: Floats | None


def stars(
    recording: Recording,
    ego: int,
    box: Inbox,
    run: int,
    known: NoiseModel,
    own: tuple[Floats, Floats] | None = None,
    growth: Growth | None = None,
) -> Iterator[list[Member]]:
    """The star at every step of one run.

    Args:
        own: (R, T, N, 3) m and m^2, estimates that are sent in place of fixes.
        growth: what a position's variance gains with its age; None for fixes.
    """
    shape, growth = recording.gnss.shape, growth or of_fix
    q = np.broadcast_to(known.process_variance(recording), shape)[run]
    r = np.broadcast_to(known.fix_variance(recording), shape)[run]
    gnss, velocity = recording.gnss[run], recording.velocity[run]
    sent_x, sent_r = (gnss, r) if own is None else (own[0][run], own[1][run])
    columns: list[int] = []
    uses: dict[int, tuple[int, int]] = {}
    for t in range(len(recording.t)):
        span = range(box.start[t], box.start[t + 1])
        now = [ego, *(int(recording.links.neighbour[box.link[k]]) for k in span)]
        steps = [t, *(int(box.newest[run, k]) for k in span)]
        fresh = [True, *(bool(box.fresh[run, k]) for k in span)]
        star, used = [], {}
        for k, (j, s) in enumerate(zip(now, steps, strict=True)):
            before = columns.index(j) if j in columns else None
            again = before is not None and uses[j][0] == s
            used[j] = (s, uses[j][1] + 1 if again else 1)
            relative = recording.relative[run, box.link[span[k - 1]]] if k else None
            if s < 0:
                nothing = np.full(3, np.inf)
                star.append(Member(before, np.zeros(3), np.full(3, FORGOTTEN), np.zeros(3), nothing, False, relative))
                continue
            age, x, variance = t - s, (gnss if k == 0 else sent_x)[s, j], (r if k == 0 else sent_r)[s, j]
            one = q[s, j] + (recording.dt**2 * age * ACCELERATION_STD) ** 2
            there = bool(np.isfinite(x).all())
            moved = recording.dt * velocity[s, j]
            position = x + age * moved if there else np.zeros(3)
            variance = variance + growth(age, q[s, j], one) if there else np.full(3, np.inf)
            star.append(
                Member(before, moved, (2 * used[j][1] - 1) * one, position, variance, fresh[k] and there, relative)
            )
        yield star
        columns, uses = now, used


def of_fix(age: int, q: Floats, one: Floats) -> Floats:
    """Variance that a fix gains in `age` steps: the same error of velocity, age times."""
    return age**2 * one


def of_estimate(age: int, q: Floats, one: Floats) -> Floats:
    """An estimate has made that error once before: age (age + 2) in all."""
    return age * (age + 2) * one


def of_independent_steps(age: int, q: Floats, one: Floats) -> Floats:
    """As MSMV-R takes it: an error of its own in each step."""
    return age * q
