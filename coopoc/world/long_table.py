"""Long ("tidy") tables of pandas from arrays that share axes: a row per element, a column per array."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import AnyArray, Bools

if TYPE_CHECKING:
    import pandas as pd


def long_table(columns: Mapping[str, AnyArray], where: Bools | None = None) -> "pd.DataFrame":
    """A row per element of the arrays' common shape, the last axis fastest.

    Args:
        columns: name -> array that broadcasts to the common shape.
        where: of the common shape, the elements to keep; all if None.

    >>> long_table({"t": np.array([[0.0], [0.1]]), "x": np.array([[1.0, 2], [3, 4]])}).to_numpy().tolist()
    [[0.0, 1.0], [0.0, 2.0], [0.1, 3.0], [0.1, 4.0]]
    """
    import pandas as pd

    kept = ... if where is None else where
    arrays = np.broadcast_arrays(*columns.values())
    return pd.DataFrame({name: array[kept].reshape(-1) for name, array in zip(columns, arrays, strict=True)})
