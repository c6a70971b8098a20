"""Compression: encoding of an update as bytes on air, and decoding."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import AnyArray

from .rule import within


class Compression(ABC):
    """Codec of updates (P,) of weights, with a residual that the client adds to its next update."""

    @abstractmethod
    def encode(self, update: Tensor, residual: Tensor, draw: np.random.Generator) -> tuple[bytes, Tensor]:
        """Bytes of an update (P,), and the new residual (P,).

        Args:
            update: (P,) theta_i - theta.
            residual: (P,) of the client's previous rounds, zeros at first.
            draw: random generator of the client.
        """

    @abstractmethod
    def decode(self, sent: bytes, size: int) -> Tensor:
        """The update (size,) in float32."""


@dataclass(frozen=True)
class Float16(Compression):
    """Half precision, 2 P bytes: relative error 2^-11 above 6e-5, absolute error 3e-8 below.

    >>> len(Float16().encode(torch.ones(5), torch.zeros(5), np.random.default_rng())[0])
    10
    """

    def encode(self, update: Tensor, residual: Tensor, draw: np.random.Generator) -> tuple[bytes, Tensor]:
        """Rounded to nearest, no error feedback."""
        return _little(update.half().numpy()), residual

    def decode(self, sent: bytes, size: int) -> Tensor:
        """As float32."""
        return torch.from_numpy(np.frombuffer(sent, "<f2").astype(np.float32))


@dataclass(frozen=True)
class TopK(Compression):
    """The k = ceil(share P) largest entries of u + e, with error feedback e <- u + e - sent.

    k (4 + b) bytes: float32 values, and indices of b = 2 bytes up to 65,536 weights and of 4 beyond.

    Args:
        share: of the weights that are sent.

    References:
        Stich, Cordonnier, Jaggi, Sparsified SGD with Memory, NeurIPS 2018, algorithm 1.

    >>> sent, residual = TopK(0.5).encode(torch.tensor([3.0, 1.0]), torch.zeros(2), np.random.default_rng())
    >>> len(sent), residual.tolist()
    (6, [0.0, 1.0])
    """

    share: float = 0.1

    def __post_init__(self) -> None:
        within("share", self.share, 0 < self.share <= 1, "in (0, 1]", "0.1 sends a tenth of the weights.")

    def encode(self, update: Tensor, residual: Tensor, draw: np.random.Generator) -> tuple[bytes, Tensor]:
        """Indices, then values; the first of equals goes first."""
        whole = update.float() + residual
        order = whole.abs().argsort(descending=True, stable=True)
        chosen = order[: math.ceil(self.share * len(whole))].sort().values
        left = whole.clone()
        left[chosen] = 0.0
        indices = chosen.numpy().astype(_index(len(whole)))
        return _little(indices) + _little(whole[chosen].numpy()), left

    def decode(self, sent: bytes, size: int) -> Tensor:
        """Zero where nothing was sent."""
        kind, update = _index(size), torch.zeros(size)
        count = len(sent) // (kind.itemsize + 4)
        indices = np.frombuffer(sent, kind, count).astype(np.int64)
        values = np.frombuffer(sent, "<f4", count, offset=count * kind.itemsize).astype(np.float32)
        update[torch.from_numpy(indices)] = torch.from_numpy(values)
        return update


@dataclass(frozen=True)
class Quantised(Compression):
    """Stochastic rounding to 2^bits - 1 levels in [-m, m], m = max |u|: unbiased, error below m / (2^(bits-1) - 1).

    q = floor(u / m s + xi), s = 2^(bits-1) - 1, xi uniform in [0, 1); 4 + ceil(bits P / 8) bytes.

    Args:
        bits: of a level.

    References:
        Alistarh et al., QSGD, NeurIPS 2017, section 3.1, with the largest entry in place of the norm.

    >>> len(Quantised(4).encode(torch.ones(5), torch.zeros(5), np.random.default_rng())[0])
    7
    """

    bits: int = 8

    def __post_init__(self) -> None:
        whole = self.bits == int(self.bits) and 2 <= self.bits <= 16
        within("bits", self.bits, whole, "a whole number in 2..16", "8 is a quarter of float32.")

    @property
    def _steps(self) -> int:
        return (1 << (self.bits - 1)) - 1

    def encode(self, update: Tensor, residual: Tensor, draw: np.random.Generator) -> tuple[bytes, Tensor]:
        """The largest entry as float32, then the levels, most significant bit first; no error feedback."""
        numbers = update.double().numpy()
        largest = np.float32(np.abs(numbers).max(initial=0.0))
        scaled = numbers / (largest or 1.0) * self._steps + draw.random(len(numbers))
        levels = np.clip(np.floor(scaled).astype(np.int64), -self._steps, self._steps) + self._steps
        bits = (levels[:, None] >> np.arange(self.bits - 1, -1, -1)) & 1
        return _little(largest) + np.packbits(bits.astype(np.uint8)).tobytes(), residual

    def decode(self, sent: bytes, size: int) -> Tensor:
        """Levels times m / s."""
        largest = float(np.frombuffer(sent, "<f4", 1)[0])
        bits = np.unpackbits(np.frombuffer(sent, np.uint8, offset=4), count=size * self.bits)
        levels = bits.reshape(size, self.bits) @ (1 << np.arange(self.bits - 1, -1, -1)) - self._steps
        return torch.from_numpy((levels * (largest / self._steps)).astype(np.float32))


def _little(numbers: AnyArray | np.floating) -> bytes:
    """Little-endian bytes on every machine."""
    array = np.asarray(numbers)
    return array.astype(array.dtype.newbyteorder("<")).tobytes()


def _index(size: int) -> np.dtype:
    return np.dtype("<u2" if size <= 2**16 else "<u4")
