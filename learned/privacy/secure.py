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
from coopoc.methods.options import check_options

from ..federation.aggregate import rule
from ..federation.rule import Rule, State
from ..training.schedule import Schedule
from .masks import KEY, RESOLUTION, TAG, Words, box, decode, encode, pair_seed, prg, public_key
from .shamir import PRIME, join, split

Stage = Literal["keys", "shares", "upload", "unmask"]
STAGES: tuple[Stage, ...] = ("keys", "shares", "upload", "unmask")
"""Messages of a client, in this order."""
SHARE = (PRIME.bit_length() + 7) // 8
"""Bytes of a share."""


class PublicKeys(NamedTuple):
    """Public keys of a client: for agreement on masks, and for encryption of shares."""

    mask: bytes
    box: bytes


@dataclass(frozen=True, eq=False)
class Party:
    """A client of the protocol, number x of 1..C. Its methods return the messages that it sends."""

    x: int
    threshold: int
    mask_key: bytes = field(default_factory=lambda: secrets.token_bytes(KEY), repr=False)
    box_key: bytes = field(default_factory=lambda: secrets.token_bytes(KEY), repr=False)
    own_seed: bytes = field(default_factory=lambda: secrets.token_bytes(KEY), repr=False)

    def keys(self) -> PublicKeys:
        """First message: public keys."""
        return PublicKeys(public_key(self.mask_key), public_key(self.box_key))

    def shares(self, public_keys: Mapping[int, PublicKeys]) -> dict[int, bytes]:
        """Second message: for every client its encrypted shares of this client's own seed and mask key."""
        _enough(len(public_keys), self.threshold, "sent keys")
        parts = [split(int.from_bytes(s), max(public_keys), self.threshold) for s in (self.own_seed, self.mask_key)]
        plain = {x: b"".join(part[x - 1].to_bytes(SHARE) for part in parts) for x in public_keys}
        return {x: box(self.box_key, public_keys[x].box).encrypt(_route(self.x, x), t, None) for x, t in plain.items()}

    def upload(self, words: Words, public_keys: Mapping[int, PublicKeys], sharing: list[int]) -> Words:
        """Third message: words (P,) + own mask + sum over x' > x of pair masks - sum over x' < x, modulo 2^32."""
        _enough(len(sharing), self.threshold, "sent shares")
        masked = words + prg(self.own_seed, len(words))
        for other in sharing:
            if other != self.x:
                masked += _signed(self.x, other, pair_seed(self.mask_key, public_keys[other].mask), len(words))
        return masked

    def reveal(
        self, boxes: Mapping[int, bytes], public_keys: Mapping[int, PublicKeys], uploaded: list[int]
    ) -> dict[int, int]:
        """Last message: a share of the own seed of each client that uploaded, of the mask key of each that did not.

        Both shares of one client would expose a late upload.
        """
        _enough(len(uploaded), self.threshold, "uploaded")
        plain = {x: box(self.box_key, public_keys[x].box).decrypt(_route(x, self.x), c, None) for x, c in boxes.items()}
        return {x: int.from_bytes(t[:SHARE] if x in uploaded else t[SHARE:]) for x, t in plain.items()}


class Sum(NamedTuple):
    """Sum (P,) over the clients that uploaded, their rows, masked uploads (n, P), bytes (C,) of each client."""

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

    y_i = v_i + PRG(b_i) + sum_{j > i} PRG(s_ij) - sum_{j < i} PRG(s_ij)  modulo 2^32, with s_ij shared by i and j, and
    b_i the client's own seed. The survivors reveal shares of b_i of the clients that upload, and shares of the key
    behind s_ij of those that left before: the server never gets both. An honest-but-curious server with fewer than
    `threshold` colluding clients learns the sum only. A server that misreports the set of clients is not detected, but
    with a threshold above two thirds cannot get both secrets of a client. All parties are simulated in this process.

    Args:
        values: (C, P) finite values, each below 2^31 steps / C.
        threshold: survivors needed, default 2 C // 3 + 1.
        leaving: row -> first message that this client does not send.
        resolution: step of the fixed point.

    Raises:
        InputError: a value that does not fit, a threshold that cannot be, or fewer clients left than the threshold.
        MissingLibraryError: no `cryptography` (X25519, ChaCha20, ChaCha20-Poly1305).

    References:
        Bonawitz et al., Practical secure aggregation, CCS 2017, figure 4 without the consistency round.

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

    public_keys = {x: parties[x].keys() for x in there["keys"]}
    boxes = {x: parties[x].shares(public_keys) for x in there["shares"]}
    sharing, uploaded = there["shares"], there["upload"]
    uploads = {x: parties[x].upload(words[x], public_keys, sharing) for x in uploaded}
    mine = {x: {sender: boxes[sender][x] for sender in sharing} for x in there["unmask"]}
    revealed = {x: parties[x].reveal(mine[x], public_keys, uploaded) for x in there["unmask"]}
    masks = unmask(revealed, public_keys, uploaded, values.shape[1], threshold)
    seen = np.stack(list(uploads.values()))
    total = decode(seen.sum(0, dtype=np.uint32) - masks, resolution)
    sent, received = traffic(count, values.shape[1], leaving)
    return Sum(total, [x - 1 for x in uploaded], seen, sent, received)


