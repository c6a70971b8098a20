"""Array types used in every signature, and checks of values; shapes stand in docstrings as (R, T, N, 3)."""

import os
import sys
from collections.abc import Mapping
from dataclasses import fields
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, shown, unknown

Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
AnyArray = NDArray[Any]

DTYPE_KINDS = {float: ("fiu", "number"), int: ("iu", "whole number"), bool: ("b", "boolean")}
"""Allowed kinds of dtype -> the name of one entry."""
TINY = 5e-324
"""The least positive number."""
TWO_TURNS = 4 * np.pi
"""rad, beyond which an angle is in degrees or unwrapped."""
Limits = Mapping[str, tuple[float, float, str]]
"""Field -> least and largest value, and both in words."""


def frozen(values: ArrayLike, dtype: Any = np.float64) -> AnyArray:
    """Read-only, contiguous and aligned array of `values`: compiled code may rely on all three.

    >>> frozen([1, 2]).flags.writeable
    False
    """
    values_array = np.asarray(values)
    array = np.array(values_array, dtype, order="C", copy=None)
    if not array.flags.aligned:
        array = array.copy()
    if array is values_array and not isinstance(values, list | tuple):
        owner = array.base if isinstance(array.base, np.ndarray) else array
        if array.flags.writeable or owner.flags.writeable:
            array = array.copy()  # the caller may go on writing to its own, or to what it shows a part of
    array.flags.writeable = False
    return array


def checked(
    field: str, values: ArrayLike, axes: str = "", shape: tuple[int, ...] | None = None, dtype: Any = float
) -> AnyArray:
    """`frozen` values of one of DTYPE_KINDS with that shape.

    Args:
        field: name of the values in an error.
        values: array-like.
        axes: the shape in letters, such as "(R, T, N, 3)".
        shape: the shape in numbers, -1 where any length will do; None for any shape.
        dtype: float, int or bool. Numbers that are not of that kind are refused, and never rounded or parsed.

    Raises:
        InputError: another shape or another kind of values.

    >>> checked("t", [0.0, 0.1], "(T,)", (3,))
    Traceback (most recent call last):
    coopoc.errors.InputError: t = shape (2,): must have shape (T,) = (3,). Give one entry per index of each axis.
    """
    kinds, word = DTYPE_KINDS[dtype]
    array = plain(values)
    if array.dtype.kind not in kinds and (array.size or array.dtype == object):
        hint = "Convert it with numpy first: rows must be equally long, text is not parsed, floats are not rounded."
        raise InputError(field, f"dtype {array.dtype}", f"must be an array of {word}s", hint)
    if shape is not None and (
        array.ndim != len(shape) or any(n not in (size, -1) for n, size in zip(shape, array.shape, strict=True))
    ):
        wanted = str(tuple("any" if n < 0 else n for n in shape)).replace("'", "")
        allowed = f"must have shape {axes} = {wanted}"
        raise InputError(field, f"shape {array.shape}", allowed, "Give one entry per index of each axis.")
    return frozen(array, dtype)


