"""V2X: neighbourhood, rate, latency, loss and byte budget of the channel, its presets, and the messages on it."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..arrays import AnyArray, check_fields, checked, whole

Schedule = Literal["nearest", "round robin"]


@dataclass(frozen=True)
class V2X:
    """Neighbourhood and channel. Neighbours are the nearest by true distance, as an on-board sensor would find them.

    By default every message comes at every step, at once, for free, as the paper's baselines assume.
    """

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
        limits = {
            "max_neighbours": (0, 1e6, ">= 0, 0 for no neighbours"),
            "radius": (0, np.inf, ">= 0 m"),
            "rate": (1e-3, 1e4, "> 0 Hz"),
            "latency": (0, 3600, ">= 0 s"),
            "loss": (0, 1, "in [0, 1]"),
            "burst": (1, 1e6, ">= 1 message"),
            "max_age": (0, 3600, ">= 0 s"),
            "bytes_per_second": (0, np.inf, ">= 0"),
            "overhead": (0, 1e6, ">= 0 bytes"),
        }
        check_fields(self, limits)

    @classmethod
    def cam(cls, max_neighbours: int = 6) -> "V2X":
        """Cooperative Awareness Messages in town: 2.2 Hz, 350 B on air, and what a method adds to them.

        In unaligned PER (ETSI EN 302 637-2) a CAM takes 41 B, with a path history of ten points each half second 129 B:
        317 B on air at 2.2 Hz with headers and security. The measured traces also carry optional containers.

        Sources: sizes and intervals of VW's and Renault's traces (Molina-Masegosa et al., IEEE TVT 2020, arXiv
        2004.06919); loss within 30 m in LTE-V2X at 200 to 300 vehicles per km (Gonzalez-Martin et al., IEEE TVT 2019,
        arXiv 1807.06508). A CAM carries position and velocity in the plane, so a fix and a velocity are mostly there.

        >>> cam = V2X.cam()
        >>> cam.rate, cam.latency, cam.loss, cam.burst, cam.overhead
        (2.2, 0.02, 0.02, 5.0, 350)
        """
        return cls(max_neighbours, rate=2.2, latency=0.02, loss=0.02, burst=5.0, overhead=350)

    @classmethod
    def bsm(cls, max_neighbours: int = 6) -> "V2X":
        """Basic Safety Messages: 10 Hz, 190 B on air and 300 B every fifth time, 60 ms, and what a method adds.

        Source: SAE J2735; 3GPP's traffic model of 190 and 300 B at 100 ms (TR 36.885).
        """
        return cls(max_neighbours, rate=10.0, latency=0.06, loss=0.03, burst=5.0, overhead=212)

    @classmethod
    def cpm(cls, max_neighbours: int = 6) -> "V2X":
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
        per_neighbour: numbers more in each round for each neighbour of the sender: a list as long as its neighbourhood.

    >>> Message("fix and velocity", 8).payload
    32
    >>> print(Message("estimate", 9, rounds=3).size(overhead=100))
    408
    """

    name: str
    numbers: int
    rounds: int = 1
    per_neighbour: int = 0

    def __post_init__(self) -> None:
        check_fields(self, dict.fromkeys(("numbers", "rounds", "per_neighbour"), (0, 2**62, ">= 0")))

    @property
    def payload(self) -> int:
        """Bytes of one round, without lists."""
        return 4 * self.numbers

    def size(self, overhead: int = 0, neighbours: AnyArray | int = 0) -> Any:
        """Bytes that one receiver takes from one sender in a step: rounds x (payload + overhead).

        Args:
            overhead: bytes per message on air.
            neighbours: of the sender, a number or an array.
        """
        overhead, counts = whole("overhead", overhead), checked("neighbours", neighbours, dtype=int)
        return self.rounds * (self.payload + 4 * self.per_neighbour * counts + overhead)


NO_MESSAGE = Message("none", 0, rounds=0)
FIX_AND_VELOCITY = Message("fix and velocity", 8)
"""GNSS fix (3), velocity (3), id and time (2): LKF-SA's star and the joint filter."""
ESTIMATE = Message("estimate", 8)
"""Position estimate (3), the receiver's own relative measurement is on board; velocity (3), id and time (2)."""
ESTIMATE_AND_COV = Message("estimate and covariance", 14)
"""As ESTIMATE with the six numbers of a symmetric covariance."""
