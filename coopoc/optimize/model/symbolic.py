"""Problems as CasADi expressions of their structure alone: costs of one measurement or of all, constraints."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from .factor import Factor
from .kinds import converted_rows, is_converted
from .losses import LOSSES, Loss
from .measurements import Measurement
from .space import Space

Columns = list[Any]
"""One CasADi column (M, 1) per number: a formula runs once for all M measurements, as it does on NumPy's arrays."""


class Kind(NamedTuple):
    """All that the formula of a factor's cost depends on.

    Attributes:
        measurement: of its kind.
        space: of the problem.
        full: its weight is a matrix.
        loss: rho.
    """

    measurement: Measurement
    space: Space
    full: bool = False
    loss: Loss | None = None

    @property
    def widths(self) -> tuple[int, int, int]:
        """How many numbers z, constants and weights a measurement has."""
        measurement, d = self.measurement, self.space.dimension
        return measurement.given(d), measurement.constants, measurement.size(d) ** (1 + self.full)


class Term(NamedTuple):
    """Structure of a factor or a constraint.

    Attributes:
        kind: of it.
        raw: nodes (M, arity) int64 as bytes.
        steered: (M, size) as bytes, see `steerable`; of a constraint.
    """

    kind: Kind
    raw: bytes
    steered: bytes = b""

    @property
    def nodes(self) -> Ints:
        """(M, arity)."""
        return np.frombuffer(self.raw, np.int64).reshape(-1, self.kind.measurement.arity)


class Structure(NamedTuple):
    """All of a problem that is no number: problems that share it share one solver.

    Attributes:
        nodes: n.
        space: where they live.
        still: (n, dof) as bytes, True where a node cannot move; empty: all move.
        factors: in the problem's order.
        constraints: as `factors`.
    """

    nodes: int
    space: Space
    still: bytes
    factors: tuple[Term, ...]
    constraints: tuple[Term, ...]

    @property
    def movable(self) -> Bools:
        """(n, dof) True where a node can move."""
        shape = (self.nodes, self.space.dof)
        return ~np.frombuffer(self.still, bool).reshape(shape) if self.still else np.ones(shape, dtype=bool)


def numbers_of(factor: Factor) -> Floats:
    """(P, M) or (B, P, M): z, constants and weights of the measurements of a factor."""
    weight, batch = factor.sqrt_information, () if factor.batch is None else (factor.batch,)
    if factor.std is not None:
        weight = 1.0 / factor.std
    else:
        assert weight is not None
        weight = weight.reshape(*weight.shape[:-2], -1)
    assert factor.constants is not None
    first, second = factor.z.shape[-1], factor.z.shape[-1] + factor.constants.shape[1]
    out = np.empty((*batch, second + weight.shape[-1], len(factor.nodes)))
    out[..., :first, :], out[..., first:second, :] = factor.z.swapaxes(-1, -2), factor.constants.T
    out[..., second:, :] = weight.swapaxes(-1, -2)
    return out


def expressions(structure: Structure) -> dict[str, Any]:
    """CasADi's x (the free steps), p (centres, numbers of factors, constants of constraints), f (cost) and g (what
    the constraints bound).

    A step (dp, w) moves a node from the centre to (p + dp, R C(w)), C the Cayley map in space, which like Exp starts
    as I + [w]x but is rational, and the angle itself in the plane.
    """
    import casadi as ca

    space, n = structure.space, structure.nodes
    centre = ca.SX.sym("centre", n, space.ambient)
    steps: Any = ca.SX.sym("dx", int(structure.movable.sum()))
    step: Any = ca.SX.zeros(n, space.dof)
    for k, (i, j) in enumerate(np.argwhere(structure.movable).tolist()):
        step[i, j] = steps[k]
    place, cost = _moved(space, ca.horzsplit(centre), ca.horzsplit(step)), 0.0
    numbers, bounds = list[Any](), list[Any]()
    for kind, nodes in ((term.kind, term.nodes) for term in structure.factors):
        numbers.append(ca.SX.sym("number", len(nodes), sum(kind.widths)))
        square = sum(w * w for w in _white(kind, *place, nodes, ca.horzsplit(numbers[-1])))
        cost += 0.5 * ca.sum1(_robust(square, kind.loss))
    for term in structure.constraints:
        measurement, size = term.kind.measurement, term.kind.widths[2]
        numbers.append(ca.SX.sym("number", len(term.nodes), measurement.constants))
        constants = ca.horzsplit(numbers[-1]) if measurement.constants else []
        value: Any = ca.horzcat(
            *_residual(measurement, _local(measurement, *place, term.nodes), [0.0] * size, constants)
        )
        bounds.append(ca.vec(value.T)[np.flatnonzero(np.frombuffer(term.steered, bool)).tolist()])
    return {"x": steps, "p": ca.veccat(centre, *numbers), "f": cost, "g": ca.vertcat(*bounds)}


class Cost(NamedTuple):
    """What one measurement costs, by CasADi's symbols.

    Attributes:
        nodes: (arity ambient,).
        number: (P,) see `numbers_of`.
        steps: (arity dof,) of the nodes.
        white: (size,) whitened residual.
        square: a symbol of its square.
        rho: of `square`.
    """

    nodes: Any
    number: Any
    steps: Any
    white: Any
    square: Any
    rho: Any


