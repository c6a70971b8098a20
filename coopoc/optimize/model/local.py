"""The vector between a measurement's nodes in its frame, and its derivative by the nodes."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats, Ints
from .measurements import Measurement
from .space import Space, cross


def local(space: Space, known: Measurement, x: Floats, nodes: Ints) -> tuple[Floats, Floats | None]:
    """Vector (B, M, d) and rotation (B, M, d, d), or None, that the formula of a kind gets at x (B, n, ambient)."""
    p = space.position(x)
    here = p[:, nodes[:, -1]]
    vector = here if known.arity == 1 else here - p[:, nodes[:, 0]]
    if known.frame == "world":
        return vector, None
    turned = space.rotation(x)
    if known.arity == 1:
        return vector, turned[:, nodes[:, 0]]
    back = np.swapaxes(turned[:, nodes[:, 0]], -1, -2)
    vector = (back @ vector[..., None])[..., 0]
    return vector, back @ turned[:, nodes[:, 1]] if known.frame == "relative" else None


def chain(
    space: Space, known: Measurement, x: Floats, nodes: Ints, seen: tuple[Floats, Floats | None], jacobian: Floats
) -> tuple[Floats, ...]:
    """Derivatives (B, M, size, dof) by the steps of the nodes, from those by what is seen.

    A pair in the world frame gets only its second node's: the first's is minus it.

    Args:
        seen: of `local`.
        jacobian: (B, M, size, d), or (B, M, size, dof) if the frame is relative.
    """
    if known.frame == "world":
        return (_wide(space, jacobian),)
    if known.arity == 1:
        return (jacobian,)
    vector, rotation = seen
    d = space.dimension
    back = np.swapaxes(space.rotation(x)[:, nodes[:, 0]], -1, -2)
    moved = jacobian[..., :d] @ back
    turning = jacobian[..., :d] @ _swing(vector)
    if rotation is None:
        return np.concatenate([-moved, turning], axis=-1), _wide(space, moved)
    own = jacobian[..., d:]
    turning -= own @ (np.swapaxes(rotation, -1, -2) if d == 3 else np.ones((1, 1)))
    return np.concatenate([-moved, turning], axis=-1), np.concatenate([moved, own], axis=-1)


def _swing(vector: Floats) -> Floats:
    """d(Exp(-w) v)/dw = [v]x at w = 0: (..., 3, 3), or (..., 2, 1) in the plane."""
    if vector.shape[-1] == 3:
        return cross(vector)
    return np.stack([vector[..., 1], -vector[..., 0]], axis=-1)[..., None]


def _wide(space: Space, jacobian: Floats) -> Floats:
    if space.angles == 0:
        return jacobian
    return np.concatenate([jacobian, np.zeros((*jacobian.shape[:-1], space.angles))], axis=-1)
