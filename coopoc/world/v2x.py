"""V2X: neighbourhood, rate, latency, loss and byte budget of the channel; its presets, its messages and its load."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from ..arrays import AnyArray, Bools, Floats, checked, number
from ..errors import InputError
from ..plugins import find, one_of
from ..world.axes import check_texts

Schedule = Literal["nearest", "round robin"]


@dataclass(frozen=True)
class V2X:
    """Neighbourhood and channel. Neighbours are the nearest by true distance, as an on-board sensor would find them."""

    max_neighbours: int = 6
    """K: at most this many neighbours, nearest first."""
    radius: float = 30.0
    """m, the paper's range."""
    rate: float | None = None
    """Hz at which each vehicle broadcasts, None for every step; relative measurements come at every step anyway."""
    latency: float = 0.0
    """s from sending to arrival, rounded up to whole steps."""
    loss: float = 0.0
    """Share of messages that never arrive."""
    burst: float = 1.0
    """Mean length of a run of losses, in messages (Gilbert-Elliott); 1/(1 - loss) or less means independent losses."""
    max_age: float = 1.0
    """s, older messages are forgotten: their sender is measured, but nothing is assumed of it."""
    bytes_per_second: float = float("inf")
    """Cap on what one vehicle receives: a token bucket, full at first, that holds one second's worth; messages beyond
    it are dropped."""
    overhead: int = 0
    """Bytes per message on air beyond the payload (headers, signature)."""
    schedule: Schedule = "nearest"
    """Which message a receiver takes first under the cap: "nearest", or "round robin", of the sender that waited
    longest."""

    def __post_init__(self) -> None:
        one_of("schedule", self.schedule, get_args(Schedule))
        limits: dict[str, tuple[float, float, str]] = {
            "max_neighbours": (0, 1e6, ">= 0"),
            "radius": (0, np.inf, ">= 0 m"),
            "rate": (1e-3, 1e4, "> 0 Hz"),
            "latency": (0, 3600, ">= 0 s"),
            "loss": (0, 1, "in [0, 1]"),
            "burst": (1, 1e6, ">= 1 message"),
            "max_age": (0, 3600, ">= 0 s"),
            "bytes_per_second": (0, np.inf, ">= 0"),
            "overhead": (0, 1e6, ">= 0 bytes"),
        }
        for name, (low, high, words) in limits.items():
            value, kind = getattr(self, name), int if name in ("max_neighbours", "overhead") else float
            if value is not None or name != "rate":
                hint = "Use 0 for no neighbours." if name == "max_neighbours" else f"Give V2X({name}=...)."
                object.__setattr__(self, name, number(name, value, low, high, kind=kind, allowed=words, hint=hint))

    @classmethod
    def ideal(cls, max_neighbours: int = 6) -> V2X:
        """Every message at every step, at once, for free, as the paper's baselines assume."""
        return cls(max_neighbours=max_neighbours)

    @classmethod
    def cam(cls, max_neighbours: int = 6) -> V2X:
        """Cooperative Awareness Messages in town: 2.2 Hz, 350 B on air, and what a method adds to them.

        In unaligned PER (ETSI EN 302 637-2) a CAM takes 41 B, with a path history of ten points each half second 129 B:
        317 B on air at 2.2 Hz with headers and security. The measured traces also carry optional containers.

        Sources: sizes and intervals of VW's and Renault's traces (Molina-Masegosa et al., IEEE TVT 2020, arXiv
        2004.06919); loss within 30 m in LTE-V2X at 200 to 300 vehicles per km (Gonzalez-Martin et al., IEEE TVT 2019,
        arXiv 1807.06508). A CAM carries position and velocity in the plane, so a fix and a velocity are mostly there.
        """
        return cls(max_neighbours, rate=2.2, latency=0.02, loss=0.02, burst=5.0, overhead=350)

    @classmethod
    def bsm(cls, max_neighbours: int = 6) -> V2X:
        """Basic Safety Messages: 10 Hz, 190 B on air and 300 B every fifth time, 60 ms, and what a method adds.

        Source: SAE J2735; 3GPP's traffic model of 190 and 300 B at 100 ms (TR 36.885).
        """
        return cls(max_neighbours, rate=10.0, latency=0.06, loss=0.03, burst=5.0, overhead=212)

    @classmethod
    def cpm(cls, max_neighbours: int = 6) -> V2X:
        """Collective Perception Messages: 5 Hz, 200 B on air, 50 ms, 5 % lost, and what a method adds.

        In unaligned PER (ETSI TS 103 324 V2.1.1) a CPM takes 33 B without objects and 16.75 B more for each object with
        position and confidence. 44 B of headers (EN 302 636), 96 B of security (TS 103 097; 220 B once a second, with
        the certificate) and, once a second, 11 B of a sensor make 200 B on air. Objects are not among them: a method
        that sends its relative measurements counts these itself.
        """
        return cls(max_neighbours, rate=5.0, latency=0.05, loss=0.05, burst=5.0, overhead=200)


@dataclass(frozen=True)
class Message:
    """The messages of a vehicle in one step: `rounds` messages of `numbers` float32, 4 bytes each.

    Args:
        numbers: in each round.
        rounds: messages a step; they share the fate of the step's message. 0 sends nothing.
        opening: numbers that ride with the first round only, such as the measurements that all rounds work on.
        per_neighbour: numbers more in each round for each neighbour of the sender: a list as long as its neighbourhood.
        unicast: True for a message of its own to each neighbour; False for one broadcast that all neighbours receive.

    >>> Message("fix and velocity", 8).payload
    32
    >>> Message("belief", 9, rounds=3, opening=5).size(overhead=100)
    428
    """

    name: str
    numbers: int
    rounds: int = 1
    opening: int = 0
    per_neighbour: int = 0
    unicast: bool = False

    def __post_init__(self) -> None:
        check_texts(self, "name")
        for field in ("numbers", "rounds", "opening", "per_neighbour"):
            value = number(field, getattr(self, field), kind=int, allowed=">= 0", hint=f"Give Message({field}=...).")
            object.__setattr__(self, field, value)

    @property
    def payload(self) -> int:
        """Bytes of one round, without lists."""
        return 4 * self.numbers

    def size(self, overhead: int = 0, neighbours: AnyArray | int = 0) -> Any:
        """Bytes that one receiver takes from one sender in a step: rounds x (payload + overhead), and the opening.

        Args:
            overhead: bytes per message on air.
            neighbours: of the sender, a number or an array.
        """
        return 4 * self.opening + self.rounds * (self.payload + 4 * self.per_neighbour * neighbours + overhead)


NO_MESSAGE = Message("none", 0, rounds=0)
FIX_AND_VELOCITY = Message("fix and velocity", 8)
"""GNSS fix (3), velocity (3), id and time (2): LKF-SA's star and the joint filter."""
ESTIMATE = Message("estimate", 8)
"""Position estimate (3), the receiver's own relative measurement is on board; velocity (3), id and time (2)."""
ESTIMATE_AND_COV = Message("estimate and covariance", 14)
"""As ESTIMATE with the six numbers of a symmetric covariance."""


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
