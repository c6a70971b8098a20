"""Checks of the options of a method, a schedule or a rule, each against the type that its class declares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ..arrays import checked, number
from ..errors import InputError, shown
from ..world.sensors import Sensors
from ..world.v2x import Message
from .noise_model import NoiseModel

NUMBERS: dict[str, Any] = {"int": int, "float": float}
TYPES: dict[str, Any] = {
    "bool": bool | np.bool_,
    "str": str,
    "Message": Message,
    "Sensors": Sensors,
    "NoiseModel | str": NoiseModel | str,
}


Limits = Mapping[str, tuple[float, float, str]]
"""Option -> least and largest value, and both in words."""


def check_options(made: Any, limits: Limits | None = None, kinds: Mapping[str, Any] | None = None) -> None:
    """InputError for an option of another type than its field of the dataclass has; NumPy's numbers become Python's.

    Args:
        made: instance of a dataclass, in its `__post_init__`.
        limits: of numbers; default no NaN.
        kinds: option -> its class, where that is none of TYPES.

    >>> from coopoc import JointFilter
    >>> JointFilter(exact="no")
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: exact = 'no': must be bool. Give JointFilter(exact=...).
    """
    own = {str(f.type).removesuffix(" | None"): kinds[f.name] for f in fields(made) if kinds and f.name in kinds}
    types = {**TYPES, **own}
    for field in fields(made):
        name, text, value = field.name, str(field.type), getattr(made, field.name)
        if not field.init or (value is None and text.endswith("None")):
            continue
        text = text.removesuffix(" | None")
        if isinstance(field.default, str) and text not in types:  # one of some words, which the method lists
            text = "str"
        hint = f"Give {type(made).__name__}({name}=...)."
        if text in NUMBERS:
            most = 2**62 if text == "int" else np.inf
            low, high, words = (limits or {}).get(name, (-most, most, "no NaN"))
            value = number(name, value, low, high, kind=NUMBERS[text], allowed=words, hint=hint)
            object.__setattr__(made, name, value)
        elif text == "Floats":
            object.__setattr__(made, name, checked(name, value))
        elif text in types and not isinstance(value, types[text]):
            raise InputError(name, shown(value), f"must be {text}", hint)