def check_arrays(made: Any, shapes: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
    """`checked` arrays in the fields of a dataclass; None stays where the field allows it.

    Args:
        made: instance of a dataclass, in its `__post_init__`.
        shapes: field -> its shape in letters and in numbers.
    """
    for field in fields(made):
        value = getattr(made, field.name)
        if field.name in shapes and (value is not None or NoneType not in get_args(field.type)):
            made.__dict__[field.name] = checked(field.name, value, *shapes[field.name])


def remade(self: Any) -> tuple[Any, tuple[Any, ...]]:
    """`__reduce__` of a dataclass of arrays: what is copied or unpickled is made anew, checked and read-only."""
    return type(self), tuple(getattr(self, field.name) for field in fields(self))


def plain(values: object) -> AnyArray:
    """Any value as an array; of dtype object what is none, such as rows of different lengths or masked entries.

    >>> plain([[1], [2, 3]]).dtype, plain(np.ma.masked_less([1.0, 2.0], 1.5)).dtype
    (dtype('O'), dtype('O'))
    """
    if not np.ma.is_masked(values):  # numpy gives the numbers behind a mask as if they were measured
        try:
            return np.asarray(values)
        except Exception:  # a class from elsewhere may raise anything
            pass
    return np.empty(0, object)


def listed(field: str, values: Any, hint: str, allowed: str = "must be a sequence") -> list[Any]:
    """Entries of a sequence; InputError for one text, for what has no entries, no order, or has them once only.

    >>> listed("egos", np.array(3), "Give [3].")
    Traceback (most recent call last):
    coopoc.errors.InputError: egos = array(3): must be a sequence. Give [3].
    """
    if not isinstance(values, str | bytes | set | frozenset) and not np.ma.is_masked(values):
        try:
            if (entries := iter(values)) is not values:
                return list(entries)
        except Exception:  # a class from elsewhere may raise anything
            pass
    raise InputError(field, shown(values), allowed, hint)


def number(
    field: str,
    value: object,
    low: float = 0.0,
    high: float = sys.float_info.max,
    *,
    kind: Any = float,
    allowed: str = "finite and >= 0",
    hint: str = "Give a number in SI units.",
) -> Any:
    """`value` as a Python float or int in [low, high].

    Args:
        field: its name in an error.
        value: a Python or NumPy number.
        low: least value.
        high: largest value; infinity allows infinity.
        kind: float or int. Booleans, text and (for int) floats are refused.
        allowed: the range in words.
        hint: how to fix it.

    Raises:
        InputError: not a number of that kind, or outside the range.

    >>> number("range_std", 2)
    2.0
    """
    kinds, word = DTYPE_KINDS[kind]
    scalar = np.asarray(value if isinstance(value, int | float | np.generic | np.ndarray) else None)
    if scalar.ndim or scalar.dtype.kind not in kinds:
        raise InputError(field, shown(value), f"must be a {word}, {allowed}", hint)
    result = kind(scalar.item())
    if not low <= result <= high:
        most = f" and at most {high:g}" if ">" in allowed and high < result < np.inf else ""
        raise InputError(field, value, f"must be {allowed}{most}", hint)
    return result


def whole(field: str, value: object, low: int = 0, high: int = 2**63 - 1, hint: str = "Give a whole number.") -> int:
    """`value` as a Python int in [low, high], see `number`.

    >>> whole("run", 3, 0, 2)
    Traceback (most recent call last):
    coopoc.errors.InputError: run = 3: must be in 0..2. Give a whole number.
    """
    allowed = f"in {low}..{high}" if high < 2**62 else f">= {low}"
    return int(number(field, value, low, high, kind=int, allowed=allowed, hint=hint))


def runs_in_memory(runs: object, per_run: int) -> int:
    """A number of runs whose recording takes no more than half of the memory of this machine.

    Args:
        runs: the number.
        per_run: numbers of a recording of one run.

    >>> runs_in_memory(10**15, 1000)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    coopoc.errors.InputError: runs = 1000000000000000: must be in 1...
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else sys.maxsize
    hint = "A recording must fit into memory: make several of fewer runs, each with its seed, or take fewer vehicles."
    return whole("runs", runs, 1, memory // (16 * max(per_run, 1)), hint)


def seed_of(value: object) -> int:
    """A seed of random draws."""
    return whole("seed", value, hint="Any whole number from 0 on will do.")


def extent(field: str, value: Any, hint: str = "Give (low, high).") -> tuple[float, float]:
    """(low, high), numbers from 0 on.

    >>> extent("size", [3, 20])
    (3.0, 20.0)
    """
    lengths = [number(field, each, 0, 1e9, allowed=">= 0", hint=hint) for each in listed(field, value, hint)]
    if len(lengths) != 2 or lengths[0] > lengths[1]:
        raise InputError(field, value, "must be 2 numbers (low, high) with low <= high", hint)
    return lengths[0], lengths[1]


def one_of(noun: str, name: object, known: Any) -> str:
    """`name` if it is one of the words, a sequence or a Literal of them; else the error of `unknown`.

    >>> one_of("frame", "body", ("world", "body"))
    'body'
    """
    known = get_args(known) or tuple(known)
    if not isinstance(name, str) or name not in known:
        raise unknown(noun, name, known)
    return name


def last_true(flags: ArrayLike, axis: int = 0) -> Ints:
    """Index along an axis of the last True until there, -1 before the first.

    >>> last_true(np.array([False, True, False])).tolist()
    [-1, 1, 1]
    """
    shape = np.shape(flags)
    index = np.arange(shape[axis]).reshape(-1, *(1,) * (len(shape) - 1 - axis))
    return np.maximum.accumulate(np.where(flags, index, -1), axis)


def robust_std(values: Floats) -> float:
    """1.4826 median(|v - median(v)|), the standard deviation of a Gaussian without its outliers (MAD).

    >>> round(robust_std(np.array([-1.0, 0, 1, 100])), 4)
    1.4826
    """
    return float(1.4826 * np.median(abs(values - np.median(values))))


def check_turns(field: str, angles: Floats) -> None:
    """InputError for angles (T, ...) rad that jump by more than two turns, as degrees do: a drive's may be unwrapped.

    >>> check_turns("heading", np.array([0.0, 90.0]))
    Traceback (most recent call last):
    coopoc.errors.InputError: heading[1] = 90.0: must be in rad, and jump by less than two turns. Convert degrees by \
np.deg2rad, and wrap what is unwrapped.
    """
    jump = abs(np.diff(angles, axis=0, prepend=0.0) if angles.ndim else angles) > TWO_TURNS
    hint = "Convert degrees by np.deg2rad, and wrap what is unwrapped."
    refuse(field, angles, jump, "must be in rad, and jump by less than two turns", hint)


Kind = TypeVar("Kind")


def instance(field: str, value: object, kind: type[Kind], hint: str = "") -> Kind:
    """`value` if it is of a class; InputError that names the field otherwise.

    >>> instance("track", None, dict)
    Traceback (most recent call last):
    coopoc.errors.InputError: track = None: must be a dict. Give dict(...).
    """
    if not isinstance(value, kind):
        raise InputError(field, shown(value), f"must be a {kind.__name__}", hint or f"Give {kind.__name__}(...).")
    return value


def named(field: str, values: object, hint: str) -> dict[str, Any]:
    """A mapping from texts as a dict; InputError for anything else.

    >>> named("stamps", {"a": 0.0}, "Give name -> s.")
    {'a': 0.0}
    """
    if isinstance(values, Mapping) and all(isinstance(name, str) for name in values):
        return dict(values)
    raise InputError(field, shown(values), "must be a mapping from names", hint)


def refuse(field: str, values: AnyArray, wrong: ArrayLike, allowed: str, hint: str) -> None:
    """InputError that names the first value where `wrong` is true, if there is one; both have the same shape.

    >>> refuse("step", np.array([3, -1]), [False, True], "must be >= 0", "Count steps from 0.")
    Traceback (most recent call last):
    coopoc.errors.InputError: step[1] = -1: must be >= 0. Count steps from 0.
    """
    if np.asarray(wrong).any():
        first_wrong = tuple(np.argwhere(wrong)[0].tolist())
        raise InputError(f"{field}{[*first_wrong] or ''}", values[first_wrong], allowed, hint)


def texts(field: str, values: object) -> tuple[str, ...]:
    """A tuple of texts; InputError if it is one text, or holds anything else.

    >>> texts("notes", ["a reconstruction"])
    ('a reconstruction',)
    """
    hint = 'Give a tuple such as ("a note",).'
    values_listed = listed(field, values, hint)
    if not all(isinstance(value, str) for value in values_listed):
        raise InputError(field, shown(values), "must be a sequence of texts", hint)
    return tuple(values_listed)


def check_fields(made: Any, limits: Limits | None = None) -> None:
    """InputError for a value of another type than its field of a dataclass has; NumPy's numbers become Python's.

    Args:
        made: instance of a dataclass, in its `__post_init__`; fields of generic types and protocols are not checked.
        limits: of numbers; default no NaN.

    >>> from coopoc import V2X
    >>> V2X(loss=2.0)
    Traceback (most recent call last):
    coopoc.errors.InputError: loss = 2.0: must be in [0, 1]. Give V2X(loss=...).
    """
    for field in fields(made):
        name, value = field.name, getattr(made, field.name)
        kinds = get_args(field.type) if isinstance(field.type, UnionType) else (field.type,)
        if not field.init or (value is None and NoneType in kinds):
            continue
        hint, kind = f"Give {type(made).__name__}({name}=...).", kinds[0]
        if kind in (int, float):
            most = 2**62 if kind is int else np.inf
            low, high, words = (limits or {}).get(name, (-most, most, "no NaN"))
            made.__dict__[name] = number(name, value, low, high, kind=kind, allowed=words, hint=hint)
        elif kind == Floats:
            made.__dict__[name] = checked(name, value)
        elif get_origin(kind) is Literal:
            one_of(name, value, kind)
        elif not all(isinstance(one, type) and not getattr(one, "_is_protocol", False) for one in kinds):
            continue
        elif not isinstance(value, (*kinds, np.bool_) if kind is bool else kinds):
            allowed = f"must be {' | '.join(one.__name__ for one in kinds if one is not NoneType)}"
            raise InputError(name, shown(value), allowed, hint)
