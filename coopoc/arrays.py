"""Array types used in every signature; shapes stand in the docstrings as (R, T, N, 3)."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.floating[Any]]
Ints: TypeAlias = npt.NDArray[np.int64]
Bools: TypeAlias = npt.NDArray[np.bool_]
AnyArray: TypeAlias = npt.NDArray[Any]


def frozen(values: npt.ArrayLike, dtype: Any = np.float64) -> AnyArray:
    """Read-only array of `values`: the nouns are frozen, and so is what they hold.

    >>> frozen([1, 2]).flags.writeable
    False
    """
    array = np.asarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy()  # the caller may go on writing to its own
        array.flags.writeable = False
    return array
