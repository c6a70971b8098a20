"""The last steps of one ego's star in LANES runs, slot by slot."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy import uint64

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import inner, storage
from ..compiling.small import load, store, subtract, times
from ..compiling.vectors import LANES, put, take
from ..stars.edges import edge
from ..stars.messages import MOVED, POSITION, PROCESS, RELATIVE, Assumptions, Measurements, Star, gather

ONE, ROW = (0.0,) * 9, (0.0,) * 3
"""Any block, any row."""
LEAST_PROCESS = 1e-90
"""m^2; the cube of its inverse is still a number, and far beyond any digit that counts."""


class Window(NamedTuple):
    """The last steps of one ego's star in LANES runs; step t stands in slot t modulo h + 1, member k of slot s in place
    s most + k.

    Attributes:
        sizes: (h + 1,) members.
        member: (places,) column.
        previous: (places,) index in the star before, or -1.
        later: (places,) index in the star after, or -1.
        joined: (places,) step since which it has been in the star.
        status: of `coopoc.kernels.stars.messages.Star`, place by place.
        motion: of `coopoc.kernels.stars.messages.Star`, place by place.
        relative: of `coopoc.kernels.stars.messages.Star`, place by place.
        fix: (3 places, LANES) 1/m^2, information of the positions that count.
        used: (3 places, LANES) 1/m^2, the same times their GNC weights.
        edge: (9 places, LANES), information of the relative measurements around the points.
        eta: (3 places, LANES), their information vectors.
        point: (3 places, LANES) m.
        located: (places, LANES) 1 where a position or a whole vector has told where the member is, else 0.
        odometry: (1, LANES) GNC weight of the ego's odometry.
        layout: slots h + 1, and most members, places of a slot.
    """

    sizes: Ints
    member: Ints
    previous: Ints
    later: Ints
    joined: Ints
    status: Floats
    motion: Floats
    relative: Floats
    fix: Floats
    used: Floats
    edge: Floats
    eta: Floats
    point: Floats
    located: Floats
    odometry: Floats
    layout: tuple[int, int]


def new_window(length: int, most: int) -> Window:
    """Room for windows of `length` steps of at most `most` members."""
    places = (length + 1) * most
    return Window(
        np.zeros(length + 1, np.int64),
        np.zeros(places, np.int64),
        np.full(places, -1, np.int64),
        np.full(places, -1, np.int64),
        np.zeros(places, np.int64),
        np.zeros((5 * places, LANES)),
        np.zeros((12 * places, LANES)),
        np.zeros((8 * places, LANES)),
        np.zeros((3 * places, LANES)),
        np.zeros((3 * places, LANES)),
        np.zeros((9 * places, LANES)),
        np.zeros((3 * places, LANES)),
        np.zeros((3 * places, LANES)),
        np.zeros((places, LANES)),
        np.ones((1, LANES)),
        (length + 1, most),
    )


@inner
def place_of(layout: tuple[int, int], step: int, k: int) -> int:
    """Of member k of a step."""
    return step % layout[0] * layout[1] + k


@inner
def count_of(sizes: Ints, step: int) -> int:
    """Members of a step."""
    return int(sizes[step % len(sizes)])


@inner
def enter(window: Window, star: Star, seen: Measurements, known: Assumptions, runs: Any, t: int) -> None:
    """Gather what is known of step t into its slot."""
    old = count_of(window.sizes, t - 1) if t > 0 else 0
    n = gather(star, seen, known, runs, t, old)
    here, before = place_of(window.layout, t, 0), place_of(window.layout, t - 1, 0)
    window.sizes[t % len(window.sizes)] = n
    for k in range(n):
        place = here + k
        window.member[place], window.previous[place], window.later[place] = star.member[k], star.previous[k], -1
        window.joined[place] = t
        if star.previous[k] >= 0:
            window.later[before + star.previous[k]] = k
            window.joined[place] = window.joined[before + star.previous[k]]
    copy_rows(window.motion, 12 * here, star.motion, 12 * n)
    copy_rows(window.relative, 8 * here, star.relative, 8 * n)
    copy_rows(window.status, 5 * here, star.status, 5 * n)


@inner
def any_positive(mask: AnyArray) -> bool:
    """Whether any number is."""
    found = False
    for value in mask:
        found = found or value > 0.0
    return found


@inner
def copy_rows(out: AnyArray, at: int, source: AnyArray, count: int) -> None:
    """The first rows of LANES numbers; an assignment of slices would compile the text of its errors."""
    for row in range(count):
        put(out, uint64(at + row), take(source, uint64(row)))


@inner
def linearise(window: Window, span: Any, assumed: Any, how: int) -> None:
    """The relative measurements as edges at the points, in one of the ways of `edge`."""
    for step in range(span[0], span[1] + 1):
        ego = place_of(window.layout, step, 0)
        origin = load(window.point, ego, ROW)
        for place in range(ego + 1, ego + count_of(window.sizes, step)):
            gap = subtract(load(window.point, place, ROW), origin)
            information, eta = edge(gap, load(window.relative, place, RELATIVE), assumed, how)
            store(window.edge, place, information)
            store(window.eta, place, eta)


@inner
def fix_gap(window: Window, place: int) -> Any:
    """Measured position less the point, m."""
    return subtract(load(window.motion, 4 * place + POSITION, ROW), load(window.point, place, ROW))


@inner
def motion(window: Window, here: int, there: int) -> Any:
    """Information 1/m^2 of the motion from a place to the one after, and its eta on the latter's point."""
    p, q, r = load(window.motion, 4 * there + PROCESS, ROW)
    process = 1.0 / max(p, LEAST_PROCESS), 1.0 / max(q, LEAST_PROCESS), 1.0 / max(r, LEAST_PROCESS)
    moved = subtract(load(window.point, there, ROW), load(window.point, here, ROW))
    return process, times(process, subtract(load(window.motion, 4 * there + MOVED, ROW), moved))


@inner
def largest_of(v: Any) -> Any:
    """Largest of three absolute values."""
    return max(max(abs(v[0]), abs(v[1])), abs(v[2]))


@storage
def star_at(window: Window, step: int) -> Star:
    """The star of a step, and of the one before it, in the window's own memory."""
    here, before, n = place_of(window.layout, step, 0), place_of(window.layout, step - 1, 0), window.layout[1]
    return Star(
        window.member[here : here + n],
        window.previous[here : here + n],
        window.status[5 * here : 5 * (here + n)],
        window.motion[12 * here : 12 * (here + n)],
        window.relative[8 * here : 8 * (here + n)],
        window.member[before : before + n],
        window.status[5 * before : 5 * (before + n)],
    )
