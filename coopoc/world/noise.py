"""Keyed noise: every draw belongs to (seed, sensor, run, vehicle, partner) and to its step, and to nothing else."""

from __future__ import annotations

import zlib

import numpy as np

from ..arrays import number


def stream(seed: int, sensor: str, run: int, vehicle: str, partner: str = "") -> np.random.Generator:
    """Random stream of one sensor of one vehicle in one run; step t takes the t-th draw.

    30 runs are a prefix of 100, and adding a vehicle, a neighbour or a method changes no other draws, because the key
    names everything that the draw belongs to (ids, not columns). Philox is counter-based: streams do not overlap.

    Args:
        seed: the study's seed.
        run: 0..R-1.
        sensor: names.
        vehicle: names.
        partner: names.

    >>> bool(stream(0, "gnss", 3, "a").normal() == stream(0, "gnss", 3, "a").normal())
    True
    """
    if type(seed) is not int or seed < 0:
        hint = "Any whole number from 0 on will do."
        seed = number("seed", seed, 0, 2**63 - 1, kind=int, allowed="in 0..2^63 - 1", hint=hint)
    key = (seed, run, *(zlib.crc32(word.encode()) for word in (sensor, vehicle, partner)))
    small = max(seed, run) < 2**32  # then NumPy makes the same words of the key, three times as slowly
    entropy = np.array(key, dtype=np.uint32) if small else key
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))
