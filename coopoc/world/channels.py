"""Channels by name, the losses that they draw, and the share of air time that their messages need."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from ..arrays import Bools, Floats, checked, number
from ..errors import InputError
from ..plugins import find
from .v2x import V2X


def lost(draws: Floats, loss: float, burst: float) -> Bools:
    """Gilbert-Elliott losses: a two-state chain with stationary share `loss` and mean bad run `burst`.

    P(good -> bad) = loss / (burst (1 - loss)), P(bad -> good) = 1 / burst; burst <= 1/(1 - loss) is independent loss.

    Args:
        draws: (R, M) uniforms in [0, 1), one per message in sending order.

    Returns:
        (R, M) True where lost.

    >>> bool(lost(np.full((1, 4), 0.5), 0.2, 1.0).any())
    False
    """
    if loss in (0.0, 1.0):
        return np.full(draws.shape, bool(loss))
    mean_run = max(burst, 1.0 / (1.0 - loss))
    to_bad, stay_bad = loss / (mean_run * (1.0 - loss)), 1.0 - 1.0 / mean_run
    bad = np.empty(draws.shape, dtype=bool)
    state = draws[:, 0] < loss if draws.shape[1] else np.zeros(len(draws), dtype=bool)
    for k in range(draws.shape[1]):
        if k:
            state = draws[:, k] < np.where(state, stay_bad, to_bad)
        bad[:, k] = state
    return bad


CHANNELS: Mapping[str, Callable[[int], V2X]] = {"ideal": V2X.ideal, "cam": V2X.cam, "bsm": V2X.bsm, "cpm": V2X.cpm}
"""Largest number of neighbours -> V2X. "ideal" counts payload only."""


def channel(name: str, max_neighbours: int = 6) -> V2X:
    """The channel of a name.

    Args:
        name: one of CHANNELS, an entry point in `coopoc.channels`, or "mine.py:NAME", a function of the number K.
        max_neighbours: K.

    Raises:
        InputError: an unknown name, or a function that returns no V2X.

    >>> channel("bsm", 4).rate
    10.0
    """
    found = find("coopoc.channels", name)(max_neighbours)
    if not isinstance(found, V2X):
        raise InputError(
            "channel", name, f"returned {type(found).__name__}, no V2X", "Return V2X(max_neighbours, ...)."
        )
    return found


CARRIER_SENSE = 300.0
"""m, radius within which another's message keeps the channel busy."""
BIT_RATE = 6e6
"""bit/s of 802.11p in a channel of 10 MHz, the usual choice of eight."""


def channel_load(
    position: npt.ArrayLike,
    size: npt.ArrayLike,
    rate: npt.ArrayLike,
    carrier_sense: float = CARRIER_SENSE,
    bit_rate: float = BIT_RATE,
) -> Floats:
    """Share of air time that the messages within carrier-sense range of each vehicle need: the channel busy ratio if
    all go out.

    load_i = sum over j with |p_j - p_i| <= carrier_sense, i itself included, of 8 size_j rate_j / bit_rate. Above 1 the
    channel is saturated, and some are not sent or collide; preambles and waiting times come on top.

    Args:
        position: (..., N, 3) m, NaN for absent vehicles.
        size: bytes on air of a message, a number or (N,).
        rate: Hz, a number or (N,).
        carrier_sense: m.
        bit_rate: bit/s.

    Returns:
        (..., N), NaN where absent.

    Raises:
        InputError: a shape that does not fit, or a number below zero (`bit_rate`: not above it).

    300 vehicles x 350 B x 10 Hz are 8.4 Mb/s, more than the 6 Mb/s of the channel.

    >>> channel_load(np.zeros((300, 3)), 350, [2.5] * 300)[0].round(2)  # 2.1 of 6 Mb/s
    np.float64(0.35)
    """
    places = checked("position", position)
    if places.ndim < 2 or places.shape[-1] != 3:
        raise InputError("position", places.shape, "must have shape (..., N, 3)", "Give fleet.position.")
    bit_rate = number("bit_rate", bit_rate, 1e-9, allowed="> 0 bit/s", hint="802.11p has 6e6.")
    carrier_sense = number("carrier_sense", carrier_sense, 0.0, np.inf, allowed=">= 0 m")
    vehicles = places.shape[-2]
    given = {name: checked(name, value) for name, value in (("size", size), ("rate", rate))}
    for name, value in given.items():
        if not (value >= 0).all() or value.shape not in ((), (vehicles,)):
            raise InputError(name, value.tolist(), f"must be a number >= 0, or {vehicles} of them", "One per vehicle.")
    with np.errstate(over="ignore", invalid="ignore"):
        busy = np.broadcast_to(8.0 * given["size"] * given["rate"] / bit_rate, vehicles)
    if not np.isfinite(busy).all():
        raise InputError("size, rate", (size, rate), "must have a finite product", "Give bytes and Hz.")
    flat = places.reshape(places.size // max(3 * vehicles, 1), vehicles, 3)
    loads = [_load_within(step, busy, carrier_sense) for step in flat]
    return np.array(loads, dtype=float).reshape(places.shape[:-1])


def _load_within(position: Floats, busy: Floats, reach: float) -> Floats:
    """(N,) sum over the vehicles within reach."""
    from scipy.spatial import KDTree

    here = np.flatnonzero(np.isfinite(position[:, 0]))
    near = here[KDTree(position[here]).query_pairs(reach, output_type="ndarray")]
    load = np.full(len(position), np.nan)
    load[here] = busy[here]
    for one, other in (near.T, near.T[::-1]):
        load[here] += np.bincount(one, busy[other], len(position))[here]
    return load
