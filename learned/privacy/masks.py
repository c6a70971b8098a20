"""Cryptographic primitives of secure aggregation, its fixed point, and normal noise from a cryptographic generator."""

from __future__ import annotations

import hashlib
import secrets
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from coopoc.arrays import Floats
from coopoc.errors import MissingLibraryError

Words = NDArray[np.uint32]
KEY, TAG = 32, 16
"""Bytes of a key, private or public, and of the tag of a ciphertext."""
RESOLUTION = 2.0**-24
"""Of the fixed point: 6e-8, as float32 has it near 1. 32 bits then hold sums between -128 and 128."""


def encode(values: Floats, resolution: float = RESOLUTION) -> Words:
    """Real numbers as integers modulo 2^32, rounded to multiples of the resolution; sums of at most 2^31 steps fit.

    >>> decode(encode(np.array([-0.5])) + encode(np.array([0.25]))).tolist()
    [-0.25]
    """
    words: Words = np.rint(values / resolution).astype(np.int64).astype(np.uint32)
    return words


def decode(words: Words, resolution: float = RESOLUTION) -> Floats:
    """Real numbers of integers modulo 2^32, the upper half being negative."""
    found: Floats = words.astype(np.int32) * resolution
    return found


def public_key(key: bytes) -> bytes:
    """X25519 public key of a private one, 32 bytes each; any 32 bytes are a private key.

    References:
        RFC 7748.
    """
    found: bytes = _crypto().X25519PrivateKey.from_private_bytes(key).public_key().public_bytes_raw()
    return found


def pair_seed(key: bytes, other: bytes) -> bytes:
    """Shared secret (32 bytes) of a private key and another client's public one: the same from either side."""
    return _agreed(key, other, b"mask")


def prg(seed: bytes, size: int) -> Words:
    """Words (size,) of the ChaCha20 key stream of a seed of 32 bytes.

    References:
        Bernstein, ChaCha, a variant of Salsa20, 2008; RFC 8439.
    """
    crypto = _crypto()
    stream = crypto.Cipher(crypto.ChaCha20(seed, bytes(16)), None).encryptor()
    return np.frombuffer(stream.update(bytes(4 * size)), dtype="<u4").astype(np.uint32)


def secure_normal(size: int) -> Floats:
    """(size,) standard normal draws under a fresh key of the operating system: ChaCha20, 52 bits each, inverted."""
    high, low = (prg(secrets.token_bytes(KEY), 2 * size).astype(np.uint64) >> 6).reshape(2, size)
    draws: Floats = ndtri(((high << 26 | low) + 0.5) * 2.0**-52)
    return draws


def box(key: bytes, other: bytes) -> Any:
    """Authenticated encryption (ChaCha20-Poly1305) under the shared secret of a private and a public key."""
    return _crypto().ChaCha20Poly1305(_agreed(key, other, b"box"))


def _agreed(key: bytes, other: bytes, purpose: bytes) -> bytes:
    crypto = _crypto()
    point = crypto.X25519PrivateKey.from_private_bytes(key).exchange(crypto.X25519PublicKey.from_public_bytes(other))
    return hashlib.sha256(purpose + point).digest()


@cache
def _crypto() -> SimpleNamespace:
    """The primitives; MissingLibraryError without the library."""
    try:
        from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
        from cryptography.hazmat.primitives.ciphers import Cipher
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
        from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20
    except ModuleNotFoundError:
        raise MissingLibraryError("cryptography", "secure aggregation", "'coopoc[privacy]'") from None
    return SimpleNamespace(
        X25519PrivateKey=X25519PrivateKey,
        X25519PublicKey=X25519PublicKey,
        Cipher=Cipher,
        ChaCha20=ChaCha20,
        ChaCha20Poly1305=ChaCha20Poly1305,
    )
