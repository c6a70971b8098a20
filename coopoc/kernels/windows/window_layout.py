"""Layout of a window in memory: the last steps of one ego's star in LANES runs, slot by slot."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import inner, storage
from ..compiling.small import subtract, times
from ..compiling.vectors import LANES
from ..stars.messages import (
    Assumptions,
    Measurements,
    Star,
    gather,
    moved_of,
    position_of,
    process_information,
    vector_at,
)


class Window(NamedTuple):
    """The last steps of one ego's star in LANES runs; step t stands in slot t modulo h + 1, member k of slot s in row
    s most + k.

    Attributes:
        sizes: (h + 1,) members.
        member: (rows,) column.
        previous: (rows,) index in the star before, or -1.
        later: (rows,) index in the star after, or -1.
        joined: (rows,) step since which it has been in the star.
        status: (5 rows, LANES) of `coopoc.kernels.stars.messages.Star`.
        motion: (12 rows, LANES) of the same.
        relative: (8 rows, LANES) of the same.
        used: (3 rows, LANES) 1/m^2, information of the positions that count.
        edge: (9 rows, LANES), information of the relative measurements.
        eta: (3 rows, LANES), their information vectors at the points.
        point: (3 rows, LANES) m.
        start: (3 rows, LANES) m, where a point was expected before its step was solved.
        base: (3 rows, LANES) m, vector from the ego at which the relative measurement is linear.
        located: (rows, LANES) 1 where a position or a whole vector has told where the member is, else 0.
        layout: slots h + 1, and most members, rows of a slot.
    """

    sizes: Ints
    member: Ints
    previous: Ints
    later: Ints
    joined: Ints
    status: Floats
    motion: Floats
    relative: Floats
    used: Floats
    edge: Floats
    eta: Floats
    point: Floats
    start: Floats
    base: Floats
    located: Floats
    layout: tuple[int, int]


def new_window(length: int, most: int) -> Window:
    """Room for windows of `length` steps of at most `most` members."""
    rows = (length + 1) * most
    member, previous, later, joined = (np.full(rows, -1, np.int64) for _ in range(4))
    status, motion, relative, edge, located = (np.zeros((size * rows, LANES)) for size in (5, 12, 8, 9, 1))
    used, eta, point, start, base = (np.zeros((3 * rows, LANES)) for _ in range(5))
    return Window(
        np.zeros(length + 1, np.int64),
        member,
        previous,
        later,
        joined,
        status,
        motion,
        relative,
        used,
        edge,
        eta,
        point,
        start,
        base,
        located,
        (length + 1, most),
    )


@inner
def row_of(layout: tuple[int, int], step: int, k: int) -> int:
    """Of member k of a step."""
    return step % layout[0] * layout[1] + k


@inner
def count_of(sizes: Ints, step: int) -> int:
    """Members of a step."""
    return int(sizes[step % len(sizes)])


@inner
def enter(window: Window, measurements: Measurements, model: Assumptions, runs: tuple[int, int], t: int) -> None:
    """Gather what is known of step t into its slot."""
    old, star = count_of(window.sizes, t - 1) if t > 0 else 0, star_at(window, t)
    n = gather(star, star_at(window, t - 1), measurements, model, runs[0], runs[1], t, old)
    here, before = row_of(window.layout, t, 0), row_of(window.layout, t - 1, 0)
    window.sizes[t % len(window.sizes)] = n
    for k in range(n):
        row, previous = here + k, star.previous[k]
        window.later[row], window.joined[row] = -1, t
        if previous >= 0:
            window.later[before + previous], window.joined[row] = k, window.joined[before + previous]


@inner
def any_positive(mask: AnyArray) -> bool:
    """Whether any number is."""
    found = False
    for value in mask:
        found = found or value > 0.0
    return found


@inner
def fix_gap(window: Window, row: int) -> Any:
    """Measured position less the point, m."""
    return subtract(position_of(window, row), vector_at(window.point, row))


@inner
def motion(window: Window, here: int, there: int) -> Any:
    """Information 1/m^2 of the motion from a row to the one after, and its eta on the latter's point."""
    process = process_information(window, there)
    moved = subtract(vector_at(window.point, there), vector_at(window.point, here))
    return process, times(process, subtract(moved_of(window, there), moved))


@inner
def largest_of(v: Any) -> Any:
    """Largest of three absolute values."""
    return max(max(abs(v[0]), abs(v[1])), abs(v[2]))


@storage
def star_at(window: Window, step: int) -> Star:
    """The star of a step, in the window's own memory."""
    here, n = row_of(window.layout, step, 0), window.layout[1]
    return Star(
        window.member[here : here + n],
        window.previous[here : here + n],
        window.status[5 * here : 5 * (here + n)],
        window.motion[12 * here : 12 * (here + n)],
        window.relative[8 * here : 8 * (here + n)],
    )
