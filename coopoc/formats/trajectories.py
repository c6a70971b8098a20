"""Trajectories: poses over time, as TUM files (`t x y z qx qy qz qw`)."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import check_turns, checked, refuse
from ..paths import given_path, write


def write_tum(path: str | Path, t: ArrayLike, position: ArrayLike, heading: ArrayLike | None = None) -> None:
    """Write a path as a TUM file, `t x y z qx qy qz qw` by rows, which evo and most SLAM tools read.

    Args:
        path: of the file, which is replaced whole; its folder is made.
        t: (T,) s, increasing.
        position: (T, 3) m, such as `track.x[run, :, k]` of the k-th ego.
        heading: (T,) rad from +x, anticlockwise; None where it is unknown: all poses then point along +x.

    Raises:
        InputError: shapes, numbers that are not finite, stamps that do not increase, headings that jump by
            more than two turns, as degrees do.

    Source: the tools of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

    >>> import tempfile
    >>> write_tum(file := Path(tempfile.mkdtemp()) / "a.tum", [0.0, 0.1], [[1, 2, 0], [2, 2, 0]], [0.0, np.pi])
    >>> np.loadtxt(file)[1].tolist()
    [0.1, 2.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    """
    where = checked("position", position, "(T, 3)", (-1, 3))
    stamps = checked("t", t, "(T,)", (len(where),))
    course = np.zeros(len(where)) if heading is None else checked("heading", heading, "(T,)", (len(where),))
    for name, values in (("t", stamps), ("position", where), ("heading", course)):
        refuse(name, values, ~np.isfinite(values), "must be finite", "Remove the pose.")
    late, hint = np.append(False, np.diff(stamps) <= 0), "Sort the poses by time, and remove one that repeats."
    refuse("t", stamps, late, "must increase", hint)
    check_turns("heading", course)
    half, none = 0.5 * course, 0.0 * course
    rows = np.column_stack([stamps, where, none, none, np.sin(half), np.cos(half)])
    write(given_path(path), lambda file: np.savetxt(file, rows, fmt="%.9f"))