def unmask(
    revealed: Mapping[int, Mapping[int, int]],
    public_keys: Mapping[int, PublicKeys],
    uploaded: list[int],
    size: int,
    least: int,
) -> Words:
    """Sum (size,) of the masks in the uploads, computed by the server from the shares that the survivors reveal."""
    _enough(len(revealed), least, "are left")
    holders = sorted(revealed)[:least]
    secret = {x: join({h: revealed[h][x] for h in holders}).to_bytes(KEY) for x in revealed[holders[0]]}
    masks = np.zeros(size, dtype=np.uint32)
    for x, key in secret.items():
        if x in uploaded:
            masks += prg(key, size)
        else:
            for other in uploaded:
                masks += _signed(other, x, pair_seed(key, public_keys[other].mask), size)
    return masks


def traffic(clients: int, parameters: int, leaving: Mapping[int, Stage] | None = None) -> tuple[list[int], list[int]]:
    """Bytes that each client sends and receives in one `secure_sum`, without framing: keys, shares, masked words.

    Up: two keys, an encrypted pair of shares for each other client, 4 P, one share of each client. Down: the others'
    keys, the encrypted shares for it, one bit per client for the set of uploads.

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
class SecureAggregation(Rule):
    """A rule that needs the clients' mean only, computed by `secure_sum`: theta_g + sum_i a_i (theta_i - theta_g).

    Args:
        then: rule of the server on the mean: mean, uniform, fedprox, fedavgm, fedadam, or any with `mean_by`.
        equal: a_i = 1 / C, which privacy requires, instead of n_i / sum n (the sizes are not hidden).
        threshold: of `secure_sum`.
        resolution: of `secure_sum`.

    Raises:
        InputError: a rule that needs the weights of single clients, which masks hide.

    >>> SecureAggregation("uniform").mean_by
    'uniform'
    """

    then: str | Rule = "mean"
    equal: bool = False
    threshold: int | None = None
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        check_options(self, {"threshold": (1, 2**31, ">= 1"), "resolution": (1e-30, 1e30, "> 0")}, {"then": object})
        if self.server.mean_by is None:
            allowed = "must depend on nothing but the clients' mean under masks"
            raise InputError("aggregate", repr(self.then), allowed, "Take mean, uniform, fedprox, fedavgm or fedadam.")

    @property
    def server(self) -> Rule:
        """The rule on the mean."""
        return rule(self.then)

    @property
    def mean_by(self) -> Literal["sizes", "uniform"] | None:
        """Uniform if all clients weigh the same."""
        return "uniform" if self.equal else self.server.mean_by

    @property
    def least(self) -> int:
        """Two, as the sum of one client is its update, or the threshold."""
        return max(2, self.threshold or 0)

    def overhead(self, clients: int, parameters: int) -> tuple[int, int]:
        """Bytes that each client sends and receives in a round beyond the weights themselves.

        >>> SecureAggregation().overhead(4, 19938)
        (772, 637)
        """
        sent, received = traffic(clients, parameters)
        return sent[0] - 4 * parameters, received[0]

    def start(self, theta: Tensor) -> State:
        """State of the server's rule."""
        return self.server.start(theta)

    def local(self, schedule: Schedule) -> Schedule:
        """Schedule of the server's rule."""
        return self.server.local(schedule)

    def unfit(self, theta: Tensor, weights: Tensor, sizes: Tensor) -> Mapping[int, str]:
        """Updates that the fixed point cannot hold, which a client finds before it masks its own."""
        largest, most = _range(self._shares(theta, weights, sizes), self.resolution)
        text = "weighted update of {:g} does not fit the fixed point, at most {:g}"
        return {row: text.format(value, most) for row, value in enumerate(largest) if not value < most}

    def __call__(
        self, state: State, theta: Tensor, weights: Tensor, sizes: Tensor, uncertainty: Tensor
    ) -> tuple[Tensor, State]:
        """The server's rule on the mean, which is all that the server sees."""
        summed = secure_sum(self._shares(theta, weights, sizes), self.threshold, resolution=self.resolution).total
        average = theta + torch.from_numpy(summed).to(theta.dtype)
        return self.server(state, theta, average[None], sizes[:1], uncertainty[:1])

    def _shares(self, theta: Tensor, weights: Tensor, sizes: Tensor) -> Floats:
        """a_i (theta_i - theta_g), (C, P)."""
        shares = torch.ones_like(sizes, dtype=torch.float64) if self.mean_by == "uniform" else sizes.double()
        values: Floats = ((shares / shares.sum())[:, None] * (weights - theta).double()).numpy()
        return values


def _range(values: Floats, resolution: float) -> tuple[list[float], float]:
    """Largest absolute value of each row, and the bound below which the sum of the rows fits 32 bits."""
    return np.abs(values).max(axis=1).tolist(), 2.0**31 * resolution / len(values)


def _fitting(values: Floats, resolution: float) -> list[Words]:
    """The rows as words; InputError for a row that is not finite or too large for the sum to fit."""
    largest, most = _range(values, resolution)
    for row, value in enumerate(largest):
        if not value < most:
            raise InputError(
                f"update of client {row}",
                value,
                f"must be below {most:g} everywhere",
                "Clip it, or take a coarser resolution.",
            )
    return list(encode(values, resolution))


def _enough(count: int, least: int, what: str) -> None:
    if count < least:
        hint = "The server learned nothing; repeat the round, or lower the threshold."
        raise InputError("clients", count, f"of them {what}, and {least} are needed", hint)


def _signed(x: int, other: int, seed: bytes, size: int) -> Words:
    """The pair's mask as x adds it; the other adds its negative."""
    words = prg(seed, size)
    return words if other > x else np.negative(words)


def _route(sender: int, receiver: int) -> bytes:
    """Nonce of 12 bytes: each key encrypts one message each way."""
    return sender.to_bytes(6) + receiver.to_bytes(6)
