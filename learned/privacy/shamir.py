"""Shamir's secret sharing over a prime field: t shares determine the secret, t - 1 are independent of it."""

from __future__ import annotations

import secrets
from collections.abc import Mapping

from coopoc.errors import InputError

PRIME = 2**521 - 1
"""The Mersenne prime M521: room for a key of 32 bytes; a share takes 66."""


def split(secret: int, holders: int, threshold: int, prime: int = PRIME) -> list[int]:
    """Shares f(1), ..., f(holders) of a random polynomial f of degree threshold - 1 with f(0) = secret, modulo a prime.

    Args:
        secret: 0 <= secret < prime.
        holders: number of shares.
        threshold: number of shares that determine the secret.
        prime: size of the field.

    Raises:
        InputError: a threshold outside 1..holders, or a secret outside the field.

    References:
        Shamir, How to share a secret, Communications of the ACM 22, 1979.

    >>> join({k: share for k, share in enumerate(split(42, 5, 3), start=1) if k in (1, 4, 5)})
    42
    """
    if not 1 <= threshold <= holders < prime:
        raise InputError("threshold", threshold, f"must be in 1..{holders}, the holders", "Two thirds is usual.")
    if not 0 <= secret < prime:
        raise InputError("secret", "outside the field", "must be in the field", "Share keys of 32 bytes.")
    coefficients = [secrets.randbelow(prime) for _ in range(threshold - 1)]
    return [_value([*coefficients, secret], x, prime) for x in range(1, holders + 1)]


def join(shares: Mapping[int, int], prime: int = PRIME) -> int:
    """The secret f(0) of at least `threshold` shares x -> f(x), by Lagrange interpolation; fewer give noise."""
    total = 0
    for x, share in shares.items():
        above, below = share, 1
        for other in shares:
            if other != x:
                above, below = above * other % prime, below * (other - x) % prime
        total = (total + above * pow(below, -1, prime)) % prime
    return total


def _value(coefficients: list[int], x: int, prime: int) -> int:
    """Polynomial at x, highest power first."""
    total = 0
    for coefficient in coefficients:
        total = (total * x + coefficient) % prime
    return total
