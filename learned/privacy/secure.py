"""Secure aggregation: the server learns the sum of the clients' updates and none of them, and clients may drop out."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError

from ..federation.aggregate import rule
from ..federation.means import Stateless, mean, uniform
from ..federation.rule import Rule, State
from ..federation.server_rules import FedAdam, FedAvgM
from ..training.schedule import Schedule
from .masks import KEY, RESOLUTION, TAG, Words, box, decode, encode, pair_seed, public, stretched
from .shamir import PRIME, join, split

Stage = Literal["keys", "shares", "upload", "unmask"]
STAGES: tuple[Stage, ...] = ("keys", "shares", "upload", "unmask")
"""What a client sends, in this order."""
SHARE = (PRIME.bit_length() + 7) // 8
"""Bytes of a share."""


class Letter(NamedTuple):
    """Public keys of a client: one agrees on masks, the other on what encrypts shares."""

    mask: bytes
    box: bytes


@dataclass(frozen=True, eq=False)
class Party:
    """A client of the protocol, number x of 1..C: what it draws stays in it; its methods are what it sends."""

    x: int
    threshold: int
    mask_key: bytes = field(default_factory=lambda: secrets.token_bytes(KEY), repr=False)
    box_key: bytes = field(default_factory=lambda: secrets.token_bytes(KEY), repr=False)
    own_seed: bytes = field(default_factory=lambda: secrets.token_bytes(KEY), repr=False)

    def keys(self) -> Letter:
        """First message: public keys."""
        return Letter(public(self.mask_key), public(self.box_key))

    def shares(self, letters: Mapping[int, Letter]) -> dict[int, bytes]:
        """Second message: for every client its encrypted shares of this client's own seed and mask key."""
        _enough(len(letters), self.threshold, "sent keys")
        parts = [split(int.from_bytes(s), max(letters), self.threshold) for s in (self.own_seed, self.mask_key)]
        plain = {x: b"".join(part[x - 1].to_bytes(SHARE) for part in parts) for x in letters}
        return {x: box(self.box_key, letters[x].box).encrypt(_route(self.x, x), t, None) for x, t in plain.items()}

    def upload(self, words: Words, letters: Mapping[int, Letter], sharing: list[int]) -> Words:
        """Third message: words (P,) + own mask + sum over x' > x of pair masks - sum over x' < x, modulo 2^32."""
        _enough(len(sharing), self.threshold, "sent shares")
        masked = words + stretched(self.own_seed, len(words))
        for other in sharing:
            if other != self.x:
                masked += _signed(self.x, other, pair_seed(self.mask_key, letters[other].mask), len(words))
        return masked

    def reveal(self, boxes: Mapping[int, bytes], letters: Mapping[int, Letter], uploaded: list[int]) -> dict[int, int]:
        """Last message: of each that uploaded the share of its own seed, of each that did not, of its mask key.

        Never both of one client: an upload that comes too late would then be bare.
        """
        _enough(len(uploaded), self.threshold, "uploaded")
        plain = {x: box(self.box_key, letters[x].box).decrypt(_route(x, self.x), c, None) for x, c in boxes.items()}
        return {x: int.from_bytes(t[:SHARE] if x in uploaded else t[SHARE:]) for x, t in plain.items()}


class Sum(NamedTuple):
    """Sum (P,) of those who uploaded, their rows, what the server saw of each (n, P), and bytes (C,) of each client."""

    total: Floats
    uploaded: list[int]
    seen: Words
    sent: list[int]
    received: list[int]


