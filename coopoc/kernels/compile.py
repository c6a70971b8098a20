"""Whether kernels are compiled, and how: machine code at the first call, kept on disk, no interpreter's lock."""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from ..errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])
SWITCH = "COOPOC_KERNELS"
"""Environment variable: "numba" (default) compiles, "numpy" uses the readable reference."""


def use_kernels() -> bool:
    """True if the methods may call the compiled kernels; False, with one warning, where numba is missing.

    Raises:
        InputError: the environment variable COOPOC_KERNELS is neither "numba" nor "numpy".
    """
    wish = os.environ.get(SWITCH, "numba")
    if wish not in ("numba", "numpy"):
        raise InputError(SWITCH, repr(wish), "must be 'numba' or 'numpy'", "Unset the environment variable.")
    return wish == "numba" and numba_is_there("the NumPy reference runs, many times slower")


@cache
def numba_is_there(instead: str) -> bool:
    """Whether anything can be compiled; if not, one warning says what runs instead.

    Args:
        instead: the end of a sentence, such as "the NumPy reference runs, many times slower".
    """
    if importlib.util.find_spec("numba") is None:
        text = f"numba is not installed: {instead}. Run: pip install 'coopoc[fast]'"
        warnings.warn(text, stacklevel=2)
        return False
    return True


def compiled(function: Function) -> Function:
    """Compiled at the first call. A product and a sum may become one instruction; nothing is reordered.

    The machine code is kept beside the source, or in the user's cache where that is read-only. It is made anew after a
    change of any file of the kernels or of the function's own folder, since it holds what it calls.
    """
    return _kept(_made(function, {"contract"}), function)


def as_written(function: Function) -> Function:
    """Compiled, each product and sum rounded as it stands, so that numbers and vectors of them get the same digits."""
    return _kept(_made(function, set()), function)


def part(function: Function) -> Function:
    """Compiled as `compiled` is, together with the first kernel that calls it, and kept in that one's machine code."""
    return cast(Function, _made(function, {"contract"}))


def summing(function: Function) -> Function:
    """A part that adds many terms: it may do so in several sums, in one way for all arguments."""
    return cast(Function, _made(function, {"contract", "reassoc"}))


def inside(function: Function) -> Function:
    """Compiled as `as_written` is, and copied into whoever calls it: a call would hand over every number that describes
    an array, which takes longer than to read three of its elements."""
    return cast(Function, _made(function, set(), forceinline=True))


def _made(function: Function, liberties: set[str], forceinline: bool = False) -> Any:
    import numba

    return numba.njit(nogil=True, error_model="numpy", fastmath=liberties, forceinline=forceinline)(function)


def _kept(made: Any, function: Function) -> Function:
    folders = {Path(__file__).parent, Path(function.__code__.co_filename).parent}
    try:
        made.enable_caching()
        made._cache._cache_file._source_stamp = _stamp(tuple(sorted(folders)))
    except RuntimeError:  # neither the source's folder nor the user's can be written: every process compiles
        pass
    return cast(Function, made)


@cache
def _stamp(folders: tuple[Path, ...]) -> tuple[tuple[str, int, int], ...]:
    files = sorted(file for folder in folders for file in folder.glob("*.py"))
    return tuple((file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in files)
