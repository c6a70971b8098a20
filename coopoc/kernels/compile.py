"""Whether kernels are compiled, and how: machine code at the first call, kept on disk, no interpreter's lock."""

from __future__ import annotations

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
    return wish == "numba" and _numba_is_there()


@cache
def _numba_is_there() -> bool:
    try:
        import numba  # noqa: F401
    except ImportError:
        warnings.warn(
            "numba is not installed: the NumPy reference runs, many times slower. Run: pip install 'coopoc[fast]'",
            stacklevel=2,
        )
        return False
    return True


def compiled(function: Function) -> Function:
    """Compiled at the first call. A product and a sum may become one instruction; nothing is reordered.

    The machine code is kept beside the source, or in the user's cache where that is read-only. It is made anew after a
    change of any file of the kernels or of the function's own folder, since it holds what it calls.
    """
    return _compiled(function, {"contract"})


def as_written(function: Function) -> Function:
    """Compiled, each product and sum rounded as it stands, so that numbers and vectors of them get the same digits."""
    return _compiled(function, set())


def _compiled(function: Function, liberties: set[str]) -> Function:
    import numba

    made: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=liberties)(function)
    folders = {Path(__file__).parent, Path(function.__code__.co_filename).parent}
    made._cache._cache_file._source_stamp = _stamp(tuple(sorted(folders)))
    return cast(Function, made)


@cache
def _stamp(folders: tuple[Path, ...]) -> tuple[tuple[str, int, int], ...]:
    files = sorted(file for folder in folders for file in folder.glob("*.py"))
    return tuple((file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in files)
