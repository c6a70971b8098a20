"""Optimization-based cooperative localization with learned-gain comparisons.

A Fleet drives. `observe` turns it into a Recording under Sensors and a V2X budget. A Method turns a Recording into a
Track. `rt_le` compares Track and Fleet. A Study does this over a grid and yields Results.
"""

import importlib
import re
from pathlib import Path
from typing import Any

_STUB = Path(__file__).with_suffix(".pyi").read_text("utf-8")
_HOME = {name: module for module, name in re.findall(r"from (\.\S+) import (\w+)", _STUB)}
"""Public name -> module that defines it, as type checkers see it."""

__version__ = "0.2.0"
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name from its home when it is first used: `import coopoc` stays quick."""
    if name not in _HOME:
        raise AttributeError(f"module 'coopoc' has no attribute {name!r}")
    try:
        value = globals()[name] = getattr(importlib.import_module(_HOME[name], __name__), name)
        return value
    except ModuleNotFoundError as error:
        from .errors import missing

        raise missing(error, f"coopoc.{name}") from None


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
