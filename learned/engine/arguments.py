"""Arguments of the compiled kernels, by name.

Import this module by its full name: numba's cache finds the classes again under it.
"""

from __future__ import annotations

from typing import NamedTuple

from coopoc.arrays import AnyArray, Bools, Floats, Ints


class Matrices(NamedTuple):
    """Layers of nets of one shape, and whether the matrix of each is transposed: of all, of none, of the tall ones.

    Attributes:
        layers: (layers, 11) as in `tape.Net`.
        transposed: (3, layers) whether the matrix is transposed.
        places: (3, P) index in the padded matrices of each number of theta.
    """

    layers: Ints
    transposed: Bools
    places: AnyArray


class Drives(NamedTuple):
    """Inputs of a rollout: gnss (T, S, B, 3) m, velocity (T, S, B, 3) m/s, x0 (S, B, 3) m, dt (T,) s."""

    gnss: Floats
    velocity: Floats
    x0: Floats
    dt: Floats


class Memory(NamedTuple):
    """Sizes of a kernel's memory: fields of the tape and of the deltas; lengths of the matrices, of the tape for all
    steps, of the tape for `slots` steps, of the deltas."""

    fields: Ints
    delta_fields: Ints
    padded: int
    kept: int
    passing: int
    waiting: int
    slots: int


class Moments(NamedTuple):
    """Weights, where their training started, mean gradient and mean squared gradient, each (S, P), or (P,) of one."""

    theta: Floats
    began: Floats
    first: Floats
    second: Floats


class Update(NamedTuple):
    """An optimiser step of the models `rows` (R,): its number, learning rates (R,), decoupled decay, gamma, mu, clip.

    Step 0 computes losses and gradients only, step -1 gradients only, for a given gradient in the estimates.
    """

    rows: Ints
    step: int
    rates: Floats
    decay: float
    l2: float
    proximal: float
    limit: float


class Found(NamedTuple):
    """Outputs of a step: gradients (R, P), losses (R,), whether both are finite (R,)."""

    gradient: Floats
    losses: Floats
    finite: Bools