def cost_of(kind: Kind, converted: bool) -> Cost:
    """The cost of one measurement; of converted ones those without a linear form have no residual.

    Raises:
        InputError: CasADi cannot run the formula.
    """
    import casadi as ca

    measurement, space = kind.measurement, kind.space
    nodes = ca.SX.sym("nodes", measurement.arity * space.ambient)
    steps = ca.SX.sym("steps", measurement.arity * space.dof)
    number: Any = ca.SX.sym("number", sum(kind.widths))
    square = ca.SX.sym("square")
    rows = [ca.horzsplit(ca.reshape(v, width, -1).T) for v, width in ((nodes, space.ambient), (steps, space.dof))]
    vectors = converted and is_converted(measurement)
    try:
        place = _moved(space, *rows)
        given: Columns = [number[k] for k in range(number.numel())]
        white: Any = ca.vertcat(*_white(kind, *place, np.arange(measurement.arity)[None], given, vectors))
    except Exception as problem:  # the formula is the user's, who must learn what it raised
        hint, why = "Take its functions from the namespace m, such as m.sqrt.", " ".join(str(problem).split())[:80]
        raise InputError("kind", repr(measurement.name), f"must run on CasADi's numbers: {why}", hint) from problem
    if converted and not (vectors or measurement.linear):
        white = ca.SX(white.numel(), 1)
    return Cost(nodes, number, steps, white, square, _robust(square, kind.loss))


def _white(
    kind: Kind, at: Columns, turned: list[Columns], nodes: Ints, number: Columns, converted: bool = False
) -> Columns:
    """Whitened residuals, one column per component; `converted`: those of `converted_rows`."""
    measurement, (given, constants, _) = kind.measurement, kind.widths
    z, assumed, weight = number[:given], number[given : given + constants], number[given + constants :]
    local = _local(measurement, at, turned, nodes)
    gap = _converted(local, z) if converted else _residual(measurement, local, z, assumed)
    size = len(gap)
    if not kind.full:
        return [g * w for g, w in zip(gap, weight, strict=True)]
    return [sum(weight[size * k + j] * gap[j] for j in range(size)) for k in range(size)]


def _converted(vector: Columns, z: Columns) -> Columns:
    d, rows = converted_rows(z, _namespace())
    along, *across = (sum(a * v for a, v in zip(row, vector, strict=True)) for row in rows)
    return [along - d, *across]


def _robust(square: Any, loss: Loss | None) -> Any:
    """rho of the squared residual; that of a truncated loss has a kink, with nothing beyond."""
    return square if loss is None else LOSSES[loss.name][0](square, loss.scale, _namespace())


def _namespace() -> Any:
    """CasADi as the namespace of a formula."""
    import casadi as ca

    return SimpleNamespace(
        sqrt=ca.sqrt,
        sin=ca.sin,
        cos=ca.cos,
        atan2=ca.atan2,
        log1p=ca.log1p,
        fabs=ca.fabs,
        fmax=ca.fmax,
        where=ca.if_else,
        remainder=ca.remainder,
    )


def _moved(space: Space, centre: Columns, step: Columns) -> tuple[Columns, list[Columns]]:
    """Columns of the positions and of the rotations (d rows of d) after the steps."""
    d = space.dimension
    at = [centre[k] + step[k] for k in range(d)]
    if not space.has_rotation:
        return at, []
    turn = _chart(step[d:])
    start = [centre[d + d * i : 2 * d + d * i] for i in range(d)]
    return at, _product(start, turn)


def _chart(w: Columns) -> list[Columns]:
    import casadi as ca

    if len(w) == 1:
        c, s = ca.cos(w[0]), ca.sin(w[0])
        return [[c, -s], [s, c]]
    x, y, z = w
    zero = 0.0 * x
    skew = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    twice = _product(skew, skew)
    share = 1.0 / (1.0 + 0.25 * (x * x + y * y + z * z))
    return [[float(i == j) + share * (skew[i][j] + 0.5 * twice[i][j]) for j in range(3)] for i in range(3)]


def _product(a: list[Columns], b: list[Columns]) -> list[Columns]:
    return [[sum(a[i][k] * b[k][j] for k in range(len(b))) for j in range(len(b[0]))] for i in range(len(a))]


def _local(measurement: Measurement, at: Columns, turned: list[Columns], nodes: Ints) -> Columns:
    """Inputs of the formula as by `local`: the vector's columns and, if the frame is relative, the rotation's."""
    first, last = nodes[:, 0].tolist(), nodes[:, -1].tolist()
    vector = [c[last] - c[first] if measurement.arity == 2 else c[last] for c in at]
    if measurement.frame == "world":
        return vector
    body = [[c[first] for c in row] for row in turned]
    if measurement.arity == 1:
        return [*vector, *(c for row in body for c in row)]
    back = [list(column) for column in zip(*body, strict=True)]
    vector = [row[0] for row in _product(back, [[v] for v in vector])]
    if measurement.frame == "body":
        return vector
    other = [[c[last] for c in row] for row in turned]
    return [*vector, *(c for row in _product(back, other) for c in row)]


def _residual(measurement: Measurement, local: Columns, z: Columns, constants: Columns) -> Columns:
    """h - z, angles in [-pi, pi]: the derivative of the remainder is 1."""
    m, dimension = _namespace(), 2 if len(local) in (2, 6) else 3
    parts = measurement.residual(local, z, constants, m)
    return [
        m.remainder(part, 2.0 * np.pi) if angle else part
        for part, angle in zip(parts, measurement.angles(dimension), strict=True)
    ]
