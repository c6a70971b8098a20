"""Space: where the nodes of a problem live, and how a small step moves them."""

from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, check_turns, checked, refuse, whole
from ...errors import InputError
from ...formats.values import to_orientation


@dataclass(frozen=True)
class Space:
    """Points of dimension d, or poses too: a node is `ambient` numbers, and moves in `dof` directions.

    A point is its position (d,) m. Where there are poses (`has_rotation`) every node is its position and then its
    rotation matrix row by row, d + d^2 numbers, the identity for points. A step (dp, w) moves it to
    (p + dp, R Exp(w)): dp in world coordinates, m, and w in the body's, rad.

    Args:
        dimension: 2 or 3.
        has_rotation: some nodes have a rotation.

    >>> Space(3, has_rotation=True).ambient, Space(3, has_rotation=True).dof
    (12, 6)
    """

    dimension: int = 3
    has_rotation: bool = False

    def __post_init__(self) -> None:
        whole("dimension", self.dimension, 2, 3, "Roads are flat (2) or not (3).")

    @property
    def ambient(self) -> int:
        """Numbers per node."""
        return self.dimension + self.has_rotation * self.dimension**2

    @property
    def angles(self) -> int:
        """Directions in which a pose turns."""
        return self.has_rotation * (1 if self.dimension == 2 else 3)

    @property
    def dof(self) -> int:
        """Directions in which a node moves."""
        return self.dimension + self.angles

    def position(self, x: Floats) -> Floats:
        """(..., d) m of nodes (..., ambient)."""
        return x[..., : self.dimension]

    def rotation(self, x: Floats) -> Floats:
        """(..., d, d) of nodes (..., ambient)."""
        d = self.dimension
        if not self.has_rotation:
            return np.broadcast_to(np.eye(d), (*x.shape[:-1], d, d))
        return x[..., d:].reshape(*x.shape[:-1], d, d)

    def join(self, position: Floats, rotation: Floats | None = None) -> Floats:
        """Nodes (..., ambient) from positions (..., d) and rotations (..., d, d), default the identity."""
        if not self.has_rotation:
            return np.asarray(position, float)
        turned = np.eye(self.dimension) if rotation is None else np.asarray(rotation, float)
        flat = turned.reshape(*turned.shape[:-2], self.dimension**2)
        return np.concatenate([position, np.broadcast_to(flat, (*np.shape(position)[:-1], flat.shape[-1]))], axis=-1)

    def retract(self, x: Floats, step: Floats) -> Floats:
        """Nodes (..., ambient) after a step (..., dof): p + dp, R Exp(w)."""
        if not self.has_rotation:
            return x + step
        d = self.dimension
        return self.join(x[..., :d] + step[..., :d], self.rotation(x) @ exp(step[..., d:]))


def carried(space: Space, x: Floats, before: Floats, after: Floats) -> Floats:
    """Nodes x (..., ambient) moved as the rigid body that takes a pose from `before` (ambient,) to `after`.

    >>> carried(Space(2, True), pose([3.0, 0.0]), pose([1.0, 0.0]), pose([1.0, 0.0], np.pi / 2)).round(3)[:2]
    array([1., 2.])
    """
    turn = space.rotation(after) @ space.rotation(before).T
    gap = space.position(x) - space.position(before)
    return space.join(space.position(after) + gap @ turn.T, turn @ space.rotation(x))


def exp(w: Floats) -> Floats:
    """Rotation matrices (..., 2, 2) of angles (..., 1), or (..., 3, 3) of rotation vectors (..., 3), rad.

    Exp(w) = I + sin|w|/|w| [w]x + (1 - cos|w|)/|w|^2 [w]x^2 (Rodrigues).

    >>> exp(np.array([np.pi / 2])).round(3)
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    if w.shape[-1] == 1:
        c, s = np.cos(w), np.sin(w)
        return np.concatenate([c, -s, s, c], axis=-1).reshape(*w.shape[:-1], 2, 2)
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(np.array(w).reshape(-1, 3)).as_matrix()  # which takes nothing read-only
    return np.asarray(flat).reshape(*w.shape, 3)


def log(rotation: Floats) -> Floats:
    """Angles (..., 1) or rotation vectors (..., 3), rad, of rotation matrices (..., d, d): the inverse of `exp`."""
    if rotation.shape[-1] == 2:
        return to_orientation(rotation)
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()).reshape(*rotation.shape[:-2], 3)


def nearest_rotation(matrix: Floats) -> Floats:
    """The nearest rotations (..., d, d), by singular values.

    >>> nearest_rotation(np.array([[0.0, -2.0], [2.0, 0.0]])).round(6) + 0.0
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    left, _, right = np.linalg.svd(matrix)
    left[..., :, -1] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


MAX_ANGLE = 1e6
"""rad, beyond which the sine of an angle keeps too few digits to be one of a heading."""


def pose(position: Floats, turn: Floats | float = 0.0) -> Floats:
    """Poses (..., d + d^2) from positions (..., d) m and headings (...) rad in 2-D or rotation vectors (..., 3) in 3-D.

    >>> pose([1.0, 2.0], np.pi / 2).round(3) + 0.0
    array([ 1.,  2.,  0., -1.,  1.,  0.])
    """
    at, w = checked("position", position), checked("turn", turn)
    refuse("turn", w, ~(abs(w) <= MAX_ANGLE), "must be finite, at most 10^6 rad", "Give rad.")
    check_turns("turn", w)
    if not at.ndim or at.shape[-1] not in (2, 3):
        allowed = "must have shape (..., 2) or (..., 3)"
        raise InputError("position", f"shape {at.shape}", allowed, "Give x, y or x, y, z of each.")
    space = Space(at.shape[-1], has_rotation=True)
    wanted = at.shape[:-1] if space.dimension == 2 else (*at.shape[:-1], 3)
    try:
        turns = np.broadcast_to(w, wanted)
    except ValueError:
        hint = "A heading for each position in the plane, a rotation vector in space."
        raise InputError("turn", f"shape {w.shape}", f"must fit to {wanted}", hint) from None
    return space.join(at, exp(turns.reshape(*at.shape[:-1], space.angles)))
