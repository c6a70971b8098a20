"""Layout of a window in memory: the last steps of one ego's star in LANES runs, slot by slot."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import inner, storage
from ..compiling.small import subtract, times
from ..compiling.vectors import LANES, put, take
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
def enter(
    window: Window, star: Star, measurements: Measurements, model: Assumptions, runs: tuple[int, int], t: int
) -> None:
    """Gather what is known of step t into its slot."""
    old = count_of(window.sizes, t - 1) if t > 0 else 0
    n = gather(star, measurements, model, runs[0], runs[1], t, old)
    here, before = row_of(window.layout, t, 0), row_of(window.layout, t - 1, 0)
    window.sizes[t % len(window.sizes)] = n
    for k in range(n):
        row = here + k
        window.member[row], window.previous[row], window.later[row] = star.member[k], star.previous[k], -1
        window.joined[row] = t
        if star.previous[k] >= 0:
            window.later[before + star.previous[k]] = k
            window.joined[row] = window.joined[before + star.previous[k]]
    copy_rows(window.motion, 12 * here, star.motion, 12 * n)
    copy_rows(window.relative, 8 * here, star.relative, 8 * n)
    copy_rows(window.status, 5 * here, star.status, 5 * n)


@inner
def copy_rows(out: AnyArray, at: int, source: AnyArray, count: int) -> None:
    """The first rows of LANES numbers; an assignment of slices would compile the text of its errors."""
    for row in range(count):
        put(out, uint64(at + row), take(source, uint64(row)))


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
    """The star of a step, and of the one before it, in the window's own memory."""
    here, before, n = row_of(window.layout, step, 0), row_of(window.layout, step - 1, 0), window.layout[1]
    return Star(
        window.member[here : here + n],
        window.previous[here : here + n],
        window.status[5 * here : 5 * (here + n)],
        window.motion[12 * here : 12 * (here + n)],
        window.relative[8 * here : 8 * (here + n)],
        window.member[before : before + n],
        window.status[5 * before : 5 * (before + n)],
    )
