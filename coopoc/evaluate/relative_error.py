"""Relative pose error: how wrong the motion between two instants is, whatever the frame."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..arrays import Floats, Ints, checked, number
from ..errors import InputError
from ..plugins import one_of

Unit = Literal["steps", "m"]


def relative_error(
    estimate: tuple[Floats, Floats], truth: tuple[Floats, Floats], delta: float = 1.0, unit: Unit = "steps"
) -> Floats:
    """(n,) m, |E_k| of E_k = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), translation part, over pairs i, j that are `delta` apart.

    Args:
        estimate: positions (T, 3) m and rotations (T, 3, 3), body to frame.
        truth: the same at the same instants.
        delta: from i to j, and from there to the next; a whole number of steps.
        unit: "steps", or "m" along the estimated path.

    Raises:
        InputError: other shapes, a part of a step, or a drive shorter than `delta`.

    Source: Sturm et al., IROS 2012, equation 2; evo's "RPE, translation part" is the same number.

    >>> still = (np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))
    >>> moved = (np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), still[1])
    >>> relative_error(moved, still)
    array([1., 1.])
    """
    one_of("unit", unit, ("steps", "m"))
    x, r = (checked("estimate", part) for part in estimate)
    y, q = (checked("truth", part) for part in truth)
    if not (x.shape == y.shape == (len(x), 3) and r.shape == q.shape == (len(x), 3, 3)):
        given = f"shapes {x.shape}, {r.shape}, {y.shape}, {q.shape}"
        raise InputError("estimate, truth", given, "must be (T, 3) and (T, 3, 3)", "Take both at the same instants.")
    at = ends(x, delta, unit)
    i, j = at[:-1], at[1:]
    if not len(i):
        raise InputError("delta", f"{delta:g} {unit}", "must fit into the drive once", "Take a smaller one.")
    moved = np.einsum("kab,ka->kb", r[i], x[j] - x[i])
    wanted = np.einsum("kab,ka->kb", q[i], y[j] - y[i])
    return np.asarray(np.linalg.norm(moved - wanted, axis=1))


def ends(x: Floats, delta: float, unit: Unit) -> Ints:
    """(n + 1,) steps between which the motions of a path x (T, 3) are compared.

    Raises:
        InputError: `delta` is not positive, or a part of a step.

    >>> ends(np.zeros((7, 3)), 3, "steps")
    array([0, 3, 6])
    """
    if unit == "steps":
        steps = number("delta", delta, 1, allowed="a whole number of steps, >= 1")
        if steps % 1:
            raise InputError("delta", delta, "must be a whole number of steps", 'For a length, set unit to "m".')
        return np.arange(0, len(x), int(steps))
    delta = number("delta", delta, 1e-12, allowed="> 0")
    found, gone = [0], 0.0
    for k, step in enumerate(np.linalg.norm(np.diff(x, axis=0), axis=1).tolist(), 1):
        gone += step
        if gone >= delta:
            found.append(k)
            gone = 0.0
    return np.array(found, dtype=np.int64)