def secure_sum(
    values: Floats,
    threshold: int | None = None,
    leaving: Mapping[int, Stage] | None = None,
    resolution: float = RESOLUTION,
) -> Sum:
    """sum_i v_i over the clients that upload, by pairwise masks that cancel; exact to n / 2 steps of the resolution.

    y_i = v_i + PRG(b_i) + sum_{j > i} PRG(s_ij) - sum_{j < i} PRG(s_ij)  modulo 2^32, where s_ij is a key that i and j
    agree on and b_i the client's own seed. Of the clients that upload the survivors give shares of b_i, of those that
    left before, shares of the key behind s_ij: the server never gets both. It learns the sum if it follows the protocol
    and fewer than `threshold` clients tell it what they know; one that lies about who is there is not found out, but
    with a threshold above two thirds cannot get both secrets of a client. All parties are played in this process.

    Args:
        values: (C, P), finite, each below 2^31 steps / C. threshold: survivors needed, default 2 C // 3 + 1.
        leaving: row -> what this client does not send any more. resolution: step of the fixed point.

    Raises:
        InputError: a value that does not fit, a threshold that cannot be, or fewer clients left than the threshold.
        MissingLibraryError: no `cryptography` (X25519, ChaCha20, ChaCha20-Poly1305).

    Source: Bonawitz et al., Practical secure aggregation, CCS 2017, figure 4 without the consistency round.

    >>> secure_sum(np.array([[0.5], [-2.0], [1.0]])).total.tolist()
    [-0.5]
    """
    count = len(values)
    threshold = 2 * count // 3 + 1 if threshold is None else threshold
    if not 1 < threshold <= count:
        raise InputError("threshold", threshold, f"must be in 2..{count}, the clients", "Two thirds of them is usual.")
    words = {row + 1: words for row, words in enumerate(_fitting(values, resolution))}
    parties = {x: Party(x, threshold) for x in words}
    gone = {row + 1: STAGES.index(stage) for row, stage in (leaving or {}).items()}
    there = {stage: [x for x in parties if gone.get(x, len(STAGES)) > i] for i, stage in enumerate(STAGES)}

    letters = {x: parties[x].keys() for x in there["keys"]}
    boxes = {x: parties[x].shares(letters) for x in there["shares"]}
    sharing, uploaded = there["shares"], there["upload"]
    uploads = {x: parties[x].upload(words[x], letters, sharing) for x in uploaded}
    mine = {x: {sender: boxes[sender][x] for sender in sharing} for x in there["unmask"]}
    revealed = {x: parties[x].reveal(mine[x], letters, uploaded) for x in there["unmask"]}
    masks = unmask(revealed, letters, uploaded, values.shape[1], threshold)
    seen = np.stack(list(uploads.values()))
    total = decode(seen.sum(0, dtype=np.uint32) - masks, resolution)
    sent, received = traffic(count, values.shape[1], leaving)
    return Sum(total, [x - 1 for x in uploaded], seen, sent, received)


def unmask(
    revealed: Mapping[int, Mapping[int, int]], letters: Mapping[int, Letter], uploaded: list[int], size: int, least: int
) -> Words:
    """What the masks of the uploads sum to (size,): the server's part, from what the survivors reveal."""
    _enough(len(revealed), least, "are left")
    holders = sorted(revealed)[:least]
    secret = {x: join({h: revealed[h][x] for h in holders}).to_bytes(KEY) for x in revealed[holders[0]]}
    masks = np.zeros(size, dtype=np.uint32)
    for x, key in secret.items():
        if x in uploaded:
            masks += stretched(key, size)
        else:
            for other in uploaded:
                masks += _signed(other, x, pair_seed(key, letters[other].mask), size)
    return masks


