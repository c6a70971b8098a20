"""Checks of a method's options, each against the type that its class declares."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from ..arrays import number
from ..errors import InputError
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


def check_options(method: Any) -> None:
    """InputError for an option of another type than its field of the dataclass has; NumPy's numbers become Python's.

    >>> from coopoc import JointFilter
    >>> JointFilter(exact="no")
    Traceback (most recent call last):
    ...
    coopoc.errors.InputError: exact = 'no': must be bool. Give JointFilter(exact=...).
    """
    for field in fields(method):
        name, text, value = field.name, str(field.type), getattr(method, field.name)
        if not field.init or (value is None and text.endswith("None")):
            continue
        text = text.removesuffix(" | None")
        if isinstance(field.default, str) and text not in TYPES:  # one of some words, which the method lists
            text = "str"
        hint = f"Give {type(method).__name__}({name}=...)."
        if text in NUMBERS:
            least = -(2**62) if text == "int" else -np.inf
            value = number(name, value, least, -least, kind=NUMBERS[text], allowed="no NaN", hint=hint)
            object.__setattr__(method, name, value)
        elif text in TYPES and not isinstance(value, TYPES[text]):
            raise InputError(name, repr(value)[:60], f"must be {text}", hint)
