"""Measurements as a setting: an object goes to a file, whose path workers and later runs take."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import InputError
from ..world.fleet import Fleet
from ..world.recording import Recording
from ..world.storage import digest, save_recording


def data_path(name: str, value: Any, out: str | Path) -> Any:
    """The value itself, or the path in `out/data` of a Recording, a Log, or a pair (Recording, Fleet of its truth).

    Args:
        name: of the setting.
        value: of the setting.
        out: folder of all studies.

    Raises:
        InputError: a Fleet, which a study names by its path.
    """
    pair = (value.recording, value.truth) if hasattr(value, "recording") and hasattr(value, "truth") else value
    if isinstance(pair, Recording):
        pair = (pair, None)
    if isinstance(pair, Fleet):
        hint = "Give the path of its file, or mine.py:NAME of a function that makes it."
        raise InputError(name, repr(pair), "must be a name or a path, or a Recording", hint)
    if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[0], Recording)):
        return value
    recording, truth = pair
    folder = Path(out) / "data"
    file = folder / f"{digest(recording)[:12]}{truth.digest[:8] if truth is not None else ''}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part.npz")
        save_recording(recording, part, truth)
        part.replace(file)
    return str(file)
