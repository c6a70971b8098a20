"""Checksums inside files: SHA-256 over the whole file, computed with zeros where the checksum then stands."""

import hashlib
import re

UNSEALED = "sha256:" + 64 * "0"
"""Place of the checksum while it is computed; the last one in a file counts."""
_SEAL = re.compile(rb"sha256:[0-9a-f]{64}")


def sealed(content: bytes) -> bytes:
    """The content of a file with its checksum in place of the last UNSEALED.

    >>> file = sealed(b"7 " + UNSEALED.encode())
    >>> holds(file), holds(file.replace(b"7 ", b"8 "))
    (True, False)
    """
    before, _, after = content.rpartition(UNSEALED.encode())
    return before + _seal(content) + after


def holds(content: bytes) -> bool | None:
    """Whether the checksum in the content is right; None if there is none.

    >>> holds(b"7") is None
    True
    """
    seals = _SEAL.findall(content)
    if not seals:
        return None
    before, seal, after = content.rpartition(seals[-1])
    return _seal(before + UNSEALED.encode() + after) == bytes(seal)


def _seal(content: bytes) -> bytes:
    return b"sha256:" + hashlib.sha256(content).hexdigest().encode()
