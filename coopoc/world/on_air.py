"""Bytes on air of messages as vehicles send them in Europe: what stands around a CAM or a CPM."""

from __future__ import annotations

HEADERS, DIGEST, CERTIFICATE = 44, 96, 220
"""Bytes around a message: BTP-B and GeoNetworking single hop (EN 302 636), security (TS 103 097) with a digest of the
sender's certificate or, once a second, with the certificate."""


def share(due: float, rate: float) -> float:
    """Share of the messages at a rate, Hz, that carry what is due so many times a second."""
    return min(1.0, due / rate)


def on_air(message: float, rate: float) -> float:
    """Mean bytes on air of messages of a mean size, bytes, at a rate, Hz.

    >>> on_air(41, 10.0)
    193.4
    """
    return HEADERS + message + DIGEST + share(1.0, rate) * (CERTIFICATE - DIGEST)
