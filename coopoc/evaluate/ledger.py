"""Ledger: the bytes of a training or of online cooperation, as payload and on air, sent once or per receiver."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Floats, check_arrays, checked, one_of, refuse, remade, texts, whole
from ..errors import InputError
from ..methods.track import Track, of_recording
from ..text import short_repr
from ..world.recording import Recording
from ..world.v2x import Message

Kind = Literal["payload", "on air"]
Way = Literal["broadcast", "per receiver"]
"""Bytes sent, each message once; or bytes received, one copy for each receiver, as unicast would carry it."""


@dataclass(frozen=True, eq=False)
class Ledger:
    """Bytes of V participants in R runs, by kind ("payload", "on air").

    Args:
        names: (V,) of the participants.
        seconds: (V,) of driving that the bytes are for; 0 for a training, and for servers.
        sent: (2, R, V) bytes, by kind: a message once, whatever the number of its receivers.
        received: (2, R, V) bytes: a message in the account of each receiver.
        servers: the participants that are no vehicles.

    Raises:
        InputError: shapes that do not fit together, a name twice, a server that does not take part.

    >>> once = of_training(["a", "b"], [400.0, 400.0], [200.0, 200.0])
    >>> once.per_vehicle(), once
    (200.0, Ledger(names=('a', 'b'), seconds (2,), sent (2, 1, 2), received (2, 1, 2)))
    """

    names: tuple[str, ...]
    seconds: Floats
    sent: Floats
    received: Floats
    servers: tuple[str, ...] = ()

    __repr__ = short_repr
    __reduce__ = remade

    def __post_init__(self) -> None:
        for name in ("names", "servers"):
            self.__dict__[name] = texts(name, getattr(self, name))
        moved = "(2, R, V)", (2, -1, len(self.names))
        check_arrays(self, {"seconds": ("(V,)", (len(self.names),)), "sent": moved, "received": moved})
        for name in ("seconds", "sent", "received"):
            values = getattr(self, name)
            wrong = ~(values >= 0) | np.isinf(values)
            refuse(name, values, wrong, "must be finite and >= 0", "Give bytes and seconds.")
        if self.received.shape != self.sent.shape:
            raise InputError("received", self.received.shape, f"must have shape {self.sent.shape}", "Give all runs.")
        if len(set(self.names)) < len(self.names) or not set(self.servers) <= set(self.names):
            raise InputError("names", self.names, f"must differ and hold the servers {self.servers}", "Rename them.")

    def of(self, kind: Kind = "payload", way: Way = "per receiver") -> Floats:
        """(R, V) bytes."""
        one_of("way", way, Way)
        one_of("kind", kind, Kind)
        array = self.sent if way == "broadcast" else self.received
        return np.asarray(array[get_args(Kind).index(kind)])

    def per_vehicle(self, kind: Kind = "payload", way: Way = "per receiver") -> float:
        """Bytes of all, servers included, for each vehicle: the mean over runs."""
        return float(self.of(kind, way).sum(1).mean()) / max(len(self.names) - len(self.servers), 1)

    def rate(self, kind: Kind = "payload", way: Way = "per receiver") -> float:
        """Bytes per second of driving and vehicle; InputError without any driving."""
        if not self.seconds.sum() > 0:
            raise InputError("seconds", self.seconds.tolist(), "must be > 0 for some vehicle", "Add a drive.")
        return float(self.of(kind, way).sum(1).mean() / self.seconds.sum())


def of_training(
    names: Sequence[str],
    sent: ArrayLike,
    received: ArrayLike,
    servers: Sequence[str] = (),
    messages: ArrayLike = 0.0,
    overhead: int = 0,
) -> Ledger:
    """The ledger of a training from payload bytes (V,) sent once and received.

    Args:
        names: of the participants.
        sent: (V,) bytes.
        received: (V,) bytes.
        servers: those that are no vehicles.
        messages: (2, V) that each sent and received.
        overhead: bytes per message on air.

    >>> ledger = of_training(["a", "s"], [80.0, 40.0], [40.0, 80.0], ["s"], messages=np.ones((2, 2)), overhead=10)
    >>> ledger.per_vehicle(), ledger.per_vehicle("on air")
    (120.0, 140.0)
    """
    overhead = whole("overhead", overhead, 0, 10**9, "Give bytes.")
    count = (len(names),)
    payload = np.array([checked("sent", sent, "(V,)", count), checked("received", received, "(V,)", count)])
    moved = np.stack([payload, payload + overhead * checked("messages", messages)], 1)[:, :, None]
    return Ledger(tuple(names), np.zeros(len(names)), moved[0], moved[1], tuple(servers))


def of_track(track: Track, recording: Recording, message: Message) -> Ledger:
    """The ledger of a drive: the messages that the egos of a track broadcast and received.

    A message whose length depends on the number of neighbours goes to a centre, which answers it: every step at which
    the vehicle is present counts the overhead of one message in each direction.

    Args:
        track: with its bytes on air.
        recording: that the track is of.
        message: of the method.

    Raises:
        InputError: a track of another recording.

    >>> from coopoc import Fleet, GNSS, Sensors, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> seen = observe(fleet, Sensors())
    >>> of_track(GNSS()(seen, ["a"]), seen, GNSS().message).rate()
    0.0
    """
    of_recording(track, recording)
    overhead, vehicles = recording.v2x.overhead, len(track.egos)
    size, moved = message.size(overhead), np.zeros((2, 2, len(track.received_bytes), vehicles))
    for k, on_air in enumerate((track.sent_bytes, track.received_bytes)):
        payload = on_air * (message.size() / size if size else 1.0)
        if message.per_neighbour:
            payload = on_air - overhead * recording.present[:, track.egos].sum(0)
        moved[k] = payload, on_air
    steps = np.full(vehicles, len(track.t)) if track.absent is None else (~track.absent).sum(0)
    return Ledger(tuple(recording.ids[ego] for ego in track.egos), steps * recording.dt, *moved)