def traffic(clients: int, parameters: int, leaving: Mapping[int, Stage] | None = None) -> tuple[list[int], list[int]]:
    """Bytes that each client sends and receives in one `secure_sum`, without framing: keys, shares, masked words.

    Up: two keys, an encrypted pair of shares for each other client, 4 P, one share of each client. Down: everyone's
    keys, the shares meant for it, one bit per client for who has uploaded.

    >>> traffic(4, 9)
    ([808, 808, 808, 808], [637, 637, 637, 637])
    """
    gone = {row: STAGES.index(stage) for row, stage in (leaving or {}).items()}
    stays = [gone.get(row, len(STAGES)) for row in range(clients)]
    keyed, sharing = (sum(stay > stage for stay in stays) for stage in (0, 1))
    box = 2 * SHARE + TAG
    up = [2 * KEY, (keyed - 1) * box, 4 * parameters, sharing * SHARE]
    down = [0, (keyed - 1) * 2 * KEY, (sharing - 1) * box, -(-clients // 8)]
    return [sum(up[:stay]) for stay in stays], [sum(down[:stay]) for stay in stays]


@dataclass(frozen=True)
class SecureMean(Rule):
    """A rule that needs the clients' mean only, fed by `secure_sum`: theta_g + sum_i a_i (theta_i - theta_g).

    Args:
        then: what the server does with the mean: mean, uniform, fedprox, fedavgm, fedadam, or such a rule.
        equal: a_i = 1 / C, as privacy wants it, instead of n_i / sum n (the sizes are not hidden).
        threshold, resolution: of `secure_sum`.

    Raises:
        InputError: a rule that looks at single clients, which nobody can under masks.

    >>> SecureMean("uniform").uniform
    True
    """

    then: str | Rule = "mean"
    equal: bool = False
    threshold: int | None = None
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        server = self.server
        if not isinstance(server, FedAvgM | FedAdam) and not (
            isinstance(server, Stateless) and server.combine in (mean, uniform)
        ):
            raise InputError("aggregate", repr(self.then), "must use nothing but the clients' mean under masks",
                             "Take mean, uniform, fedprox, fedavgm or fedadam.")  # fmt: skip

    @property
    def server(self) -> Rule:
        """The rule that gets the mean."""
        return rule(self.then)

    @property
    def uniform(self) -> bool:
        """Whether all clients weigh the same."""
        return self.equal or getattr(self.server, "combine", None) is uniform

    @property
    def least(self) -> int:
        """Two: the sum of one client is its update."""
        return 2

    def overhead(self, clients: int, parameters: int) -> tuple[int, int]:
        """Bytes that each client sends and receives in a round beyond the weights themselves.

        >>> SecureMean().overhead(4, 19938)
        (772, 637)
        """
        sent, received = traffic(clients, parameters)
        return sent[0] - 4 * parameters, received[0]

    def start(self, theta: Tensor) -> State:
        """State of the server's rule."""
        return self.server.start(theta)

    def local(self, schedule: Schedule) -> Schedule:
        """As the server's rule wants it."""
        return self.server.local(schedule)

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """The server's rule on the mean, which is all that it sees."""
        shares = torch.ones_like(sizes, dtype=torch.float64) if self.uniform else sizes.double()
        values = (shares / shares.sum())[:, None] * (weights - theta).double()
        summed = secure_sum(values.numpy(), self.threshold, resolution=self.resolution).total
        average = theta + torch.from_numpy(summed).to(theta.dtype)
        return self.server(state, theta, average[None], sizes[:1], uncertainty[:1])


def _fitting(values: Floats, resolution: float) -> list[Words]:
    """The rows as words; InputError for a row that is not finite or too large for the sum to fit."""
    most = 2.0**31 * resolution / len(values)
    largest = np.abs(values).max(axis=1)
    for row, value in enumerate(largest.tolist()):
        if not value < most:
            raise InputError(f"update of client {row}", value, f"must be below {most:g} everywhere",
                             "Clip it, or take a coarser resolution.")  # fmt: skip
    return list(encode(values, resolution))


def _enough(count: int, least: int, what: str) -> None:
    if count < least:
        mend = "Nothing was learned; repeat the round, or lower the threshold."
        raise InputError("clients", count, f"of them {what}, and {least} are needed", mend)


def _signed(x: int, other: int, seed: bytes, size: int) -> Words:
    """The pair's mask as x adds it; the other adds its negative."""
    words = stretched(seed, size)
    return words if other > x else np.negative(words)


def _route(sender: int, receiver: int) -> bytes:
    """Nonce of 12 bytes: each key encrypts one message each way."""
    return sender.to_bytes(6) + receiver.to_bytes(6)
