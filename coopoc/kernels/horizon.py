"""The moving horizon of one ego's star: a window of steps behind an arrival cost, solved anew at every step.

The sweeps of `coopoc.methods.window` over the knowledge of `coopoc.methods.true_time`, one run after the other. Slot t
modulo length + 1 of the window holds step t: the step that leaves is still there when the next one has come. In the
plain tuple `window`, of h slots and n members:

    who (h, 5, n): column, step of the message that moves it, uses of that, place in the star before, step it joined at
    motion (h, 4, n, 3): of `coopoc.kernels.star_messages.hear`
    point, at (h, n, 3) m: the estimate, and where the past expects it
    base (h, n, 3) m: vector from the ego around which its sighting, edge (h, n, 9), is linear
    past (h, .): information and pull of what the steps before say around `at`; kept (h, .), of `loosen_and_keep`

Matrices are those of `coopoc.kernels.blocks`, the ego's block the last.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import AnyArray, Bools, Floats
from .blocks import width
from .compile import as_written
from .horizon_steps import enter, go_on, size, strayed, sweep
from .roster import widest
from .star_messages import hear, says

SENT, USES, PLACE, JOINED = 1, 2, 3, 4


@as_written
def horizons(
    measured: Any, assumed: Any, arrival: Any, length: int, refine: bool, sweeps: int, age: float, moved: float
) -> tuple[Floats, Floats, Floats, Bools]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, and (R, T) True where it still moved.

    Args:
        arrival: (R, M) of the inbox, None if messages stay where they were brought forward to. length: steps.
        refine: sightings in range and angles. sweeps: how many more, m `moved` since the last one. age: of messages.
    """
    seen, start = measured[2], measured[4]
    runs, steps, most = seen.shape[0], len(start) - 1, widest(start)
    x, cov, others = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    moving, slots, stride = np.zeros((runs, steps), np.bool_), length + 1, width(3 * most)
    who, motion, point = np.zeros((slots, 5, most), np.int64), np.zeros((slots, 4, most, 3)), np.zeros((slots, most, 3))
    window = (who, motion, point, np.zeros((slots, most, 3)), np.zeros((slots, most, 3)), np.zeros((slots, most, 9)),
              np.zeros((slots, 3 * most * stride)), np.zeros((slots, most * (3 * stride + 9))))  # fmt: skip
    memory = (np.zeros(3 * most * stride), np.zeros(3 * most * stride), np.zeros(9 * most), np.zeros(3 * most),
              np.zeros(3 * most), np.zeros(3 * stride))  # fmt: skip
    for run in range(runs):
        for t in range(steps):
            n, slot, first = size(start, t), t % slots, max(0, t - length + 1)
            old = size(start, t - 1) if t > 0 else 0
            hear(measured, assumed, run, t, who[slot, :4, :n], who[slot - 1, :3, :old], motion[slot])
            if arrival is not None:
                for k in range(n):
                    place = who[slot, PLACE, k]
                    who[slot, JOINED, k] = who[slot - 1, JOINED, place] if place >= 0 else t
                for step in range(first, t + 1):
                    listen(measured, assumed, arrival, run, step, t, age, who, motion)
            enter(window, seen[run], start, t, assumed)
            if t >= length:
                go_on(window, start, t - length, assumed, memory)
            for again in range(sweeps + 1):
                sweep(window, seen[run], start, first, t, assumed, refine, again == 0, memory, cov[run, t])
                moving[run, t] = refine and strayed(window, start, first, t, moved)
                if not moving[run, t]:
                    break
            for c in range(3):
                x[run, t, c] = point[slot, 0, c]
                for k in range(1, n):
                    others[run, start[t] + k - 1, c] = point[slot, k, c]
    return x, cov, others, moving


@as_written
def listen(
    measured: Any, assumed: Any, arrival: AnyArray, run: int, step: int, now: int, age: float, who: AnyArray,
    motion: AnyArray,
) -> None:  # fmt: skip
    """What has arrived by now about a step: `coopoc.methods.true_time.known_by`."""
    start, slot = measured[4], step % len(who)
    for k in range(size(start, step)):
        member, was, place = who[slot, 0, k], who[slot, SENT, k], who[slot, PLACE, k]
        come = k == 0 or 0 <= arrival[run, start[step] + k - 1] <= now
        sent = step if come else was
        if step > 0 and place >= 0:
            carried = who[slot - 1, SENT, place]
            if step - carried <= age:
                sent = max(sent, carried)
        if step < now and sent == was and come == (motion[slot, 3, k, 0] > 0.0):
            continue
        uses = step - max(sent, who[slot, JOINED, k]) + 1
        said = says(measured, assumed, run, step, member, sent, uses, come)
        who[slot, SENT, k], who[slot, USES, k] = sent, uses
        for i in range(4):
            motion[slot, i, k, 0], motion[slot, i, k, 1], motion[slot, i, k, 2] = said[i]
